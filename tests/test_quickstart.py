"""A small quickstart through its commands, uninterrupted and killed."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from click.testing import CliRunner

from radejax.cli import main
from radejax.inference.saved import load_model

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

REPOSITORY = pathlib.Path(__file__).resolve().parents[1]
OVERRIDES = [
    "--config=configs/quickstart.py:short",
    "--config.simulation.train_sequences=2",
    "--config.simulation.frames_per_sequence=6",
    "--config.model.widths=(8,8,16)",
    "--config.model.decoder_width=8",
    "--config.model.num_groups=4",
    "--config.train.num_epochs=4",
    "--config.train.checkpoint_every_steps=1",
    "--config.evaluation.num_visualizations=1",
]


def _environment():
    return {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONUNBUFFERED": "1"}


def _start(folder, *more):
    command = [sys.executable, "train.py", *OVERRIDES, *more]
    command += [f"--workdir={folder / 'run'}", f"--data={folder / 'data'}"]
    return subprocess.Popen(
        command,
        cwd=REPOSITORY,
        env=_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _finish(process):
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    return output


def _radejax(*arguments):
    """`evaluate.py` is `radejax evaluate`."""
    return CliRunner().invoke(main.main, [str(argument) for argument in arguments])


def _metrics(folder):
    path = folder / "run" / "evaluation" / "metrics.json"
    metrics = json.loads(path.read_text())
    del metrics["date"]
    return metrics


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """An uninterrupted run: its folder and its output."""
    folder = tmp_path_factory.mktemp("undisturbed")
    return folder, _finish(_start(folder))


def test_from_an_empty_folder_to_metrics_and_figures(undisturbed):
    folder, output = undisturbed
    stages = ("simulate", "preprocess", "train", "detect", "Done in")
    assert all(line in output for line in stages)
    report = folder / "run" / "evaluation"
    worst = _metrics(folder)["worst_frames"]
    drawn = {path.name for path in (report / "worst_frames").iterdir()}
    assert drawn == {f"{x['sequence']:02d}_{x['name']}.png" for x in worst}
    tables = (report / "tables.md").read_text()
    titles = [line for line in tables.splitlines() if line.startswith("**")]
    assert titles
    assert all(title.startswith("**Simulated data: ") for title in titles)
    assert any((report / "figures").iterdir())
    assert not list(folder.rglob("*.tmp"))
    expected = load_model(folder / "run")
    found = load_model(folder / "run" / "checkpoints")
    assert (found.grid, found.config) == (expected.grid, expected.config)
    jax.tree.map(np.testing.assert_array_equal, found.variables, expected.variables)


def test_evaluate_reproduces_the_table_and_detect_writes_boxes(undisturbed):
    folder, _ = undisturbed
    first = _metrics(folder)
    # A process of its own: to the last digit on as many devices as in training.
    subprocess.run(
        [sys.executable, "evaluate.py", f"--workdir={folder / 'run'}"],
        cwd=REPOSITORY,
        env=_environment(),
        check=True,
        capture_output=True,
        timeout=600,
    )
    assert _metrics(folder) == first
    words = [folder / "data" / "3", "--workdir", folder / "run"]
    words += ["--out", folder / "boxes", "--score-threshold", "0", "--json"]
    done = _radejax("detect", *words)
    assert json.loads(done.stdout)["frames"] == 6
    assert len(list((folder / "boxes").glob("3_*.json"))) == 6


def _simulating(folder):
    return any((folder / "data").glob("2/info_label_v2_1/*.txt"))


def _preprocessing(folder):
    return (folder / "data" / "records" / "manifest.json").exists()


def _training(folder):
    checkpoints = folder / "run" / "checkpoints"
    steps = checkpoints.glob("[0-9]*")
    return any(path.name.isdigit() and int(path.name) >= 2 for path in steps)


def _evaluating(folder):
    """Whether an evaluation is running; it writes a temporary folder and moves its content."""
    return any((folder / "run").glob("evaluation/*.tmp"))


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("stage", [_simulating, _preprocessing, _training, _evaluating])
def test_killed_at_any_stage_it_ends_in_the_same_digits(stage, undisturbed, tmp_path):
    process = _start(tmp_path)
    while not stage(tmp_path):
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    evaluation = tmp_path / "run" / "evaluation" / "metrics.json"
    assert not evaluation.exists(), "killed too late to show anything"
    _finish(_start(tmp_path))
    assert _metrics(tmp_path) == _metrics(undisturbed[0])
