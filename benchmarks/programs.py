"""Analyzes programs lowered for GPUs without running them, and computes lower bounds of their time.

    python benchmarks/programs.py    # full size, bfloat16; a minute, without accelerator
    python benchmarks/programs.py --training dinorade dinorade:r

The first writes `docs/reports/benchmarks/programs.json` and its table in
`docs/reports/benchmarks.md`. The second prints lower bounds of the time and memory of
trainings on an A100, which `docs/reproduce.md` contains.

Every program is lowered with `jax.export` for a platform that need not be available. `facts`
extracts types, host callbacks, convolutions, transposes and loops from its text. `work` counts the
operations and bytes of matrix products, convolutions, gathers and scatters, including loops and
the chosen branches of `platform_dependent`, which XLA's own analysis counts once or not at all.
Other operations, most of which can be fused, are not counted. The lower bound is the sum over the
counted operations of the larger of operations / peak and bytes / bandwidth.
"""

import argparse
import collections
import datetime
import functools
import json
import math
import pathlib
import re
import shlex
import sys

import flax.linen as nn
import jax
import jax.export
import jax.numpy as jnp

from radejax import models
from radejax.config import load_config
from radejax.core.structures import Batch
from radejax.data.cameras import no_images
from radejax.detection.decode import DecodeOptions
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.detector import detect
from radejax.models.layers import GroupNorm
from radejax.simulation.radar import tensor
from radejax.training.step import create_state, make_optimizer, make_train_step

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import page

CONFIGS = pathlib.Path(__file__).parents[1] / "configs"

# Dense peaks of bfloat16 and TF32 in FLOP/s and of the memory in byte/s. Those of H100 SXM,
# H200 SXM and A100 SXM 80 GB are from NVIDIA's data sheets, those of AGX Orin 64 GB from its
# technical brief: 170 sparse INT8 TOP/s are 42.5 dense in 16 bits and 21.25 in TF32.
DEVICES = {
    "H100": (989e12, 494e12, 3.35e12),
    "H200": (989e12, 494e12, 4.8e12),
    "A100": (312e12, 156e12, 2.039e12),
    "Orin": (42.5e12, 21.25e12, 0.2048e12),
}


# Programs ----------------------------------------------------------------------------


def shape_of(*shape, dtype=jnp.float32):
    return jax.ShapeDtypeStruct(shape, dtype)


def batch_of(model, grid, size, max_objects=16):
    """Returns the shapes of a training batch."""
    rows = size, max_objects
    image = camera = None
    if models.has_camera(model):
        pixels = model.options.image.size
        image, camera = jax.eval_shape(lambda: no_images(size, pixels))
    return Batch(
        projection=shape_of(size, *grid.projection_shape, dtype=jnp.float16),
        boxes=shape_of(*rows, 8),
        classes=shape_of(*rows, dtype=jnp.int32),
        is_valid=shape_of(*rows, dtype=jnp.bool_),
        frame=shape_of(size, dtype=jnp.int32),
        image=image,
        camera=camera,
    )


def detector(config, grid, size):
    """Returns the function from inputs to detections, and the shapes of its arguments."""
    model = models.build(config.model)
    batch = batch_of(model, grid, size)
    inputs = [x for x in (batch.projection, batch.image, batch.camera) if x is not None]
    variables = jax.eval_shape(model.init, jax.random.key(0), *inputs)
    map_grid = models.map_grid(grid, model, "true")
    function = functools.partial(detect, model, map_grid, DecodeOptions())
    return function, (variables, *inputs)


def train_step(config, grid, size):
    """Returns the training step, and the shapes of its arguments."""
    model = models.build(config.model)
    _, (variables, *_) = detector(config, grid, size)
    optimizer = make_optimizer(config.train, lambda _: 1e-3)
    create = functools.partial(
        create_state,
        optimizer=optimizer,
        use_ema=False,
        model=model,
    )
    map_grid = models.map_grid(grid, model, "true")
    step = make_train_step(model, optimizer, map_grid, loss=config.loss)
    rng = jax.eval_shape(lambda: jax.random.key(0))
    state = jax.eval_shape(create, variables)
    return step, (state, batch_of(model, grid, size), rng)


def simulator(grid, num_scatterers=1024):
    """Returns the simulation of one frame's projection, and the shapes of its arguments."""
    points = [shape_of(num_scatterers)] * 4
    scatterers = tensor.Scatterers(*points, amplitude=shape_of(num_scatterers, 2))
    noise = shape_of(grid.num_range, grid.num_doppler)
    function = functools.partial(tensor.simulate, grid=grid)
    return function, (scatterers, noise, shape_of(2, dtype=jnp.uint32))


def text_of(function, arguments, platform):
    """Returns the StableHLO text of a program for a platform."""
    exported = jax.export.export(jax.jit(function), platforms=(platform,))(*arguments)
    return exported.mlir_module()


# Facts from the text -----------------------------------------------------------------


def facts(text):
    """Extracts facts from a program's text.

    "ops", "calls" (to external code) and "convolutions" (by result type) are counts. "types" is
    the set of element types. "turned" lists the shapes of arrays with four or more axes whose
    innermost axis a transpose moves. "wide" has the source locations of 64-bit operations.
    """
    lines = text.splitlines()
    turned = []
    for line in lines:
        found = re.search(
            r"stablehlo.transpose .* dims = \[([\d, ]+)\] : \(tensor<(\S+)>\)", line
        )
        if found:
            order = [int(axis) for axis in found[1].split(",")]
            if len(order) >= 4 and order[-1] != len(order) - 1:
                turned.append(found[2])
    convolutions = [
        re.findall(r"-> tensor<(?:\d+x)*(\w+)>", line)[-1]
        for line in lines
        if "stablehlo.convolution" in line
    ]
    origins = dict(re.findall(r'^(#loc\d*) = loc\("([^"]*)"', text, re.MULTILINE))
    wide = [
        re.findall(r"loc\((#loc\d*)\)", line)[-1]
        for line in lines
        if re.search(r"tensor<(?:\d+x)*(?:f|i|ui)64>", line)
    ]
    return {
        "ops": collections.Counter(re.findall(r"(?:stablehlo|chlo)\.(\w+)", text)),
        "types": set(re.findall(r"tensor<(?:\d+x)*([a-z]\w*)>", text)),
        "calls": collections.Counter(re.findall(r"custom_call @(\w+)", text)),
        "convolutions": collections.Counter(convolutions),
        "turned": turned,
        "wide": {origins.get(place, "?") for place in wide},
    }


# Operations and bytes ----------------------------------------------------------------


def work(function, arguments, platform):
    """Lists (name, dtype, FLOPs, bytes, times) of all products, convolutions, gathers and scatters.

    `times` is the product of the lengths of the enclosing scans. Loops with a condition, such as
    that of NMS, count once. Of scatters, only those that add are listed.
    """
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return list(_work(jaxpr, platform, 1))


def _work(jaxpr, platform, times):
    chosen = {}  # index of the platform's branch
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name == "platform_index":
            names = eqn.params["platforms"]
            here = [i for i, n in enumerate(names) if n is None or platform in n]
            chosen[eqn.outvars[0]] = here[0]
        elif name in ("dot_general", "conv_general_dilated", "gather", "scatter-add"):
            moved = sum(_bytes(v.aval) for v in (*eqn.invars, *eqn.outvars))
            if name == "gather":  # elements that are not gathered are not read
                moved = 2 * _bytes(eqn.outvars[0].aval)
            yield name, eqn.invars[0].aval.dtype.name, _flops(eqn), moved, times
        elif name == "cond":
            index = chosen.get(eqn.invars[0], -1)
            yield from _work(eqn.params["branches"][index].jaxpr, platform, times)
        else:
            length = eqn.params["length"] if name == "scan" else 1
            for inner in jax.core.jaxprs_in_params(eqn.params):
                yield from _work(inner, platform, times * length)


def _bytes(aval):
    return aval.size * aval.dtype.itemsize


def _flops(eqn):
    left, right = (v.aval.shape for v in eqn.invars[:2])
    out = math.prod(eqn.outvars[0].aval.shape)
    if eqn.primitive.name == "dot_general":
        (contracted, _), _ = eqn.params["dimension_numbers"]
        return 2 * out * math.prod(left[axis] for axis in contracted)
    if eqn.primitive.name == "conv_general_dilated":
        numbers = eqn.params["dimension_numbers"]
        return 2 * out * math.prod(right) // right[numbers.rhs_spec[0]]
    return 0


def least_seconds(found, device):
    """Returns the lower bound of a device's time in seconds; see the module docstring."""
    bfloat16, tf32, bandwidth = DEVICES[device]
    total = 0.0
    for _, dtype, flops, moved, times in found:
        peak = bfloat16 if dtype in ("bfloat16", "float16") else tf32
        total += times * max(flops / peak, moved / bandwidth)
    return total


TRAINING_FRAMES = 17_458  # of K-Radar


def least_training(config, grid=None, device="A100"):
    """Returns lower bounds of the hours and gigabytes that a training needs.

    The hours are those of all steps, without loading data, evaluation and checkpoints. The
    memory is that of the training state, the gradient, one batch, and the inputs of all group
    and batch normalizations, which the backward pass needs.
    """
    train = config.train
    step, arguments = train_step(config, grid or RadarGrid.kradar(), train.batch_size)
    steps = TRAINING_FRAMES // train.batch_size * train.num_epochs
    hours = steps * least_seconds(work(step, arguments, "cuda"), device) / 3600
    state, batch, rng = arguments
    size = sum(map(_bytes, jax.tree.leaves((state, state.params, batch))))

    def note(function, args, kwargs, context):
        nonlocal size
        is_norm = isinstance(context.module, (nn.BatchNorm, GroupNorm))
        if is_norm and context.method_name == "__call__":
            size += _bytes(args[0])
        return function(*args, **kwargs)

    with nn.intercept_methods(note):
        model = models.build(config.model)
        jax.eval_shape(
            lambda *x: model.init(x[0], *x[1].model_inputs(), train=False), rng, batch
        )
    return hours, size / 1e9


def bounds_text(config):
    """Returns the lower bounds of a training, rounded down, such as "0.4 h, 3.9 GB"."""
    hours, size = (math.floor(10 * x) / 10 for x in least_training(config))
    return f"{hours} h, {size} GB"


# Table ---------------------------------------------------------------------------------


def full_size(size, dtype="bfloat16"):
    """Returns function, shapes of arguments and number of frames of each program by name."""
    grid = RadarGrid.kradar()
    programs = {"simulator": (*simulator(grid), 1)}
    for name, path in (("RADE-Net", "radenet.py"), ("DinoRADE", "dinorade.py")):
        config = load_config(str(CONFIGS / path)).replace(model={"dtype": dtype})
        programs[f"{name}, detector"] = (*detector(config, grid, size), size)
        programs[f"{name}, training step"] = (*train_step(config, grid, size), size)
    return programs


HEAVY = (
    "convolution", "dot_general", "gather", "scatter", "sort", "while", "constant",
    "return", "case",
)  # fmt: skip


def rows(size):
    """Yields the facts of each program and its lower bounds in milliseconds per frame."""
    for name, (function, arguments, frames) in full_size(size).items():
        sys.stderr.write(f"{name}\n")
        found = work(function, arguments, "cuda")
        shown = facts(text_of(function, arguments, "cuda"))
        ops = shown["ops"]
        yield {
            "program": name,
            "batch": frames,
            "gflop_a_frame": sum(f * t for _, _, f, _, t in found) / frames / 1e9,
            "mib_a_frame": sum(b * t for _, _, _, b, t in found) / frames / 2**20,
            "convolutions": ops["convolution"],
            "products": ops["dot_general"],
            "loops": ops["while"],
            "fusable": sum(ops.values()) - sum(ops[x] for x in HEAVY),
            "turned": len(shown["turned"]),
            "least_ms_a_frame": {
                device: 1e3 * least_seconds(found, device) / frames
                for device in DEVICES
            },
        }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--training", nargs="+", metavar="CONFIG")
    args = parser.parse_args()
    if args.training:
        for name in args.training:
            print(f"{name}: at least {bounds_text(load_config(name))}")
        return
    result = {
        "command": shlex.join(["python", "benchmarks/programs.py", *sys.argv[1:]]),
        "date": datetime.date.today().isoformat(),
        "jax": jax.__version__,
        "programs": list(rows(args.batch)),
    }
    print(page.programs_table(result))
    text = json.dumps(result, indent=1) + "\n"
    (page.RESULTS / "programs.json").write_text(text)
    page.write_page()


if __name__ == "__main__":
    main()
