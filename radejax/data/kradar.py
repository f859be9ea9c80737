"""K-Radar as it is on disk: labelled frames with boxes in the radar frame.

The folders are described in `docs/data.md`. Reading starts from the label files:
`KRadar` needs no tesseract to open, so that labels alone can be counted and swapped.
"""

from __future__ import annotations

import collections
import dataclasses
import json
import os
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from radejax.data import kradar_files, sequences
from radejax.data.kradar_summary import Summary
from radejax.data.labels import (
    AVAILABILITY_FLAGS,
    LABEL_CLASSES,
    Label,
    LabelFile,
    LabelHeader,
    Problem,
    normalise_version,
    parse_label_file,
    read_labels,
)
from radejax.errors import DataError, UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.structures import CLASSES

__all__ = ["Frame", "KRadar", "Label", "LabelHeader", "read_labels"]

PathLike = str | os.PathLike


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One labelled frame.

    Attributes:
        sequence: Number of the sequence.
        name: Radar and LiDAR frame numbers, such as `"00033_00001"`.
        header: Frame numbers of all sensors and the time stamp.
        environment, time, weather: Conditions of the sequence.
        labels: Every object of the file, in the LiDAR frame, unfiltered.
        boxes: `[N, 7]` float64 x, y, z, l, w, h, yaw in the radar frame, of the
            objects that the filters of the data set keep.
        classes: `[N]` class names of `boxes`.
        visibility: `[N]` availability flags of `boxes`.
        radar_from_lidar_m: Offset that was added to LiDAR positions: x, y, z.
        tesseract_path: The tesseract, None where it is missing.
        projection_path: An official `.npy` projection, None where there is none.
        camera_path: Front image (stereo pair), None where it is missing.
        camera_calibration_path: Calibration of the left front camera, or None.
    """

    sequence: int
    name: str
    header: LabelHeader
    environment: str
    time: str
    weather: str
    labels: tuple[Label, ...]
    boxes: np.ndarray
    classes: np.ndarray
    visibility: np.ndarray
    radar_from_lidar_m: tuple[float, float, float]
    tesseract_path: pathlib.Path | None
    projection_path: pathlib.Path | None
    camera_path: pathlib.Path | None
    camera_calibration_path: pathlib.Path | None

    @property
    def key(self) -> str:
        """Name that is unique in a data set: `"1/00033_00001"`."""
        return f"{self.sequence}/{self.name}"


class KRadar(Sequence[Frame]):
    """The labelled frames of a K-Radar copy, in the order of sequence and frame.

    Args:
        root: Folder of the sequences, or several when they are spread over disks.
            None when only labels are at hand.
        labels: Folder or zip of a label revision; None: the sequences' own folders.
        version: Version of these labels: v1.0, v1.1, v2.0 or v2.1.
        split: "train" or "test", the path of a split file, or None for every frame.
            Official split files are looked for as `split/<name>.txt` in the roots and
            beside `labels`; without them K-Radar's rule (alternating quarters of every
            sequence) is applied, and `summary()` says so.
        strict: Raise on the first missing or malformed thing. Otherwise it is left
            out, counted and named in `summary()`.
        radar_from_lidar: Metres (x, y) to add to LiDAR positions on every sequence;
            None: from each sequence's calibration file, else (-2.54, 0.3).
        z_offset_m: Metres to add to LiDAR z: 0 in the papers, 0.7 in K-Radar's code.
        visibility: Availability flags to keep, None for all.
        classes: Classes to keep.
        field_of_view: Keep only boxes whose center is in the field of view.
        sequence_numbers: Only these sequences; None for all.
        camera_calibration: Folder of camera calibrations (`calib_seq_v2/`, `common/`).

    Attributes:
        grid: Sensor axes: K-Radar's, or those of `radar_grid.json` in a root.

    Raises:
        FileNotFoundError: A folder or file that was named does not exist.
        UserError: Nothing to read, an unknown version or split, or labels of another
            version than was said.
        DataError: Something is missing or malformed, and `strict`.

    Examples:
        >>> data = KRadar("/data/kradar", split="train")  # doctest: +SKIP
        >>> print(data.summary().to_text())  # doctest: +SKIP
    """

    def __init__(
        self,
        root: PathLike | Iterable[PathLike] | None = None,
        labels: PathLike | None = None,
        *,
        version: str = "v2.1",
        split: PathLike | None = None,
        strict: bool = False,
        radar_from_lidar: tuple[float, float] | None = None,
        z_offset_m: float = 0.0,
        visibility: Sequence[str] | None = ("R",),
        classes: Sequence[str] = CLASSES,
        field_of_view: bool = True,
        sequence_numbers: Iterable[int] | None = None,
        camera_calibration: PathLike | None = None,
    ) -> None:
        self.version = normalise_version(version)
        self.strict = strict
        self.classes = tuple(classes)
        self.roots = _as_paths(root)
        self.counts: collections.Counter[str] = collections.Counter()
        self.problems: list[Problem] = []
        self.notes: list[str] = []
        self._radar_from_lidar = radar_from_lidar
        self._z_offset_m = float(z_offset_m)
        self._camera_calibration = _as_paths(camera_calibration)
        self._check_arguments(labels, visibility)
        self.folders = kradar_files.find_sequences(self.roots)
        self.grid = read_grid(self.roots)
        source = self._open_labels(labels)
        keys = self._select(source, split, labels, sequence_numbers)
        files = self._read_label_files(source, keys)
        self._frames = self._make_frames(files, visibility, field_of_view)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        return self._frames[index]

    def summary(self) -> Summary:
        """What was read, left out, missing and malformed."""
        return Summary(
            counts=dict(self.counts),
            problems=list(self.problems),
            notes=list(self.notes),
        )

    def class_counts(self) -> dict[str, int]:
        """Objects of every class that the filters keep."""
        counts = collections.Counter(cls for f in self._frames for cls in f.classes)
        return {cls: counts[cls] for cls in self.classes}

    # Opening -------------------------------------------------------------------------

    def _check_arguments(
        self, labels: PathLike | None, visibility: Sequence[str] | None
    ) -> None:
        if not self.roots and labels is None:
            raise UserError("give a K-Radar root, or labels, or both")
        if isinstance(visibility, str):
            raise UserError(
                f"visibility is a sequence of flags, such as ({visibility!r},)"
            )
        unknown = [cls for cls in self.classes if cls not in LABEL_CLASSES]
        if unknown or not self.classes:
            raise UserError(
                f"classes {unknown or 'are empty'}, expected some of "
                + ", ".join(LABEL_CLASSES)
            )

    def _open_labels(self, labels: PathLike | None) -> kradar_files.LabelSource:
        """The label source; `UserError` when there is nothing in it."""
        if labels is not None:
            return kradar_files.labels_from(pathlib.Path(labels))
        if not self.folders:
            raise UserError(
                f"no sequence folders (1, 2, ...) in {', '.join(map(str, self.roots))}"
            )
        source = kradar_files.own_labels(self.folders, self.version)
        if not source.files:
            raise UserError(
                f"no {self.version} labels in the sequence folders of "
                f"{', '.join(map(str, self.roots))} (info_label/*.txt); name the folder "
                "or zip of a label revision as labels"
            )
        return source

    def _select(
        self,
        source: kradar_files.LabelSource,
        split: PathLike | None,
        labels: PathLike | None,
        sequence_numbers: Iterable[int] | None,
    ) -> list[tuple[int, str]]:
        """Keys of the label files to read, sorted."""
        wanted = None if sequence_numbers is None else set(sequence_numbers)
        present = {sequence for sequence, _ in source.files}
        if wanted is not None and wanted - present:
            raise UserError(
                f"no labels of sequences {sorted(wanted - present)} in "
                f"{source.description}; there are {sorted(present)}"
            )
        keys = [key for key in source.files if wanted is None or key[0] in wanted]
        if split is None:
            return keys
        near = list(self.roots)
        if labels is not None:
            near += [pathlib.Path(labels), pathlib.Path(labels).parent]
        entries = self._split_entries(split, near, keys)
        for sequence, name in sorted(entries - set(keys)):
            if wanted is not None and sequence not in wanted:
                continue
            if sequence in present:
                self._report(
                    "label file missing",
                    f"{sequence}/{name}",
                    f"in split {split} but not among the labels of {source.description}",
                    error=FileNotFoundError,
                )
            else:
                self.counts["split entries of sequences that are not here"] += 1
        return [key for key in keys if key in entries]

    def _split_entries(
        self, split: PathLike, near: list[pathlib.Path], keys: list[tuple[int, str]]
    ) -> set[tuple[int, str]]:
        """Frames of a split, from its file or by rule."""
        if pathlib.Path(split).is_file():
            return set(sequences.read_split(split))
        if str(split) not in ("train", "test"):
            raise UserError(
                f"split {str(split)!r} is neither 'train', 'test', None nor a split file"
            )
        if path := kradar_files.find_split_file(str(split), near):
            return set(sequences.read_split(path))
        self.notes.append(
            f"no split/{split}.txt found: split by K-Radar's rule, alternating quarters"
        )
        names = collections.defaultdict(list)
        for sequence, name in keys:
            names[sequence].append(name)
        return {
            (sequence, name)
            for sequence in names
            for name in sequences.split_by_rule(names[sequence], str(split))
        }

    # Reading -------------------------------------------------------------------------

    def _read_label_files(
        self, source: kradar_files.LabelSource, keys: list[tuple[int, str]]
    ) -> dict[tuple[int, str], LabelFile]:
        """Parsed label files; damaged ones are reported."""
        files = {}
        for key, content in source.read(keys):
            where = source.where(key)
            problems: list[Problem] = []
            try:
                file = parse_label_file(
                    content, self.version, where=where, problems=problems
                )
            except DataError as error:
                self._report("label file", where, str(error).removeprefix(where + ":"))
                continue
            if problems and not any(file.labels for file in files.values()):
                self._raise_on_other_version(problems[0], source)
            for problem in problems:
                self._report(problem.kind, problem.where, problem.message)
            self._count_labels(key, file)
            files[key] = file
        return files

    def _raise_on_other_version(
        self, problem: Problem, source: kradar_files.LabelSource
    ) -> None:
        """A wrong version is the user's to mend, not thousands of malformed lines."""
        if "has the layout of" in problem.message:
            raise UserError(
                f"{problem}; say the version of the labels in {source.description}"
            )

    def _count_labels(self, key: tuple[int, str], file: LabelFile) -> None:
        self.counts["objects in the label files"] += len(file.labels)
        self.counts["disabled objects (no leading *)"] += file.num_disabled
        odd = [x for x in file.labels if x.visibility not in AVAILABILITY_FLAGS]
        self.counts["objects with an odd availability flag"] += len(odd)
        expected = f"{file.header.radar:05d}_{file.header.lidar:05d}"
        self.counts["files named unlike their header"] += key[1] != expected

    def _make_frames(
        self,
        files: dict[tuple[int, str], LabelFile],
        visibility: Sequence[str] | None,
        field_of_view: bool,
    ) -> list[Frame]:
        """Frames with filtered boxes; all boxes of the data set are filtered at once."""
        numbers = sorted({number for number, _ in files})
        info = {number: self._sequence_info(number) for number in numbers}
        owners, labels, offsets = [], [], []
        for index, ((number, _), file) in enumerate(files.items()):
            owners += [index] * len(file.labels)
            labels += file.labels
            offsets += [info[number].offset] * len(file.labels)
        boxes = np.array([label.box for label in labels], np.float64).reshape(-1, 7)
        boxes[:, :3] += np.array(offsets, np.float64).reshape(-1, 3)
        is_kept = self._filter(boxes, labels, visibility, field_of_view)
        kept = np.flatnonzero(is_kept)
        ends = np.searchsorted(
            np.array(owners, np.int64)[kept], np.arange(len(files) + 1)
        )
        self.counts["frames"] = len(files)
        self.counts["frames without objects"] = int((np.diff(ends) == 0).sum())
        names = np.array([label.cls for label in labels], dtype=np.str_)
        flags = np.array([label.visibility for label in labels], dtype=np.str_)
        return [
            self._frame(key, file, info[key[0]], *_take(boxes, names, flags, kept[a:b]))
            for (key, file), a, b in zip(
                files.items(), ends[:-1], ends[1:], strict=True
            )
        ]

    def _filter(
        self,
        boxes: np.ndarray,
        labels: list[Label],
        visibility: Sequence[str] | None,
        field_of_view: bool,
    ) -> np.ndarray:
        """`[M]` True for the objects to keep; the others are counted by reason."""
        is_kept = np.ones(len(labels), bool)
        rules = {"class": np.array([x.cls in self.classes for x in labels], bool)}
        if visibility is not None:
            flags = set(visibility)
            rules["visibility"] = np.array(
                [x.visibility in flags for x in labels], bool
            )
        if field_of_view:
            rules["field of view"] = self.grid.in_field_of_view(
                boxes[:, 0], boxes[:, 1]
            )
        for rule, passes in rules.items():
            self.counts[f"objects left out by {rule}"] = int((is_kept & ~passes).sum())
            is_kept &= passes
        self.counts["objects kept"] = int(is_kept.sum())
        return is_kept

    def _frame(
        self,
        key: tuple[int, str],
        file: LabelFile,
        info: _SequenceInfo,
        boxes: np.ndarray,
        classes: np.ndarray,
        visibility: np.ndarray,
    ) -> Frame:
        """One frame with the paths of its files; missing ones are reported."""
        header, folder = file.header, self.folders.get(key[0])
        tesseract = projection = camera = None
        if folder is not None:
            stem = f"tesseract_{header.radar:05d}"
            tesseract = folder.find("radar_tesseract", f"{stem}.mat")
            projection = folder.find("DERA_tesseract", f"DERA_{stem}.npy")
            if header.camera_front is not None:
                name = f"cam-front_{header.camera_front:05d}.png"
                camera = folder.find("cam-front", name)
            if tesseract is None and projection is None:
                self._report(
                    "tesseract missing",
                    f"{key[0]}/{key[1]}",
                    f"no radar_tesseract/{stem}.mat in "
                    + ", ".join(map(str, folder.folders)),
                    error=FileNotFoundError,
                )
            self.counts["frames without front image"] += camera is None
        return Frame(
            *key,
            header,
            info.conditions.environment,
            info.conditions.time,
            info.conditions.weather,
            tuple(file.labels),
            boxes,
            classes,
            visibility,
            info.offset,
            tesseract,
            projection,
            camera,
            info.camera_calibration,
        )

    # Sequences -----------------------------------------------------------------------

    def _sequence_info(self, number: int) -> _SequenceInfo:
        x, y = self._offset(number)
        return _SequenceInfo(
            self._conditions(number),
            (x, y, self._z_offset_m),
            kradar_files.find_camera_calibration(
                [
                    *self._camera_calibration,
                    *(root / name for root in self.roots for name in _CAMERA_FOLDERS),
                ],
                number,
            ),
        )

    def _offset(self, number: int) -> tuple[float, float]:
        """Metres to add to LiDAR x and y of a sequence."""
        if self._radar_from_lidar is not None:
            dx_m, dy_m = self._radar_from_lidar
            return float(dx_m), float(dy_m)
        folder = self.folders.get(number)
        if folder is not None:
            path = folder.find("info_calib", "calib_radar_lidar.txt")
            try:
                if path is not None:
                    calibration = sequences.read_calibration(path)
                    return calibration.dx_m, calibration.dy_m
                self._report(
                    "calibration missing",
                    f"sequence {number}",
                    f"no info_calib/calib_radar_lidar.txt, {_DEFAULT_OFFSET_TEXT}",
                    error=FileNotFoundError,
                )
            except DataError as error:
                self._report(
                    "calibration", str(path), f"{error}; {_DEFAULT_OFFSET_TEXT}"
                )
        self.counts["sequences with the default calibration"] += 1
        return sequences.DEFAULT_RADAR_FROM_LIDAR_M

    def _conditions(self, number: int) -> sequences.Conditions:
        """Conditions of a sequence: its own description, else the built-in table."""
        folder = self.folders.get(number)
        path = None if folder is None else folder.find(".", "description.txt")
        if path is not None:
            try:
                return sequences.read_description(path)
            except DataError as error:
                self._report("description", str(path), str(error))
        self.counts["sequences with built-in conditions"] += 1
        return sequences.KRADAR_CONDITIONS.get(number, sequences.UNKNOWN_CONDITIONS)

    def _report(
        self, kind: str, where: str, message: str, error: type[Exception] = DataError
    ) -> None:
        """Counts and keeps a problem; raises it when strict."""
        problem = Problem(kind, where, message.removeprefix(f"{where}:").strip())
        if self.strict:
            raise error(str(problem))
        self.problems.append(problem)


@dataclasses.dataclass(frozen=True, slots=True)
class _SequenceInfo:
    """What all frames of a sequence share."""

    conditions: sequences.Conditions
    offset: tuple[float, float, float]
    camera_calibration: pathlib.Path | None


_DEFAULT_OFFSET_TEXT = "taking K-Radar's (-2.54, 0.3)"
_CAMERA_FOLDERS = ("calib", "cam_calib", "resources/cam_calib")


def read_grid(roots: Iterable[PathLike]) -> RadarGrid:
    """Sensor axes of a data set: `radar_grid.json` in a root, else K-Radar's.

    Raises:
        DataError: The file is malformed, or two roots have different axes.
    """
    found: dict[pathlib.Path, RadarGrid] = {}
    for root in roots:
        path = pathlib.Path(root) / "radar_grid.json"
        if path.is_file():
            try:
                found[path] = RadarGrid.from_dict(json.loads(path.read_bytes()))
            except (ValueError, KeyError, TypeError) as error:
                raise DataError(f"{path}: no radar grid: {error!r}") from None
    if len(set(found.values())) > 1:
        raise DataError(
            f"different sensor axes in {', '.join(map(str, found))}; data sets of "
            "different sensors cannot be read as one"
        )
    return next(iter(found.values()), RadarGrid.kradar())


def _as_paths(paths: PathLike | Iterable[PathLike] | None) -> list[pathlib.Path]:
    """A list of paths from one, several or none."""
    if paths is None:
        return []
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    return [pathlib.Path(path) for path in paths]


def _take(
    boxes: np.ndarray, names: np.ndarray, flags: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rows of one frame as arrays of their own."""
    return boxes[rows], names[rows], flags[rows]
