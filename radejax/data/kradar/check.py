"""Health report of a K-Radar copy: what is there, what is missing, what is damaged."""

from __future__ import annotations

import collections
import dataclasses
import functools
import os
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

from tabulate import tabulate
from tqdm import tqdm

from radejax.core.errors import DataError, UserError
from radejax.core.structures import CLASSES, RARE_SHARE
from radejax.data.kradar import sequences
from radejax.data.kradar.dataset import KRadar, as_paths
from radejax.data.kradar.findings import Findings, Summary
from radejax.data.kradar.folders import SequenceFolder, find_sequences, read_grid
from radejax.data.kradar.frame import Frame
from radejax.data.kradar.labels import VERSIONS, normalize_version
from radejax.data.kradar.splits import read_split_entries
from radejax.data.tesseract import check_tesseract
from radejax.geometry.radar_grid import RadarGrid


@dataclasses.dataclass(frozen=True)
class SequenceHealth:
    """What is there of one sequence: numbers of files, and of labels without them."""

    sequence: int
    environment: str
    time: str
    weather: str
    labels: int
    train: int
    test: int
    tesseracts: int
    tesseracts_missing: int
    tesseracts_damaged: int
    projections: int
    images: int
    images_missing: int
    calibration: str


@dataclasses.dataclass(frozen=True)
class HealthReport:
    """Result of `check_dataset`.

    Attributes:
        roots: The folders that were looked at.
        version: Version of the labels.
        sequences: One row a sequence.
        class_counts: Objects visible to the radar and in its field of view: rows
            (split, weather, class) to number.
        summary: Counts, problems with file and line, notes.
    """

    roots: list[str]
    version: str
    sequences: list[SequenceHealth]
    class_counts: dict[tuple[str, str, str], int]
    summary: Summary

    @property
    def num_problems(self) -> int:
        """Number of things missing or malformed."""
        return len(self.summary.problems)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "roots": self.roots,
            "version": self.version,
            "num_problems": self.num_problems,
            "sequences": [dataclasses.asdict(row) for row in self.sequences],
            "class_counts": [
                {
                    "split": split,
                    "weather": weather,
                    "class": cls,
                    "objects": number,
                    "share": number / self._totals[split, weather],
                }
                for (split, weather, cls), number in sorted(self.class_counts.items())
            ],
            **self.summary.to_dict(),
        }

    def to_text(self) -> str:
        """Tables for a terminal."""
        rows = [dataclasses.asdict(row) for row in self.sequences]
        header = {name: name.replace("_", "\n") for name in rows[0]} if rows else {}
        parts = [
            f"{len(rows)} sequences in {', '.join(self.roots)}; labels {self.version}",
            tabulate(rows, headers=header),
            "objects visible to the radar, in its field of view, and their share of the "
            f"row; *: under {RARE_SHARE:.0%} of the training objects of a weather",
            self._count_table(),
            self.summary.to_text(),
            f"{self.num_problems:,} problems" if self.num_problems else "no problems",
        ]
        return "\n\n".join(part for part in parts if part)

    @functools.cached_property
    def _totals(self) -> collections.Counter[tuple[str, ...]]:
        """Objects by split and weather, "all" too, and by these and class."""
        totals: collections.Counter[tuple[str, ...]] = collections.Counter()
        for (split, weather, cls), number in self.class_counts.items():
            for key in ((split, weather), (split, "all")):
                totals[key] += number
                totals[(*key, cls)] += number
        return totals

    def _count_table(self) -> str:
        """Rows split and weather, columns classes."""
        keys = [key for key in self._totals if len(key) == 2]
        keys.sort(key=lambda key: (key[0], key[1] == "all", key))
        table = [[*key, *(self._cell(key, cls) for cls in CLASSES)] for key in keys]
        return tabulate(
            table,
            headers=["split", "weather", *CLASSES],
            disable_numparse=True,
            colalign=["left", "left", *["right"] * len(CLASSES)],
        )

    def _cell(self, key: tuple[str, ...], cls: str) -> str:
        """Number, share of the row, and the mark of a class that is hardly trained on."""
        number, share = self._totals[(*key, cls)], 0.0
        if self._totals[key]:
            share = number / self._totals[key]
        mark = "*" if key[0] == "train" and share < RARE_SHARE else ""
        return f"{mark}{number:,} ({100 * share:4.1f} %)"


def check_dataset(
    roots: str | os.PathLike | Iterable[str | os.PathLike],
    *,
    labels: str | os.PathLike | None = None,
    version: str = "v2.1",
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
    deep: bool = False,
    progress: bool = False,
) -> HealthReport:
    """Looks through a K-Radar copy and reports what is there and what is wrong.

    Labels are read whole; of tesseracts the head and the size, so that a copy of 16 TB
    takes minutes.

    Args:
        roots: Folder or folders of the sequences.
        labels: Folder or zip of a label revision; None: the sequences' own.
        version: Version of the labels. If they turn out to be of another, that is a
            problem that is reported, and they are read as what they are.
        sequence_numbers: Only these sequences; None for all.
        weather: Only sequences of these weathers; None for all.
        deep: Read and project every tesseract, which finds all damage and takes hours.
        progress: Show a progress bar.

    Raises:
        FileNotFoundError: A root or `labels` does not exist.
        UserError: There are neither sequence folders nor labels, or none of the
            sequences and weathers asked for.
    """
    paths = as_paths(roots)
    findings = Findings(strict=False)
    part = {"sequence_numbers": sequence_numbers, "weather": weather}
    data = _open(paths, labels, version, part, findings)
    folders = data.folders if data is not None else find_sequences(paths)
    frames = [] if data is None else list(data)
    if data is not None:
        summary = data.summary()
        findings.problems += summary.problems
        findings.notes += summary.notes
        findings.counts.update(summary.counts)
    splits = _splits(data, findings)
    by_sequence = collections.defaultdict(list)
    for frame in frames:
        by_sequence[frame.sequence].append(frame)
    if (sequence_numbers, weather) != (None, None):
        if not frames:
            raise UserError("no frames of these sequences and weathers")
        folders = {n: f for n, f in folders.items() if n in by_sequence}
    numbers = sorted({*folders, *by_sequence})
    total = sum(len(f.listing("radar_tesseract")) for f in folders.values())
    shape = read_grid(paths).shape_drea
    with tqdm(total=total, unit="file", desc="check", disable=not progress) as bar:
        rows = [
            _check_sequence(
                number,
                folders.get(number, SequenceFolder([])),
                by_sequence[number],
                splits,
                (shape, deep, bar),
                findings,
            )
            for number in numbers
        ]
    return HealthReport(
        [str(path) for path in paths],
        data.version if data is not None else normalize_version(version),
        rows,
        _count_classes(frames, splits),
        findings.summary(),
    )


def _open(
    paths: list[pathlib.Path],
    labels: str | os.PathLike | None,
    version: str,
    part: dict[str, Any],
    findings: Findings,
) -> KRadar | None:
    """The data set, as the version that its labels have; None without labels."""
    try:
        return KRadar(paths, labels, version=version, **part)
    except UserError as error:
        if "has the layout of" not in str(error):
            is_whole = all(chosen is None for chosen in part.values())
            if labels is None and is_whole and find_sequences(paths):
                findings.report("labels missing", "labels", str(error))
                return None
            raise
    for other in VERSIONS:
        try:
            data = KRadar(paths, labels, version=other, **part)
        except UserError:
            continue
        findings.report(
            "label version",
            data.label_source,
            f"the labels are {other}, not {normalize_version(version)}: give "
            f"--label-version {other}, in training --config.data.label_version={other}",
        )
        return data
    raise UserError(f"the labels have the layout of none of {', '.join(VERSIONS)}")


def _splits(data: KRadar | None, findings: Findings) -> dict[str, str]:
    """Split of every frame key; frames in no split are reported."""
    if data is None:
        return {}
    keys = [(frame.sequence, frame.name) for frame in data]
    found: dict[str, str] = {}
    for split in ("train", "test"):
        for sequence, name in read_split_entries(
            split, data.split_folders, keys, findings
        ):
            key = f"{sequence}/{name}"
            if key in found:
                findings.report("split", key, f"in both {found[key]} and {split}")
            found[key] = split
    for frame in data:
        if frame.key not in found:
            findings.report(
                "split", frame.key, "labelled, but in neither train nor test"
            )
    present, sequences_here = {f.key for f in data}, {f.sequence for f in data}
    for key in sorted(found.keys() - present):
        if int(key.split("/")[0]) in sequences_here:
            findings.report("label file missing", key, f"in split {found[key]}")
    return found


def _check_sequence(
    number: int,
    folder: SequenceFolder,
    frames: Sequence[Frame],
    splits: dict[str, str],
    how: tuple[tuple[int, ...], bool, tqdm],
    findings: Findings,
) -> SequenceHealth:
    """One row of the report; problems go to the findings."""
    split_counts = collections.Counter(splits.get(frame.key) for frame in frames)
    files = folder.listing("radar_tesseract")
    tesseracts = [path for name, path in files.items() if name.endswith(".mat")]
    is_kradar = how[0] == RadarGrid.kradar().shape_drea
    return SequenceHealth(
        number,
        *_check_conditions(number, folder, findings, is_kradar),
        len(frames),
        split_counts["train"],
        split_counts["test"],
        len(tesseracts),
        sum(frame.tesseract_path is None for frame in frames),
        _check_tesseracts(tesseracts, how, findings),
        len(folder.listing("DERA_tesseract")),
        len(folder.listing("cam-front")),
        sum(frame.camera_path is None for frame in frames),
        _check_calibration(number, folder, frames, findings),
    )


def _check_tesseracts(
    paths: Sequence[pathlib.Path],
    how: tuple[tuple[int, ...], bool, tqdm],
    findings: Findings,
) -> int:
    """Number of damaged tesseracts."""
    shape, deep, bar = how
    num_damaged = 0
    for path in paths:
        try:
            check_tesseract(path, shape_drea=shape, deep=deep)
        except (DataError, OSError) as error:
            findings.report("tesseract damaged", str(path), str(error))
            num_damaged += 1
        bar.update()
    return num_damaged


def _check_conditions(
    number: int, folder: SequenceFolder, findings: Findings, is_kradar: bool
) -> sequences.Conditions:
    """Conditions of a sequence; a contradiction to K-Radar's own is noted."""
    published = sequences.KRADAR_CONDITIONS.get(number, sequences.UNKNOWN_CONDITIONS)
    path = folder.find(".", "description.txt")
    if path is None:
        return published
    try:
        found = sequences.read_description(path)
    except DataError:  # KRadar has reported it
        return published
    is_published = is_kradar and number in sequences.KRADAR_CONDITIONS
    if is_published and found != published:
        findings.notes.append(
            f"{path}: {','.join(found)}; K-Radar published "
            f"{','.join(published)} for sequence {number}"
        )
    return found


def _check_calibration(
    number: int,
    folder: SequenceFolder,
    frames: Sequence[Frame],
    findings: Findings,
) -> str:
    """The offset in words; frame numbers that contradict the file are reported."""
    path = folder.find("info_calib", "calib_radar_lidar.txt")
    if path is None:
        return "default"
    try:
        calibration = sequences.read_calibration(path)
    except DataError:  # KRadar has reported it
        return "damaged"
    differences = {frame.header.radar - frame.header.lidar for frame in frames}
    if differences - {calibration.frame_difference}:
        findings.report(
            "calibration",
            str(path),
            f"frame difference {calibration.frame_difference}, but radar minus LiDAR "
            f"frame numbers in the labels of sequence {number} are {sorted(differences)}",
        )
    return f"{calibration.dx_m:g}, {calibration.dy_m:g}"


def _count_classes(
    frames: Sequence[Frame], splits: dict[str, str]
) -> dict[tuple[str, str, str], int]:
    """Kept objects by split, weather and class."""
    return collections.Counter(
        (splits.get(frame.key, "none"), frame.weather, str(cls))
        for frame in frames
        for cls in frame.classes
    )
