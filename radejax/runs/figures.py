"""Figures of a run: frames with boxes, losses, and how much fusion uses the camera."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from jaxtyping import Float

from radejax.core import files
from radejax.core.structures import Boxes
from radejax.data.cameras import front_view
from radejax.data.dataset import FrameSequence, LabelledFrame
from radejax.data.kradar.conditions import WEATHERS
from radejax.data.pipeline import LoaderOptions, make_loader, make_table
from radejax.data.projection import decode
from radejax.data.records import Records
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.detection import LOSSES
from radejax.runs.data import Data
from radejax.visualize import curves
from radejax.visualize.draw import draw_frame, draw_scenes
from radejax.visualize.style import Scene, save_figure


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


class FrameDrawer:
    """Draws frames of a dataset with their ground truth and predictions.

    Args:
        records: Projections.
        frames: The dataset.
        predictions: Predictions by position in `frames`.
        roi: Region of the evaluation, x, y, z from and to in meters, or None.
        score_threshold: Predictions from here on are drawn, as in use of the detector.
    """

    def __init__(
        self,
        records: Records,
        frames: FrameSequence,
        predictions: Boxes,
        *,
        roi: Sequence[float] | None,
        score_threshold: float,
    ) -> None:
        assert predictions.score is not None
        self._records = records
        self._frames = frames
        self._predictions = predictions.take(predictions.score >= score_threshold)
        self._fields = {"roi": roi, "score_threshold": score_threshold}

    def __call__(self, index: int, path: str | os.PathLike) -> None:
        """Draw the frame at a position of the dataset into a file."""
        save_figure(draw_frame(self._scene(int(index))), path)

    def _scene(self, index: int, **fields: Any) -> Scene:
        """The frame at a position with its boxes and image."""
        return frame_scene(
            self._frames[index],
            decode(self._records[self._frames[index].key]),
            self._records.grid,
            predictions=self._predictions.take(self._predictions.frame == index),
            **self._fields,
            **fields,
        )

    def draw_scenes(self, path: str | os.PathLike) -> None:
        """Draw the frame with the most objects of each weather, side by side.

        The layout of RADE-Net's Figure 4.
        """
        fullest: dict[str, int] = {}
        for i, frame in enumerate(self._frames):
            best = fullest.setdefault(frame.weather, i)
            if len(frame.boxes) > len(self._frames[best].boxes):
                fullest[frame.weather] = i
        # In the order of tables; unknown weathers come last.
        names = [name for name in WEATHERS if name in fullest]
        names += sorted(set(fullest) - set(WEATHERS))
        scenes = [
            self._scene(
                fullest[name], title=f"{name} ({self._frames[fullest[name]].key})"
            )
            for name in names
        ]
        save_figure(draw_scenes(scenes), path)

    def draw_spread(self, folder: pathlib.Path, count: int) -> list[pathlib.Path]:
        """Draw frames with objects, spread evenly over the dataset."""
        candidates = [i for i, frame in enumerate(self._frames) if len(frame.boxes)]
        paths = []
        for index in _spread(candidates, count):
            frame = self._frames[index]
            paths.append(folder / f"{frame.sequence:02d}_{frame.name}.png")
            self(index, paths[-1])
        return paths


def _spread(values: Any, count: int) -> list[Any]:
    """At most `count` of a sequence, evenly spread."""
    places = np.linspace(0, len(values) - 1, min(count, len(values)))
    return [values[int(i)] for i in np.round(places)]


def draw_curves(
    workdir: pathlib.Path, path: pathlib.Path, *, is_simulated: bool = False
) -> None:
    """Draw the losses of a run, if it has any, over its steps into a file."""
    if not (workdir / "metrics.jsonl").exists():
        return
    series = curves.read_metrics(workdir / "metrics.jsonl")
    keys = [name for name in LOSSES if name in series]
    if keys:
        title = workdir.name + (", simulated" if is_simulated else "")
        save_figure(curves.draw_training(series, keys, title), path)


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
    table = make_table(
        data.records,
        frames,
        max_objects=max(len(frame.boxes) for frame in frames) or 1,
        classes=data.classes,
        images=data.images(frames),
    )
    options = LoaderOptions(
        batch_size=8,
        shuffle=False,
        num_epochs=1,
        pad_remainder=True,
        process_index=0,  # only the main process draws
        process_count=1,
    )

    @jax.jit
    def share_of(variables: Any, inputs: Any) -> jax.Array:
        _, sown = model.apply(variables, *inputs, mutable=["intermediates"])
        return sown["intermediates"]["image_fusion"]["camera_share"][0]

    variables = jax.device_put(dict(variables))
    for batch in make_loader(table, options):
        found = np.asarray(share_of(variables, batch.model_inputs()), np.float64)
        for index, share in zip(batch.frame, found, strict=True):
            if index >= 0:
                yield frames[index], share


def average_by_group(
    shares: Iterable[tuple[str, Float[np.ndarray, "R A"]]],
) -> tuple[dict[str, Float[np.ndarray, "R A"]], dict[str, int]]:
    """Mean maps of groups, "all" first, over what the camera sees.

    A bin that no query sees in the image has weight 0, which says nothing about the
    gate: every bin is averaged over the frames that have it in view.

    Args:
        shares: Group and map of every frame.

    Returns:
        Means by group, 0 in bins that no frame has in view, and the numbers of
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


def mean_share(share: Float[np.ndarray, "R A"], grid: RadarGrid) -> float:
    """Mean of a map over the bins in view, those above 0; NaN without any.

    Bins beyond the grid are padding and do not count.
    """
    share = np.asarray(share)[: grid.num_range, : grid.num_azimuth]
    return float(share[share > 0].mean()) if (share > 0).any() else float("nan")


def write_camera_share(
    path: pathlib.Path,
    model: nn.Module,
    variables: Mapping[str, Any],
    data: Data,
    frames: FrameSequence,
) -> None:
    """Write the mean weight of the camera by weather as JSON, with numbers of frames.

    At most 256 frames, evenly spread, are used. Means are over the bins in view; null
    without any. Other arguments as of `frame_shares`.
    """
    shares = frame_shares(model, variables, data, _spread(frames, 256))
    maps, counts = average_by_group((frame.weather, share) for frame, share in shares)
    means = {name: mean_share(share, data.records.grid) for name, share in maps.items()}
    summary = {
        name: {"mean": None if np.isnan(mean) else mean, "frames": counts[name]}
        for name, mean in means.items()
    }
    files.write_json(path, summary)
