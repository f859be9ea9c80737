"""Benchmarks of `run.py`, with the implementations to compare and their sizes.

A benchmark yields its cases one by one, so that not all of their data are in memory at once.
"""

import collections
import contextlib
import functools
import importlib.util
import itertools
import pathlib
import statistics
import tempfile

import inputs
import jax
import networks
import numpy as np
import scipy.io
import stages
import start
from case import Case, compiled, difference, first_call, timed, waiting

from radejax.config import load_config
from radejax.data.adc import LIGHT_MPS, FmcwRadar, adc_to_power
from radejax.data.kradar.tesseract import project_file
from radejax.data.kradar.write import write_tesseract
from radejax.data.pipeline import LoaderOptions, make_loader, make_table
from radejax.data.projection import project_jax, project_tensor
from radejax.evaluation import EvaluationSet
from radejax.evaluation.protocols import PROTOCOLS
from radejax.evaluation.results import ReportOptions, compute_results
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.export import export
from radejax.inference.exported_loader import load as load_exported

GRID = RadarGrid.kradar()


def projection(machine):
    """Tensor max projection of a tesseract in the memory order of `loadmat`, and from files."""
    tesseract = inputs.make_tesseract(GRID.shape_drea)
    columns = {
        "radejax": lambda: timed(lambda: project_tensor(tesseract)),
        "authors' formula": lambda: timed(lambda: inputs.project_released(tesseract)),
        "plain read (sum)": lambda: timed(tesseract.sum),
    }
    yield Case(
        name="projection on the host",
        columns=columns,
        error=difference(
            [project_tensor(tesseract)], [inputs.project_released(tesseract)]
        ),
        note="share of the bandwidth of a plain read",
    )
    if machine["platform"] != "cpu":
        x = jax.device_put(np.ascontiguousarray(tesseract)[None])
        program, cost = compiled(project_jax, x)
        columns = {"radejax": waiting(program, x)}
        yield Case(name="projection on the device", columns=columns, **cost)
    with tempfile.TemporaryDirectory() as folder:
        for name, is_small in (("uncompressed", False), ("compressed", True)):
            path = pathlib.Path(folder) / f"{name}.mat"
            write_tesseract(path, tesseract, compress=is_small)
            columns = {
                "radejax": functools.partial(timed, lambda p=path: project_file(p))
            }
            if not is_small:
                columns["loadmat, authors' formula"] = lambda p=path: timed(
                    lambda: inputs.project_released(scipy.io.loadmat(p)["arrDREA"])
                )
            note = (
                f"{tesseract.nbytes / 1e6:.0f} MB of bins, the file in the page cache"
            )
            yield Case(
                name=f"projection from a .mat, {name}", columns=columns, note=note
            )


def adc(machine):
    """ADC samples of a radar with 3 x 4 antennas to power in 64 azimuths."""
    half = 0.5 * LIGHT_MPS / 77e9
    radar = FmcwRadar(
        tx_m=[(0, 4 * half * i, 0) for i in range(3)],
        rx_m=[(0, half * i, 0) for i in range(4)],
        azimuth_rad=np.arcsin(np.linspace(-0.9, 0.9, 64)),
        carrier_hz=77e9,
        slope_hz_per_s=30e12,
        sample_rate_hz=15e6,
        chirp_period_s=20e-6,
        num_chirps=128,
        num_samples=256,
    )
    white = np.random.default_rng(0).normal(size=(2, *radar.shape)).astype(np.float32)
    samples = white[0] + 1j * white[1]
    program, cost = compiled(lambda x: adc_to_power(x, radar), samples)
    run = functools.partial(inputs.adc_in_numpy, samples, radar)
    yield Case(
        name="ADC samples to power, 128 chirps x 12 antennas x 256",
        columns={"radejax": waiting(program, samples), "NumPy": lambda: timed(run)},
        error=difference([program(samples)], [run()]),
        **cost,
    )


def nms(machine):
    """Decoding of peaks to boxes with NMS, compared with the authors' Python loops."""
    for peaks in (40, 100):
        maps, loops = inputs.make_maps(peaks), inputs.peaks_on_host(peaks)
        ours, cost = compiled(inputs.decoder(128), maps)
        found = ours(maps)
        kept = np.stack([f[2] for f in inputs.loop_decode(*loops)])
        boxes = np.asarray(found.boxes[0])[np.asarray(found.is_valid[0])]
        yield Case(
            name=f"decoding and NMS, {peaks} peaks",
            columns={
                "radejax": waiting(ours, maps),
                "authors' loops": lambda loops=loops: timed(
                    lambda: inputs.loop_decode(*loops)
                ),
            },
            error=difference([boxes], [kept]),
            **cost,
        )


def evaluate(machine):
    """Evaluation of a test split of K-Radar's size in every protocol and weather."""
    for false_per_frame in (2, 50):
        truth, found, frames = inputs.synthetic_set(false_per_frame=false_per_frame)
        options = ReportOptions(protocols=tuple(PROTOCOLS))

        def everything(truth=truth, found=found, frames=frames, options=options):
            data = EvaluationSet(truth, found, frames=frames)
            compute_results(data, frames, options)

        yield Case(
            name=f"evaluation of the test split, {len(found['frame']):,} predictions",
            columns={"radejax": functools.partial(timed, everything)},
            note=f"{len(frames['frame']):,} frames in one call, {len(PROTOCOLS)} protocols",
        )


def load(machine):
    """Loading of host batches of 8: records, and frames per second by number of threads."""
    size, count = 8, 128
    with contextlib.ExitStack() as stack:
        columns = {}
        for name, dtype in (("radejax", "float16"), ("radejax, uint8", "uint8")):
            source = stack.enter_context(inputs.folder_of_records(32, GRID, dtype))
            table = make_table(source, inputs.labeled(source), max_objects=32)
            batches = make_loader(table, LoaderOptions(size))
            take = functools.partial(itertools.islice, batches, count // size)
            # As in training, earlier batches are released.
            columns[name] = functools.partial(
                timed, lambda take=take: collections.deque(take(), maxlen=1)
            )
        folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        paths = inputs.write_npy(folder, size, GRID)
        columns["authors' .npy"] = functools.partial(
            timed, lambda: inputs.read_npy(paths, size, count)
        )
        yield Case(name="records to batches", columns=columns, frames=count)
    with (
        inputs.folder_of_records(32, GRID, "float16") as source,
        inputs.front_images(32) as images,
    ):
        frames = inputs.labeled(source)
        for name, given, count in (("radar", None, 128), ("camera", images, 32)):
            table = make_table(source, frames, max_objects=32, images=given)
            for num_threads in inputs.thread_counts():
                options = LoaderOptions(size, num_threads=num_threads)
                column, note = reading(
                    make_loader(table, options), count // size, count
                )
                yield Case(
                    name=f"{name} frames to batches, threads: {num_threads}",
                    columns={"radejax": column},
                    frames=count,
                    dtype=source.dtype,
                    note=note,
                )


def reading(batches, num_batches, num_frames):
    """Returns a column that takes batches, and a note with frames per second."""
    walls = []

    def column():
        taken = itertools.islice(batches, num_batches)
        wall, processor = timed(lambda: collections.deque(taken, maxlen=1))
        walls.append(wall)
        return wall, processor

    def note():
        return f"{num_frames / statistics.median(walls[1:]):.0f} frames/s"

    return column, note


def simulate(machine):
    """Fused projections of the simulator: one frame on a CPU, 16 copies on an accelerator."""
    count = 1 if machine["platform"] == "cpu" else 16
    arrays, run = inputs.simulator_of()
    arrays = jax.device_put(jax.tree.map(lambda x: np.stack([x] * count), arrays))
    program, cost = compiled(jax.vmap(run), *arrays)
    yield Case(
        name="simulator, fused projection",
        columns={"radejax": waiting(program, *arrays)},
        frames=count,
        **cost,
    )


def deploy(machine):
    """Programs of `radejax export`, compared with the detector that was exported."""
    has_onnx = importlib.util.find_spec("onnxruntime") and machine["platform"] == "cpu"
    for name in ("quickstart", "radenet"):
        config = load_config(name)
        found = stages.untrained(config, batch_sizes=(1,), score_threshold=0.0)
        shape = (1, *found.grid.projection_shape)
        x = np.random.default_rng(0).random(shape, np.float32)
        with tempfile.TemporaryDirectory() as folder:
            export(found, folder)
            program = load_exported(folder)
            columns = {"radejax": waiting(found, x), "StableHLO": waiting(program, x)}
            cost = first_call(columns["radejax"])
            scores = [np.asarray(program(x)["scores"])]
            if has_onnx:
                export(found, folder, kind="onnx")
                session = inputs.onnx_session(f"{folder}/detector.onnx")
                columns["ONNX Runtime"] = functools.partial(
                    timed, functools.partial(session, x)
                )
                scores.append(session(x)[1])
        yield Case(
            name=f"exported detector, {name}",
            columns=columns,
            error=max(difference([s], [np.asarray(found(x).scores)]) for s in scores),
            tolerance=1e-4,
            note="projection to boxes; difference of scores",
            **cost,
        )


BENCHMARKS = {
    "radenet": networks.radenet,
    "radenet_training": networks.radenet_training,
    "dinorade": networks.dinorade,
    "projection": projection,
    "adc": adc,
    "simulator": simulate,
    "dinorade_training": functools.partial(networks.dinorade, task="training step"),
    "detector": networks.detector,
    "evaluation": evaluate,
    "attention": networks.attention,
    "nms": nms,
    "loader": load,
    "feeding": networks.feeding,
    "deploy": deploy,
    "start": start.start,
}
"""Function by name, which `--only` selects. The most important benchmarks run first."""
