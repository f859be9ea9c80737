"""K-Radar as it is on disk: labelled frames with boxes in the radar frame.

The folders are described in `docs/data.md`. Reading starts from the label files:
`KRadar` needs no tesseract to open, so that labels alone can be counted and swapped.
"""

from __future__ import annotations

import collections
import os
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from radejax.core.errors import DataError, UserError
from radejax.core.structures import CLASSES
from radejax.data.kradar import folders
from radejax.data.kradar.findings import Findings, Summary
from radejax.data.kradar.frame import Frame
from radejax.data.kradar.labels import (
    AVAILABILITY_FLAGS,
    LABEL_CLASSES,
    Label,
    LabelFile,
    Problem,
    normalise_version,
    parse_label_file,
)
from radejax.data.kradar.sequence_info import camera_folders, read_sequence_info
from radejax.data.kradar.splits import select_frames

PathLike = str | os.PathLike


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
        self._findings = Findings(strict=strict)
        self._check_arguments(labels, visibility)
        self.folders = folders.find_sequences(self.roots)
        self.grid = folders.read_grid(self.roots)
        source = self._open_labels(labels)
        near = list(self.roots)
        if labels is not None:
            near += [pathlib.Path(labels), pathlib.Path(labels).parent]
        keys = select_frames(
            source,
            self._findings,
            split=split,
            near=near,
            sequence_numbers=sequence_numbers,
        )
        files = self._read_label_files(source, keys)
        self._info = {
            number: read_sequence_info(
                number,
                self.folders.get(number),
                self._findings,
                radar_from_lidar=radar_from_lidar,
                z_offset_m=float(z_offset_m),
                camera_folders=camera_folders(
                    self.roots, _as_paths(camera_calibration)
                ),
            )
            for number in sorted({number for number, _ in files})
        }
        self._frames = self._make_frames(files, visibility, field_of_view)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        return self._frames[index]

    def summary(self) -> Summary:
        """What was read, left out, missing and malformed."""
        return self._findings.summary()

    @property
    def counts(self) -> collections.Counter[str]:
        """What was read and left out, by reason: `summary().counts`."""
        return self._findings.counts

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

    def _open_labels(self, labels: PathLike | None) -> folders.LabelSource:
        """The label source; `UserError` when there is nothing in it."""
        if labels is not None:
            return folders.labels_from(pathlib.Path(labels))
        if not self.folders:
            raise UserError(
                f"no sequence folders (1, 2, ...) in {', '.join(map(str, self.roots))}"
            )
        source = folders.own_labels(self.folders, self.version)
        if not source.files:
            raise UserError(
                f"no {self.version} labels in the sequence folders of "
                f"{', '.join(map(str, self.roots))} (info_label/*.txt); name the folder "
                "or zip of a label revision as labels"
            )
        return source

    # Reading -------------------------------------------------------------------------

    def _read_label_files(
        self, source: folders.LabelSource, keys: list[tuple[int, str]]
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
                self._findings.report("label file", where, str(error))
                continue
            if problems and not any(file.labels for file in files.values()):
                self._raise_on_other_version(problems[0], source)
            for problem in problems:
                self._findings.report(problem.kind, problem.where, problem.message)
            self._count_labels(key, file)
            files[key] = file
        return files

    def _raise_on_other_version(
        self, problem: Problem, source: folders.LabelSource
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
        owners, labels, offsets = [], [], []
        for index, ((number, _), file) in enumerate(files.items()):
            owners += [index] * len(file.labels)
            labels += file.labels
            offsets += [self._info[number].radar_from_lidar_m] * len(file.labels)
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
            self._frame(key, file, *_take(boxes, names, flags, kept[a:b]))
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
            info.conditions.environment,
            info.conditions.time,
            info.conditions.weather,
            tuple(file.labels),
            boxes,
            classes,
            visibility,
            info.radar_from_lidar_m,
            tesseract,
            projection,
            camera,
            info.camera_calibration_path,
        )


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
