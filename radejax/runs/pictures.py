"""Pictures of a run: frames with boxes, losses, and what fusion takes from the camera."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np

from radejax.data.dataset import FrameSequence, LabelledFrame
from radejax.data.encoding import decode, model_inputs
from radejax.data.frame_table import make_table
from radejax.data.images import front_view
from radejax.data.kradar.sequences import WEATHERS
from radejax.data.pipeline import LoaderOptions, make_loader
from radejax.data.records.projections import RecordSource, record_positions
from radejax.losses.detection import loss_names
from radejax.runs.data import Data
from radejax.visualize import bev, curves
from radejax.visualize.camera_share import average_by_group, write_camera_share
from radejax.visualize.canvas import Scene
from radejax.visualize.scenes import draw_scenes


class FrameDrawer:
    """Draws frames of a data set with their ground truth and predictions.

    Args:
        records: Projections.
        frames: The data set.
        predictions: Columns as `predict_dataset` returns.
        roi: Region of the evaluation, x, y, z from and to in metres, or None.
        score_threshold: Predictions from here on are drawn, as a detector in use would
            show them.
    """

    def __init__(
        self,
        records: RecordSource,
        frames: FrameSequence,
        predictions: Mapping[str, np.ndarray],
        *,
        roi: Sequence[float] | None,
        score_threshold: float,
    ) -> None:
        self._records = records
        self._frames = frames
        self._positions = record_positions(records, frames)
        self._predictions = predictions
        self._roi = roi
        self._score_threshold = score_threshold

    def __call__(self, index: int, path: str | os.PathLike) -> None:
        """Draws the frame at a position of the data set into a picture file."""
        frame = self._frames[int(index)]
        title = (
            f"sequence {frame.sequence}, frame {frame.name}, {frame.weather}"
            f"{_simulated(frame.is_simulated)}"
        )
        scene = dataclasses.replace(self._scene(int(index)), title=title)
        figure = bev.draw_frame(scene)
        bev.save_figure(figure, path)

    def _scene(self, index: int) -> Scene:
        """The frame at a position with its boxes and image."""
        frame = self._frames[index]
        mine = self._predictions["frame"] == index
        mine &= self._predictions["score"] >= self._score_threshold
        columns = {k: v[mine] for k, v in self._predictions.items()}
        record = self._records[self._positions[index]]
        image, camera = front_view(frame)
        return Scene(
            decode(record["projection"]),
            self._records.grid,
            ground_truth=(frame.boxes, list(frame.classes)),
            predictions=(columns["box"], columns["score"], list(columns["cls"])),
            roi=self._roi,
            score_threshold=self._score_threshold,
            image=image,
            camera=camera,
            title=f"{frame.weather} ({frame.key}){_simulated(frame.is_simulated)}",
        )

    def draw_scenes(self, path: str | os.PathLike) -> None:
        """Draws one frame of each weather, that with the most objects, side by side.

        The layout of RADE-Net's Figure 4.
        """
        fullest: dict[str, int] = {}
        for i, frame in enumerate(self._frames):
            best = fullest.setdefault(frame.weather, i)
            if len(frame.boxes) > len(self._frames[best].boxes):
                fullest[frame.weather] = i
        scenes = [self._scene(fullest[w]) for w in sorted(fullest, key=_place)]
        figure = draw_scenes(scenes)
        bev.save_figure(figure, path)

    def draw_spread(self, folder: pathlib.Path, count: int) -> list[pathlib.Path]:
        """Draws frames with objects, spread evenly over the data set."""
        candidates = [i for i, frame in enumerate(self._frames) if len(frame.boxes)]
        if not candidates or count < 1:
            return []
        folder.mkdir(parents=True, exist_ok=True)
        spread = np.linspace(0, len(candidates) - 1, min(count, len(candidates)))
        paths = []
        for index in np.array(candidates)[np.round(spread).astype(int)]:
            frame = self._frames[index]
            paths.append(folder / f"{frame.sequence:02d}_{frame.name}.png")
            self(index, paths[-1])
        return paths


def _place(weather: str) -> int:
    """Of a weather in every table; unknown ones come last."""
    return WEATHERS.index(weather) if weather in WEATHERS else len(WEATHERS)


def _simulated(is_simulated: bool) -> str:
    """The end of a title."""
    return ", simulated" if is_simulated else ""


def draw_curves(
    workdir: pathlib.Path, path: pathlib.Path, *, is_simulated: bool = False
) -> None:
    """Draws the losses of a run, if it has any, over its steps into a picture file."""
    if not (workdir / "metrics.jsonl").exists():
        return
    title = f"{workdir.name}{_simulated(is_simulated)}"
    series = curves.read_metrics(workdir / "metrics.jsonl")
    parts = [name for name in loss_names() if name in series]
    figure = curves.draw_training(series, keys=parts, title=title)
    bev.save_figure(figure, path)


def draw_camera_share(
    model: nn.Module,
    variables: Mapping[str, Any],
    data: Data,
    frames: FrameSequence,
    out: pathlib.Path,
) -> None:
    """Writes `camera_share.json` and `camera_share.png`, see `camera_share`."""
    shares = camera_share(model, variables, data, frames)
    title = "Simulated data" if data.frames.is_simulated else ""
    write_camera_share(out, *shares, data.records.grid, title=title)


def camera_share(
    model: nn.Module,
    variables: Mapping[str, Any],
    data: Data,
    frames: FrameSequence,
    *,
    max_frames: int = 256,
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Mean share of the camera in the fused map by weather, "all" first.

    Args:
        model: Radar-camera detector.
        variables: Of the model.
        data: Of the run, or others.
        frames: Of them; evenly spread ones where there are more than `max_frames`.
        max_frames: Limit of frames.

    Returns:
        `[R, A]` means by weather, and how many frames with an image each is of; see
        `average_by_group`.
    """
    spread = np.linspace(0, len(frames) - 1, min(max_frames, len(frames)))
    frames = [frames[int(i)] for i in np.round(spread)]
    found = frame_shares(model, variables, data, frames)
    return average_by_group((frame.weather, share) for frame, share in found)


def frame_shares(
    model: nn.Module,
    variables: Mapping[str, Any],
    data: Data,
    frames: FrameSequence,
    *,
    batch_size: int = 8,
) -> Iterator[tuple[LabelledFrame, np.ndarray]]:
    """Every frame with its `[R, A]` share of the camera in the fused map, in [0, 1].

    0 in bins that no query sees in the image, and everywhere without an image. The maps
    are padded as the model's are. Arguments as of `camera_share`.
    """
    table = make_table(
        data.records,
        frames,
        max_objects=max(len(frame.boxes) for frame in frames) or 1,
        classes=data.classes,
        images=data.images(frames),
    )
    options = LoaderOptions(
        batch_size=batch_size,
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
        found = np.asarray(share_of(variables, model_inputs(batch)), np.float64)
        for index, share in zip(batch.frame, found, strict=True):
            if index >= 0:
                yield frames[index], share
