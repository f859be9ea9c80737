"""Boxes for folders of frames, without labels: what `radejax detect` does."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import tqdm

from radejax import files
from radejax.data.tesseract import read_frame
from radejax.detector import Detector
from radejax.errors import UserError
from radejax.structures import Detections

PATTERNS = ("tesseract_*.mat", "DERA_tesseract_*.npy")
"""Names of the files that hold a frame."""


def find_frames(paths: Sequence[str | os.PathLike]) -> list[pathlib.Path]:
    """Tesseract and projection files among files and below folders, sorted.

    Of a frame that is there as both, the projection is taken.

    Raises:
        FileNotFoundError: A path does not exist.
        UserError: There is no frame; says what was looked for.
    """
    found: set[pathlib.Path] = set()
    for path in map(pathlib.Path, paths):
        if not path.exists():
            raise FileNotFoundError(f"no such file or folder: {path}")
        if path.is_file():
            found.add(path)
        for pattern in PATTERNS:
            found.update(path.rglob(pattern))
    if not found:
        names = ", ".join(map(str, paths))
        raise UserError(f"no frames in {names}: looked for {' and '.join(PATTERNS)}")
    frames = {_frame_key(path): path for path in sorted(found, key=_by_preference)}
    return sorted(frames.values())


def _by_preference(path: pathlib.Path) -> tuple[bool, pathlib.Path]:
    return path.suffix == ".npy", path


def _frame_key(path: pathlib.Path) -> tuple[pathlib.Path, str]:
    return path.parent.parent, path.stem.removeprefix("DERA_")


def detect_files(
    workdir: str | os.PathLike,
    paths: Sequence[str | os.PathLike],
    out: str | os.PathLike,
    *,
    step: int | None = None,
    batch_size: int = 8,
    **settings: Any,
) -> dict[str, int]:
    """Detects in every frame and writes one JSON file each, atomically.

    Args:
        workdir: Run of `train.py`.
        paths: Files and folders of frames.
        out: Folder for `<sequence>_<frame>.json`: a list of {cls, score, x, y, z, l,
            w, h, yaw}, metres and radians in the ego frame.
        step: Of the checkpoint; the newest if None.
        batch_size: Frames at once.
        **settings: `score_threshold`, `nms_iou`, `roi` of the detector.

    Returns:
        Counts "frames" and "boxes", and for a radar-camera model "radar_alone": files
        of frames name no image, so that these are all of them. Evaluating a run uses
        the images.
    """
    frames = find_frames(paths)
    detector = Detector.from_workdir(workdir, step)
    out = pathlib.Path(out)
    out.mkdir(parents=True, exist_ok=True)
    chunks = [frames[i : i + batch_size] for i in range(0, len(frames), batch_size)]

    def batches() -> Iterator[np.ndarray]:
        for chunk in chunks:
            yield np.stack([read_frame(path, detector.grid) for path in chunk])

    num_boxes = 0
    found: Iterator[Detections] = detector.stream(batches(), **settings)
    with tqdm.tqdm(total=len(frames), desc="detect", unit="frame") as bar:
        for chunk, detections in zip(chunks, found, strict=True):
            for path, boxes in zip(
                chunk, detections.to_list(detector.classes), strict=True
            ):
                files.write_json(out / f"{output_name(path)}.json", boxes)
                num_boxes += len(boxes)
            bar.update(len(chunk))
    count = {"frames": len(frames), "boxes": num_boxes}
    if detector.takes_camera:
        count["radar_alone"] = detector.num_radar_alone
    return count


def output_name(path: pathlib.Path) -> str:
    """Name that is unique among sequences: "5_tesseract_00033"."""
    stem = path.stem.removeprefix("DERA_")
    sequence = path.absolute().parent.parent.name
    return f"{sequence}_{stem}" if sequence else stem
