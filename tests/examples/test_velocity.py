"""The example of an own output: its config, its metrics, and a whole run."""

import json
import pathlib

import numpy as np
import pytest
import velocity
from click.testing import CliRunner

from radejax import models
from radejax.core.structures import Boxes


def test_the_config_names_the_functions_of_the_example() -> None:
    config = velocity.get_config("short")
    config.check_imports()
    assert config.loss.weights["velocity_loss"] == 4.0
    assert config.loss.weights["focal"] == 8.0
    assert dict(models.build(config.model).options.outputs) == {"velocity": 2}


def test_only_objects_that_move_over_ground_count_as_moving() -> None:
    def boxes(**extras: np.ndarray) -> Boxes:
        frame, names = np.zeros(2, np.int64), np.array(["Sedan"] * 2)
        return Boxes(frame, np.ones((2, 7)), names, extras=extras)

    found = boxes(velocity=np.array([[3.0, 4.0], [1.0, 0.0]]))
    truth = boxes(velocity_mps=np.zeros((2, 2)), speed_mps=np.array([0.2, 9.0]))
    assert velocity.velocity_error_mps(found, truth).tolist() == [5.0, 1.0]
    error = velocity.moving_error_mps(found, truth)
    np.testing.assert_array_equal(error, [np.nan, 1.0])


@pytest.mark.slow
@pytest.mark.usefixtures("commands_on_one_device")
def test_a_whole_run(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(velocity.main, ["--workdir", "run", "--preset", "short"])
    assert done.exit_code == 0, done.output
    metrics = json.loads((tmp_path / "run/evaluation/metrics.json").read_text())
    assert metrics["options"]["metrics"][0] == "velocity:velocity_error_mps"
    assert "moving_error_mps_median" in metrics["box_errors"]["Sedan"]
    table = (tmp_path / "run/evaluation/report.txt").read_text()
    assert "Velocity error mps" in table
    rows = (tmp_path / "run/metrics.jsonl").read_text().splitlines()
    assert json.loads(rows[0])["velocity_loss"] > 0
    assert (tmp_path / "run/velocity.png").stat().st_size > 50_000
