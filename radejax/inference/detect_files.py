"""Boxes for folders of frames: what `radejax detect` does.

Labels are not needed, but for images: in K-Radar only the header of a label file says
which image belongs to which frame.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import tqdm

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.structures import Detections
from radejax.data.kradar import KRadar
from radejax.data.kradar.conditions import check_weather, read_description
from radejax.data.pipeline import camera_inputs
from radejax.evaluation import kitti
from radejax.geometry.camera import Camera
from radejax.inference.detector import Detector
from radejax.inference.saved import Step

PATTERNS = ("tesseract_*.mat", "DERA_tesseract_*.npy")
"""Patterns of the names of radar files."""


def find_frames(
    paths: Sequence[str | os.PathLike],
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
) -> list[pathlib.Path]:
    """Tesseract and projection files among files and below folders, sorted.

    If a frame exists as both, the projection is taken.

    Args:
        paths: Files and folders.
        sequence_numbers: Only these sequences; all if None.
        weather: Only sequences of these, by their `description.txt`; all if None.

    Raises:
        FileNotFoundError: A path, or a `description.txt`, does not exist.
        UserError: There is no frame; names what was looked for.
    """
    found: set[pathlib.Path] = set()
    for path in map(pathlib.Path, paths):
        if not path.exists():
            raise FileNotFoundError(f"no such file or folder: {path}")
        if path.is_file():
            found.add(path)
        for pattern in PATTERNS:
            found.update(path.rglob(pattern))
    folders = {_sequence(path) for path in found}
    if sequence_numbers:
        wanted = {str(number) for number in sequence_numbers}
        folders = {f for f in folders if f.name.lstrip("0") in wanted}
    if weather:
        check_weather(weather)
        descriptions = {f: read_description(f / "description.txt") for f in folders}
        folders = {f for f in folders if descriptions[f].weather in weather}
    frames = {
        (_sequence(path), path.stem.removeprefix("DERA_")): path
        for path in sorted(found, key=lambda path: (path.suffix == ".npy", path))
        if _sequence(path) in folders
    }
    if not frames:
        asked = map(str, [*paths, *(sequence_numbers or ()), *(weather or ())])
        raise UserError(
            f"no frames for {', '.join(asked)}: looked for {' and '.join(PATTERNS)}"
        )
    return sorted(frames.values())


def _sequence(path: pathlib.Path) -> pathlib.Path:
    return path.absolute().parent.parent


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
        for folder in {_sequence(path) for path in paths}
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
    file_format: str = "json",
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
    labels: str | os.PathLike | None = None,
    image_backbone: str | os.PathLike | None = None,
    **settings: Any,
) -> dict[str, int]:
    """Detect in every frame and write one file per frame, atomically.

    Args:
        source: Model, as `load_model` takes it: a run, an exported folder, ...
        paths: Files and folders of frames.
        out: Folder for `<sequence>_<radar>.json`: a list of {frame, cls, score, x, y, z,
            l, w, h, yaw}, meters and radians in the radar frame, frame
            "sequence/radar".
        step: Step of the checkpoint, or "best"; the latest if None.
        batch_size: Frames at once.
        file_format: "json", or "kitti" for `preds/000000.txt` as K-Radar's tools write
            them, and `frames.json` with the frames of these numbers.
        sequence_numbers: See `find_frames`, as `weather`.
        weather: See `find_frames`.
        labels: Label revision used to find the image of each frame, for radar-camera
            models; the one that a run was trained with if None.
        image_backbone: See `Detector.from_workdir`.
        **settings: `score_threshold`, `nms_iou`, `roi` of the detector.

    Returns:
        Counts "frames", "boxes" and "clipped", boxes of them with a size that was
        clipped, and for a radar-camera model "radar_only": frames without a label file,
        image or calibration.

    Raises:
        FileNotFoundError: A path does not exist.
        UserError: There is no frame, two would be written to one file, or an image or
            a weight is not as expected.
    """
    frames = find_frames(paths, sequence_numbers, weather)
    seen: dict[str, pathlib.Path] = {}
    for path in frames:
        if (other := seen.setdefault(output_name(path), path)) is not path:
            raise UserError(
                f"{other} and {path} would both be written as "
                f"{output_name(path)}.json: detect each root into a folder of its own"
            )
    detector = Detector.from_workdir(source, step, image_backbone=image_backbone)
    data, out = detector.saved.config.data, pathlib.Path(out)
    known: dict[pathlib.Path, tuple[pathlib.Path, Camera]] = {}
    if detector.takes_camera:
        labels = labels or data.labels
        known = front_images(frames, detector, labels, data.label_version)
    out.mkdir(parents=True, exist_ok=True)
    keys = [frame_key(path) for path in frames]
    names = [f"{output_name(path)}.json" for path in frames]
    if file_format == "kitti":
        names = [f"preds/{number:06d}.txt" for number in range(len(frames))]
        table = {"frame": list(range(len(frames))), "name": keys}
        files.write_json(out / "frames.json", table)
    batches = [slice(i, i + batch_size) for i in range(0, len(frames), batch_size)]
    inputs: list[Any] = [frames[batch] for batch in batches]
    if known:
        images = [known.get(path.absolute(), (None, None)) for path in frames]
        inputs = [(frames[b], *zip(*images[b], strict=True)) for b in batches]
    found = detector.stream(inputs, **settings)
    count = {"frames": len(frames), "boxes": 0, "clipped": 0}
    with tqdm.tqdm(total=len(frames), desc="detect", unit="frame") as bar:
        for batch, detections in zip(batches, found, strict=True):
            texts = _texts(keys[batch], detections, file_format)
            for name, text in zip(names[batch], texts, strict=True):
                files.write_text(out / name, text)
            count["boxes"] += int(np.asarray(detections.is_valid).sum())
            count["clipped"] += int(detections.num_clipped.sum())
            bar.update(len(texts))
    if detector.takes_camera:
        count["radar_only"] = detector.num_radar_only
    return count


def _texts(keys: Sequence[str], detections: Detections, file_format: str) -> list[str]:
    """Contents of the files of some frames."""
    if file_format == "kitti":
        return [f"{text}\n" for text in kitti.prediction_texts(detections)]
    frames = zip(keys, detections.to_list(), strict=True)
    named = [[{"frame": key, **box} for box in boxes] for key, boxes in frames]
    return [json.dumps(boxes, indent=2) + "\n" for boxes in named]


def frame_key(path: pathlib.Path) -> str:
    """Key without the part that only labels tell: "5/00033"."""
    radar = path.stem.removeprefix("DERA_").removeprefix("tesseract_")
    sequence = _sequence(path).name
    return f"{sequence}/{radar}" if sequence else radar


def output_name(path: pathlib.Path) -> str:
    """Name that is unique among sequences: "5_00033"."""
    return frame_key(path).replace("/", "_")
