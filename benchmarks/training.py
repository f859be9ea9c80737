"""Training: memory of a step, frames a second, waiting for data, more devices.

    python benchmarks/training.py memory [--batch 1 2 4 8 16]   # compiles, runs nothing
    python benchmarks/training.py speed [--steps 4] [--batch 2] # full size, one device
    python benchmarks/training.py scaling [--devices 1 2 4]     # fake CPU devices, narrow

`memory` is what XLA plans for the backend at hand: arguments (parameters, moments, one
batch) and temporaries of one optimizer step of RADE-Net at full size. `speed` and
`scaling` run `radejax.training.loop.train` on records in a temporary folder.
"""

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np
from tabulate import tabulate

from radejax import models
from radejax.core.config import base_config
from radejax.core.structures import Batch
from radejax.data.frame_table import make_table
from radejax.data.pipeline import LoaderOptions, make_loader
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.radenet import REMAT
from radejax.training import loop, sharding
from radejax.training.start import Plan
from radejax.training.state import create_state, make_optimizer
from radejax.training.step import make_train_step

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from pipeline import make_frames, write_records

GIB = 2**30


def step_memory(config, batch_size):
    """Bytes of arguments and temporaries of one compiled step, and seconds to compile."""
    grid, model = RadarGrid.kradar(), models.build(config.model)
    optimizer = make_optimizer(lambda _: 1e-3, weight_decay=0.01)

    def init():
        x = jnp.zeros((1, 16, 16, grid.projection_shape[-1]))
        variables = model.init(jax.random.key(0), x)
        return create_state(variables, optimizer, batch_size=batch_size, use_ema=False)

    def array(*shape, dtype=jnp.float32):
        return jax.ShapeDtypeStruct((batch_size, *shape), dtype)

    batch = Batch(
        projection=array(*grid.projection_shape, dtype=jnp.float16),
        boxes=array(32, 8),
        classes=array(32, dtype=jnp.int32),
        is_valid=array(32, dtype=jnp.bool_),
        frame=array(dtype=jnp.int32),
    )
    step = make_train_step(
        model,
        optimizer,
        models.map_grid(grid, model, config.data.azimuth_mapping),
        loss=dict(config.loss),
    )
    rng = jax.eval_shape(lambda: jax.random.key(0))
    lowered = jax.jit(step, donate_argnums=0).lower(jax.eval_shape(init), batch, rng)
    began = time.perf_counter()
    found = lowered.compile().memory_analysis()
    seconds = time.perf_counter() - began
    return found.argument_size_in_bytes, found.temp_size_in_bytes, seconds


def report_memory(batches, dtypes, policies):
    rows = []
    for dtype in dtypes:
        for policy in policies:
            config = base_config()
            config.model.update(dtype=dtype, remat=policy)
            cells, seconds = [], []
            for batch in batches:
                arguments, temporary, took = step_memory(config, batch)
                cells.append(f"{arguments / GIB:.2f} + {temporary / GIB:.2f}")
                seconds.append(took)
                sys.stderr.write(
                    f"{dtype} {policy} {batch}: {cells[-1]} {took:.0f} s\n"
                )
            rows.append([dtype, policy, *cells, f"{statistics.median(seconds):.0f} s"])
    head = ["compute", "remat", *(f"batch {b}" for b in batches), "to compile"]
    sys.stdout.write(f"GiB, arguments + temporaries, {jax.default_backend()}\n")
    sys.stdout.write(tabulate(rows, head) + "\n")


def train(config, grid, steps, num_devices, folder):
    """Rows of metrics.jsonl of a training of a few steps, the first left out."""
    records = write_records(
        folder / "records", 4 * config.train.batch_size, grid, "float16"
    )
    table = make_table(
        records, make_frames(records), max_objects=config.data.max_objects
    )
    loader = make_loader(table, LoaderOptions(config.train.batch_size))
    model = models.build(config.model)
    config.train.update(
        num_epochs=steps, log_every_steps=1, checkpoint_every_steps=10**6
    )
    loop.train(
        model,
        None,
        loader,
        models.map_grid(grid, model, config.data.azimuth_mapping),
        folder,
        Plan(
            options=config.train,
            loss=config.loss,
            watch=config.watch,
            seed=config.seed,
            info={},
            steps_per_epoch=1,
        ),
        mesh=sharding.make_mesh(num_devices),
    )
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines][1:]


def report_speed(steps, batch, dtype):
    config = base_config()
    config.model.dtype = dtype
    config.train.batch_size = batch
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        rows = train(config, RadarGrid.kradar(), steps + 1, 1, folder)
    names = ("frames_per_s", "data_wait_share")
    names += tuple(f"{part}_ms_per_step" for part in ("data", "compute", "host"))
    values = [statistics.median(row[name] for row in rows) for name in names]
    table = [[batch, dtype, *(f"{value:.3g}" for value in values)]]
    sys.stdout.write(tabulate(table, ["batch", "compute", *names]) + "\n")


def scaling_run(num_devices, steps):
    """Frames a second of a narrow network on some of the devices; in a new process."""
    grid = RadarGrid.reduced(
        num_doppler=16, num_range=64, num_elevation=9, num_azimuth=56
    )
    config = base_config()
    config.model.update(
        doppler_bins=16,
        elevation_bins=9,
        widths=(32, 64, 128),
        decoder_width=32,
        num_groups=8,
    )
    config.train.batch_size = 8
    with tempfile.TemporaryDirectory() as folder:
        rows = train(config, grid, steps + 1, num_devices, pathlib.Path(folder))
    sys.stdout.write(
        json.dumps(
            [
                statistics.median(row["frames_per_s"] for row in rows),
                statistics.median(row["data_wait_share"] for row in rows),
                float(np.float32(rows[-1]["focal"])),
            ]
        )
        + "\n"
    )


def report_scaling(devices, steps):
    rows = []
    for count in devices:
        command = [sys.executable, __file__, "scaling", "--child", str(count)]
        done = subprocess.run(
            [*command, "--steps", str(steps)],
            env={
                **os.environ,
                "JAX_PLATFORMS": "cpu",
                "JAX_NUM_CPU_DEVICES": str(count),
            },
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        speed, wait, focal = json.loads(done.stdout.splitlines()[-1])
        rows.append([count, f"{speed:.2f}", f"{wait:.0%}", f"{focal:.5f}"])
    head = ["fake devices", "frames/s", "data wait", "focal loss at the end"]
    sys.stdout.write(f"{os.cpu_count()} cores, global batch 8\n")
    sys.stdout.write(tabulate(rows, head) + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=["memory", "speed", "scaling"])
    parser.add_argument("--batch", type=int, nargs="+")
    parser.add_argument("--dtype", nargs="+", default=["float32", "bfloat16"])
    parser.add_argument("--remat", nargs="+", default=REMAT)
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.what == "memory":
        batches = arguments.batch or [1, 2, 4, 8, 16]
        report_memory(batches, arguments.dtype, arguments.remat)
    elif arguments.what == "speed":
        for batch in arguments.batch or [2]:
            report_speed(arguments.steps, batch, arguments.dtype[0])
    elif arguments.child:
        scaling_run(arguments.child, arguments.steps)
    else:
        report_scaling(arguments.devices, arguments.steps)


if __name__ == "__main__":
    main()
