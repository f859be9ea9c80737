"""Speed of RADE-Net against the same network in PyTorch, interleaved in one run.

    python benchmarks/radenet.py                    # CPU, or the GPU where there is one
    python benchmarks/radenet.py --cpu-time         # on a machine that others use too
    python benchmarks/radenet.py --batch 1 10 --dtype float32 bfloat16   # GPU
    python benchmarks/radenet.py --parts            # parameters and FLOPs of every part

Rows: forward, gradient, training step (loss and AdamW), detection (forward, decoding,
NMS; ours only). Without torch the table has our column only. Each cell is the median
of the repeats, each ratio ours / torch.
"""

import argparse
import functools
import pathlib
import statistics
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tabulate import tabulate

from radejax import models
from radejax.core.config import base_config
from radejax.core.structures import Batch
from radejax.detection.decode import decode
from radejax.geometry.radar_grid import RadarGrid
from radejax.interop import radenet_torch
from radejax.losses.detection import detection_loss

sys.path.insert(0, str(pathlib.Path(__file__).parent))
try:
    import torch
    import torch_radenet
except ImportError:
    torch = None

# Dense peaks in FLOP/s, from the maker's data sheet. Both libraries run float32
# convolutions as TF32 by default.
PEAKS = {"H200": {"float32": 494e12, "bfloat16": 989e12}}


def make_batch(size):
    """Random projections with a few boxes in view; the same numbers in every run."""
    rng = np.random.default_rng(0)
    boxes = np.zeros((size, 8, 8), np.float32)
    boxes[..., 0] = rng.uniform(5, 70, (size, 8))
    boxes[..., 1] = rng.uniform(-5, 5, (size, 8))
    boxes[..., 3:6] = (4.2, 1.9, 1.6)
    yaw = rng.uniform(-3, 3, (size, 8))
    boxes[..., 6], boxes[..., 7] = np.sin(yaw), np.cos(yaw)
    return Batch(
        projection=0.6 * rng.random((size, 256, 107, 101), np.float32),
        boxes=boxes,
        classes=rng.integers(0, 5, (size, 8)).astype(np.int32),
        is_valid=np.arange(8)[None] < rng.integers(2, 9, size)[:, None],
        frame=np.arange(size, dtype=np.int32),
    )


def outputs_loss(heatmap, boxes):
    """What both gradients are taken of: no loss, so that the networks compare."""
    return (heatmap**2).mean() + (boxes**2).mean()


def jax_tasks(config, variables, batch):
    """Functions without arguments that run one task and wait for it."""
    model = models.build(config.model)
    grid = RadarGrid.kradar()
    batch = jax.device_put(batch)
    variables = jax.device_put(variables)
    optimizer = optax.adamw(1e-3, weight_decay=0.01)

    def loss(variables):
        maps = model.apply(variables, batch.projection, train=True)
        return detection_loss(maps, batch, grid)

    # What takes the place of its argument gives its memory away.
    @functools.partial(jax.jit, donate_argnums=0)
    def step(state):
        variables, moments = state
        (_, parts), gradient = jax.value_and_grad(loss, has_aux=True)(variables)
        updates, moments = optimizer.update(gradient, moments, variables)
        return (optax.apply_updates(variables, updates), moments), parts

    @jax.jit
    def gradient(variables, x):
        def f(variables):
            maps = model.apply(variables, x)
            return outputs_loss(maps.heatmap_logits, maps.box_params)

        return jax.grad(f)(variables)

    @jax.jit
    def detect(variables, x):
        maps = model.apply(variables, x)
        return decode(maps, grid, max_detections=50, score_threshold=0.3)

    forward = jax.jit(model.apply)
    state = [
        jax.device_put((jax.tree.map(jnp.copy, variables), optimizer.init(variables)))
    ]

    def run_step():
        state[0], parts = step(state[0])
        jax.block_until_ready(state[0])
        return parts

    x = batch.projection
    return {
        "forward": lambda: jax.block_until_ready(forward(variables, x)),
        "gradient": lambda: jax.block_until_ready(gradient(variables, x)),
        "training step": run_step,
        "detection": lambda: jax.block_until_ready(detect(variables, x)),
    }


def torch_tasks(model, batch, dtype, device, *, is_compiled):
    """The same for torch; its step has AdamW and the loss on outputs, so less work."""
    x = np.pad(batch.projection, ((0, 0), (0, 0), (0, 5), (0, 0)))
    x = torch.tensor(x.transpose(0, 3, 1, 2).copy(), device=device)
    if device == "cuda":
        x = x.to(memory_format=torch.channels_last)
    run = torch.compile(model) if is_compiled else model
    optimizer = torch.optim.AdamW(model.parameters(), 1e-3, weight_decay=0.01)

    def autocast():
        enabled = dtype == "bfloat16"
        return torch.autocast(device, torch.bfloat16, enabled=enabled)

    def wait():
        if device == "cuda":
            torch.cuda.synchronize()

    def forward():
        with torch.inference_mode(), autocast():
            run(x)
        wait()

    def gradient():
        model.zero_grad(set_to_none=True)
        with autocast():
            outputs = run(x)
        outputs_loss(*(o.float() for o in outputs)).backward()
        wait()

    def step():
        gradient()
        optimizer.step()
        wait()

    return {"forward": forward, "gradient": gradient, "training step": step}


def forward_flops(model, variables, batch):
    """Operations of the forward pass, as XLA counts them."""
    lowered = jax.jit(model.apply).lower(variables, batch.projection)
    return lowered.cost_analysis()["flops"]


def parts_table(model, size):
    """Outputs, parameters and operations of every part of the network."""
    x = np.zeros((size, 256, 107, 101), np.float32)
    return model.tabulate(jax.random.key(0), x, compute_flops=True, depth=2)


def measure(columns, repeats, clock):
    """Seconds by column and task, interleaved so that a slow moment hits all."""
    times = {}
    for name, tasks in columns.items():
        for task, run in tasks.items():
            start = time.perf_counter()
            run()
            sys.stderr.write(
                f"{name} {task}: first {time.perf_counter() - start:.1f} s\n"
            )
    for _ in range(repeats):
        for task in next(iter(columns.values())):
            for name, tasks in columns.items():
                if task in tasks:
                    start = clock()
                    tasks[task]()
                    times.setdefault((name, task), []).append(clock() - start)
    return {key: statistics.median(values) for key, values in times.items()}


def report(times, columns, batch, flops, peak):
    """Rows of the table: a task, milliseconds, ratios, frames per second."""
    rows = []
    for task in columns["radejax"]:
        ours = times["radejax", task]
        row = [task] + [
            f"{1e3 * times[name, task]:.1f}" if (name, task) in times else "-"
            for name in columns
        ]
        others = [name for name in columns if name != "radejax"]
        row += [
            f"{ours / times[name, task]:.2f}" if (name, task) in times else "-"
            for name in others
        ]
        work = flops if task in ("forward", "detection") else 3 * flops
        share = f"{work / ours / peak:.0%}" if peak else "-"
        rows.append([*row, f"{batch / ours:.2f}", f"{work / ours / 1e9:.0f}", share])
    ratios = [f"/ {name}" for name in columns if name != "radejax"]
    units = [f"{name} ms" for name in columns]
    return tabulate(rows, ["task", *units, *ratios, "frames/s", "GFLOP/s", "of peak"])


def overfit(config, variables, batch, steps):
    """Losses of repeated training steps on the same frames."""
    step = jax_tasks(config, variables, batch)["training step"]
    for i in range(steps):
        parts = {k: float(v) for k, v in step().items() if jnp.ndim(v) == 0}
        text = " ".join(f"{name} {value:.4f}" for name, value in parts.items())
        sys.stdout.write(f"step {i + 1}: {text}\n")
        sys.stdout.flush()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    on_gpu = jax.default_backend() == "gpu"
    parser.add_argument(
        "--batch", type=int, nargs="+", default=[1, 10] if on_gpu else [1]
    )
    dtypes = ["float32", "bfloat16"] if on_gpu else ["float32"]
    parser.add_argument("--dtype", nargs="+", default=dtypes)
    parser.add_argument("--repeats", type=int, default=20 if on_gpu else 5)
    parser.add_argument("--cpu-time", action="store_true", help="CPU seconds, not wall")
    parser.add_argument("--tasks", nargs="+", help="only these rows")
    parser.add_argument("--parts", action="store_true", help="only the network's parts")
    parser.add_argument("--overfit", type=int, metavar="STEPS", help="only train")
    arguments = parser.parse_args()
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    device = jax.devices()[0]
    peaks = next((v for k, v in PEAKS.items() if k in device.device_kind), {})
    if torch is None:
        sys.stdout.write("torch is not installed: no comparison (pip install torch)\n")
    sys.stdout.write(f"{device.device_kind}, jax {jax.__version__}\n")
    for dtype in arguments.dtype:
        config = base_config()
        config.model.dtype = dtype
        model = models.build(config.model)
        x = np.zeros((1, 16, 16, 101), np.float32)
        variables = jax.jit(model.init)(jax.random.key(0), x)
        for size in arguments.batch:
            if arguments.parts:
                sys.stdout.write(parts_table(model, size))
                continue
            batch = make_batch(size)
            if arguments.overfit:
                overfit(config, variables, batch, arguments.overfit)
                continue
            columns = {"radejax": jax_tasks(config, variables, batch)}
            columns |= torch_columns(config, model, variables, batch, dtype, on_gpu)
            if arguments.tasks:
                columns = {
                    name: {k: v for k, v in tasks.items() if k in arguments.tasks}
                    for name, tasks in columns.items()
                }
            flops = forward_flops(model, variables, batch)
            times = measure(columns, arguments.repeats, clock)
            rows = report(times, columns, size, flops, peaks.get(dtype))
            sys.stdout.write(f"\nbatch {size}, {dtype}\n{rows}\n")


def torch_columns(config, model, variables, batch, dtype, on_gpu):
    """Columns for torch: eager, and compiled on a GPU."""
    if torch is None:
        return {}
    device = "cuda" if on_gpu and torch.cuda.is_available() else "cpu"
    if on_gpu and device == "cpu":
        sys.stdout.write("torch sees no GPU: no comparison\n")
        return {}
    reference = torch_radenet.RadeNet(config.model)
    state = radenet_torch.save(model, variables)
    reference.load_state_dict({k: torch.tensor(v) for k, v in state.items()})
    reference = reference.to(device)
    if on_gpu:
        reference = reference.to(memory_format=torch.channels_last)
    kinds = {"torch": False} | ({"torch.compile": True} if on_gpu else {})
    return {
        name: torch_tasks(reference, batch, dtype, device, is_compiled=compiled)
        for name, compiled in kinds.items()
    }


if __name__ == "__main__":
    main()
