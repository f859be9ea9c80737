"""Health report on a K-Radar copy: existing, missing and corrupted files."""

from __future__ import annotations

import collections
import contextlib
import itertools
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from radejax.core.errors import DataError, UserError
from radejax.core.files import JsonObject, PathLike
from radejax.core.structures import CLASSES
from radejax.data.cameras import front_view
from radejax.data.check import HealthReport, Rows, count_objects, find_splits
from radejax.data.dataset import Summary
from radejax.data.kradar.conditions import KRADAR_CONDITIONS, UNKNOWN_CONDITIONS
from radejax.data.kradar.dataset import Frame, KRadar
from radejax.data.kradar.folders import SequenceFolder, read_calibration
from radejax.data.kradar.labels import MEDIAN_SIZES_M
from radejax.data.kradar.tesseract import check_frame
from radejax.geometry.boxes import MIN_OBJECTS, find_size_problem
from radejax.geometry.radar_grid import RadarGrid

MIN_SEEN = 0.5
"""Smallest plausible fraction of the objects of a sequence that are in view, of those that are
visible to the radar. In K-Radar's labels v2.1, it is 0.95; in v2.0, which do not contain the
visibility, it is 0.6."""


def check_dataset(
    roots: PathLike | Iterable[PathLike],
    *,
    deep: bool = False,
    progress: bool = False,
    **options: Any,
) -> HealthReport:
    """Checks a K-Radar copy and reports its content and its problems.

    Label files are read completely. Only the head and the size of radar tensors are
    checked, so that a copy of 16 TB takes minutes.

    Args:
        roots: Folder or folders that contain the sequences.
        deep: Whether to read every image, and to read and project every radar tensor, which
            finds all corruption and takes hours.
        progress: Whether to show a progress bar.
        **options: Options of `KRadar`: `labels`, `version`, `camera_calibration`, and the
            `sequences` and `weather` of the sequences to check.

    Raises:
        FileNotFoundError: A root or `labels` does not exist.
        UserError: There are no sequence folders or no labels, no frames of the given
            sequences and weathers, or the labels have another version.
        DataError: The folders or the labels are ambiguous or corrupted as a whole.
    """
    data = KRadar(roots, **options)
    summary = data.summary()
    splits = find_splits(data)
    groups = itertools.groupby(data, key=lambda frame: frame.sequence)
    frames = {number: list(group) for number, group in groups}
    folders = dict(data.files.sequences)
    if any(options.get(name) is not None for name in ("sequences", "weather")):
        if not frames:
            raise UserError("no frames of these sequences and weathers")
        folders = {number: folders[number] for number in frames}
    tensors = [
        (number, path)
        for number, folder in folders.items()
        for path in [*_tensors(folder), *_projections(folder)]
    ]
    corrupted: collections.Counter[int] = collections.Counter()
    for number, path in tqdm(tensors, "check", unit="file", disable=not progress):
        try:
            check_frame(path, data.grid, deep=deep)
        except DataError as error:
            kind = "tesseract" if path.suffix == ".mat" else "projection"
            summary.problems.append((f"{kind} corrupted", str(error)))
            corrupted[number] += 1
        except OSError as error:
            summary.problems.append(("tesseract not readable", str(error)))
    seen = data if deep else [own[0] for own in frames.values()]
    look = front_view if deep else Frame.calibrated_size
    for frame in tqdm(seen, "check cameras", disable=not progress):
        try:
            look(frame)
        except (DataError, OSError) as error:
            summary.report("image or calibration", f"{frame.key}: {error}")
    is_kradar = data.grid.shape_drea == RadarGrid.kradar().shape_drea
    rows = []
    for number, folder in folders.items():
        own = frames.get(number, [])
        _check_calibration(folder, own, summary)
        _check_objects(number, own, data)
        if is_kradar:
            _check_conditions(number, own, summary)
        row = _row(number, folder, own, splits)
        rows.append(row | {"radar_corrupted": corrupted[number]})
    _check_parts(rows, summary)
    names = [str(path) for path in data.files.roots]
    objects = count_objects(data, splits, CLASSES)
    return HealthReport(names, data.files.options.version, rows, objects, summary)


def _check_parts(rows: Rows, summary: Summary) -> None:
    """Reports sequences without labels, radar data or images if other ones have them."""
    for what in ("labels", "radar data", "images"):
        names = ("tesseracts", "projections") if what == "radar data" else (what,)
        lacking = [row["sequence"] for row in rows if not any(row[n] for n in names)]
        if 0 < len(lacking) < len(rows):
            numbers = ", ".join(map(str, lacking))
            summary.report("sequences", f"sequences without {what}: {numbers}")


def _tensors(folder: SequenceFolder) -> list[pathlib.Path]:
    files = folder.listing("radar_tesseract").values()
    return [path for path in files if path.suffix == ".mat"]


def _projections(folder: SequenceFolder) -> list[pathlib.Path]:
    files = folder.listing("DERA_tesseract") | folder.listing(".")
    return [path for path in files.values() if path.suffix == ".npy"]


def _row(
    number: int,
    folder: SequenceFolder,
    frames: Sequence[Frame],
    splits: Mapping[str, str],
) -> JsonObject:
    """Returns the table row of one sequence."""
    conditions = KRADAR_CONDITIONS.get(number, UNKNOWN_CONDITIONS)._asdict()
    calibration = "unknown"
    if frames:
        conditions = {name: getattr(frames[0], name) for name in conditions}
        calibration = "{:g}, {:g}".format(*frames[0].radar_from_lidar_m)
    in_split = collections.Counter(splits.get(frame.key) for frame in frames)
    return {
        "sequence": number,
        **conditions,
        "labels": len(frames),
        "train": in_split["train"],
        "test": in_split["test"],
        "projections": len(_projections(folder)),
        "images": len(folder.listing("cam-front")),
        "images_missing": sum(frame.camera_path is None for frame in frames),
        "calibration": calibration,
        "tesseracts": len(_tensors(folder)),
        "radar_missing": sum(frame.radar_path is None for frame in frames),
    }


def _check_objects(number: int, frames: Sequence[Frame], data: KRadar) -> None:
    """Reports a sequence whose objects seem to have other units than K-Radar's labels."""
    labels = [x for f in frames for x in f.labels if x.visibility == "R"]
    if len(labels) < MIN_OBJECTS:
        return
    problems = {}
    num_seen = sum(len(frame.boxes) for frame in frames)
    if num_seen < MIN_SEEN * len(labels):
        azimuth = np.rad2deg(data.grid.fov_azimuth_rad)
        problems["objects out of view"] = (
            f"{len(labels) - num_seen} of {len(labels)} objects that are visible to the "
            f"radar are not in its view of {data.grid.fov_range_m:g} m and {azimuth:.3g} deg"
        )
    boxes = np.array([label.box for label in labels])
    # In K-Radar, the largest yaw of a sequence in degrees is below 2 or above 5.
    if 3 <= np.rad2deg(np.abs(boxes[:, 6])).max() <= 3.15:
        problems["yaw unit"] = "all yaws are up to pi, as in radians, expected degrees"
    usual_m = np.array([MEDIAN_SIZES_M[label.cls] for label in labels])
    if problem := find_size_problem(boxes[:, 3:6], usual_m):
        problems["object sizes"] = f"objects have {problem} in K-Radar (median)"
    for kind, text in problems.items():
        data.summary().report(kind, f"sequence {number}: {text}")


def _check_conditions(number: int, frames: Sequence[Frame], summary: Summary) -> None:
    """Notes conditions that differ from those that K-Radar published."""
    published = KRADAR_CONDITIONS.get(number)
    for frame in frames[:1]:
        found = frame.environment, frame.time, frame.weather
        if published is not None and found != published:
            summary.notes.append(
                f"sequence {number}: description.txt has {','.join(found)}; "
                f"K-Radar published {','.join(published)}"
            )


def _check_calibration(
    folder: SequenceFolder, frames: Sequence[Frame], summary: Summary
) -> None:
    """Reports frame numbers that contradict the calibration file."""
    path = folder.find("info_calib", "calib_radar_lidar.txt")
    differences = {frame.header.radar - frame.header.lidar for frame in frames}
    with contextlib.suppress(DataError):  # already reported by KRadar
        if path and differences - {expected := read_calibration(path)[0]}:
            message = (
                f"{path}: frame difference {expected}, but radar minus LiDAR frame "
                f"numbers in the labels are {sorted(differences)}"
            )
            summary.problems.append(("calibration", message))
