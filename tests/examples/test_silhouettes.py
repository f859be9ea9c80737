"""The oracle images: both runs have the same scenes, and the condition for success."""

import dataclasses
import pathlib
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from radejax.config import load_module
from radejax.evaluation.comparison import Comparison
from radejax.evaluation.report import write_report
from radejax.evaluation.results import ReportOptions
from radejax.runs import experiment

ROOT = pathlib.Path(__file__).resolve().parents[2]
silhouettes = load_module(ROOT / "examples" / "silhouettes.py")


def _run(score_of_camera: float, seen: list[Any]) -> Any:
    """Replaces a training: every frame has an object, and the radar detects every other one."""

    def run(config: Any, workdir: pathlib.Path) -> pathlib.Path:
        seen.append(config)
        frame = np.arange(40)
        box = np.tile([20.0, 0, 0, 4, 2, 1.5, 0], (40, 1))
        truth = {"frame": frame, "box": box, "cls": np.full(40, "Sedan")}
        is_found = (frame % 2 == 0) | (workdir.name == "camera")
        found = {key: column[is_found] for key, column in truth.items()}
        found["score"] = np.where(frame % 2 == 0, 0.9, score_of_camera)[is_found]
        frames = {"frame": frame, "sequence": frame, "simulated": np.full(40, True)}
        write_report(
            truth, found, frames, workdir / "evaluation",
            ReportOptions(iou_thresholds=(0.3,), protocols=("all_point",), plots=False),
        )  # fmt: skip
        return workdir

    return run


@pytest.mark.parametrize(("score", "exit_code"), [(0.5, 0), (0.0, 1)])
def test_both_runs_see_the_same_scenes_and_the_gain_decides(
    score: float,
    exit_code: int,
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(experiment, "run", _run(score, seen))
    arguments = ["--workdir", str(tmp_path), "--resamples", "50", "--seed", "3"]
    result = CliRunner().invoke(silhouettes.main, arguments)
    assert result.exit_code == exit_code, result.output
    assert ("yes" if exit_code == 0 else "no") in result.output.splitlines()[-1]
    radar, camera = seen
    assert (radar.model.name, camera.model.name) == ("radenet", "dinorade")
    assert radar.simulation == camera.simulation
    assert camera.simulation.camera_mode == "oracle"
    assert radar.seed == camera.seed == 3


def test_a_gain_that_chance_explains_does_not_meet_the_bar() -> None:
    row = dict.fromkeys([field.name for field in dataclasses.fields(Comparison)])
    row |= {"cls": "mean", "difference": 9.0, "low": -0.5}
    assert not silhouettes.is_met([Comparison(**row)])
    assert silhouettes.is_met([Comparison(**row | {"low": 0.5})])
    assert not silhouettes.is_met([Comparison(**row | {"low": 0.5, "difference": 2.9})])
