"""K-Radar as it is on disk: labelled frames with boxes in the radar frame.

The folders are described in `docs/data.md`. Reading starts from the label files:
`KRadar` needs no radar tensor to open, so that labels can be counted and replaced without
them. A sequence is a folder named by its number. One sequence may have folders under
several roots (tensors on one disk, images on another); each file is taken from the first
root that has it.
"""

from __future__ import annotations

import collections
import contextlib
import copy
import dataclasses
import functools
import itertools
import logging
import os
import pathlib
import re
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Shaped

from radejax.core.archives import open_zip, read_member
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike, read_json, read_text
from radejax.core.structures import CLASSES
from radejax.data.dataset import Summary
from radejax.data.kradar.conditions import (
    KRADAR_CONDITIONS,
    UNKNOWN_CONDITIONS,
    WEATHERS,
    Conditions,
    check_weather,
    read_description,
)
from radejax.data.kradar.labels import (
    LABEL_CLASSES,
    MAX_LABEL_BYTES,
    VISIBILITY_FLAGS,
    Label,
    LabelFile,
    LabelHeader,
    normalize_version,
    parse_label_file,
    read_label_bytes,
)
from radejax.data.tesseract import read_frame
from radejax.geometry.camera import (
    KRADAR_RADAR_FROM_LIDAR_Z_M,
    RADAR_FROM_LIDAR_M,
    CameraCalibration,
)
from radejax.geometry.radar_grid import RadarGrid

_log = logging.getLogger(__name__)

SIMULATION_MARKER = "simulation.json"
"""File that marks a data set as simulated and has the settings of the simulator."""

Key = tuple[int, str]
"""Sequence number and frame name, such as `(1, "00033_00001")`."""

_LABEL_FOLDERS = {
    "v1.0": ("info_label_v1_0", "info_label"),
    "v1.1": ("info_label_v1_1", "info_label"),
    "v2.0": ("info_label_v2_0", "info_label_v2", "info_label"),
    "v2.1": ("info_label_v2_1", "info_label"),
}
# Regular expressions, as str.isdecimal is also true of the digits of other scripts.
_SEQUENCE = re.compile(r"[0-9]{1,6}")
_LABELLED_SEQUENCE = re.compile(r"([0-9]{1,6})(?:_info_label_revised)?")
_LABEL_NAME = re.compile(r"[0-9]{1,9}_[0-9]{1,9}\.txt")
_SPLIT_LINE = re.compile(r"\s*([0-9]{1,6})\s*,\s*([0-9]{1,9}_[0-9]{1,9})(?:\.txt)?\s*")
_CAMERA_FOLDERS = ("calib", "cam_calib", "resources/cam_calib")
_MAX_OFFSET_M = 100.0


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One labelled frame.

    Attributes:
        sequence: Number of the sequence.
        name: Radar and LiDAR frame numbers, such as `"00033_00001"`.
        header: Frame numbers of all sensors and the time stamp.
        environment, time, weather: Conditions of the sequence.
        labels: Every object of the file, in the LiDAR frame, unfiltered.
        boxes: float64 x, y, z, l, w, h, yaw in the radar frame, of the objects that the
            filters of the data set keep.
        classes: Class names of `boxes`.
        visibility: Visibility flags of `boxes`.
        radar_from_lidar_m: Offset that was added to LiDAR positions: x, y, z
            (`p_radar = p_lidar + t`).
        tesseract_path: The 4D radar tensor, None where it is missing.
        projection_path: A released `.npy` projection, None where there is none.
        camera_path: Front image (stereo pair), None where it is missing.
        camera_calibration_path: Calibration of the left front camera, or None.
        is_simulated: The data set is simulated.
        radar_from_lidar_z_m: The z of the offset between the sensors as they are
            mounted, whatever z was added to the boxes.
    """

    sequence: int
    name: str
    header: LabelHeader
    environment: str
    time: str
    weather: str
    labels: tuple[Label, ...]
    boxes: Float[np.ndarray, "N 7"]
    classes: Shaped[np.ndarray, " N"]
    visibility: Shaped[np.ndarray, " N"]
    radar_from_lidar_m: tuple[float, float, float]
    tesseract_path: pathlib.Path | None
    projection_path: pathlib.Path | None
    camera_path: pathlib.Path | None
    camera_calibration_path: pathlib.Path | None
    is_simulated: bool = False
    radar_from_lidar_z_m: float = KRADAR_RADAR_FROM_LIDAR_Z_M

    @property
    def key(self) -> str:
        """Name that is unique in a data set: `"1/00033_00001"`."""
        return f"{self.sequence}/{self.name}"

    @property
    def radar_path(self) -> pathlib.Path | None:
        """File of the radar: the tensor, or without one the released projection."""
        return self.tesseract_path or self.projection_path

    def read_projection(self, grid: RadarGrid) -> Float[np.ndarray, "R A DE"]:
        """Read the float32 projection; see `tesseract.read_frame`.

        Raises:
            FileNotFoundError: There is no file of the radar.
            DataError: It is corrupted, or of another shape than the grid.
        """
        if self.radar_path is None:
            raise FileNotFoundError("no radar tensor in any root")
        return read_frame(self.radar_path, grid)

    def read_calibration(
        self, radar_from_lidar_m: tuple[float, ...] | None = None
    ) -> CameraCalibration:
        """Read the camera's calibration, with the frame's own offset or another."""
        assert self.camera_calibration_path is not None  # callers check it
        return CameraCalibration.from_kradar(
            self.camera_calibration_path,
            radar_from_lidar_m=radar_from_lidar_m or self.radar_from_lidar_m,
        )


class KRadar(Sequence[Frame]):
    """The labelled frames of a K-Radar copy, in the order of sequence and frame.

    What is missing or malformed is skipped, counted and listed in `summary()`.

    Args:
        root: Folder of the sequences, or several when they are spread over disks.
            None when only labels are available.
        labels: Folder or zip of a label revision; None: the sequences' own folders.
        version: Version of these labels: v1.0, v1.1, v2.0 or v2.1.
        split: "train" or "test", the path of a split file, or None for every frame.
            Official split files are looked for as `split/<name>.txt` in the roots and
            next to `labels`; without them K-Radar's rule (alternating quarters of every
            sequence) is applied, which `summary()` notes.
        visibility: Visibility flags to keep, None for all.
        include_unstarred_v11_labels: Lines of v1.x labels without a `*` count too, as in
            the reference implementation.
        classes: Classes to keep.
        field_of_view: Keep only boxes whose center is in the field of view.
        sequence_numbers: Only these sequences; None for all. Sequences that have labels
            and no folder in the roots are skipped and counted, if any has one.
        weather: Only sequences of these weathers; None for all.
        camera_calibration: Folder of camera calibrations (`calib_seq_v2/`, `common/`).
        common_camera: Use `common/cam_front0.yml` for all sequences, as the reference
            implementation does.

    Attributes:
        grid: Sensor axes: K-Radar's, or those of `radar_grid.json` in a root.
        folders: Folders of every sequence in the roots, by number.
        split_folders: Folders in and next to which split files are looked for.
        is_simulated: The simulator wrote one of these folders.

    Raises:
        FileNotFoundError: A folder or file that was named does not exist.
        UserError: There is nothing to read, no such version or split, or the labels
            have another version.
        DataError: The labels are corrupted or ambiguous as a whole.

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
        self.classes = tuple(classes)
        self.roots = as_paths(root)
        if not self.roots and labels is None:
            raise UserError("give a K-Radar root, or labels, or both")
        if isinstance(visibility, str):
            raise UserError(f"visibility is {visibility!r}, expected a tuple of flags")
        if not self.classes or not set(self.classes) <= set(LABEL_CLASSES):
            expected = ", ".join(LABEL_CLASSES)
            raise UserError(f"classes are {self.classes}, expected some of {expected}")
        self._weather = None if weather is None else check_weather(weather)
        self.folders = find_sequences(self.roots)
        self.grid = read_grid(self.roots)
        self._label_files = self._find_labels(labels)
        self.split_folders = list(self.roots)
        if labels is not None:
            self.split_folders += [pathlib.Path(labels), pathlib.Path(labels).parent]
        self.is_simulated = are_simulated(self.split_folders)
        self._radar_from_lidar_z_m = read_radar_from_lidar_z(self.split_folders)
        self._sequence_numbers = (
            None if sequence_numbers is None else set(sequence_numbers)
        )
        self._camera_folders = as_paths(camera_calibration)
        self._camera_folders += [
            r / name for r in self.roots for name in _CAMERA_FOLDERS
        ]
        self._common_camera = common_camera
        self._visibility, self._field_of_view = visibility, field_of_view
        self._include_unstarred = include_unstarred_v11_labels
        self._parsed: dict[Key, tuple[LabelFile | None, list[str]]] = {}
        self._read(split)

    def of_split(self, split: PathLike | None) -> KRadar:
        """Return the frames of a split, as opening the data set with it gives them.

        Label files that were read before are not read again.

        Raises:
            UserError: There is no such split.
        """
        other = copy.copy(self)
        other._read(split)
        return other

    def without(self, left_out: Collection[str], reason: str) -> KRadar:
        """Return all frames but those of some keys, which are counted for a reason."""
        other = copy.copy(self)
        other._summary = copy.deepcopy(self._summary)
        other._frames = [frame for frame in self if frame.key not in left_out]
        other.counts[f"frames left out: {reason}"] += len(self) - len(other)
        return other

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        return self._frames[index]

    def summary(self) -> Summary:
        """What was read, skipped, missing and malformed."""
        return self._summary

    @property
    def counts(self) -> collections.Counter[str]:
        """What was read and skipped, by reason: `summary().counts`."""
        return self._summary.counts

    def class_counts(self) -> dict[str, int]:
        """Objects of every class that the filters keep."""
        counts = collections.Counter(cls for f in self._frames for cls in f.classes)
        return {cls: counts[cls] for cls in self.classes}

    def _find_labels(self, labels: PathLike | None) -> LabelFiles:
        """The label files; `UserError` when there is nothing to read."""
        roots = ", ".join(map(str, self.roots))
        if not self.folders and self.roots:
            raise UserError(f"no sequence folders (1, 2, ...) in {roots}")
        if labels is not None:
            return find_labels(pathlib.Path(labels))
        found = find_own_labels(self.folders, self.version)
        if not found.paths:
            raise UserError(
                f"no {self.version} labels in the sequence folders of {roots} "
                "(info_label/*.txt); name the folder or zip of a label revision as labels"
            )
        return found

    def _read(self, split: PathLike | None) -> None:
        """Read the label files of a split and make its frames."""
        self._summary = Summary()
        keys = self._select(split)
        self._info = {
            number: self._read_sequence_info(number)
            for number in sorted({number for number, _ in keys})
        }
        if self._weather is not None:
            kept = [
                key for key in keys if self._info[key[0]][0].weather in self._weather
            ]
            self.counts["frames left out by weather"] = len(keys) - len(kept)
            keys = kept
        self._frames = self._make_frames(self._read_label_files(keys))

    def _select(self, split: PathLike | None) -> list[Key]:
        """Keys of the label files to read, sorted; the others are counted."""
        all_keys, numbers = self._label_files.paths, self._sequence_numbers
        present = {number for number, _ in all_keys}
        absent = present - set(self.folders) if self.folders else set()
        if numbers is None:
            wanted = present - absent
            self.counts["sequences with labels that are not in the roots"] = len(absent)
            self.counts["frames of sequences that are not in the roots"] = sum(
                number in absent for number, _ in all_keys
            )
        else:
            wanted = numbers
        if wanted & absent:
            raise UserError(
                f"no folders of sequences {sorted(wanted & absent)} in the roots; there "
                f"are {sorted(self.folders)}"
            )
        if wanted - present:
            raise UserError(
                f"no labels of sequences {sorted(wanted - present)} in "
                f"{self._label_files.description}; there are {sorted(present)}"
            )
        keys = [key for key in all_keys if key[0] in wanted]
        if split is None:
            return keys
        self._report_overlap()
        entries = read_split_entries(split, self.split_folders, keys, self._summary)
        for number, name in sorted(entries - set(keys)):
            if number in wanted:
                self._report(
                    "label file missing",
                    f"{number}/{name}: in split {split} but not among the labels of "
                    f"{self._label_files.description}",
                )
            elif numbers is None:
                self.counts["split entries of sequences that are not here"] += 1
        return [key for key in keys if key in entries]

    def _report(self, kind: str, message: str) -> None:
        self._summary.problems.append((kind, message))

    def _report_overlap(self) -> None:
        """Report, and warn of, frames that the files of both splits name."""
        paths = [
            find_split_file(name, self.split_folders) for name in ("train", "test")
        ]
        if None in paths:
            return
        train, test = (set(read_split(path)) for path in paths if path)
        if both := sorted(train & test):
            message = (
                f"{both[0][0]}/{both[0][1]}: the first of {len(both)} frames that are in "
                f"both {paths[0]} and {paths[1]}; a model is evaluated on frames that it "
                "was trained on"
            )
            self._report("split", message)
            _log.warning(message)

    def _read_sequence_info(
        self, number: int
    ) -> tuple[Conditions, tuple[float, float, float], pathlib.Path | None]:
        """Conditions, LiDAR offset and camera calibration of a sequence."""
        folder = self.folders.get(number)
        camera, is_own = find_camera_calibration(
            self._camera_folders, number, common_only=self._common_camera
        )
        if camera is None:
            self.counts["sequences without camera calibration"] += 1
        elif not is_own:
            self.counts["sequences with the common camera calibration"] += 1
        offset = self._read_offset(number, folder)
        return self._read_conditions(number, folder), (*offset, 0.0), camera

    def _read_offset(
        self, number: int, folder: SequenceFolder | None
    ) -> tuple[float, float]:
        """Metres to add to LiDAR x and y of a sequence."""
        path = folder.find("info_calib", "calib_radar_lidar.txt") if folder else None
        default = RADAR_FROM_LIDAR_M[:2]
        if path is not None:
            try:
                return read_calibration(path)[1:]
            except DataError as error:
                self._report("calibration", f"{error}; using K-Radar's {default}")
        elif folder is not None:
            self._report(
                "calibration missing",
                f"sequence {number}: no info_calib/calib_radar_lidar.txt, using K-Radar's "
                f"{default}",
            )
        self.counts["sequences with the default calibration"] += 1
        return default

    def _read_conditions(
        self, number: int, folder: SequenceFolder | None
    ) -> Conditions:
        """Conditions of a sequence: its own description, else the built-in table."""
        path = folder.find(".", "description.txt") if folder else None
        if path is not None:
            try:
                conditions = read_description(path)
            except DataError as error:
                self._report("description", str(error))
            else:
                if conditions.weather not in (*WEATHERS, "unknown"):
                    self._summary.notes.append(
                        f"{path}: weather {conditions.weather!r} is none of K-Radar's: "
                        f"{', '.join(WEATHERS)}"
                    )
                return conditions
        self.counts["sequences with built-in conditions"] += 1
        return KRADAR_CONDITIONS.get(number, UNKNOWN_CONDITIONS)

    def _read_label_files(self, keys: list[Key]) -> dict[Key, LabelFile]:
        """Parsed label files; corrupted ones are reported."""
        files: dict[Key, LabelFile] = {}
        for key, (file, problems) in self._parse(keys):
            has_labels = any(file.labels for file in files.values())
            if problems and not has_labels and "has the layout of" in problems[0]:
                raise UserError(
                    f"{problems[0]}; give the version of the labels in "
                    f"{self._label_files.description}: --label-version VERSION, in "
                    "training --config.data.label_version=VERSION, such as v1.0"
                )
            kind = "label file" if file is None else "label line"
            self._summary.problems += [(kind, message) for message in problems]
            if file is None:
                continue
            files[key] = file
            odd = [x for x in file.labels if x.visibility not in VISIBILITY_FLAGS]
            expected = f"{file.header.radar:05d}_{file.header.lidar:05d}"
            self.counts["objects in the label files"] += len(file.labels)
            self.counts["disabled objects (no leading *)"] += file.num_unstarred
            self.counts["objects with an odd availability flag"] += len(odd)
            self.counts["files named unlike their header"] += key[1] != expected
        return files

    def _parse(
        self, keys: list[Key]
    ) -> Iterator[tuple[Key, tuple[LabelFile | None, list[str]]]]:
        """Every file with its problems, parsed unless that was done before.

        None stands for a file of which nothing can be used.
        """
        with self._label_files.reader() as read:
            for key in keys:
                if key not in self._parsed:
                    problems: list[str] = []
                    file = None
                    try:
                        file = parse_label_file(
                            read(self._label_files.paths[key]),
                            self.version,
                            where=self._label_files.where(key),
                            problems=problems,
                            include_unstarred=self._include_unstarred,
                        )
                    except DataError as error:
                        problems = [str(error)]
                    self._parsed[key] = file, problems
                yield key, self._parsed[key]

    def _make_frames(self, files: dict[Key, LabelFile]) -> list[Frame]:
        """Frames with filtered boxes; all boxes of the data set are filtered at once."""
        labels = [label for file in files.values() for label in file.labels]
        sizes = np.array([len(file.labels) for file in files.values()], int)
        offsets = [self._info[number][1] for number, _ in files]
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
            self._frame(key, file, boxes[rows], names[rows], flags[rows])
            for (key, file), rows in zip(files.items(), rows_of_files, strict=True)
        ]

    def _filter(
        self, boxes: np.ndarray, names: np.ndarray, flags: np.ndarray
    ) -> np.ndarray:
        """`[M]` True for the objects to keep; the others are counted by reason."""
        rules = {"class": np.isin(names, np.array(self.classes, np.str_))}
        if self._visibility is not None:
            wanted = np.array(list(self._visibility), np.str_)
            rules["visibility"] = np.isin(flags, wanted)
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
        header, folder = file.header, self.folders.get(key[0])
        conditions, offset, camera_calibration = self._info[key[0]]
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
                    f"{key[0]}/{key[1]}: no radar_tesseract/{stem}.mat in "
                    + ", ".join(map(str, folder.folders)),
                )
            self.counts["frames without front image"] += camera is None
        return Frame(
            *key,
            header,
            *conditions,
            tuple(file.labels),
            boxes,
            classes,
            visibility,
            offset,
            tesseract,
            projection,
            camera,
            camera_calibration,
            self.is_simulated,
            self._radar_from_lidar_z_m,
        )


# Folders -----------------------------------------------------------------------------


class SequenceFolder:
    """All folders of one sequence, seen as one; a subfolder is listed once."""

    def __init__(self, folders: Sequence[pathlib.Path]) -> None:
        self.folders = tuple(folders)
        self._listings: dict[str, dict[str, pathlib.Path]] = {}

    def listing(self, subfolder: str) -> dict[str, pathlib.Path]:
        """Files of a subfolder by name; the first root takes precedence."""
        if subfolder not in self._listings:
            files: dict[str, pathlib.Path] = {}
            for folder in self.folders:
                with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                    for name in sorted(os.listdir(folder / subfolder)):
                        files.setdefault(name, folder / subfolder / name)
            self._listings[subfolder] = files
        return self._listings[subfolder]

    def find(self, subfolder: str, name: str) -> pathlib.Path | None:
        """Path of a file, None where no root has it."""
        return self.listing(subfolder).get(name)


def as_paths(paths: PathLike | Iterable[PathLike] | None) -> list[pathlib.Path]:
    """A list of paths from one, several or none."""
    if paths is None:
        return []
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    return [pathlib.Path(path) for path in paths]


def find_sequences(roots: Sequence[pathlib.Path]) -> dict[int, SequenceFolder]:
    """Every sequence under the roots, by number.

    Raises:
        FileNotFoundError: A root does not exist.
        DataError: A root has a sequence twice, as `1` and `01`.
    """
    found: dict[int, list[pathlib.Path]] = {}
    for root in roots:
        if not root.is_dir():
            raise FileNotFoundError(f"{root}: no such folder, expected a K-Radar root")
        for folder in sorted(root.iterdir()):
            if _SEQUENCE.fullmatch(folder.name) and folder.is_dir():
                same = found.setdefault(int(folder.name), [])
                if same and same[-1].parent == root:
                    raise DataError(
                        f"sequence {int(folder.name)} is there twice, as {same[-1]} and "
                        f"{folder}: delete or move one"
                    )
                same.append(folder)
    return {number: SequenceFolder(found[number]) for number in sorted(found)}


def find_camera_calibration(
    folders: Sequence[pathlib.Path], sequence: int, *, common_only: bool = False
) -> tuple[pathlib.Path | None, bool]:
    """Find the calibration of the left front camera.

    Args:
        folders: Where it is looked for.
        sequence: Number of the sequence.
        common_only: Find the common one even where the sequence has its own.

    Returns:
        The file, None where there is none, and whether it is the sequence's own.
    """
    own = f"seq_{sequence:02d}/cam_1.yml"
    of_sequence = (f"calib_seq_v2/{own}", own)
    common = ("common/cam_front0.yml", "cam_front0.yml")
    for names, is_own in ((of_sequence, True), (common, False))[common_only:]:
        for folder in folders:
            for name in names:
                if (folder / name).is_file():
                    return folder / name, is_own
    return None, False


def read_calibration(path: PathLike) -> tuple[int, float, float]:
    """Read `info_calib/calib_radar_lidar.txt`: a header line and three numbers.

    Returns:
        Radar frame number minus LiDAR frame number, and metres to add to a LiDAR x
        and y.

    Raises:
        DataError: The file is malformed; the message names file and line.
    """
    lines = read_text(path).splitlines()
    line = lines[1] if len(lines) > 1 else ""
    with contextlib.suppress(ValueError):
        difference, dx_m, dy_m = map(float, line.split(","))
        is_near = abs(dx_m) <= _MAX_OFFSET_M and abs(dy_m) <= _MAX_OFFSET_M
        if (
            is_near
            and abs(difference) < 1e6
            and difference % 1 == 0
            and "_" not in line
        ):
            return int(difference), dx_m, dy_m
    raise DataError(
        f"{path}:2: {line[:80]!r}, expected three numbers: frame difference (whole), x, y "
        f"up to {_MAX_OFFSET_M:g} m, such as 32,-2.54,0.3"
    )


def are_simulated(folders: Sequence[pathlib.Path]) -> bool:
    """Whether the simulator has written one of the folders."""
    # os.path, as pathlib raises for names that no file can have.
    return any(os.path.isfile(folder / SIMULATION_MARKER) for folder in folders)


def read_radar_from_lidar_z(folders: Sequence[pathlib.Path]) -> float:
    """Read z of `p_radar = p_lidar + t` as the sensors are mounted.

    A simulated data set states it; K-Radar's calibration files do not, and its loaders
    have 0.7 m: the radar is below the LiDAR.

    Raises:
        DataError: A simulation's file is malformed, or two of them differ.
    """
    found: dict[pathlib.Path, float] = {}
    for path in (folder / SIMULATION_MARKER for folder in folders):
        if path.is_file():
            try:
                shift = read_json(path).get("config", {}).get("radar_from_lidar_m")
                found[path] = float(
                    KRADAR_RADAR_FROM_LIDAR_Z_M if shift is None else shift[2]
                )
            except (AttributeError, IndexError, TypeError, KeyError, ValueError):
                raise DataError(
                    f"{path}: config.radar_from_lidar_m is not three numbers"
                ) from None
    return _the_same(found, "heights of the sensors", KRADAR_RADAR_FROM_LIDAR_Z_M)


def read_grid(roots: Sequence[pathlib.Path]) -> RadarGrid:
    """Read the sensor axes of a data set: `radar_grid.json` in a root, else K-Radar's.

    Raises:
        DataError: The file is malformed, or two roots have different axes.
    """
    paths = [root / "radar_grid.json" for root in roots]
    found: dict[pathlib.Path, RadarGrid] = {}
    for path in filter(pathlib.Path.is_file, paths):
        try:
            found[path] = RadarGrid.from_dict(read_json(path))
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: not the axes of a sensor ({error})") from None
    return _the_same(found, "sensor axes", RadarGrid.kradar())


T = TypeVar("T")


def _the_same(found: Mapping[pathlib.Path, T], what: str, default: T) -> T:
    """The one value of all files; `DataError` where they differ."""
    if len(set(found.values())) > 1:
        raise DataError(
            f"different {what} in {', '.join(map(str, found))}; data sets of different "
            "sensors cannot be read as one"
        )
    return next(iter(found.values()), default)


# Label files -------------------------------------------------------------------------


class LabelFiles(NamedTuple):
    """Label files by key, sorted.

    Attributes:
        paths: Path of each label file, or its name in `archive`.
        archive: Zip file that they are in, None for plain files.
        description: Where they are from, for messages.
    """

    paths: dict[Key, pathlib.Path | str]
    archive: pathlib.Path | None
    description: str

    def where(self, key: Key) -> str:
        """Name of a label file, for messages."""
        path = self.paths[key]
        return str(path) if self.archive is None else f"{self.archive}/{path}"

    @contextlib.contextmanager
    def reader(self) -> Iterator[Callable[[Any], bytes]]:
        """A function that reads one of the paths; an archive is opened once."""
        if self.archive is None:
            yield read_label_bytes
        else:
            with open_zip(self.archive) as archive:
                yield functools.partial(read_member, archive, max_bytes=MAX_LABEL_BYTES)


def find_own_labels(sequences: dict[int, SequenceFolder], version: str) -> LabelFiles:
    """Label files in the sequences' own folders, as the data set is delivered."""
    paths: dict[Key, pathlib.Path | str] = {}
    for number, folder in sequences.items():
        for subfolder in _LABEL_FOLDERS[version]:
            listing = folder.listing(subfolder)
            names = sorted(name for name in listing if _LABEL_NAME.fullmatch(name))
            paths |= {(number, n.removesuffix(".txt")): listing[n] for n in names}
            if names:
                break
    return LabelFiles(paths, None, "the sequences' own folders")


def find_labels(path: pathlib.Path) -> LabelFiles:
    """Label files of a revision, a folder or zip with `<sequence>/<radar>_<lidar>.txt`.

    Raises:
        FileNotFoundError: There is no such folder or file.
        UserError: It is neither a folder nor a zip, or holds no label files.
        DataError: A frame is in it twice, or the zip is corrupted.
    """
    names: list[tuple[pathlib.PurePath, Any]]
    if path.is_dir():
        names = [(file.relative_to(path), file) for file in sorted(path.rglob("*.txt"))]
    elif not path.exists():
        raise FileNotFoundError(f"{path}: no such labels, expected a folder or a zip")
    elif path.suffix == ".zip" or zipfile.is_zipfile(path):
        with open_zip(path) as file:
            names = [(pathlib.PurePosixPath(name), name) for name in file.namelist()]
    else:
        raise UserError(f"{path}: labels must be a folder or a zip file")
    found: dict[Key, pathlib.Path | str] = {}
    for name, member in names:
        key = _label_key(name)
        if key is not None and key in found:
            raise DataError(
                f"{path}: frame {key[0]}/{key[1]} is there twice, as {found[key]} and "
                f"{member}: one revision of every label, delete or move the other"
            )
        if key is not None:
            found[key] = member
    if not found:
        raise UserError(
            f"{path}: no label files in it, expected <sequence>/<radar>_<lidar>.txt "
            "such as 1/00033_00001.txt"
        )
    archive = None if path.is_dir() else path
    return LabelFiles(dict(sorted(found.items())), archive, str(path))


def _label_key(path: pathlib.PurePath) -> Key | None:
    """Sequence and frame name of a label file, None for any other file.

    The sequence is the nearest folder above that is named like one: `1/...`,
    `1/info_label/...` or `1_info_label_revised/...`.
    """
    if _LABEL_NAME.fullmatch(path.name):
        for folder in reversed(path.parts[:-1]):
            if match := _LABELLED_SEQUENCE.fullmatch(folder):
                return int(match[1]), path.stem
    return None


# Splits ------------------------------------------------------------------------------


def find_split_file(split: str, near: Sequence[pathlib.Path]) -> pathlib.Path | None:
    """`split/<name>.txt` in or next to the given folders, None where there is none."""
    for folder in near:
        for candidate in ("split", "resources/split", "."):
            path = folder / candidate / f"{split}.txt"
            if path.is_file():
                return path
    return None


def read_split(path: PathLike) -> list[Key]:
    """Read a split file: lines `sequence,label file`.

    Raises:
        DataError: A line is malformed; the message names file and line.
    """
    frames = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if match := _SPLIT_LINE.fullmatch(line):
            frames.append((int(match[1]), match[2]))
        elif line.strip():
            raise DataError(
                f"{path}:{number}: {line[:80]!r}, expected 'sequence,label file', such "
                "as 1,00033_00001.txt"
            )
    return frames


def split_by_rule(names: Iterable[str], split: str) -> list[str]:
    """K-Radar's split of one sequence: quarters 1 and 3 train, quarters 2 and 4 test.

    Args:
        names: Names of every labelled frame of the sequence.
        split: "train" or "test".

    Returns:
        The names of the split, sorted. On complete sequences they equal the official
        split files.
    """
    names = sorted(names)
    cuts = [int(len(names) * quarter / 4) for quarter in range(5)]
    first = 0 if split == "train" else 1
    return [
        name
        for quarter in (first, first + 2)
        for name in names[cuts[quarter] : cuts[quarter + 1]]
    ]


def read_split_entries(
    split: PathLike,
    near: Sequence[pathlib.Path],
    keys: Collection[Key],
    summary: Summary,
) -> set[Key]:
    """Frames of a split, from its file or by rule.

    Args:
        split: "train", "test" or a split file.
        near: Folders in which split files are looked for.
        keys: All labelled frames, which the rule divides.
        summary: The use of the rule is noted in it.
    """
    if pathlib.Path(split).is_file():
        return set(read_split(split))
    if str(split) not in ("train", "test"):
        raise UserError(
            f"split {str(split)!r} is neither 'train', 'test', None nor a split file"
        )
    if path := find_split_file(str(split), near):
        return set(read_split(path))
    summary.notes.append(
        f"no split/{split}.txt found: split by K-Radar's rule, alternating quarters"
    )
    names = collections.defaultdict(list)
    for sequence, name in keys:
        names[sequence].append(name)
    return {
        (sequence, name)
        for sequence in names
        for name in split_by_rule(names[sequence], str(split))
    }


def held_out(
    sequences: Collection[int], validation: Sequence[float], seed: int
) -> list[int]:
    """Whole sequences of the train split that a run keeps for validation, sorted.

    Args:
        sequences: Numbers of those that have frames to train on.
        validation: Numbers of sequences; or one fraction of them above 0 and below 1,
            which is drawn, at least one sequence; () for none.
        seed: Seed of the draw.

    Raises:
        UserError: A sequence does not exist, or none is left to train on.

    Examples:
        >>> held_out({1, 2, 5}, (5,), 0)
        [5]
        >>> len(held_out(range(1, 59), (0.1,), 0))
        6
    """
    here = sorted(set(sequences))
    if len(validation) == 1 and 0 < validation[0] < 1:
        count = max(1, round(validation[0] * len(here)))
        chosen = {int(n) for n in np.random.default_rng(seed).permutation(here)[:count]}
    else:
        chosen = {int(number) for number in validation}
    if absent := sorted(chosen.difference(here)):
        raise UserError(
            f"config.data.validation holds out sequences {absent}, which have no frames in "
            f"the train split; there are {here}"
        )
    if chosen and len(chosen) == len(here):
        raise UserError(
            f"config.data.validation is {tuple(validation)}, which holds out every "
            f"sequence of the train split ({here}); leave at least one"
        )
    return sorted(chosen)
