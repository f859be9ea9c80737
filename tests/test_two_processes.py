"""Two processes that train one model together, against one process with two devices."""

import json
import shutil
import signal
import time

import chex
import numpy as np
import pytest

from radejax.config import load_config
from radejax.inference.saved import load_model
from radejax.training.checkpoints import Checkpoints

from . import processes
from . import small_models as small

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

MIDDLE = 3  # of six steps


def _config():
    return small.shrink_run(load_config("quickstart:short")).replace(
        simulation={"train_sequences": 2, "frames_per_sequence": 5},
        model={"cbam": "off"},
        train={
            "num_epochs": 3,
            "log_every_steps": 1,
            "checkpoint_every_steps": 3,
            "checkpoints_to_keep": 9,
        },
        evaluation={"num_visualizations": 0, "batch_size": 3},
    )


def _start(folder, run, num_processes, *overrides):
    """Start train.py on two devices, in one process or in two."""
    config = small.write_config(folder / "config.py", _config())
    places = [f"--workdir={folder / run}", f"--data={folder / 'data'}"]
    command = ["train.py", f"--config={config}", *overrides, *places]
    return processes.start(num_processes, *command, num_devices=2 // num_processes)


def _train(folder, run, num_processes, *overrides):
    started = _start(folder, run, num_processes, *overrides)
    outputs = processes.outputs_of(started, timeout_s=900)
    for process in started:
        assert process.returncode == 0, "\n".join(outputs)
    assert "Done in" in outputs[0]
    assert not any("Done in" in output for output in outputs[1:])


def _cut(folder, run, to):
    """Copy of a run in the state of its middle."""
    shutil.copytree(folder / run, folder / to)
    for path in (folder / to / "checkpoints").iterdir():
        if path.name.isdigit() and int(path.name) > MIDDLE:
            shutil.rmtree(path)
    shutil.rmtree(folder / to / "evaluation")


def _losses(folder):
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    rows = [row for row in map(json.loads, lines) if "focal" in row]
    names = ("focal", "gwd", "smooth_l1", "grad_norm")
    return [(row["step"], [row[name] for name in names]) for row in rows]


def _aps(folder):
    rows = (folder / "evaluation" / "metrics.csv").read_text().splitlines()
    return [row.split(",")[1:] for row in rows[1:]]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Folder with the runs "one" and "two", each also resumed by the other number of processes."""
    folder = tmp_path_factory.mktemp("processes")
    _train(folder, "two", 2)
    _train(folder, "one", 1)
    _cut(folder, "two", "two_then_one")
    _train(folder, "two_then_one", 1)
    _cut(folder, "one", "one_then_two")
    _train(folder, "one_then_two", 2)
    return folder


@pytest.mark.parametrize("run", ["two", "two_then_one", "one_then_two"])
def test_two_processes_equal_one(runs, run):
    expected, actual = _losses(runs / "one"), _losses(runs / run)
    assert [step for step, _ in actual] == list(range(1, 7))
    np.testing.assert_allclose(
        [v for _, v in actual], [v for _, v in expected], rtol=1e-5
    )
    chex.assert_trees_all_close(
        load_model(runs / run).variables, load_model(runs / "one").variables, atol=1e-6
    )
    assert _aps(runs / run) == _aps(runs / "one")


def test_two_processes_run_several_seeds_and_evaluate_on_the_way(runs):
    # The second process must not read files that the first one is still writing.
    _train(
        runs,
        "seeds",
        2,
        "--seeds=0,1",
        "--config.train.evaluate_every_epochs=2",
        "--config.logging.num_visualizations=2",
        "--config.evaluation.num_visualizations=2",
    )
    assert _losses(runs / "seeds" / "seed0") == _losses(runs / "two")
    rows = json.loads((runs / "seeds" / "seeds.json").read_text())
    assert set(rows[0]["values"]) == {"0", "1"}


def test_only_one_process_writes(runs):
    files = [path.suffix for path in (runs / "two" / "tensorboard").iterdir()]
    assert files.count(".test") == len(files) - 1 == 1  # of the training and the report
    assert not list(runs.rglob("*.tmp"))


def _start_long(folder, run):
    """Start a long training in two processes, and wait for its first steps."""
    long = [
        "--config.train.num_epochs=2000",
        "--config.train.checkpoint_every_steps=9999",
    ]
    started = _start(folder, run, 2, *long)
    path = folder / run / "metrics.jsonl"
    while not path.exists() or len(_losses(folder / run)) < MIDDLE:
        time.sleep(0.1)
        assert all(process.poll() is None for process in started)
    return started


@pytest.mark.parametrize("name", ["SIGTERM", "SIGUSR1", "SIGHUP"])
def test_a_signal_to_one_process_stops_both_with_a_checkpoint(runs, name):
    started = _start_long(runs, name)
    started[1].send_signal(signal.Signals[name])
    outputs = processes.outputs_of(started, timeout_s=120)
    assert [process.returncode for process in started] == [0, 0], "\n".join(outputs)
    step = _losses(runs / name)[-1][0]
    assert f"stopped at step {step}; run the same command" in outputs[0]
    with Checkpoints(runs / name / "checkpoints", read_only=True) as checkpoints:
        assert checkpoints.steps()[-1] == step
