"""Evaluation of a run: detect on a split, score, tabulate, draw."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import tqdm
from absl import logging

from radejax import files
from radejax.data.kradar import KRadar
from radejax.data.records import Records
from radejax.detector import Detector
from radejax.experiment import frame_table, ground_truth_table, load_run


def evaluate_run(
    workdir: str | os.PathLike,
    *,
    step: int | None = None,
    split: str = "test",
    out: str | os.PathLike | None = None,
    num_pictures: int | None = None,
) -> dict[str, Any]:
    """Evaluates a run's checkpoint as its config says.

    Args:
        workdir: Of `train.py`.
        step: Of the checkpoint; the newest if None.
        split: "test", "train" or a split file.
        out: Folder of the results; `evaluation` in the work folder if None.
        num_pictures: Frames drawn; as the config says if None.

    Returns:
        What `write_report` returns.
    """
    from radejax.evaluation.report import write_report

    run = load_run(workdir, step)
    config = run.config
    out = pathlib.Path(out or run.workdir / "evaluation")
    out.mkdir(parents=True, exist_ok=True)
    frames = run.paths.open(config, split)
    records = Records(run.paths.records)
    options = config.evaluation
    detector = Detector.from_config(
        config, run.variables, run.grid, score_threshold=options.score_threshold
    )
    predictions = predict_dataset(detector, records, frames, options.batch_size)
    report = write_report(
        ground_truth_table(frames),
        predictions,
        frame_table(frames),
        out,
        classes=config.classes,
        protocols=options.protocols,
        iou_thresholds=options.iou_thresholds,
        roi=options.roi,
        score_threshold=options.score_threshold,
        label_version=config.data.label_version,
    )
    logging.info("step %d, split %s\n%s", run.step, split, report.text)
    count = options.num_pictures if num_pictures is None else num_pictures
    draw_frames(records, frames, predictions, out / "pictures", config, count)
    return report


def predict_dataset(
    detector: Detector,
    records: Records,
    frames: KRadar,
    batch_size: int = 8,
    **settings: Any,
) -> dict[str, np.ndarray]:
    """Detections on every frame of a data set.

    Args:
        detector: Runs on batches of projections.
        records: Projections of the frames.
        frames: Which frames, in which order.
        batch_size: Frames at once.
        **settings: Further keyword arguments of a `Detector` call.

    Returns:
        Columns "frame" (position in `frames`), "box", "cls", "score".
    """
    positions = [records.index_of(frame) for frame in frames]
    starts = range(0, len(positions), batch_size)
    bar = tqdm.tqdm(total=len(positions), desc="detect", unit="frame")

    def batches() -> Any:
        for start in starts:
            chunk = positions[start : start + batch_size]
            yield np.stack([records[i]["projection"] for i in chunk])

    parts = []
    found = detector.stream(batches(), **settings)
    for start, detections in zip(starts, found, strict=True):
        columns = detections.to_columns(detector.classes)
        parts.append({**columns, "frame": columns["frame"] + start})
        bar.update(detections.is_valid.shape[0])
    bar.close()
    return {
        name: np.concatenate([part[name] for part in parts])
        for name in ("frame", "box", "cls", "score")
    }


def draw_frames(
    records: Records,
    frames: KRadar,
    predictions: Mapping[str, np.ndarray],
    folder: pathlib.Path,
    config: Any,
    count: int,
) -> list[pathlib.Path]:
    """Draws frames spread evenly over a data set, those with objects first choice.

    Returns:
        The pictures.
    """
    from radejax.visualize import bev

    candidates = [i for i, frame in enumerate(frames) if len(frame.boxes)]
    if not candidates or count < 1:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    spread = np.linspace(0, len(candidates) - 1, min(count, len(candidates)))
    paths = []
    for index in np.array(candidates)[np.round(spread).astype(int)]:
        frame = frames[index]
        mine = predictions["frame"] == index
        figure = bev.draw_frame(
            records[records.index_of(frame)]["projection"],
            records.grid,
            ground_truth=(frame.boxes, list(frame.classes)),
            predictions=(
                predictions["box"][mine],
                predictions["score"][mine],
                list(predictions["cls"][mine]),
            ),
            roi=config.evaluation.roi,
            image=read_left_image(frame.camera_path),
            title=f"sequence {frame.sequence}, frame {frame.name}, {frame.weather}",
        )
        paths.append(folder / f"{frame.sequence:02d}_{frame.name}.png")
        bev.save_figure(figure, paths[-1])
    logging.info("drew %d frames in %s", len(paths), folder)
    return paths


def read_left_image(path: pathlib.Path | None) -> np.ndarray | None:
    """`[H, W, 3]` uint8 left half of a stereo front image; None where there is none."""
    if path is None:
        return None
    from PIL import Image

    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    return pixels[:, : pixels.shape[1] // 2]


def write_boxes(
    predictions: Mapping[str, np.ndarray], frames: KRadar, out: pathlib.Path
) -> None:
    """Writes one JSON file a frame: its boxes, scores and classes."""
    out.mkdir(parents=True, exist_ok=True)
    for index, frame in enumerate(frames):
        mine = np.flatnonzero(predictions["frame"] == index)
        boxes = [
            {
                "cls": str(predictions["cls"][i]),
                "score": float(predictions["score"][i]),
                "box": predictions["box"][i].tolist(),
            }
            for i in mine
        ]
        files.write_json(out / f"{frame.sequence}_{frame.name}.json", boxes)
