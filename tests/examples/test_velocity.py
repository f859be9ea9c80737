"""The example of an own output: its config, its metrics, and a whole run."""

import json

import pytest
import velocity
from click.testing import CliRunner


@pytest.mark.slow
@pytest.mark.usefixtures("commands_on_one_device")
def test_a_whole_run(tmp_path, monkeypatch):
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
