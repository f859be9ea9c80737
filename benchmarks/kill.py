"""Kills a short run with SIGKILL at random moments; the final digits must not change.

    python benchmarks/kill.py --kills 20 [--seed 0] [--workdir DIR]

First an undisturbed run, then the same one killed again and again: every start gets a
random time to live, up to that of a whole start. Compared are all parameters, bit for
bit, the logged losses and the metrics of the evaluation.
"""

import argparse
import collections
import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time

import jax
import numpy as np

from radejax.experiment import load_run

REPOSITORY = pathlib.Path(__file__).resolve().parents[1]
OVERRIDES = [
    "--config=configs/quickstart.py:short",
    "--config.simulation.train_sequences=2",
    "--config.simulation.frames_per_sequence=5",
    "--config.model.widths=(8,8,8)",
    "--config.model.decoder_width=8",
    "--config.model.num_groups=4",
    "--config.model.cbam=off",
    "--config.model.neck=plain",
    "--config.model.heads=default",
    "--config.train.checkpoint_every_steps=7",
    "--config.train.log_every_steps=5",
    "--config.evaluation.num_pictures=0",
    "--config.evaluation.protocols=('exact',)",
]


def start(folder, run, steps):
    command = [sys.executable, "train.py", *OVERRIDES, f"--workdir={folder / run}"]
    command += [f"--data={folder / 'data'}", f"--config.train.num_epochs={steps // 2}"]
    return subprocess.Popen(
        command,
        cwd=REPOSITORY,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.DEVNULL,
        stderr=(folder / f"{run}.log").open("a"),
    )


def finish(process):
    if process.wait() != 0:
        raise SystemExit(f"the run ended with exit code {process.returncode}")


def stage(folder):
    """What a killed run had reached."""
    if (folder / "evaluation").exists():
        return "evaluation"
    steps = [p.name for p in (folder / "checkpoints").glob("*") if p.name.isdigit()]
    return f"step {max(map(int, steps))}" if steps else "before the first checkpoint"


def same(folder, a, b):
    """Names of what is not equal."""
    different = []
    variables = [load_run(folder / run).variables for run in (a, b)]
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
        values.pop("run")
        values["options"].pop("run")
    different += ["metrics"] * (metrics[0] != metrics[1])
    return different


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workdir", type=pathlib.Path)
    arguments = parser.parse_args()
    folder = arguments.workdir or pathlib.Path(tempfile.mkdtemp(prefix="radejax-kill-"))
    folder.mkdir(parents=True, exist_ok=True)
    finish(start(folder, "undisturbed", arguments.steps))
    begin = time.perf_counter()
    finish(start(folder, "warm", arguments.steps))  # data and programs are there now
    whole = time.perf_counter() - begin
    sys.stdout.write(f"an undisturbed run takes {whole:.1f} s\n")
    moments = random.Random(arguments.seed)
    stages, kills = collections.Counter(), 0
    while kills < arguments.kills:
        process = start(folder, "killed", arguments.steps)
        try:
            process.wait(timeout=moments.uniform(0.0, whole))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
            stages[stage(folder / "killed")] += 1
            sys.stdout.write(f"kill {kills}: {stage(folder / 'killed')}\n")
            sys.stdout.flush()
    finish(start(folder, "killed", arguments.steps))
    different = same(folder, "undisturbed", "killed")
    sys.stdout.write(f"{kills} kills; reached when killed: {dict(stages)}\n")
    if different:
        raise SystemExit(f"not equal to the undisturbed run: {', '.join(different)}")
    sys.stdout.write(
        "parameters, losses and metrics equal those of the undisturbed run\n"
    )


if __name__ == "__main__":
    main()
