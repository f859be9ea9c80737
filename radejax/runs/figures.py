"""Figures of a run: frames, training samples, and the camera's weight in the fusion."""

from __future__ import annotations

import logging
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import VariableDict
from jaxtyping import Float, PyTree
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from radejax import models
from radejax.config import Config
from radejax.core import files
from radejax.core.files import JsonObject
from radejax.core.structures import CLASSES, Array, Batch, Boxes
from radejax.data.cameras import front_view
from radejax.data.dataset import FrameSequence, LabeledFrame, find_reader
from radejax.data.options import DataOptions
from radejax.data.pipeline import read_sample, sample_keys
from radejax.data.projection import decode
from radejax.data.records import open_projections
from radejax.evaluation.analysis import OPERATING_SCORE
from radejax.evaluation.boxes import ids_by_name, roi_bounds
from radejax.evaluation.comparison import short_names
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, load, report_folders
from radejax.evaluation.results import ReportOptions, condition_masks, repair_sizes
from radejax.geometry.boxes import boxes7_from_8
from radejax.geometry.camera import Camera, CameraCalibration
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.focal import gaussian_heatmap
from radejax.models.radenet import RadeNet
from radejax.runs.data import Data, located, open_data
from radejax.visualize.draw import draw_samples, draw_scenes
from radejax.visualize.style import Matches, Scene, save_figure

T = TypeVar("T")

_log = logging.getLogger(__name__)


def frame_scene(
    frame: LabeledFrame,
    projection: ArrayLike,
    grid: RadarGrid,
    *,
    iou: float = 0.3,
    **fields: Any,
) -> Scene:
    """Creates the scene of a labeled frame with its boxes, image, calibration and title.

    Predictions are matched to the objects inside the region by the protocol `all_point`, so
    that figures show which are correct.

    Args:
        frame: Frame to draw.
        projection: Projection `[R, A, D+E]` of the frame.
        grid: Grid of the projection.
        iou: 3D IoU above which a prediction matches an object.
        **fields: Other fields of `Scene`, such as `predictions` and `roi`, which may also
            be "narrow" or "wide".
    """
    image, camera = front_view(frame)
    simulated = ", simulated" if frame.is_simulated else ""
    title = f"sequence {frame.sequence}, frame {frame.name}, {frame.weather}{simulated}"
    given = {"image": image, "camera": camera, "title": title, **fields}
    given["roi"] = roi_bounds(given.get("roi"))
    truth = Boxes.one_frame(frame.boxes, frame.classes)
    if (found := given.get("predictions")) is not None:
        found = Boxes.one_frame(found.box, found.cls, found.score)
        found, _ = repair_sizes(found, "false_positive")
        classes = sorted({*CLASSES, *truth.cls.tolist(), *found.cls.tolist()})
        data = EvaluationSet(truth, found, classes=classes, roi=given.get("roi"))
        given["matches"] = Matches(*data.outcomes(iou), iou)
    return Scene(projection, grid, ground_truth=truth, **given)


def draw_training_samples(config: Config, count: int = 4) -> Figure:
    """Draws the first frames of a training as the network gets them.

    Args:
        config: Config of the run. Data are simulated and preprocessed as for a run.
        count: Largest number of frames of the first batch to draw.

    Raises:
        UserError: The config does not fit the data, see `open_data`.
    """
    config.check_imports()
    config = located(config)
    data = open_data(config)
    frames = data.split("train")
    batch = next(data.training_batches())
    model = models.build(config.model, config.data.num_frames)
    grid = models.map_grid(data.records.grid, model, config.data.azimuth_mapping)
    samples = []
    for row, index in enumerate(batch.frame[:count].tolist()):
        sample: Batch = jax.tree.map(lambda x, row=row: np.asarray(x[row]), batch)
        target = gaussian_heatmap(
            jnp.asarray(sample.boxes),
            sample.classes,
            jnp.asarray(sample.is_valid),
            grid,
            num_classes=len(config.classes),
            sigma_mode=config.loss.heatmap_sigma_mode,
            sigma_bins=config.loss.heatmap_sigma_bins,
        )
        scene = _input_scene(sample, data, roi_bounds(config.evaluation.roi))
        record = decode(data.records[frames[index].key])
        frame = frame_scene(frames[index], record, scene.grid, roi=scene.roi)
        samples.append((frame, scene, np.asarray(target).max(-1)))
    return draw_samples(samples, grid)


def _input_scene(sample: Batch, data: Data, roi: tuple[float, ...] | None) -> Scene:
    """Returns the scene of one frame of a batch, without the axis of the batch."""
    grid = data.records.grid
    # The channels of several frames are reduced to their maximum, which is drawn.
    power = decode(np.asarray(sample.projection)).max(-1, keepdims=True)
    rows = sample.is_valid
    names = np.array(data.classes)[sample.classes[rows]]
    truth = Boxes.one_frame(boxes7_from_8(np.asarray(sample.boxes)[rows]), names)
    image = camera = None
    if sample.image is not None and sample.image.dtype == np.uint8:
        image = sample.image
        if isinstance(sample.camera, Camera) and sample.camera.is_valid:
            of = sample.camera
            rotation, shift_m = np.split(np.asarray(of.cam_from_ego), [3], axis=1)
            width, height = map(int, of.size_px)
            lens = np.asarray(of.intrinsics), np.asarray(of.distortion)
            no_shift_m = np.zeros(3)  # as the rotation is from the radar frame
            camera = CameraCalibration(
                *lens, rotation, shift_m[:, 0], width, height, no_shift_m
            )
    return Scene(
        np.broadcast_to(power, grid.projection_shape),
        grid,
        ground_truth=truth,
        roi=roi,
        image=image,
        camera=camera,
        title="input of the network",
    )


def fullest_of_weathers(frames: FrameSequence) -> dict[str, int]:
    """Returns the position of the frame with the most objects for each weather.

    The weathers are in the order of the tables, and unknown ones come last.
    """
    counts = np.array([len(frame.boxes) for frame in frames])
    table = {"weather": [frame.weather for frame in frames]}
    masks = condition_masks(table, "weather")
    return {name: int(np.where(m, counts, -1).argmax()) for name, m in masks.items()}


def draw_compared(
    paths: Sequence[files.PathLike],
    out_dir: pathlib.Path,
    source: Source,
    options: ReportOptions,
    ending: str,
) -> None:
    """Draws a frame of each weather with the detections of several runs side by side.

    It is the evaluated frame with the most objects, and the detections are those above the
    operating score. Of a run with several seeds, the first one is drawn. If there are no
    radar data of the frames, a warning is logged.

    Args:
        paths: Runs, reports or predictions as for `compare_files`.
        out_dir: Folder of the figures, which are named after the weathers.
        source: Source of the ground truth. Its data replace those of the runs.
        options: Settings of the comparison.
        ending: Format of the figures, such as "pdf".
    """
    folders = [next(iter(report_folders(path).values())) for path in paths]
    made_from = [x for folder in folders for x in folder.glob("source.json")]
    fields: JsonObject = {"roots": source.data, **dict(source)}
    if not source.data:
        fields = files.read_object(made_from[0]) if made_from else {}
    data_options = DataOptions(
        **{name: x for name, x in fields.items() if name in DataOptions.model_fields}
    )
    if not data_options.roots:
        _log.warning(
            "no scenes are drawn: there are no radar data of the compared frames; give "
            "--data ROOT, or runs that `radejax evaluate` has evaluated"
        )
        return
    reader = find_reader(data_options.format)
    dataset = reader.from_options(data_options, options.classes)
    records = data_options.records and open_projections(data_options.records)
    frames = {frame.key: frame for frame in dataset}
    runs = {}
    for name, folder in zip(short_names(paths), folders, strict=True):
        _, found, table, _ = load(folder, source, options.classes)
        assert found.score is not None
        # Ids differ if a run was evaluated on a part of the frames.
        runs[name] = found.take(found.score > OPERATING_SCORE), ids_by_name(table)
    evaluated = [frames[key] for key in ids_by_name(table) if key in frames]
    for weather, index in fullest_of_weathers(evaluated).items():
        frame = evaluated[index]
        if records:
            grid = records.grid
            projection = decode(records[frame.key])
        else:
            grid = dataset.grid
            projection = frame.read_projection(grid)
        suffix = ", simulated" if frame.is_simulated else ""
        scenes = [
            frame_scene(
                frame,
                projection,
                grid,
                iou=options.iou_thresholds[0],
                predictions=found.take(found.frame == ids[frame.key]),
                roi=options.roi,
                score_threshold=OPERATING_SCORE,
                title=f"{name}: {weather} ({frame.key}){suffix}",
            )
            for name, (found, ids) in runs.items()
        ]
        save_figure(draw_scenes(scenes), out_dir / f"scenes_{weather}.{ending}")


def spread(values: Sequence[T], count: int) -> list[T]:
    """Returns at most `count` evenly spaced items."""
    places = np.linspace(0, len(values) - 1, min(count, len(values)))
    return [values[int(i)] for i in np.round(places)]


def frame_shares(
    model: RadeNet,
    variables: VariableDict,
    data: Data,
    frames: FrameSequence,
) -> Iterator[tuple[LabeledFrame, Float[np.ndarray, "R A"]]]:
    """Yields every frame with a map of the camera's weight in the fusion, in [0, 1].

    The weight is 0 in bins without a query that projects into the image, and everywhere
    if the frame has no image. The maps include the padding of the model's maps.

    Args:
        model: Radar-camera detector.
        variables: Variables of the model.
        data: Data that the frames belong to.
        frames: Frames to compute the maps for.
    """
    images = data.images(frames)
    assert images is not None  # the model has a camera

    @jax.jit
    def share_of(variables: VariableDict, *inputs: PyTree[Array]) -> jax.Array:
        batch = jax.tree.map(lambda x: x[None], inputs)
        _, sown = model.apply(variables, *batch, mutable=["intermediates"])
        share: jax.Array = sown["intermediates"]["image_fusion"]["camera_share"][0][0]
        return share

    variables = jax.device_put(dict(variables))
    keys = sample_keys(data.records, frames, model.num_frames)
    for index, frame in enumerate(frames):
        projection = decode(read_sample(data.records, keys[index]))
        inputs = projection, images.image(index), images.cameras[index]
        yield frame, np.asarray(share_of(variables, *inputs), np.float64)


def average_shares(
    shares: Iterable[tuple[str, Float[np.ndarray, "R A"]]], grid: RadarGrid
) -> dict[str, JsonObject]:
    """Computes the mean weight of the camera by group over the bins in its view.

    Bins without a query that projects into the image have weight 0, which is not an output
    of the gate. Therefore every bin is first averaged over the frames that have it in view,
    then the mean over these bins is taken.

    Args:
        shares: Group and map of every frame.
        grid: Grid of the maps without their padding.

    Returns:
        A dictionary per group, with the group "all" first. "mean" is the mean over the
        bins in view, or None if there are none; "frames" is the number of frames with any
        bin in view, that is, with an image.
    """
    groups, maps = zip(*shares, strict=True)
    names = np.array(groups)
    stacked = np.stack(maps)
    means = {}
    for name in ("all", *dict.fromkeys(groups)):
        chosen = stacked if name == "all" else stacked[names == name]
        is_seen = chosen > 0
        mean = mean_share(chosen.sum(0) / np.maximum(is_seen.sum(0), 1), grid)
        count = int(is_seen.any((1, 2)).sum())
        means[name] = {"mean": None if np.isnan(mean) else mean, "frames": count}
    return means


def mean_share(share: Float[np.ndarray, "R A"], grid: RadarGrid) -> float:
    """Computes the mean of a map over the bins in view, whose weight is above 0.

    Bins beyond the grid are padding and are ignored. The result is NaN if no bin is in view.
    """
    share = np.asarray(share)[: grid.num_range, : grid.num_azimuth]
    return float(share[share > 0].mean()) if (share > 0).any() else float("nan")
