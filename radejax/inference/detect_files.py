"""Boxes for folders of frames: what `radejax detect` does.

Labels are not needed, but for images: in K-Radar only the header of a label file says
which image belongs to a frame.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import tqdm

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.structures import Detections
from radejax.data.cameras import camera_inputs
from radejax.data.kradar import KRadar
from radejax.data.tesseract import read_frame
from radejax.geometry.camera import Camera
from radejax.inference.detector import Detector
from radejax.inference.open import Step, load

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
    return path.absolute().parent.parent, path.stem.removeprefix("DERA_")


def front_images(
    paths: Sequence[pathlib.Path],
    detector: Detector,
    labels: str | os.PathLike | None = None,
    version: str = "v2.1",
) -> dict[pathlib.Path, tuple[pathlib.Path, Camera]]:
    """Image and camera of the files of frames that have both.

    Args:
        paths: Of `find_frames`.
        detector: Of a radar-camera model.
        labels: Label revision, see `KRadar`; the sequences' own label files if None,
            where there are any.
        version: Of these labels.

    Raises:
        UserError: The labels are of another version, or a calibration is of images of
            another size than the model's.
    """
    sequences = [
        folder
        for folder in {path.absolute().parent.parent for path in paths}
        if folder.name.isdecimal() and (labels or any(folder.glob("info_label*")))
    ]
    if not sequences:
        return {}
    frames = KRadar(
        sorted({folder.parent for folder in sequences}),
        labels,
        version=version,
        visibility=None,
        field_of_view=False,
        sequence_numbers={int(folder.name) for folder in sequences},
        common_camera=detector.camera_options.calibration == "common",
    )
    options = dataclasses.replace(detector.camera_options, allow_missing=True)
    cameras = camera_inputs(frames, detector.model.image_size, options).cameras
    return {
        path: (frame.camera_path, camera)
        for frame, camera in zip(frames, cameras, strict=True)
        for path in (frame.tesseract_path, frame.projection_path)
        if path is not None and frame.camera_path is not None and camera.is_valid
    }


def detect_files(
    source: str | os.PathLike,
    paths: Sequence[str | os.PathLike],
    out: str | os.PathLike,
    *,
    step: Step = None,
    batch_size: int = 8,
    labels: str | os.PathLike | None = None,
    image_backbone: str | os.PathLike | None = None,
    **settings: Any,
) -> dict[str, int]:
    """Detects in every frame and writes one JSON file each, atomically.

    Args:
        source: Model, as `load` takes it: a run, an exported folder, ...
        paths: Files and folders of frames.
        out: Folder for `<sequence>_<frame>.json`: a list of {cls, score, x, y, z, l,
            w, h, yaw}, metres and radians in the ego frame.
        step: Of a run: a number or "best"; the newest if None.
        batch_size: Frames at once.
        labels: Label revision that says which image belongs to a frame, for
            radar-camera models; the one that a run was trained with if None. Of the
            version that the model's config states, v2.1 without one.
        image_backbone: See `Detector.from_workdir`.
        **settings: `score_threshold`, `nms_iou`, `roi` of the detector.

    Returns:
        Counts "frames" and "boxes", and for a radar-camera model "radar_alone": frames
        without a label file, image or calibration.

    Raises:
        FileNotFoundError: A path does not exist.
        UserError: There is no frame, two would be written to one file, or an image or
            a weight is not as expected.
    """
    frames = find_frames(paths)
    _check_names(frames)
    loaded = load(source, step=step, image_backbone=image_backbone)
    detector = Detector.from_loaded(loaded)
    out = pathlib.Path(out)
    out.mkdir(parents=True, exist_ok=True)
    chunks = [frames[i : i + batch_size] for i in range(0, len(frames), batch_size)]

    known: dict[pathlib.Path, tuple[pathlib.Path, Camera]] = {}
    if detector.takes_camera:
        labels = labels or (loaded.run.get("data") or {}).get("labels")
        version = loaded.config.data.label_version if loaded.config else "v2.1"
        known = front_images(frames, detector, labels, version)

    def batches() -> Iterator[tuple[Any, ...]]:
        for chunk in chunks:
            radar = np.stack([read_frame(path, detector.grid) for path in chunk])
            if known:
                pairs = [known.get(path.absolute(), (None, None)) for path in chunk]
                yield radar, *map(list, zip(*pairs, strict=True))
            else:
                yield (radar,)

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


def _check_names(frames: Sequence[pathlib.Path]) -> None:
    """`UserError` if two frames would be written to one file."""
    seen: dict[str, pathlib.Path] = {}
    for path in frames:
        other = seen.setdefault(output_name(path), path)
        if other is not path:
            raise UserError(
                f"{other} and {path} would both be written as "
                f"{output_name(path)}.json: detect each root into a folder of its own"
            )


def output_name(path: pathlib.Path) -> str:
    """Name that is unique among sequences: "5_tesseract_00033"."""
    stem = path.stem.removeprefix("DERA_")
    sequence = path.absolute().parent.parent.name
    return f"{sequence}_{stem}" if sequence else stem
