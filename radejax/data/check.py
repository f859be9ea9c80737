"""Health report on a dataset: what there is, and what is missing, corrupted or implausible."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from radejax.core.errors import DataError, UserError
from radejax.core.files import JsonObject, PathLike
from radejax.core.structures import CLASSES, RARE_SHARE
from radejax.data.cameras import front_view
from radejax.data.dataset import FrameSequence, LabelledFrame, LabelledFrames, Summary
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

Rows = list[JsonObject]


@dataclasses.dataclass(frozen=True)
class HealthReport:
    """Result of `check_dataset` and `check_frames`.

    Attributes:
        roots: The folders that were checked.
        version: Version of the labels, or name of the reader.
        sequences: One row per sequence with its conditions, its numbers of files, and
            the numbers of labelled frames without these files.
        objects: One row per split and weather with the number of objects of every class
            that training uses: visible to the radar and in its field of view.
        summary: Counts, problems with file and line, and notes.
    """

    roots: list[str]
    version: str
    sequences: Rows
    objects: Rows
    summary: Summary

    @property
    def num_problems(self) -> int:
        """Number of missing, malformed or implausible items."""
        return len(self.summary.problems)

    def to_dict(self) -> JsonObject:
        """Returns the report as JSON values."""
        summary = {"num_problems": self.num_problems, **self.summary.to_dict()}
        return {**vars(self), "summary": summary}

    def to_text(self) -> str:
        """Returns the report as tables for a terminal."""
        names = {
            name: name.replace("_", "\n") for row in self.sequences for name in row
        }
        objects = [_with_shares(row) for row in self.objects]
        parts = [
            f"{len(self.sequences)} sequences in {', '.join(self.roots)}; labels "
            f"{self.version}",
            tabulate(self.sequences, headers=names),
            "Objects that training uses (visible to the radar and in its field of view), and "
            f"their share of the row; *: under {RARE_SHARE:.0%} of the training objects of a "
            "weather.",
            tabulate(objects, "keys", disable_numparse=True, stralign="right"),
            self.summary.to_text(),
            f"{self.num_problems:,} problems" if self.num_problems else "no problems",
        ]
        return "\n\n".join(part for part in parts if part)


def _with_shares(row: JsonObject) -> dict[str, str]:
    """Formats one row of `objects` as text with the share of every class."""
    counts = {name: x for name, x in row.items() if name not in ("split", "weather")}
    cells = {}
    for cls, count in counts.items():
        share = count / max(sum(counts.values()), 1)
        mark = "*" if row["split"] == "train" and share < RARE_SHARE else ""
        cells[cls] = f"{mark}{count:,} ({100 * share:4.1f} %)"
    return {**row, **cells}


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
        deep: Whether to read and project every radar tensor, which finds all corruption
            and takes hours.
        progress: Whether to show a progress bar.
        **options: Options of `KRadar`: `labels`, `version`, `camera_calibration`, and the
            `sequence_numbers` and `weather` of the sequences to check.

    Raises:
        FileNotFoundError: A root or `labels` does not exist.
        UserError: There are no sequence folders or no labels, no frames of the given
            sequences and weathers, or the labels have another version.
        DataError: The folders or the labels are ambiguous or corrupted as a whole.
    """
    data = KRadar(roots, **options)
    summary = data.summary()
    splits = _find_splits(data)
    groups = itertools.groupby(data, key=lambda frame: frame.sequence)
    frames = {number: list(group) for number, group in groups}
    folders = dict(data.files.sequences)
    if any(options.get(name) is not None for name in ("sequence_numbers", "weather")):
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
    objects = _count_objects(data, splits, CLASSES)
    return HealthReport(names, data.files.options.version, rows, objects, summary)


def check_frames(
    frames: LabelledFrames[LabelledFrame],
    classes: Sequence[str],
    roots: Sequence[str],
    *,
    deep: bool = False,
    progress: bool = False,
) -> HealthReport:
    """Checks the frames of any reader and reports their content and their problems.

    Args:
        frames: Frames, such as those of `read_frames`.
        classes: Classes of their objects.
        roots: Folders of the dataset, for the report.
        deep: Whether to read radar data, image and calibration of every frame, instead of
            the first one of each sequence.
        progress: Whether to show a progress bar.
    """
    summary = frames.summary()
    splits = _find_splits(frames)
    sequences: dict[int, list[LabelledFrame]] = {}
    for frame in frames:
        sequences.setdefault(frame.sequence, []).append(frame)
    read = [x for own in sequences.values() for x in own[: None if deep else 1]]
    for frame in tqdm(read, "check", unit="frame", disable=not progress):
        try:
            frame.read_checked(frames.grid)
            front_view(frame)
        except (DataError, OSError) as error:
            summary.report("frame", f"{frame.key}: {error}")
    summary.counts["frames that were read"] = len(read)
    rows = []
    for number, own in sequences.items():
        in_split = collections.Counter(splits.get(frame.key) for frame in own)
        lacking = {
            f"without_{kind}": sum(getattr(x, f"{kind}_path") is None for x in own)
            for kind in ("radar", "camera", "camera_calibration")
        }
        row = {"sequence": number, "weather": own[0].weather, "frames": len(own)}
        rows.append(row | {x: in_split[x] for x in ("train", "test")} | lacking)
    reader = f"read by {type(frames).__module__}:{type(frames).__qualname__}"
    objects = _count_objects(frames, splits, classes)
    return HealthReport(list(roots), reader, rows, objects, summary)


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


def _find_splits(data: LabelledFrames[LabelledFrame]) -> dict[str, str]:
    """Returns the split of every frame and adds problems of the splits to the summary."""
    splits: dict[str, str] = {}
    summary = data.summary()
    for name in ("train", "test"):
        part = data.of_split(name)
        splits |= {frame.key: name for frame in part}
        found = part.summary()
        summary.problems[:] = dict.fromkeys(summary.problems + found.problems)
        summary.notes[:] = dict.fromkeys(summary.notes + found.notes)
    summary.problems += [
        ("split", f"{frame.key}: labelled, but in neither train nor test")
        for frame in data
        if frame.key not in splits
    ]
    return splits


def _count_objects(
    frames: FrameSequence, splits: Mapping[str, str], classes: Sequence[str]
) -> Rows:
    counts: dict[tuple[str, str], collections.Counter[str]] = {}
    for frame in frames:
        for weather in (frame.weather, "all"):
            row = splits.get(frame.key, "none"), weather
            counts.setdefault(row, collections.Counter()).update(frame.classes.tolist())
    return [
        {"split": split, "weather": weather}
        | {cls: counts[split, weather][cls] for cls in classes}
        for split, weather in sorted(counts)
    ]


def _check_objects(number: int, frames: Sequence[Frame], data: KRadar) -> None:
    """Reports a sequence whose objects seem to have other units than K-Radar's labels."""
    labels = [x for f in frames for x in f.labels if x.visibility == "R"]
    if len(labels) < MIN_OBJECTS:
        return
    problems = {}
    num_seen = sum(len(frame.boxes) for frame in frames)
    if num_seen < MIN_SEEN * len(labels):
        range_m, azimuth = data.grid.fov_range_m, np.rad2deg(data.grid.fov_azimuth_rad)
        problems["objects out of view"] = (
            f"{len(labels) - num_seen} of {len(labels)} objects that are visible to the "
            f"radar are not in its view of {range_m:g} m and {azimuth:.3g} deg"
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
