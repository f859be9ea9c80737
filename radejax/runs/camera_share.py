"""What a fusion model takes from the camera, by weather: the gate's map averaged."""

from __future__ import annotations

import math
import pathlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from ml_collections import ConfigDict

from radejax import models
from radejax.core import files
from radejax.data.encoding import model_inputs
from radejax.data.frame_table import make_table
from radejax.data.kradar.frame import Frame
from radejax.data.pipeline import LoaderOptions, make_loader
from radejax.data.records.projections import RecordSource
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs.data import camera_inputs


def camera_share(
    config: ConfigDict,
    variables: Mapping[str, Any],
    records: RecordSource,
    frames: Sequence[Frame],
    *,
    embeddings: str | None = None,
    group: Callable[[Frame], str] = lambda frame: frame.weather,
    max_frames: int = 256,
    batch_size: int = 8,
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Mean share of the camera in the fused map by group of frames, "all" first.

    Args:
        config: Of a radar-camera run.
        variables: Of its model.
        records: Projections.
        frames: Of a data set; evenly spread ones where there are more than `max_frames`.
        embeddings: Folder of embeddings in place of images.
        group: Names the group of a frame.
        max_frames: Limit of frames.
        batch_size: Frames at once.

    Returns:
        `[R, A]` means by group, and how many frames with an image each is of; see
        `average_by_group`.
    """
    spread = np.linspace(0, len(frames) - 1, min(max_frames, len(frames)))
    frames = [frames[int(i)] for i in np.round(spread)]
    table = make_table(
        records,
        frames,
        max_objects=max(len(frame.boxes) for frame in frames) or 1,
        classes=config.classes,
        images=camera_inputs(config, frames, embeddings),
    )
    options = LoaderOptions(
        batch_size,
        shuffle=False,
        num_epochs=1,
        pad_remainder=True,
        process_index=0,  # only the main process draws
        process_count=1,
    )
    loader = make_loader(table, options)
    model = models.build(config.model)

    @jax.jit
    def share_of(variables: Any, inputs: Any) -> jax.Array:
        _, sown = model.apply(variables, *inputs, mutable=["intermediates"])
        return sown["intermediates"]["image_fusion"]["camera_share"][0]

    variables = jax.device_put(dict(variables))

    def shares() -> Iterator[tuple[str, np.ndarray]]:
        for batch in loader:
            found = np.asarray(share_of(variables, model_inputs(batch)), np.float64)
            for index, share in zip(batch.frame, found, strict=True):
                if index >= 0:
                    yield group(frames[index]), share

    return average_by_group(shares())


def average_by_group(
    shares: Iterable[tuple[str, np.ndarray]],
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Mean maps of groups, "all" first, over what the camera sees.

    A bin that no query sees in the image has share 0, which says nothing of the gate:
    every bin is averaged over the frames that have it in view.

    Args:
        shares: Group and `[R, A]` share of every frame.

    Returns:
        `[R, A]` means by group, 0 in bins that no frame has in view, and the numbers of
        frames with anything in view, that is, with an image.
    """
    sums: dict[str, Any] = {}
    seen: dict[str, Any] = {}
    counts: dict[str, int] = {}
    for group, share in shares:
        is_seen = share > 0
        for name in ("all", group):
            sums[name] = sums.get(name, 0.0) + share
            seen[name] = seen.get(name, 0) + is_seen
            counts[name] = counts.get(name, 0) + int(is_seen.any())
    return {name: sums[name] / np.maximum(seen[name], 1) for name in sums}, counts


def write_camera_share(
    out: pathlib.Path,
    maps: Mapping[str, np.ndarray],
    counts: Mapping[str, int],
    grid: RadarGrid,
) -> None:
    """Writes `camera_share.json` (means and counts) and `camera_share.png`.

    Means are over the bins in view; null without any.
    """
    from radejax.visualize import bev
    from radejax.visualize.camera_share import draw_camera_share, mean_share

    means = {name: mean_share(share, grid) for name, share in maps.items()}
    summary = {
        name: {"mean": None if math.isnan(m) else m, "frames": counts[name]}
        for name, m in means.items()
    }
    files.write_json(out / "camera_share.json", summary)
    bev.save_figure(
        draw_camera_share(maps, grid, counts=counts), out / "camera_share.png"
    )
