"""Untrained detectors of a few thousand parameters, with and without a camera."""

import dataclasses
import functools
import json
import pathlib
from typing import Any

import flax.linen as nn
import jax
import numpy as np

from radejax import Detector, models
from radejax.config import Config, load_config
from radejax.core.structures import Batch
from radejax.geometry.camera import CameraCalibration, stack_cameras
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.saved import SavedModel
from radejax.models.lifting import OFFICIAL_OFFSET_M

CONFIGS = pathlib.Path(__file__).resolve().parents[1] / "configs"
IMAGE_SIZE = (32, 48)


def small_grid() -> RadarGrid:
    return RadarGrid.reduced(
        num_doppler=2, num_range=16, num_elevation=3, num_azimuth=14, max_range_m=30.0
    )


def uneven_grid(**axes: np.ndarray) -> RadarGrid:
    """A radar without elevation, uniform in sin(azimuth) and log(range), or other axes."""
    fields = {
        "range_m": np.geomspace(2.0, 30.0, 16),
        "azimuth_rad": np.arcsin(np.linspace(-0.8, 0.8, 14)),
        "elevation_rad": np.array([]),
        "doppler_mps": np.linspace(-4.0, 4.0, 4, endpoint=False),
        "fov_range_m": 30.0,
        "fov_azimuth_rad": 0.9,
    }
    return RadarGrid(**(fields | axes))


_SIZES = {"doppler_bins": 2, "elevation_bins": 3, "neck": "plain", "heads": "default"}
_SIZES |= {"widths": (8, 8), "decoder_width": 8, "num_groups": 4}


def shrink_run(config: Config) -> Config:
    """Few bins and channels for a quickstart, so that a run takes seconds."""
    grid = {"num_doppler": 4, "num_range": 24, "num_elevation": 3, "num_azimuth": 16}
    return config.replace(
        simulation={"grid": grid},
        model=_SIZES | {"doppler_bins": 4},
        decode={"score_threshold": 0.3},
    )


def write_config(path: pathlib.Path, config: Config) -> pathlib.Path:
    """Write a config as a file for `--config`."""
    path.write_text(
        "from radejax.config import Config\n"
        f"def get_config():\n    return Config(**{json.loads(config.model_dump_json())!r})\n"
    )
    return path


def radar_config() -> Config:
    return Config().replace(model=_SIZES, decode={"score_threshold": 0.3})


def camera_config() -> Config:
    """Config of a whole DinoRADE of small size."""
    image = {"hidden_size": 16, "num_layers": 1, "num_heads": 2, "mlp_dim": 16}
    return load_config("dinorade").replace(
        model=_SIZES
        | {
            "image": image | {"size": IMAGE_SIZE},
            "fusion": {"num_heads": 2, "num_points": 2, "num_elevation": 3},
            "query_grid": {"range_m": (1.0, 1.9), "azimuth_deg": (-50.0, 7.0)},
        },
        decode={"score_threshold": 0.3},
    )


@functools.lru_cache(maxsize=4)
def _variables(kind: str, num_frames: int) -> Any:
    """Random variables: initial zeros would hide the values that they multiply."""
    config = {"radar": radar_config, "camera": camera_config}[kind]()
    *bins, channels = small_grid().projection_shape
    inputs = [np.zeros((1, *bins, num_frames * channels), np.float32)]
    if kind == "camera":
        inputs.append(np.zeros((1, *IMAGE_SIZE, 3), np.uint8))
        inputs.append(stack_cameras([calibration().camera()]))
    return drawn(models.build(config.model, num_frames), *inputs)


def drawn(module: nn.Module, *inputs: Any, seed: int = 0) -> Any:
    """Random variables of a module instead of its initial ones.

    Only shapes are traced, as compiling the initialization takes longer than most tests.
    """
    shapes = jax.eval_shape(module.init, jax.random.key(0), *inputs)
    rng = np.random.default_rng(seed)

    def fill(path: tuple, shape: jax.ShapeDtypeStruct) -> np.ndarray:
        noise = rng.normal(size=shape.shape)
        if path[-1].key in ("scale", "var", "layer_scale_1", "layer_scale_2"):
            values = np.exp(0.1 * noise)
        else:
            values = noise / np.sqrt(max(1, np.prod(shape.shape[:-1])))
        return values.astype(shape.dtype)

    return jax.tree_util.tree_map_with_path(fill, shapes)


@functools.cache
def detector(kind: str = "radar", *, num_frames: int = 1, **overrides: Any) -> Detector:
    """The same detector for the same arguments, so that it is compiled once."""
    options = {"batch_sizes": (4,), "score_threshold": 0.1} | overrides
    return Detector(saved(kind, data__num_frames=num_frames), **options)


def detector_with_output(*, num_frames: int = 1, **options: Any) -> Detector:
    """A detector with an own output "velocity" of two channels."""
    made = saved(model__outputs={"velocity": 2}, data__num_frames=num_frames)
    *bins, channels = small_grid().projection_shape
    variables = drawn(made.model, np.zeros((1, *bins, num_frames * channels)))
    made = dataclasses.replace(made, variables=variables)
    return Detector(made, **{"score_threshold": 0.1, **options})


def saved(kind: str = "radar", **changes: Any) -> SavedModel:
    """An untrained model; `changes` are fields of its config, dots as "__"."""
    config = {"radar": radar_config, "camera": camera_config}[kind]()
    fields = {name.replace("__", "."): value for name, value in changes.items()}
    config = config.with_fields(fields)
    variables = _variables(kind, config.data.num_frames)
    return SavedModel(config, small_grid(), variables)


def simulate(folder: pathlib.Path, **fields: Any) -> pathlib.Path:
    """Simulated data in a folder, with projections instead of tensors by default."""
    from radejax.simulation.config import SimulationOptions
    from radejax.simulation.dataset import simulate_dataset

    options = SimulationOptions().replace(**{"output": "projection", **fields})
    return simulate_dataset(options, folder, progress=False)


def projections(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    shape = (count, *small_grid().projection_shape)
    return rng.uniform(0, 1, shape).astype(np.float32)


def images(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.integers(0, 256, (count, *IMAGE_SIZE, 3), dtype=np.uint8)


def labeled_batch(projection: np.ndarray, image: np.ndarray | None = None) -> Batch:
    """Frames with two sedans each, and their images from the small camera."""
    count, rng = len(projection), np.random.default_rng(0)
    boxes = np.zeros((count, 3, 8), np.float32)
    boxes[..., 0] = rng.uniform(5, 25, (count, 3))
    boxes[..., 3:] = (4.4, 1.9, 1.6, 0.0, 1.0)
    batch = Batch(
        projection=projection,
        boxes=boxes,
        classes=np.zeros((count, 3), np.int32),
        is_valid=np.tile([True, True, False], (count, 1)),
        frame=np.arange(count, dtype=np.int32),
    )
    if image is None:
        return batch
    height, width = image.shape[1:3]
    camera = calibration(width=width, height=height).camera()
    return batch.replace(image=image, camera=stack_cameras([camera] * count))


def official_calibration() -> CameraCalibration:
    """The camera of the released DinoRADE, from a golden file."""
    file = np.load(CONFIGS.parent / "tests" / "golden" / "dinorade_geometry.npz")
    matrix, extrinsics = file["intrinsics"], file["extrinsics"]
    return CameraCalibration(
        intrinsics=matrix[[0, 1, 0, 1], [0, 1, 2, 2]],
        distortion=np.zeros(5),
        rotation=extrinsics[:, :3],
        translation_m=extrinsics[:, 3],
        radar_from_lidar_m=OFFICIAL_OFFSET_M,
    )


def forward_camera(**fields: Any) -> CameraCalibration:
    """100 x 80 pixels, focal length 50, looking along x from the radar."""
    settings = {"intrinsics": (50.0, 50.0, 50.0, 40.0), "width": 100, "height": 80}
    settings["radar_from_lidar_m"] = (0.0, 0.0, 0.0)
    return calibration(**(settings | fields))


def calibration(**fields: Any) -> CameraCalibration:
    settings = {
        "intrinsics": (24.0, 24.0, 24.0, 16.0),
        "yaw_deg": 90.0,
        "pitch_deg": 0.0,
        "roll_deg": 90.0,
        "translation_m": (0.0, 0.0, 0.0),
        "width": IMAGE_SIZE[1],
        "height": IMAGE_SIZE[0],
    }
    return CameraCalibration.from_angles(**(settings | fields))
