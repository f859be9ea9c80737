"""Report on a K-Radar copy: what is there, what is missing, what is corrupted."""

from __future__ import annotations

import collections
import dataclasses
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

from tabulate import tabulate
from tqdm import tqdm

from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.core.structures import CLASSES, RARE_SHARE
from radejax.data.dataset import Summary
from radejax.data.kradar.conditions import (
    KRADAR_CONDITIONS,
    UNKNOWN_CONDITIONS,
    Conditions,
    read_description,
)
from radejax.data.kradar.dataset import (
    Frame,
    KRadar,
    SequenceFolder,
    as_paths,
    find_sequences,
    read_calibration,
    read_grid,
    read_split_entries,
)
from radejax.data.kradar.labels import normalize_version
from radejax.data.tesseract import check_tesseract
from radejax.geometry.radar_grid import RadarGrid

ClassCounts = dict[tuple[str, str, str], int]
"""Objects by split, weather and class."""


@dataclasses.dataclass(frozen=True)
class HealthReport:
    """Result of `check_dataset`.

    Attributes:
        roots: The folders that were checked.
        version: Version of the labels.
        sequences: One row per sequence: its conditions, numbers of files, and of labels
            without them.
        class_counts: Objects visible to the radar and in its field of view.
        summary: Counts, problems with file and line, notes.
    """

    roots: list[str]
    version: str
    sequences: list[dict[str, Any]]
    class_counts: ClassCounts
    summary: Summary

    @property
    def num_problems(self) -> int:
        """Number of things missing or malformed."""
        return len(self.summary.problems)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        names = ("split", "weather", "class")
        return {
            "roots": self.roots,
            "version": self.version,
            "num_problems": self.num_problems,
            "sequences": self.sequences,
            "class_counts": [
                {**dict(zip(names, key, strict=True)), "objects": number}
                for key, number in sorted(self.class_counts.items())
            ],
            **self.summary.to_dict(),
        }

    def to_text(self) -> str:
        """Tables for a terminal."""
        header = {
            name: name.replace("_", "\n") for row in self.sequences for name in row
        }
        parts = [
            f"{len(self.sequences)} sequences in {', '.join(self.roots)}; labels "
            f"{self.version}",
            tabulate(self.sequences, headers=header),
            "Objects that are visible to the radar and in its field of view, and their "
            f"share of the row; *: under {RARE_SHARE:.0%} of the training objects of a "
            "weather.",
            _class_table(self.class_counts),
            self.summary.to_text(),
            f"{self.num_problems:,} problems" if self.num_problems else "no problems",
        ]
        return "\n\n".join(part for part in parts if part)


def _class_table(class_counts: ClassCounts) -> str:
    """Rows split and weather, columns classes."""
    rows: dict[tuple[str, str], collections.Counter[str]] = {}
    for (split, weather, cls), number in class_counts.items():
        for name in (weather, "all"):
            rows.setdefault((split, name), collections.Counter())[cls] += number
    table = []
    for (split, weather), counts in sorted(
        rows.items(), key=lambda row: (row[0][0], row[0][1] == "all", row[0][1])
    ):
        shares = {cls: counts[cls] / max(counts.total(), 1) for cls in CLASSES}
        cells = [
            ("*" if split == "train" and shares[cls] < RARE_SHARE else "")
            + f"{counts[cls]:,} ({100 * shares[cls]:4.1f} %)"
            for cls in CLASSES
        ]
        table.append([split, weather, *cells])
    return tabulate(
        table,
        headers=["split", "weather", *CLASSES],
        disable_numparse=True,
        colalign=["left", "left", *["right"] * len(CLASSES)],
    )


def check_dataset(
    roots: PathLike | Iterable[PathLike],
    *,
    labels: PathLike | None = None,
    version: str = "v2.1",
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
    deep: bool = False,
    progress: bool = False,
) -> HealthReport:
    """Check a K-Radar copy and report what is there and what is wrong.

    Labels are read whole; of radar tensors the head and the size, so that a copy of
    16 TB takes minutes.

    Args:
        roots: Folder or folders of the sequences.
        labels: Folder or zip of a label revision; None: the sequences' own.
        version: Version of the labels.
        sequence_numbers: Only these sequences; None for all.
        weather: Only sequences of these weathers; None for all.
        deep: Read and project every radar tensor, which finds all corruption and takes
            hours.
        progress: Show a progress bar.

    Raises:
        FileNotFoundError: A root or `labels` does not exist.
        UserError: There are neither sequence folders nor labels, none of the sequences
            and weathers asked for, or the labels have another version.
    """
    paths, frames, summary = as_paths(roots), [], Summary()
    folders, splits = find_sequences(paths), {}
    is_whole = sequence_numbers is None and weather is None
    own_labels = folders and labels is None and is_whole
    if own_labels and not any(_has_labels(folder) for folder in folders.values()):
        summary.problems.append(("labels missing", "labels: no info_label/*.txt"))
    else:
        data = KRadar(
            paths,
            labels,
            version=version,
            sequence_numbers=sequence_numbers,
            weather=weather,
        )
        frames, summary = list(data), data.summary()
        splits = _splits(data, summary)
    by_sequence: dict[int, list[Frame]] = {}
    for frame in frames:
        by_sequence.setdefault(frame.sequence, []).append(frame)
    if not is_whole:
        if not frames:
            raise UserError("no frames of these sequences and weathers")
        folders = {n: folder for n, folder in folders.items() if n in by_sequence}
    grid = read_grid(paths)
    total = sum(len(f.listing("radar_tesseract")) for f in folders.values())
    rows = []
    with tqdm(total=total, unit="file", desc="check", disable=not progress) as bar:
        for number in sorted({*folders, *by_sequence}):
            folder = folders.get(number, SequenceFolder([]))
            tensors = folder.listing("radar_tesseract")
            corrupted = _check_tensors(tensors.values(), grid, deep, summary, bar)
            row = _row(number, folder, by_sequence.get(number, []), splits)
            rows.append(row | {"tesseracts_damaged": corrupted})
            _check_conditions(number, folder, grid, summary)
            _check_calibration(folder, by_sequence.get(number, []), summary)
    class_counts = collections.Counter(
        (splits.get(frame.key, "none"), frame.weather, str(cls))
        for frame in frames
        for cls in frame.classes
    )
    names = [str(path) for path in paths]
    return HealthReport(names, normalize_version(version), rows, class_counts, summary)


def _has_labels(folder: SequenceFolder) -> bool:
    """Whether a sequence has a folder of labels, of any version."""
    subfolders = folder.listing(".")
    return any(name.startswith("info_label") for name in subfolders)


def _splits(data: KRadar, summary: Summary) -> dict[str, str]:
    """Split of every frame key; frames in both splits or in none are reported."""
    keys = [(frame.sequence, frame.name) for frame in data]
    found: dict[str, str] = {}
    for split in ("train", "test"):
        entries = read_split_entries(split, data.split_folders, keys, summary)
        for sequence, name in sorted(entries):
            key = f"{sequence}/{name}"
            if key in found:
                message = f"{key}: in both {found[key]} and {split}"
                summary.problems.append(("split", message))
            found[key] = split
    present, sequences = {frame.key for frame in data}, {f.sequence for f in data}
    for frame in data:
        if frame.key not in found:
            message = f"{frame.key}: labelled, but in neither train nor test"
            summary.problems.append(("split", message))
    for key in sorted(found.keys() - present):
        if int(key.split("/")[0]) in sequences:
            message = f"{key}: in split {found[key]} without a label file"
            summary.problems.append(("label file missing", message))
    return found


def _row(
    number: int,
    folder: SequenceFolder,
    frames: Sequence[Frame],
    splits: dict[str, str],
) -> dict[str, Any]:
    """Row of a sequence: its conditions and numbers of files."""
    conditions, offset = KRADAR_CONDITIONS.get(number, UNKNOWN_CONDITIONS), "unknown"
    if frames:
        one = frames[0]
        conditions = Conditions(one.environment, one.time, one.weather)
        offset = "{:g}, {:g}".format(*one.radar_from_lidar_m)
    split_counts = collections.Counter(splits.get(frame.key) for frame in frames)
    return {
        "sequence": number,
        **conditions._asdict(),
        "labels": len(frames),
        "train": split_counts["train"],
        "test": split_counts["test"],
        "tesseracts": len(folder.listing("radar_tesseract")),
        "tesseracts_missing": sum(frame.tesseract_path is None for frame in frames),
        "projections": len(folder.listing("DERA_tesseract")),
        "images": len(folder.listing("cam-front")),
        "images_missing": sum(frame.camera_path is None for frame in frames),
        "calibration": offset,
    }


def _check_tensors(
    paths: Iterable[pathlib.Path],
    grid: RadarGrid,
    deep: bool,
    summary: Summary,
    bar: tqdm,
) -> int:
    """Number of corrupted radar tensors."""
    before = len(summary.problems)
    for path in paths:
        try:
            if path.suffix == ".mat":
                check_tesseract(path, shape_drea=grid.shape_drea, deep=deep)
        except (DataError, OSError) as error:
            summary.problems.append(("tesseract damaged", str(error)))
        bar.update()
    return len(summary.problems) - before


def _check_conditions(
    number: int, folder: SequenceFolder, grid: RadarGrid, summary: Summary
) -> None:
    """Note conditions of a K-Radar sequence that contradict the published ones."""
    path = folder.find(".", "description.txt")
    published = KRADAR_CONDITIONS.get(number)
    is_kradar = grid.shape_drea == RadarGrid.kradar().shape_drea
    if path is None or published is None or not is_kradar:
        return
    try:
        found = read_description(path)
    except DataError:  # KRadar has reported it
        return
    if found != published:
        summary.notes.append(
            f"{path}: {','.join(found)}; K-Radar published {','.join(published)} for "
            f"sequence {number}"
        )


def _check_calibration(
    folder: SequenceFolder, frames: Sequence[Frame], summary: Summary
) -> None:
    """Report frame numbers that contradict the calibration file."""
    path = folder.find("info_calib", "calib_radar_lidar.txt")
    if path is None:
        return
    try:
        expected = read_calibration(path)[0]
    except DataError:  # KRadar has reported it
        return
    differences = {frame.header.radar - frame.header.lidar for frame in frames}
    if differences - {expected}:
        message = (
            f"{path}: frame difference {expected}, but radar minus LiDAR frame numbers in "
            f"the labels are {sorted(differences)}"
        )
        summary.problems.append(("calibration", message))
