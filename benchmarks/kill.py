"""Kills a short run with SIGKILL at random moments and checks that its results do not change.

    python benchmarks/kill.py --kills 20 [--seed 0] [--workdir DIR]

After an uninterrupted run, the same run is started and killed again and again. Each kill comes
after a random time of up to the duration of a whole run, or of `--longest` seconds. A run that ends
before it is killed is compared, and another one begins. All parameters, the logged losses and the
metrics of the evaluation must be equal to those of the uninterrupted run.

The uninterrupted run simulates and preprocesses the data, so that no kill interrupts these stages,
and there is no evaluation during training. `tests/test_quickstart.py` kills at all stages.
"""

import argparse
import collections
import json
import multiprocessing
import pathlib
import random
import sys
import tempfile
import time

import jax
import numpy as np

from radejax.cli import entry
from radejax.config import load_module
from radejax.inference.saved import load_model
from radejax.runs import experiment

REPOSITORY = pathlib.Path(__file__).resolve().parents[1]

# Every start forks a process that has already imported the modules, as imports are not tested.
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(
    ["radejax.cli.entry", "radejax.runs.evaluate", "radejax.simulation.dataset"]
)


def make_config(steps):
    """Returns a quickstart config that is so small that starting takes longer than training."""
    path = REPOSITORY / "configs" / "quickstart.py"
    module = load_module(path)
    return module.get_config("short").replace(
        simulation={"train_sequences": 2, "frames_per_sequence": 5},
        model={
            "widths": (8, 8, 8),
            "decoder_width": 8,
            "num_groups": 4,
            "cbam": "off",
            "neck": "plain",
            "heads": "default",
        },
        # Ten frames are two steps per epoch, as incomplete batches are dropped.
        train={
            "num_epochs": steps // 2,
            "checkpoint_every_steps": 7,
            "log_every_steps": 5,
        },
        evaluation={"num_visualizations": 0, "protocols": ("all_point",)},
    )


def run(folder, name, steps):
    """Trains and evaluates in a child process, which writes its output into a log file."""
    sys.stdout = sys.stderr = (folder / f"{name}.log").open("a")
    jax.config.update("jax_platforms", "cpu")
    entry.set_up_jax()
    config = make_config(steps).replace(data={"roots": (str(folder / "data"),)})
    experiment.run(config, folder / name)


def start(folder, name, steps):
    process = PROCESSES.Process(target=run, args=(folder, name, steps))
    process.start()
    return process


def finish(process):
    process.join()
    if process.exitcode != 0:
        raise SystemExit(f"the run ended with exit code {process.exitcode}")


def stage(folder):
    """Returns the stage that a killed run had reached."""
    if (folder / "evaluation").exists():
        return "evaluation"
    steps = [p.name for p in (folder / "checkpoints").glob("*") if p.name.isdigit()]
    return f"step {max(map(int, steps))}" if steps else "before the first checkpoint"


def same(folder, a, b):
    """Returns the kinds of results that differ between two runs."""
    different = []
    variables = [load_model(folder / run).variables for run in (a, b)]
    equal = jax.tree.map(np.array_equal, *variables)
    different += ["parameters"] * (not all(jax.tree.leaves(equal)))
    losses = [
        [
            (row["step"], row["focal"], row["gwd"], row["smooth_l1"])
            for row in map(json.loads, (folder / run / "metrics.jsonl").open())
        ]
        for run in (a, b)
    ]
    different += ["losses"] * (losses[0] != losses[1])
    metrics = [
        json.loads((folder / run / "evaluation" / "metrics.json").read_text())
        for run in (a, b)
    ]
    for values in metrics:
        del values["run"], values["date"]
    different += ["metrics"] * (metrics[0] != metrics[1])
    return different


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workdir", type=pathlib.Path)
    parser.add_argument("--longest", type=float, help="seconds to live at most")
    arguments = parser.parse_args()
    folder = arguments.workdir or pathlib.Path(tempfile.mkdtemp(prefix="radejax-kill-"))
    folder.mkdir(parents=True, exist_ok=True)
    finish(start(folder, "undisturbed", arguments.steps))
    whole = arguments.longest
    if whole is None:
        begin = time.perf_counter()
        finish(
            start(folder, "warm", arguments.steps)
        )  # data and compiled programs exist
        whole = time.perf_counter() - begin
        sys.stdout.write(f"an undisturbed run takes {whole:.1f} s\n")
    moments = random.Random(arguments.seed)
    stages, kills, runs = collections.Counter(), 0, 0
    while kills < arguments.kills:
        process = start(folder, f"killed{runs}", arguments.steps)
        process.join(timeout=moments.uniform(0.0, whole))
        if process.is_alive():
            process.kill()
            process.join()
            kills += 1
            reached = stage(folder / f"killed{runs}")
            stages[reached] += 1
            sys.stdout.write(f"kill {kills}: {reached}\n")
            sys.stdout.flush()
        else:
            compare(folder, process, f"killed{runs}")
            runs += 1
    process = start(folder, f"killed{runs}", arguments.steps)
    process.join()
    compare(folder, process, f"killed{runs}")
    sys.stdout.write(
        f"{kills} kills of {runs + 1} runs, all equal to the undisturbed one in "
        f"parameters, losses and metrics; reached when killed: {dict(stages)}\n"
    )


def compare(folder, process, name):
    """Exits if a run failed or differs from the uninterrupted one; waits for its end first."""
    finish(process)
    different = same(folder, "undisturbed", name)
    if different:
        raise SystemExit(f"{name} is not the undisturbed run: {', '.join(different)}")
    sys.stdout.write(f"{name} ended, equal to the undisturbed run\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
