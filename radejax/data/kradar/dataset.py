"""K-Radar as it is on disk: labelled frames with boxes in the radar frame.

The folders are described in `docs/data.md`. Reading starts from the label files:
`KRadar` needs no tesseract to open, so that labels alone can be counted and swapped.
"""

from __future__ import annotations

import collections
import copy
import itertools
import os
import pathlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.core.structures import CLASSES
from radejax.data.kradar import folders
from radejax.data.kradar.findings import Findings, Summary
from radejax.data.kradar.frame import Frame
from radejax.data.kradar.labels import (
    LABEL_CLASSES,
    VISIBILITY_FLAGS,
    LabelFile,
    Problem,
    normalize_version,
    parse_label_file,
)
from radejax.data.kradar.sequences import (
    SequenceInfo,
    camera_folders,
    read_sequence_info,
)
from radejax.data.kradar.splits import Key, check_weather, select_frames

_Parsed = tuple[LabelFile | None, list[Problem]]  # None: nothing in it can be trusted


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
        include_unstarred_v11_labels: Lines of v1.x labels without a `*` count too, as released.
        classes: Classes to keep.
        field_of_view: Keep only boxes whose center is in the field of view.
        sequence_numbers: Only these sequences; None for all. Sequences that have labels
            and no folder in the roots are left out and counted, if any has one.
        weather: Only sequences of these weathers; None for all.
        camera_calibration: Folder of camera calibrations (`calib_seq_v2/`, `common/`).
        common_camera: `common/cam_front0.yml` for all sequences, as released.

    Attributes:
        grid: Sensor axes: K-Radar's, or those of `radar_grid.json` in a root.
        split_folders: In and beside which split files are looked for.
        is_simulated: One of these folders says that its data are simulated.

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
        include_unstarred_v11_labels: bool = False,
        classes: Sequence[str] = CLASSES,
        field_of_view: bool = True,
        sequence_numbers: Iterable[int] | None = None,
        weather: Iterable[str] | None = None,
        camera_calibration: PathLike | None = None,
        common_camera: bool = False,
    ) -> None:
        self.version = normalize_version(version)
        self.strict = strict
        self.classes = tuple(classes)
        self.roots = as_paths(root)
        _check_arguments(self.roots, labels, visibility, self.classes)
        self._weather = None if weather is None else check_weather(weather)
        self.folders = folders.find_sequences(self.roots)
        self.grid = folders.read_grid(self.roots)
        self._source = self._open_labels(labels)
        self.split_folders = list(self.roots)
        if labels is not None:
            self.split_folders += [pathlib.Path(labels), pathlib.Path(labels).parent]
        self.is_simulated = folders.are_simulated(self.split_folders)
        self._radar_from_lidar_z_m = folders.read_radar_from_lidar_z(self.split_folders)
        self._sequence_numbers = sequence_numbers and tuple(sequence_numbers)
        self._offset = (radar_from_lidar, float(z_offset_m))
        self._camera_folders = camera_folders(self.roots, as_paths(camera_calibration))
        self._common_camera = common_camera
        self._visibility, self._field_of_view = visibility, field_of_view
        self._count_disabled = include_unstarred_v11_labels
        self._parsed: dict[Key, _Parsed] = {}
        self._read(split)

    def of_split(self, split: PathLike | None) -> KRadar:
        """The frames of a split, as opening the data set with it gives them.

        Label files that either of the two has read are not read again.

        Args:
            split: As of the class.

        Raises:
            UserError: There is no such split.
            DataError: Something is missing or malformed, and `strict`.
        """
        other = copy.copy(self)
        other._read(split)
        return other

    def without(self, left_out: Collection[str], reason: str) -> KRadar:
        """The frames but those of some keys, which are counted for a reason."""
        other = copy.copy(self)
        other._findings = copy.deepcopy(self._findings)
        other._frames = [frame for frame in self if frame.key not in left_out]
        other.counts[f"frames left out: {reason}"] += len(self) - len(other)
        return other

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        return self._frames[index]

    def summary(self) -> Summary:
        """What was read, left out, missing and malformed."""
        return self._findings.summary()

    @property
    def label_source(self) -> str:
        """Where the labels are from, as messages name it."""
        return self._source.description

    @property
    def counts(self) -> collections.Counter[str]:
        """What was read and left out, by reason: `summary().counts`."""
        return self._findings.counts

    def class_counts(self) -> dict[str, int]:
        """Objects of every class that the filters keep."""
        counts = collections.Counter(cls for f in self._frames for cls in f.classes)
        return {cls: counts[cls] for cls in self.classes}

    def _open_labels(self, labels: PathLike | None) -> folders.LabelSource:
        """The label source; `UserError` when there is nothing in it."""
        if not self.folders:
            meant = folders.nearby_roots(self.roots)
            if meant or labels is None:
                hint = f"; try {', '.join(map(str, meant))}" if meant else ""
                raise UserError(
                    "no sequence folders (1, 2, ...) in "
                    f"{', '.join(map(str, self.roots))}{hint}"
                )
        if labels is not None:
            return folders.labels_from(pathlib.Path(labels))
        source = folders.own_labels(self.folders, self.version)
        if not source.files:
            raise UserError(
                f"no {self.version} labels in the sequence folders of "
                f"{', '.join(map(str, self.roots))} (info_label/*.txt); name the folder "
                "or zip of a label revision as labels"
            )
        return source

    def _read(self, split: PathLike | None) -> None:
        """Finds what belongs to a split and reads it."""
        self._findings = Findings(strict=self.strict)
        keys = select_frames(
            self._source,
            self._findings,
            split=split,
            near=self.split_folders,
            sequence_numbers=self._sequence_numbers,
            folders_here=self.folders,
        )
        if self._weather is None:
            files = self._read_label_files(keys)
            self._info = self._read_info(files)
        else:  # not the labels of other weathers
            self._info = self._read_info(keys)
            files = self._read_label_files(self._of_weather(keys, self._weather))
        self._frames = self._make_frames(files)

    def _read_info(self, keys: Iterable[Key]) -> dict[int, SequenceInfo]:
        """What is known of every sequence of the keys."""
        return {
            number: read_sequence_info(
                number,
                self.folders.get(number),
                self._findings,
                radar_from_lidar=self._offset[0],
                z_offset_m=self._offset[1],
                camera_folders=self._camera_folders,
                common_camera=self._common_camera,
            )
            for number in sorted({number for number, _ in keys})
        }

    def _of_weather(self, keys: list[Key], weather: tuple[str, ...]) -> list[Key]:
        """The keys of the weathers that were asked for; the others are counted."""
        kept = [k for k in keys if self._info[k[0]].conditions.weather in weather]
        self.counts["frames left out by weather"] = len(keys) - len(kept)
        return kept

    def _read_label_files(self, keys: list[Key]) -> dict[Key, LabelFile]:
        """Parsed label files; damaged ones are reported."""
        files: dict[Key, LabelFile] = {}
        for key, (file, problems) in self._parse(keys):
            if problems and not any(file.labels for file in files.values()):
                self._raise_on_other_version(problems[0])
            for problem in problems:
                self._findings.report(problem.kind, problem.where, problem.message)
            if file is not None:
                self._count_labels(key, file)
                files[key] = file
        return files

    def _parse(self, keys: list[Key]) -> Iterator[tuple[Key, _Parsed]]:
        """Every file with its problems, parsed unless that was done before."""
        contents = self._source.read([key for key in keys if key not in self._parsed])
        for key in keys:
            if key not in self._parsed:
                _, content = next(contents)
                problems: list[Problem] = []
                where = self._source.where(key)
                try:
                    if isinstance(content, DataError):
                        raise content
                    file = parse_label_file(
                        content,
                        self.version,
                        where=where,
                        problems=problems,
                        include_unstarred_v11_labels=self._count_disabled,
                    )
                except DataError as error:
                    file, problems = None, [Problem("label file", where, str(error))]
                self._parsed[key] = file, problems
            yield key, self._parsed[key]

    def _raise_on_other_version(self, problem: Problem) -> None:
        """A wrong version is the user's to mend, not thousands of malformed lines."""
        if "has the layout of" in problem.message:
            raise UserError(
                f"{problem}; say the version of the labels in {self.label_source}: "
                "--label-version VERSION, in training "
                "--config.data.label_version=VERSION, such as v1.0"
            )

    def _count_labels(self, key: Key, file: LabelFile) -> None:
        self.counts["objects in the label files"] += len(file.labels)
        self.counts["disabled objects (no leading *)"] += file.num_disabled
        odd = [x for x in file.labels if x.visibility not in VISIBILITY_FLAGS]
        self.counts["objects with an odd availability flag"] += len(odd)
        expected = f"{file.header.radar:05d}_{file.header.lidar:05d}"
        self.counts["files named unlike their header"] += key[1] != expected

    def _make_frames(self, files: dict[Key, LabelFile]) -> list[Frame]:
        """Frames with filtered boxes; all boxes of the data set are filtered at once."""
        labels = [label for file in files.values() for label in file.labels]
        sizes = np.array([len(file.labels) for file in files.values()], int)
        offsets = [self._info[number].radar_from_lidar_m for number, _ in files]
        boxes = np.array([label.box for label in labels], np.float64).reshape(-1, 7)
        boxes[:, :3] += np.repeat(np.reshape(offsets, (-1, 3)), sizes, axis=0)
        names = np.array([label.cls for label in labels], dtype=np.str_)
        flags = np.array([label.visibility for label in labels], dtype=np.str_)
        kept = np.flatnonzero(self._filter(boxes, names, flags))
        ends = np.searchsorted(kept, np.append(0, np.cumsum(sizes)))
        self.counts["frames"] = len(files)
        self.counts["frames without objects"] = int((np.diff(ends) == 0).sum())
        rows_of_files = [kept[a:b] for a, b in itertools.pairwise(ends)]
        return [
            self._frame(key, file, *(column[rows] for column in (boxes, names, flags)))
            for (key, file), rows in zip(files.items(), rows_of_files, strict=True)
        ]

    def _filter(
        self, boxes: np.ndarray, names: np.ndarray, flags: np.ndarray
    ) -> np.ndarray:
        """`[M]` True for the objects to keep; the others are counted by reason."""
        rules = {"class": np.isin(names, np.array(self.classes, np.str_))}
        if self._visibility is not None:
            rules["visibility"] = np.isin(
                flags, np.array(list(self._visibility), np.str_)
            )
        if self._field_of_view:
            rules["field of view"] = self.grid.in_field_of_view(
                boxes[:, 0], boxes[:, 1]
            )
        is_kept = np.ones(len(names), bool)
        for rule, passes in rules.items():
            self.counts[f"objects left out by {rule}"] = int((is_kept & ~passes).sum())
            is_kept &= passes
        self.counts["objects kept"] = int(is_kept.sum())
        return is_kept

    def _frame(
        self,
        key: Key,
        file: LabelFile,
        boxes: np.ndarray,
        classes: np.ndarray,
        visibility: np.ndarray,
    ) -> Frame:
        """One frame with the paths of its files; missing ones are reported."""
        header, folder, info = file.header, self.folders.get(key[0]), self._info[key[0]]
        tesseract = projection = camera = None
        if folder is not None:
            stem = f"tesseract_{header.radar:05d}"
            tesseract = folder.find("radar_tesseract", f"{stem}.mat")
            projection = folder.find("DERA_tesseract", f"DERA_{stem}.npy")
            if header.camera_front is not None:
                name = f"cam-front_{header.camera_front:05d}.png"
                camera = folder.find("cam-front", name)
            if tesseract is None and projection is None:
                self._findings.report(
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
            *info.conditions,
            tuple(file.labels),
            boxes,
            classes,
            visibility,
            info.radar_from_lidar_m,
            tesseract,
            projection,
            camera,
            info.camera_calibration_path,
            self.is_simulated,
            self._radar_from_lidar_z_m,
        )


def _check_arguments(
    roots: list[pathlib.Path],
    labels: PathLike | None,
    visibility: Sequence[str] | None,
    classes: tuple[str, ...],
) -> None:
    if not roots and labels is None:
        raise UserError("give a K-Radar root, or labels, or both")
    if isinstance(visibility, str):
        raise UserError(f"visibility is a sequence of flags, such as ({visibility!r},)")
    unknown = [cls for cls in classes if cls not in LABEL_CLASSES]
    if unknown or not classes:
        raise UserError(
            f"classes {unknown or 'are empty'}, expected some of "
            + ", ".join(LABEL_CLASSES)
        )


def as_paths(paths: PathLike | Iterable[PathLike] | None) -> list[pathlib.Path]:
    """A list of paths from one, several or none."""
    if paths is None:
        return []
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    return [pathlib.Path(path) for path in paths]
