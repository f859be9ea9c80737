"""Figures of a run: frames with boxes, losses, and how much fusion uses the camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from jaxtyping import Float

from radejax.core.structures import Boxes
from radejax.data.dataset import FrameSequence, LabelledFrame, front_view
from radejax.data.kradar.conditions import WEATHERS
from radejax.data.projection import decode
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs.data import Data
from radejax.visualize.style import Scene


def frame_scene(
    frame: LabelledFrame, projection: Any, grid: RadarGrid, **fields: Any
) -> Scene:
    """Scene of a labelled frame: its boxes, image, calibration and title.

    Args:
        frame: The frame.
        projection: Its `[R, A, D+E]` projection.
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
    """Position of the frame with the most objects of each weather, as tables order them.

    Unknown weathers come last.
    """
    fullest: dict[str, int] = {}
    for i, frame in enumerate(frames):
        best = fullest.setdefault(frame.weather, i)
        if len(frame.boxes) > len(frames[best].boxes):
            fullest[frame.weather] = i
    names = [*WEATHERS, *sorted(set(fullest) - set(WEATHERS))]
    return {name: fullest[name] for name in names if name in fullest}


def spread(values: Any, count: int) -> list[Any]:
    """At most `count` items, evenly spaced."""
    places = np.linspace(0, len(values) - 1, min(count, len(values)))
    return [values[int(i)] for i in np.round(places)]


def frame_shares(
    model: nn.Module,
    variables: Mapping[str, Any],
    data: Data,
    frames: FrameSequence,
) -> Iterator[tuple[LabelledFrame, Float[np.ndarray, "R A"]]]:
    """Every frame with the weight of the camera in the fused map, in [0, 1].

    0 in bins that no query sees in the image, and everywhere without an image. The maps
    are padded as the model's are.

    Args:
        model: Radar-camera detector.
        variables: Variables of the model.
        data: Data of the run, or other data.
        frames: Frames of the data.
    """
    images = data.images(frames)
    assert images is not None  # the model has a camera

    @jax.jit
    def share_of(variables: Any, projection: Any, image: Any, camera: Any) -> jax.Array:
        inputs = jax.tree.map(lambda x: x[None], (projection, image, camera))
        _, sown = model.apply(variables, *inputs, mutable=["intermediates"])
        return sown["intermediates"]["image_fusion"]["camera_share"][0][0]

    variables = jax.device_put(dict(variables))
    for index, frame in enumerate(frames):
        projection = decode(data.records[frame.key])
        inputs = projection, images.image(index), images.cameras[index]
        yield frame, np.asarray(share_of(variables, *inputs), np.float64)


def average_shares(
    shares: Iterable[tuple[str, Float[np.ndarray, "R A"]]], grid: RadarGrid
) -> dict[str, dict[str, Any]]:
    """Mean weight of the camera by group, "all" first, over what the camera sees.

    A bin that no query sees in the image has weight 0, which says nothing about the
    gate: every bin is averaged over the frames that have it in view.

    Args:
        shares: Group and map of every frame.
        grid: Of the maps without their padding.

    Returns:
        By group the "mean" over bins in view, None without any, and the number of
        "frames" with anything in view, that is, with an image.
    """
    groups, maps = zip(*shares, strict=True)
    names, stacked = np.array(groups), np.stack(maps)
    means = {}
    for name in ("all", *dict.fromkeys(groups)):
        chosen = stacked if name == "all" else stacked[names == name]
        is_seen = chosen > 0
        mean = mean_share(chosen.sum(0) / np.maximum(is_seen.sum(0), 1), grid)
        means[name] = {
            "mean": None if np.isnan(mean) else mean,
            "frames": int(is_seen.any((1, 2)).sum()),
        }
    return means


def mean_share(share: Float[np.ndarray, "R A"], grid: RadarGrid) -> float:
    """Mean of a map over the bins in view, those above 0; NaN without any.

    Bins beyond the grid are padding and do not count.
    """
    share = np.asarray(share)[: grid.num_range, : grid.num_azimuth]
    return float(share[share > 0].mean()) if (share > 0).any() else float("nan")
