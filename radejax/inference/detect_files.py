"""Detection in folders of frames, as in `radejax detect`.

Labels are needed only to find images: in K-Radar, only the header of a label file states
which image belongs to each frame.
"""

from __future__ import annotations

import csv
import itertools
import json
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import tqdm

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import PathLike
from radejax.core.structures import BOX_FIELDS, Detections, frame_key
from radejax.data.cameras import camera_inputs, require_images
from radejax.data.dataset import FrameSequence, find_reader
from radejax.data.kradar import KRadar
from radejax.data.kradar.conditions import check_weather, read_description
from radejax.data.kradar.folders import sequence_number
from radejax.data.kradar.reduced import is_reduced_file
from radejax.data.pipeline import frame_histories
from radejax.evaluation import kitti
from radejax.geometry.camera import Camera
from radejax.inference.detector import Detector
from radejax.inference.saved import Step

PATTERNS = ("tesseract_*.mat", "DERA_tesseract_*.npy", "polar3d_*.npy", "rpc_*.npy")
"""Patterns of the names of radar files."""


def find_frames(
    paths: Sequence[PathLike],
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
) -> list[pathlib.Path]:
    """Find radar files in files and folders.

    If a frame has both files, only the projection is returned.

    Args:
        paths: Files, which are taken whatever their name, and folders, which are searched
            recursively.
        sequence_numbers: Numbers of the sequences to take; all if None.
        weather: Kinds of weather to take, according to the `description.txt` of each
            sequence; all if None.

    Returns:
        Sorted paths of the files.

    Raises:
        FileNotFoundError: A path, or a `description.txt`, does not exist.
        UserError: There is no frame; the message names what was searched.
    """
    found: set[pathlib.Path] = set()
    for path in map(files.as_path, paths):
        if not path.exists():
            raise FileNotFoundError(f"no such file or folder: {path}")
        is_file = path.is_file()
        found.update([path] if is_file else files.find_files(path, *PATTERNS))
    folders = {sequence_folder(path) for path in found}
    if sequence_numbers:
        folders = {f for f in folders if sequence_number(f) in sequence_numbers}
    if weather:
        check_weather(weather)
        descriptions = {f: read_description(f / "description.txt") for f in folders}
        folders = {f for f in folders if descriptions[f].weather in weather}
    frames = {
        (sequence_folder(path), path.stem.removeprefix("DERA_")): path
        for path in sorted(found, key=lambda path: (path.suffix == ".npy", path))
        if sequence_folder(path) in folders
    }
    if not frames:
        asked = map(str, [*paths, *(sequence_numbers or ()), *(weather or ())])
        raise UserError(
            f"no frames for {', '.join(asked)}: looked for {' and '.join(PATTERNS)}"
        )
    return sorted(frames.values())


def sequence_folder(path: pathlib.Path) -> pathlib.Path:
    """Returns the folder of the sequence of a radar file."""
    folder = path.absolute().parent
    return folder if is_reduced_file(path) else folder.parent


def front_images(
    paths: Sequence[pathlib.Path],
    detector: Detector,
    labels: PathLike | None = None,
    camera_calibration: PathLike | None = None,
    roots: Sequence[PathLike] = (),
) -> dict[pathlib.Path, tuple[pathlib.Path, Camera]]:
    """Find the images and cameras of frames.

    Args:
        paths: Radar files that `find_frames` returned.
        detector: Detector of a radar-camera model. The version of the labels is that of
            its config.
        labels: Label revision, see `KRadar`. If None, the label files of the sequences
            are used, and sequences without them have no images.
        camera_calibration: Folder of camera calibrations; None for those in the roots.
        roots: Files and folders in which `find_frames` searched. Folders of sequences
            without radar files may have their images and labels.

    Returns:
        Image file and camera by the path of the radar file, for the frames that have both.

    Raises:
        UserError: The labels are of another version, there are images and no calibration,
            or a calibration is for images of another size than the model's.
    """
    searched = map(files.as_path, roots)
    others = {path.absolute() for path in searched if path.is_dir()}
    others = {root for root in others if any(map(sequence_number, root.iterdir()))}
    folders = {sequence_folder(path) for path in paths}
    others -= {folder.parent for folder in folders}
    sequences = {f for f in folders if sequence_number(f) is not None}
    if not (labels or others):
        sequences = {f for f in sequences if any(f.glob("info_label*"))}
    if not sequences:
        return {}
    frames = KRadar(
        sorted({folder.parent for folder in sequences}) + sorted(others),
        labels,
        version=detector.saved.config.data.label_version,
        visibility=None,
        field_of_view=False,
        sequence_numbers={int(folder.name) for folder in sequences},
        camera_calibration=camera_calibration,
        common_camera=detector.camera_options.calibration == "common",
    )
    cameras = _cameras(frames, detector)
    return {
        path: (frame.camera_path, camera)
        for frame, camera in zip(frames, cameras, strict=True)
        for path in (frame.tesseract_path, frame.projection_path)
        if path is not None and frame.camera_path is not None and camera.is_valid
    }


def _cameras(frames: FrameSequence, detector: Detector) -> Sequence[Camera]:
    """Return the camera of every frame.

    Raises:
        UserError: There are images, and no calibration for any of them.
    """
    options = detector.camera_options.replace(allow_missing=True)
    inputs = camera_inputs(frames, detector.model.options.image.size, options)
    if any(frame.camera_path is not None for frame in frames):
        require_images(frames, inputs, "dataset")
    return inputs.cameras


def detect_files(
    source: PathLike,
    paths: Sequence[PathLike],
    out: PathLike,
    *,
    step: Step = None,
    batch_size: int = 8,
    file_format: str = "json",
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
    labels: PathLike | None = None,
    camera_calibration: PathLike | None = None,
    image_backbone: PathLike | None = None,
    **settings: Any,
) -> dict[str, int]:
    """Detect the objects in every frame, and write one file per frame atomically.

    Args:
        source: Path of the model, such as a run or an exported folder, see `load_model`.
        paths: Files and folders of frames.
        out: Folder of the files `<sequence>_<radar>.json`. Each contains a list of {frame,
            cls, score, x, y, z, l, w, h, yaw}, in meters and radians in the radar frame;
            the value of "frame" is "<sequence>/<radar>".
        step: Step of the checkpoint, or "best"; the latest if None.
        batch_size: Number of frames per call of the detector.
        file_format: "json", or "kitti" for files `preds/000000.txt` in the format of
            K-Radar's tools, and `frames.json` with the frames that these numbers stand for.
            "csv" writes one table `boxes.csv` of all boxes at the end, in the columns of
            the records.
        sequence_numbers: Numbers of the sequences to take, see `find_frames`.
        weather: Kinds of weather to take, see `find_frames`.
        labels: Label revision in which a radar-camera model's images are looked up; the
            revision that the run was trained with if None.
        camera_calibration: Folder of camera calibrations; that of the run if None.
        image_backbone: Weights of the image backbone, see `Detector.from_workdir`.
        **settings: `score_threshold`, `nms_iou` and `roi` of the detector.

    Returns:
        The numbers of "frames", of "boxes" and of "clipped" boxes, whose size was clipped.
        For a model of several frames, "repeated" is the number of frames that repeat
        themselves, as there is no preceding one. For a radar-camera model, "radar_only" is
        the number of frames without a label file, image or calibration.

    Raises:
        FileNotFoundError: A path does not exist.
        UserError: There is no frame, two frames would be written to the same file, a
            radar-camera model has images without any calibration, or an image or weight is
            not as expected.
    """
    detector = Detector.from_workdir(source, step, image_backbone=image_backbone)
    data = detector.saved.config.data
    reader = find_reader(data.format)
    read = _files if reader.has_files_of_frames else _frames
    part = {"sequence_numbers": sequence_numbers, "weather": weather}
    own = labels or data.labels, camera_calibration or data.camera_calibration
    keys, radar, images = read(paths, part, detector, *own)

    def inputs(batch: slice) -> Any:
        of_batch = radar(batch)
        return (of_batch, *zip(*images[batch], strict=True)) if images else of_batch

    out = files.as_path(out)
    out.mkdir(parents=True, exist_ok=True)
    names = [f"{key.replace('/', '_')}.json" for key in keys]
    if file_format == "kitti":
        names = [f"preds/{number:06d}.txt" for number in range(len(keys))]
        table = {"frame": list(range(len(keys))), "name": keys}
        files.write_json(out / "frames.json", table)
    batches = _batches(keys, detector.num_frames, batch_size)
    rows: list[dict[str, Any]] = []
    streams = (detector.stream(map(inputs, part), **settings) for part in batches)
    found = itertools.chain.from_iterable(streams)
    count = {"frames": len(keys), "boxes": 0, "clipped": 0}
    with tqdm.tqdm(total=len(keys), desc="detect", unit="frame") as bar:
        for batch, detections in zip(itertools.chain(*batches), found, strict=True):
            if file_format == "csv":
                rows += itertools.chain(*_records(keys[batch], detections))
            else:
                texts = _texts(keys[batch], detections, file_format)
                for name, text in zip(names[batch], texts, strict=True):
                    files.write_text(out / name, text)
            count["boxes"] += int(np.asarray(detections.is_valid).sum())
            count["clipped"] += int(detections.num_clipped.sum())
            bar.update(len(keys[batch]))
    if file_format == "csv":
        columns = ("frame", "cls", "score", *BOX_FIELDS)
        path = out / "boxes.csv"
        with files.atomic_path(path) as temporary, open(temporary, "w") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    if detector.num_frames > 1:
        count["repeated"] = len(batches)
    if detector.takes_camera:
        count["radar_only"] = detector.num_radar_only
    return count


def _batches(
    keys: Sequence[str], num_frames: int, batch_size: int
) -> list[list[slice]]:
    """Return the batches of every part of consecutive frames, which is one stream.

    All frames are one part if a sample has one frame.
    """
    starts = [0]
    if num_frames > 1:
        before = {key: sample[0] for key, sample in frame_histories(keys, 2).items()}
        pairs = itertools.pairwise(keys)
        starts += [i for i, (a, b) in enumerate(pairs, 1) if before[b] != a]
    return [
        [slice(i, min(i + batch_size, end)) for i in range(start, end, batch_size)]
        for start, end in itertools.pairwise([*starts, len(keys)])
    ]


Inputs = tuple[list[str], Callable[[slice], Any], list[Any]]
"""Keys of frames, a function that reads a batch of radar data, and images with cameras.

The latter are empty if no frame has any."""


def _files(
    paths: Sequence[PathLike],
    part: Mapping[str, Any],
    detector: Detector,
    labels: PathLike | None,
    camera_calibration: PathLike | None,
) -> Inputs:
    """Find the frames in K-Radar's files."""
    frames = find_frames(paths, **part)
    seen: dict[str, pathlib.Path] = {}
    for path in frames:
        if (other := seen.setdefault(key_of(path), path)) is not path:
            raise UserError(
                f"{other} and {path} would both be written as frame "
                f"{key_of(path)}: detect each root into a folder of its own"
            )
    if detector.num_frames > 1:  # folders of tensors and of projections may be mixed
        frames.sort(key=key_of)
    keys = [key_of(path) for path in frames]
    images: list[Any] = []
    if detector.takes_camera:
        known = front_images(frames, detector, labels, camera_calibration, paths)
        if known:
            images = [known.get(path.absolute(), (None, None)) for path in frames]
    return keys, frames.__getitem__, images


def _frames(
    roots: Sequence[PathLike],
    part: Mapping[str, Any],
    detector: Detector,
    labels: PathLike | None,
    camera_calibration: PathLike | None,
) -> Inputs:
    """Find the frames by the reader of the run's own format."""
    config = detector.saved.config
    options = config.data.replace(
        roots=tuple(map(str, roots)),
        labels=None if labels is None else str(labels),
        camera_calibration=camera_calibration and str(camera_calibration),
        sequences=tuple(part["sequence_numbers"] or ()),
        weather=tuple(part["weather"] or ()),
    )
    frames = find_reader(options.format).from_options(options, config.classes)
    frames = frames.part(options.sequences, options.weather)
    if not len(frames):
        named = ", ".join(map(str, roots))
        raise UserError(f"no frames in {named}: give the roots of the dataset")
    if detector.grid != frames.grid:
        raise UserError(f"{roots[0]}: the radar has other axes than that of the run")
    images: list[Any] = []
    if detector.takes_camera:
        images = [
            (frame.camera_path, camera) if camera.is_valid else (None, None)
            for frame, camera in zip(frames, _cameras(frames, detector), strict=True)
        ]

    def read(batch: slice) -> Any:
        return np.stack([f.read_projection(frames.grid) for f in frames[batch]])

    return [frame.key for frame in frames], read, images


def _texts(keys: Sequence[str], detections: Detections, file_format: str) -> list[str]:
    """Return the contents of the files of a batch of frames."""
    if file_format == "kitti":
        return [f"{text}\n" for text in kitti.prediction_texts(detections)]
    named = _records(keys, detections)
    return [json.dumps(boxes, indent=2) + "\n" for boxes in named]


def _records(keys: Sequence[str], detections: Detections) -> list[list[dict[str, Any]]]:
    """Return the boxes of every frame of a batch, with the key of the frame."""
    frames = zip(keys, detections.to_list(), strict=True)
    return [[{"frame": key, **box} for box in boxes] for key, boxes in frames]


def key_of(path: pathlib.Path) -> str:
    """Return the key of the frame of a radar file without the LiDAR index: "5/00033".

    Only label files contain the LiDAR index.
    """
    radar = path.stem
    for pattern in ("DERA_*", *PATTERNS):
        radar = radar.removeprefix(pattern.partition("*")[0])
    sequence = sequence_folder(path).name
    return frame_key(f"{sequence}/{radar}" if sequence else radar)
