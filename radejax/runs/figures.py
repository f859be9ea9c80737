"""Figures of a run: frames with boxes, loss curves, and the camera's weight in the fusion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from flax.typing import VariableDict
from jaxtyping import Float, PyTree
from numpy.typing import ArrayLike

from radejax.core.files import JsonObject
from radejax.core.structures import Array, Boxes
from radejax.data.cameras import front_view
from radejax.data.dataset import FrameSequence, LabelledFrame
from radejax.data.pipeline import read_sample, sample_keys
from radejax.data.projection import decode
from radejax.evaluation.results import condition_masks
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.radenet import RadeNet
from radejax.runs.data import Data
from radejax.visualize.style import Scene

T = TypeVar("T")


def frame_scene(
    frame: LabelledFrame, projection: ArrayLike, grid: RadarGrid, **fields: Any
) -> Scene:
    """Create the scene of a labelled frame with its boxes, image, calibration and title.

    Args:
        frame: Frame to draw.
        projection: Projection `[R, A, D+E]` of the frame.
        grid: Grid of the projection.
        **fields: Other fields of `Scene`, such as `predictions` and `roi`.
    """
    image, camera = front_view(frame)
    simulated = ", simulated" if frame.is_simulated else ""
    title = f"sequence {frame.sequence}, frame {frame.name}, {frame.weather}{simulated}"
    given = {"image": image, "camera": camera, "title": title, **fields}
    truth = Boxes.one_frame(frame.boxes, frame.classes)
    return Scene(projection, grid, ground_truth=truth, **given)


def fullest_of_weathers(frames: FrameSequence) -> dict[str, int]:
    """Return the position of the frame with the most objects for each weather.

    The weathers are in the order of the tables, and unknown ones come last.
    """
    counts = np.array([len(frame.boxes) for frame in frames])
    table = {"weather": [frame.weather for frame in frames]}
    masks = condition_masks(table, "weather")
    return {name: int(np.where(m, counts, -1).argmax()) for name, m in masks.items()}


def spread(values: Sequence[T], count: int) -> list[T]:
    """Return at most `count` evenly spaced items."""
    places = np.linspace(0, len(values) - 1, min(count, len(values)))
    return [values[int(i)] for i in np.round(places)]


def frame_shares(
    model: RadeNet,
    variables: VariableDict,
    data: Data,
    frames: FrameSequence,
) -> Iterator[tuple[LabelledFrame, Float[np.ndarray, "R A"]]]:
    """Yield every frame with a map of the camera's weight in the fusion, in [0, 1].

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
    """Compute the mean weight of the camera by group over the bins in its view.

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
    """Compute the mean of a map over the bins in view, whose weight is above 0.

    Bins beyond the grid are padding and are ignored. The result is NaN if no bin is in view.
    """
    share = np.asarray(share)[: grid.num_range, : grid.num_azimuth]
    return float(share[share > 0].mean()) if (share > 0).any() else float("nan")
