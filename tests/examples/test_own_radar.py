"""The example of another radar: its reader, its config, and a whole run."""

import json

import own_radar
import pytest
from click.testing import CliRunner


@pytest.mark.slow
@pytest.mark.usefixtures("commands_on_one_device")
def test_a_simulated_recording_is_trained_evaluated_and_drawn(tmp_path):
    root, run = tmp_path / "data", tmp_path / "run"
    arguments = [str(root), "--workdir", str(run), "--drives", "120", "--epochs", "1"]
    result = CliRunner().invoke(own_radar.main, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert len(list((root / "radar").glob("*.npy"))) == 120
    assert (root / "frame.png").stat().st_size > 10_000
    assert (run / "evaluation" / "scenes.png").stat().st_size > 10_000
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text())
    assert metrics["options"]["classes"] == ["car", "truck"]
