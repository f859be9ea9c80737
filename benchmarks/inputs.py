"""Inputs of the benchmarks, and the steps of the authors' code.

Sizes are those of K-Radar. Values are random where they do not affect the time.
"""

import contextlib
import functools
import itertools
import pathlib
import tempfile
import types

import jax.numpy as jnp
import numpy as np
import shapely
from PIL import Image

from radejax.core.structures import CLASSES, Batch, DetectionMaps
from radejax.core.workers import usable_cpus
from radejax.data.cameras import CameraInputs, CameraOptions
from radejax.data.kradar.conditions import WEATHERS
from radejax.data.projection import encode
from radejax.data.records import Records
from radejax.detection.decode import DecodeOptions, decode
from radejax.geometry.boxes import bev_corners
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.config import FULL_SIZE, SimulationOptions
from radejax.simulation.radar import tensor
from radejax.simulation.simulator import SequenceSimulator
from radejax.simulation.world.traffic import make_sequence

# Calibration of the front camera in K-Radar's sequence 1.
CALIBRATION = CameraCalibration.from_angles(
    intrinsics=(567.7208, 577.2137, 628.7208, 369.3069),
    distortion=(-0.0288738, 0.0006023, 0.0039573, -0.0050472, 0.0),
    yaw_deg=88.6,
    pitch_deg=0.6,
    roll_deg=89.6,
    translation_m=(0.18, -0.13, 0.0),
)


# Tesseracts and projections ----------------------------------------------------------


def make_tesseract(shape):
    """Returns column-major noise `[D, R, E, A]` with K-Radar's order of magnitude."""
    rng = np.random.default_rng(0)
    noise = rng.standard_exponential(shape[::-1], np.float32)
    return (noise * np.float32(1e10)).T


def project_released(tesseract):
    """Computes the projection `[R, A, D+E]` of the authors' code: logarithms, two maxima."""
    level = (10 * np.log10(tesseract + 1e-10) + 1.2) / 184.3
    level = np.transpose(level, (1, 3, 2, 0))  # [R, A, E, D]
    return np.concatenate([level.max(axis=2), level.max(axis=3)], axis=-1)


def adc_in_numpy(samples, radar):
    """The steps of `adc_to_power` in NumPy, in the precision of the samples."""
    of_range, of_doppler, weights = radar.windows()
    spectrum = np.fft.fft(samples * of_range)
    spectrum = np.fft.fft(spectrum * of_doppler[:, None, None, None], axis=0)
    spectrum = np.fft.fftshift(spectrum, axes=0)
    num_chirps, num_tx, _, num_samples = samples.shape
    loops = np.arange(num_chirps) / num_chirps - 0.5
    cycles = np.multiply.outer(loops, np.arange(num_tx) / num_tx)
    spectrum *= np.exp(-2j * np.pi * cycles)[..., None, None]
    signals = spectrum.reshape(num_chirps, -1, num_samples).swapaxes(1, 2)
    steering = (radar.steering() * weights[:, None]).astype(samples.dtype)
    power = np.square(np.abs(signals.astype(samples.dtype) @ steering))
    return power.reshape(*power.shape[:2], -1, len(radar.azimuth_rad))


def frames_of(size, **camera):
    """Returns a batch of random projections with eight boxes each in the field of view."""
    rng = np.random.default_rng(0)
    boxes = np.zeros((size, 8, 8), np.float32)
    boxes[..., 0] = rng.uniform(5, 70, (size, 8))
    boxes[..., 1] = rng.uniform(-5, 5, (size, 8))
    boxes[..., 3:6] = (4.2, 1.9, 1.6)
    boxes[..., 7] = 1.0
    return Batch(
        projection=0.6
        * rng.random((size, *RadarGrid.kradar().projection_shape), np.float32),
        boxes=boxes,
        classes=rng.integers(0, 5, (size, 8)).astype(np.int32),
        is_valid=np.ones((size, 8), bool),
        frame=np.arange(size, dtype=np.int32),
        **camera,
    )


def simulator_of(weather="rain"):
    """Returns the arrays of one frame of the simulated radar, and the simulating function."""
    options = SimulationOptions(**FULL_SIZE)
    rng = np.random.default_rng(len(weather))
    sequence = make_sequence(1, ("urban", "day", weather), 1, rng)
    grid, parameters = options.make_grid(), options.radar.make_parameters()
    simulator = SequenceSimulator(sequence, options)
    arrays = simulator.radar_input(sequence.frame(0)).arrays
    return arrays, functools.partial(tensor.simulate, grid=grid, parameters=parameters)


# Records -----------------------------------------------------------------------------


@contextlib.contextmanager
def folder_of_records(count, grid, dtype):
    """Context manager of records with random projections in a temporary folder."""
    levels = np.random.default_rng(0).random(grid.projection_shape, np.float32)
    with tempfile.TemporaryDirectory() as folder:
        source = {"grid": grid.to_dict()}
        records = Records.create(folder, grid.projection_shape, dtype, source)
        for k in range(count):
            records.write(f"1/{k:05d}", encode(levels, dtype))
        yield records


@contextlib.contextmanager
def front_images(count):
    """Context manager of camera inputs: four stereo images of 2.5 MB, used in turn."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:720, :2560]
    scene = 100 + 50 * np.sin(u / 200) + 40 * np.cos(v / 150)
    with tempfile.TemporaryDirectory() as folder:
        paths = [pathlib.Path(folder) / f"cam-front_{i:05d}.png" for i in range(4)]
        for path in paths:
            noisy = scene[..., None] + rng.normal(0, 2, (720, 2560, 3))
            Image.fromarray(noisy.astype(np.uint8)).save(path)
        yield CameraInputs(
            cameras=(CALIBRATION.camera(),) * count,
            image_size=(720, 1280),
            options=CameraOptions(),
            features=None,
            sources=[paths[i % len(paths)] for i in range(count)],
            calibrated_sizes=[(720, 1280)] * count,
        )


def thread_counts():
    """Returns 1, 2 and the number of usable CPUs, each once."""
    return sorted({1, 2, usable_cpus()})


def labeled(records):
    """Returns the frames of the records, with five boxes each."""
    box = np.array([[20.0, 1, 0, 4, 2, 1.5, 0.3]])
    return [
        types.SimpleNamespace(
            key=key,
            boxes=np.repeat(box, 5, 0),
            classes=np.array(["Sedan"] * 5),
            columns={},
        )
        for key in sorted(records.keys())
    ]


def write_npy(folder, count, grid):
    """Writes random float64 projections `[D+E, R, A]` like the authors' code; returns paths."""
    r, a, c = grid.projection_shape
    stored = np.random.default_rng(0).random((c, r, a))
    paths = [folder / f"DERA_tesseract_{i:05d}.npy" for i in range(count)]
    for path in paths:
        np.save(path, stored)
    return paths


def read_npy(paths, size, count):
    """Reads `count` frames in batches with `np.load` and `np.stack`; files repeat cyclically."""
    names = itertools.cycle(paths)
    for _ in range(count // size):
        np.stack([np.load(path) for path in itertools.islice(names, size)])


# Maps, and the authors' post-processing step by step ---------------------------------

MAP_GRID = RadarGrid.kradar().padded(8)
MAP_SHAPE = (MAP_GRID.num_range, MAP_GRID.num_azimuth, 5)
THRESHOLD, NMS_IOU = 0.3, 0.3


def make_maps(num_peaks: int, seed: int = 0) -> DetectionMaps:
    """Returns maps with single-bin peaks of distinct scores that are three or more bins apart."""
    rng = np.random.default_rng(seed)
    logits = rng.uniform(-6, -4, MAP_SHAPE).astype(np.float32)
    cells = [(i, j) for i in range(20, 256, 3) for j in range(1, 111, 3)]
    cells = rng.permutation(cells)[:num_peaks]
    classes = rng.integers(0, 5, num_peaks)
    logits[cells[:, 0], cells[:, 1], classes] = np.linspace(4, -0.5, num_peaks)
    params = rng.normal(0, 0.3, (*MAP_SHAPE[:2], 8)).astype(np.float32)
    params[..., 3:6] += [4.5, 2.0, 1.6]
    yaw = rng.uniform(-np.pi, np.pi, MAP_SHAPE[:2])
    params[..., 6], params[..., 7] = np.sin(yaw), np.cos(yaw)
    return DetectionMaps(jnp.asarray(logits[None]), jnp.asarray(params[None]))


def loop_decode(logits: np.ndarray, params: np.ndarray) -> list[tuple]:
    """Decodes (score, class, box) of one frame's peaks in a loop, sorts them and applies NMS."""
    scores = 1 / (1 + np.exp(-logits))
    around = np.pad(scores, [(1, 1), (1, 1), (0, 0)], constant_values=-np.inf)
    around = np.lib.stride_tricks.sliding_window_view(around, (3, 3), (0, 1))
    is_peak = (scores >= around.max((-2, -1))) & (scores > THRESHOLD)
    found = {}
    for i, j, cls in np.argwhere(is_peak):
        if (i, j) not in found or scores[i, j, cls] > found[i, j][0]:
            x, y = MAP_GRID.bin_to_ego(int(i), int(j))
            dx, dy, z, length, width, height, sin, cos = params[i, j]
            box = (x + dx, y + dy, z, length, width, height, np.arctan2(sin, cos))
            found[i, j] = (scores[i, j, cls], cls, np.array(box))
    return loop_nms(sorted(found.values(), key=lambda f: -f[0]))


def loop_nms(found: list[tuple]) -> list[tuple]:
    """Applies greedy NMS in a loop to boxes in descending order of score."""
    kept = []
    while found:
        best, rest = found[0], found[1:]
        kept.append(best)
        found = [f for f in rest if loop_iou(best[2], f[2]) < NMS_IOU]
    return kept


def loop_iou(a: np.ndarray, b: np.ndarray) -> float:
    shape_a, shape_b = (shapely.Polygon(bev_corners(box)) for box in (a, b))
    shared = shape_a.intersection(shape_b).area
    return shared / (shape_a.area + shape_b.area - shared)


def decoder(pre_nms):
    """Returns a decoder of maps with the given number of peaks before NMS."""
    return functools.partial(
        decode,
        grid=MAP_GRID,
        options=DecodeOptions(
            max_detections=pre_nms, score_threshold=THRESHOLD, nms_iou=NMS_IOU
        ),
        pre_nms=pre_nms,
    )


def peaks_on_host(num_peaks):
    """Returns the arguments of `loop_decode` for one frame's maps."""
    maps = make_maps(num_peaks)
    return [np.asarray(x[0]) for x in (maps.heatmap_logits, maps.box_params)]


# Predictions -----------------------------------------------------------------------

COUNTS = (20000, 4200, 1800, 160, 570)
SIZES = ((4.4, 1.9, 1.6), (9, 2.6, 3), (0.7, 0.7, 1.7), (2, 0.8, 1.5), (1.8, 0.7, 1.6))


def synthetic_set(num_frames: int = 17536, false_per_frame: float = 2.0, seed: int = 0):
    """Returns ground truth, predictions and frames with the object counts of the test split."""
    rng = np.random.default_rng(seed)
    counts = [int(n * num_frames / 17536) for n in COUNTS]
    cls = np.repeat(np.arange(5), counts)
    num = cls.size
    # As in traffic, some frames have many objects and others few.
    weight = rng.gamma(0.7, size=num_frames)
    frame = np.sort(rng.choice(num_frames, num, p=weight / weight.sum()))
    rng.shuffle(cls)
    box = np.column_stack(
        [
            rng.uniform(2, 72, num),
            rng.uniform(-6.4, 6.4, num),
            rng.normal(0.5, 0.4, num),
            np.array(SIZES)[cls] * rng.uniform(0.85, 1.15, (num, 3)),
            rng.choice([0, np.pi / 2, np.pi], num) + rng.normal(0, 0.2, num),
        ]
    )
    copies = rng.choice([0, 1, 2, 3], num, p=[0.2, 0.6, 0.15, 0.05])
    source = np.repeat(np.arange(num), copies)
    noise = rng.normal(0, [0.4, 0.25, 0.15, 0.4, 0.15, 0.12, 0.1], (source.size, 7))
    found = box[source] + noise * rng.choice([0.3, 1, 2], (source.size, 1))
    found[:, 6] += np.pi * (rng.random(source.size) < 0.1)
    found[:, 3:6] = np.maximum(np.abs(found[:, 3:6]), 0.1)
    found_cls = np.where(
        rng.random(source.size) < 0.08, rng.integers(0, 5, source.size), cls[source]
    )
    num_false = int(false_per_frame * num_frames)
    false = box[rng.integers(0, num, num_false)] + rng.normal(0, 4, (num_false, 7))
    false[:, 3:6] = np.maximum(np.abs(false[:, 3:6]), 0.3)
    frame_all = np.concatenate([frame[source], rng.integers(0, num_frames, num_false)])
    score = np.concatenate([rng.beta(4, 2, source.size), rng.beta(1.2, 4, num_false)])
    names = np.array(CLASSES)
    sequence = np.arange(num_frames) * 58 // num_frames + 1
    frames = {
        "frame": np.arange(num_frames),
        "sequence": sequence,
        "weather": np.array(WEATHERS)[sequence % 7],
    }
    predictions = {
        "frame": frame_all,
        "box": np.concatenate([found, false]),
        "cls": names[np.concatenate([found_cls, rng.integers(0, 5, num_false)])],
        "score": np.round(score, 4),
    }
    return {"frame": frame, "box": box, "cls": names[cls]}, predictions, frames


def onnx_session(path):
    """Returns a function from a projection to all outputs of an exported detector."""
    import onnxruntime  # an optional dependency, in the extra "onnx"

    session = onnxruntime.InferenceSession(path)
    settings = {
        "score_threshold": [0.0] * len(CLASSES),
        "nms_iou": 0.3,
        "roi": [-1e9, 1e9] * 3,
    }
    given = {name: np.asarray(x, np.float32) for name, x in settings.items()}
    return lambda projection: session.run(None, given | {"projection": projection})
