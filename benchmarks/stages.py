"""Measures the time from a tensor in host memory to boxes by stage and module.

python benchmarks/stages.py runs/quickstart --batch-size 1 10
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from module_calls import ModuleCall, module_calls
from tabulate import tabulate

from radejax import models
from radejax.cli.entry import set_up_jax
from radejax.config import Config, load_config
from radejax.data.cameras import no_images
from radejax.data.projection import project_jax
from radejax.detection.decode import decode
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.detector import Detector
from radejax.inference.saved import SavedModel

STAGES = ("transfer", "projection", "network", "decode + NMS")


def untrained(config: Config, **overrides: Any) -> Detector:
    """Returns a detector with random weights for a config.

    Args:
        config: A config. Its section `simulation` gives the grid; without one, the grid is
            K-Radar's.
        **overrides: Arguments of `Detector`.
    """
    simulation = config.simulation
    grid = RadarGrid.kradar() if simulation is None else simulation.make_grid()
    model = models.build(config.model)
    inputs: tuple[Any, ...] = (np.zeros((1, *grid.projection_shape), np.float32),)
    if models.has_camera(model):
        inputs += no_images(1, model.options.image.size)
    # Only shapes are computed, as compiling the initialization takes longer than measuring.
    shapes = jax.eval_shape(model.init, jax.random.key(0), *inputs)
    rng = np.random.default_rng(0)
    variables = jax.tree.map(
        lambda x: 0.05 * rng.standard_normal(x.shape, x.dtype), shapes
    )
    return Detector(SavedModel(config, grid, variables), **overrides)


def measure(
    detector: Detector,
    batch_sizes: Sequence[int] = (1, 10),
    *,
    repeats: int = 5,
    tesseract: bool = True,
    seed: int = 0,
) -> list[dict[str, Any]]:
    """Times calls of a detector on random tensors, its stages and the network's submodules.

    Stages and submodules are timed separately, each until its result is ready. The whole is
    one call of the detector, in which the compiler and asynchronous dispatch may overlap the
    stages. All are interleaved in every repeat, and the shortest time is returned.

    Args:
        detector: A detector; a radar-camera model gets black images that count as valid.
        batch_sizes: Numbers of frames per call.
        repeats: Number of repeats after a first call that compiles.
        tesseract: Whether the input is tesseracts or projections, which omits a stage.
        seed: Seed of the random tensors.

    Returns:
        One dictionary per batch size with "batch", "input", "device", "jax" (version), the
        seconds of each stage ("stages"), of their sum ("sum_s"), of the network's submodules
        ("parts") and of the whole call ("whole_s"), and its "frames_per_s".

    References:
        Leitgeb et al., RADE-Net, section IV-B.2: backbone, neck and head of batches of 10
        frames take 49, 31 and 18 ms on an NVIDIA L40S.
    """
    return [_measure(detector, n, repeats, tesseract, seed) for n in batch_sizes]


def _measure(
    detector: Detector, batch: int, repeats: int, tesseract: bool, seed: int
) -> dict[str, Any]:
    grid, mapping = detector.grid, detector.saved.config.data.azimuth_mapping
    (device,) = detector.sharding.device_set
    shape = grid.shape_drea if tesseract else grid.projection_shape
    rng = np.random.default_rng(seed)
    frames = rng.standard_exponential((batch, *shape), np.float32)
    frames *= 1e9 if tesseract else 0.3
    extra: tuple[Any, ...] = ()
    if detector.takes_camera:
        image, camera = no_images(batch, detector.model.options.image.size)
        extra = image, camera.replace(is_valid=np.ones(batch, bool))
    sized = detector.replace(batch_sizes=(batch,))  # no padding to another size

    map_function = jax.jit(
        lambda variables, *inputs: detector.model.apply(variables, *inputs, train=False)
    )
    decode_function = jax.jit(
        functools.partial(
            decode,
            grid=models.map_grid(grid, detector.model, mapping),
            options=detector.decode_options,
        )
    )
    put = functools.partial(jax.device_put, device=device)
    project = jax.jit(project_jax)
    on_device = put((frames, *extra))
    projected = project(on_device[0]) if tesseract else on_device[0]
    inputs = projected, *on_device[1:]
    maps = map_function(detector.variables, *inputs)
    functions: dict[str, Callable[[], Any]] = {
        "transfer": lambda: put((frames, *extra)),
        "projection": lambda: project(on_device[0]),
        "network": lambda: map_function(detector.variables, *inputs),
        "decode + NMS": lambda: decode_function(maps),
        "whole": lambda: sized(frames, *extra),
    }
    if not tesseract:
        del functions["projection"]
    parts = _parts(detector.model, detector.variables, inputs)
    times = _best({**functions, **parts}, repeats)
    part_times = {name: times.pop(name) for name in parts}
    whole = times.pop("whole")
    return {
        "batch": batch,
        "input": "tesseract" if tesseract else "projection",
        "stages": times,
        "sum_s": sum(times.values()),
        "parts": part_times,
        "whole_s": whole,
        "frames_per_s": batch / whole,
        "device": device.device_kind,
        "jax": jax.__version__,
    }


def _parts(
    model: nn.Module, variables: Mapping[str, Any], inputs: tuple[Any, ...]
) -> dict[str, Callable[[], Any]]:
    """Returns calls of the network's submodules with the arguments that the network passes."""
    calls: dict[str, ModuleCall] = {}

    @jax.jit
    def arguments(variables: Any, *inputs: Any) -> dict[str, tuple[Any, ...]]:
        calls.update(module_calls(lambda: model.apply(variables, *inputs, train=False)))
        return {name: call.args for name, call in calls.items()}

    def part(name: str, given: tuple[Any, ...]) -> Callable[[], Any]:
        module, settings = calls[name].module, calls[name].kwargs
        own = {kind: tree[name] for kind, tree in variables.items() if name in tree}
        function = jax.jit(lambda own, given: module.apply(own, *given, **settings))
        return lambda: function(own, given)

    given = arguments(variables, *inputs)
    return {name: part(name, given[name]) for name in calls}


def _best(functions: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Returns the shortest of interleaved times of each function after a call that compiles."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for repeat in range(repeats + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            if repeat:
                times[name].append(time.perf_counter() - start)
    return {name: min(values) for name, values in times.items()}


def as_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Formats the milliseconds of each stage and their percentage of the sum by batch size.

    The network's submodules are listed below it. Within the network, the compiler may fuse them.
    """
    names = [n for n in STAGES if any(n in row["stages"] for row in rows)]
    header = ["from " + rows[0]["input"], *(f"batch {r['batch']}" for r in rows)]
    table = []
    for name in names:
        table.append([name, *(_cell(row, row["stages"][name]) for row in rows)])
        for part in rows[0]["parts"] if name == "network" else ():
            cells = (_cell(row, row["parts"][part]) for row in rows)
            table.append([f"- {part.replace('_', ' ')}", *cells])
    table.append(["sum of stages", *(f"{1000 * r['sum_s']:.2f} ms" for r in rows)])
    table.append(["one call", *(f"{1000 * r['whole_s']:.2f} ms" for r in rows)])
    table.append(["frames / s", *(f"{r['frames_per_s']:.2f}" for r in rows)])
    title = f"{rows[0]['device']}, jax {rows[0]['jax']}; best times"
    return f"{title}\n{tabulate(table, header, disable_numparse=True)}"


def _cell(row: Mapping[str, Any], seconds: float) -> str:
    return f"{1000 * seconds:.2f} ms ({100 * seconds / row['sum_s']:.1f} %)"


def main() -> None:
    """Times the model of a run, exported folder or file, or an untrained model of a config."""
    parser = argparse.ArgumentParser(description=__doc__)
    model = parser.add_mutually_exclusive_group(required=True)
    model.add_argument("source", nargs="?", help="Run, exported folder or .pth file.")
    model.add_argument("--config", help="Config of an untrained model.")
    parser.add_argument("--batch-size", type=int, nargs="+", default=[1, 10])
    parser.add_argument(
        "--input", choices=["tesseract", "projection"], default="tesseract"
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--dtype", choices=["float32", "bfloat16"])
    given = parser.parse_args()
    set_up_jax()
    if given.config:
        detector = untrained(load_config(given.config), dtype=given.dtype)
    else:
        detector = Detector.from_workdir(given.source, dtype=given.dtype)
    is_tesseract = given.input == "tesseract"
    rows = measure(
        detector, given.batch_size, repeats=given.repeats, tesseract=is_tesseract
    )
    print(as_table(rows))


if __name__ == "__main__":
    main()
