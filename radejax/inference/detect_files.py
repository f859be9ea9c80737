"""Boxes for folders of frames: what `radejax detect` does.

Labels are not needed, but for images: in K-Radar only the header of a label file says
which image belongs to a frame.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import tqdm

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.structures import Detections
from radejax.data.cameras import camera_inputs
from radejax.data.kradar import KRadar
from radejax.data.kradar.sequences import read_description
from radejax.data.kradar.splits import check_weather
from radejax.data.tesseract import read_frame
from radejax.evaluation.files import kitti
from radejax.geometry.camera import Camera
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.detector import Detector
from radejax.inference.saved import Step

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
    frames = {_place(path): path for path in sorted(found, key=_by_preference)}
    return sorted(frames.values())


def chosen_frames(
    paths: Sequence[pathlib.Path],
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
) -> list[pathlib.Path]:
    """Files of the sequences and weathers that are asked for; all of them for None.

    Raises:
        UserError: There is none, or no such weather.
        FileNotFoundError: A sequence without a `description.txt` has no weather.
    """
    folders = sorted({path.absolute().parent.parent for path in paths})
    if sequence_numbers:
        wanted = {str(number) for number in sequence_numbers}
        folders = [f for f in folders if f.name.lstrip("0") in wanted]
    if weather:
        check_weather(weather)
        conditions = {f: read_description(f / "description.txt") for f in folders}
        folders = [f for f in folders if conditions[f].weather in weather]
    kept = [path for path in paths if path.absolute().parent.parent in folders]
    if not kept:
        asked = [*(sequence_numbers or ()), *(weather or ())]
        raise UserError(f"no frames of {', '.join(map(str, asked))} in these folders")
    return kept


def _by_preference(path: pathlib.Path) -> tuple[bool, pathlib.Path]:
    return path.suffix == ".npy", path


def _place(path: pathlib.Path) -> tuple[pathlib.Path, str]:
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
    file_format: str = "json",
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
    labels: str | os.PathLike | None = None,
    image_backbone: str | os.PathLike | None = None,
    **settings: Any,
) -> dict[str, int]:
    """Detects in every frame and writes one file each, atomically.

    Args:
        source: Model, as `load` takes it: a run, an exported folder, ...
        paths: Files and folders of frames.
        out: Folder for `<sequence>_<radar>.json`: a list of {frame, cls, score, x, y, z,
            l, w, h, yaw}, metres and radians in the ego frame, frame "sequence/radar".
        step: Of a run: a number or "best"; the newest if None.
        batch_size: Frames at once.
        file_format: "json", or "kitti" for `preds/000000.txt` as K-Radar's tools write
            them, and `frames.json` with the frames of these numbers.
        sequence_numbers: Only these; all if None.
        weather: Only sequences of these, by their `description.txt`; all if None.
        labels: Label revision that says which image belongs to a frame, for
            radar-camera models; the one that a run was trained with if None. Of the
            version that the model's config states, v2.1 without one.
        image_backbone: See `Detector.from_workdir`.
        **settings: `score_threshold`, `nms_iou`, `roi` of the detector.

    Returns:
        Counts "frames", "boxes" and "clipped", boxes of them with a size that was clipped,
        and for a radar-camera model "radar_only": frames without a label file, image
        or calibration.

    Raises:
        FileNotFoundError: A path does not exist.
        UserError: There is no frame, two would be written to one file, or an image or
            a weight is not as expected.
    """
    frames = chosen_frames(find_frames(paths), sequence_numbers, weather)
    _check_names(frames)
    detector = Detector.from_workdir(source, step, image_backbone=image_backbone)
    out = pathlib.Path(out)
    out.mkdir(parents=True, exist_ok=True)
    chunks = [frames[i : i + batch_size] for i in range(0, len(frames), batch_size)]

    known: dict[pathlib.Path, tuple[pathlib.Path, Camera]] = {}
    if detector.takes_camera:
        labels = labels or (detector.saved.run.get("data") or {}).get("labels")
        version = detector.saved.config.data.label_version
        known = front_images(frames, detector, labels, version)

    if file_format == "kitti":
        numbers, names = range(len(frames)), map(frame_key, frames)
        table = {"frame": list(numbers), "name": list(names)}
        files.write_json(out / "frames.json", table)
    count = {"frames": len(frames), "boxes": 0, "clipped": 0}
    found = detector.stream(_batches(chunks, detector.grid, known), **settings)
    with tqdm.tqdm(total=len(frames), desc="detect", unit="frame") as bar:
        written = 0
        for chunk, detections in zip(chunks, found, strict=True):
            count["boxes"] += int(np.asarray(detections.is_valid).sum())
            count["clipped"] += int(detections.num_clipped.sum())
            for name, text in _as_files(chunk, written, detections, file_format):
                files.write_text(out / name, text)
            written += len(chunk)
            bar.update(len(chunk))
    if detector.takes_camera:
        count["radar_only"] = detector.num_radar_only
    return count


def _batches(
    chunks: Sequence[Sequence[pathlib.Path]],
    grid: RadarGrid,
    known: Mapping[pathlib.Path, tuple[pathlib.Path, Camera]],
) -> Iterator[tuple[Any, ...]]:
    """What a detector takes, by chunks of files; with images if any are known."""
    for chunk in chunks:
        radar = np.stack([read_frame(path, grid) for path in chunk])
        if known:
            pairs = [known.get(path.absolute(), (None, None)) for path in chunk]
            yield radar, *map(list, zip(*pairs, strict=True))
        else:
            yield (radar,)


def _as_files(
    chunk: Sequence[pathlib.Path], first: int, detections: Detections, file_format: str
) -> Iterator[tuple[str, str]]:
    """Names and texts of the files of a batch whose first frame has this number."""
    if file_format == "kitti":
        for number, text in enumerate(kitti.prediction_texts(detections), first):
            yield f"preds/{number:06d}.txt", f"{text}\n"
        return
    for path, boxes in zip(chunk, detections.to_list(), strict=True):
        named = [{"frame": frame_key(path), **box} for box in boxes]
        yield f"{output_name(path)}.json", json.dumps(named, indent=2) + "\n"


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


def frame_key(path: pathlib.Path) -> str:
    """Key without the part that only labels tell: "5/00033"."""
    radar = path.stem.removeprefix("DERA_").removeprefix("tesseract_")
    sequence = path.absolute().parent.parent.name
    return f"{sequence}/{radar}" if sequence else radar


def output_name(path: pathlib.Path) -> str:
    """Name that is unique among sequences: "5_00033"."""
    return frame_key(path).replace("/", "_")
