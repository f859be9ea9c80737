"""Reader of K-Radar's folders: labelled frames with boxes in the radar frame.

The folders are described in `docs/file_formats.md`. Reading starts from the label files:
`KRadar` can be opened without radar tensors, so that labels can be counted and replaced
without them. A sequence is a folder named by its number. One sequence may have folders
under several roots (tensors on one disk, images on another); each file is taken from the
first root that has it.
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
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Shaped

from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, UserError, require
from radejax.core.files import PathLike, as_path, find_files, read_json, read_text
from radejax.core.structures import CLASSES, frame_key
from radejax.data.dataset import LabelledFrame, LabelledFrames, Summary
from radejax.data.kradar.conditions import (
    KRADAR_CONDITIONS,
    UNKNOWN_CONDITIONS,
    WEATHERS,
    check_weather,
    read_description,
)
from radejax.data.kradar.labels import (
    LABEL_CLASSES,
    VISIBILITY_FLAGS,
    Key,
    Label,
    LabelFile,
    LabelHeader,
    LabelPath,
    normalize_version,
    read_label_file,
)
from radejax.data.reduced import RELEASES, UNUSABLE_POINTS
from radejax.geometry.camera import KRADAR_RADAR_FROM_LIDAR_Z_M, RADAR_FROM_LIDAR_M
from radejax.geometry.radar_grid import RadarGrid

_log = logging.getLogger(__name__)

T = TypeVar("T")

SIMULATION_MARKER = "simulation.json"
"""File that marks a dataset as simulated and has the settings of the simulator."""

# Regular expressions are used because str.isdecimal also accepts digits of other scripts.
_SEQUENCE = re.compile(r"[0-9]{1,6}")
_LABELLED_SEQUENCE = re.compile(r"([0-9]{1,6})(?:_info_label_revised)?")
_LABEL_NAME = re.compile(r"[0-9]{1,9}_[0-9]{1,9}\.txt")
_SPLIT_LINE = re.compile(r"\s*([0-9]{1,6})\s*,\s*([0-9]{1,9}_[0-9]{1,9})(?:\.txt)?\s*")
_CAMERA_FOLDERS = ("calib", "cam_calib", "resources/cam_calib")
_SPLIT_FOLDERS = ("split", "resources/split", ".")
_MAX_OFFSET_M = 100.0


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame(LabelledFrame):
    """One labelled frame of K-Radar.

    The `name` consists of the radar and LiDAR frame numbers, such as `"00033_00001"`.
    `boxes` contains only the objects that the filters of the dataset keep.

    Attributes:
        header: Frame numbers of all sensors and the time stamp.
        labels: All objects of the label file, unfiltered and in the LiDAR frame.
        visibility: Visibility flags of `boxes`.
        tesseract_path: File of the 4D radar tensor, or None if it is missing.
        projection_path: File of the `.npy` projection of the reference implementation,
            or of a reduced release, or None if it is missing. It is the `radar_path` if
            the tensor is missing.
    """

    header: LabelHeader
    labels: tuple[Label, ...]
    visibility: Shaped[np.ndarray, " N"]
    tesseract_path: pathlib.Path | None
    projection_path: pathlib.Path | None


class KRadar(LabelledFrames[Frame]):
    """The labelled frames of a K-Radar copy, sorted by sequence and frame.

    Missing or malformed files and lines are skipped, counted and listed in `summary()`.

    Args:
        root: Folder that contains the sequences, or several such folders if they are
            spread over disks. None if only labels are available.
        labels: Folder or zip file of a label revision. None reads the labels in the
            sequences' own folders.
        version: Version of these labels: v1.0, v1.1, v2.0 or v2.1.
        split: "train" or "test", the path of a split file, or None for every frame.
            The official split files are searched as `<split>.txt` in `split/`,
            `resources/split/` and the top level of every root, whose entries are merged,
            or else of `labels` and of its parent folder. Without them, K-Radar's rule
            (alternating quarters of every sequence) is applied, which `summary()` notes.
        visibility: Visibility flags of the objects to keep, or None for all.
        include_unstarred_v11_labels: Whether lines of v1.x labels without a `*` are
            objects too, as in the reference implementation.
        classes: Classes to keep.
        field_of_view: Whether to keep only boxes whose center is in the field of view.
        sequence_numbers: Sequences to read, or None for all. None skips and counts
            sequences that have labels but no folder in the roots, if roots are given.
        weather: Weathers of the sequences to keep, or None for all.
        camera_calibration: Folder of camera calibrations (`calib_seq_v2/`, `common/`).
        common_camera: Whether to use `common/cam_front0.yml` for all sequences, as the
            reference implementation does.

    Attributes:
        grid: Sensor axes of K-Radar, or of the `radar_grid.json` in a root.
        roots: Folders that contain the sequences.
        folders: Folders of every sequence in the roots, by sequence number.
        release: Reduced release that the roots contain ("polar3d" or "rpc"), or None.
        is_simulated: Whether the simulator wrote the roots or the labels.

    Raises:
        FileNotFoundError: A root or `labels` does not exist.
        UserError: There are no sequences, labels or labels of the given sequences; the
            roots contain several forms of radar data; an option has an invalid value; or
            the labels have another version.
        DataError: The folders, the labels or the split file are ambiguous or corrupted
            as a whole.

    Examples:
        >>> data = KRadar("/data/kradar", split="train")  # doctest: +SKIP
        >>> print(data.summary().to_text())  # doctest: +SKIP
    """

    reader_version = None

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
        flags = VISIBILITY_FLAGS if visibility is None else visibility
        known = f"some of {VISIBILITY_FLAGS}, or None"
        require(set(flags) <= set(VISIBILITY_FLAGS), "visibility", visibility, known)
        are_known = bool(classes) and set(classes) <= set(LABEL_CLASSES)
        require(are_known, "classes", self.classes, f"some of {LABEL_CLASSES}")
        self._visibility, self._field_of_view = visibility, field_of_view
        self._weather = None if weather is None else check_weather(weather)
        numbers = sequence_numbers
        self._sequence_numbers = None if numbers is None else set(numbers)

        roots = self.roots = _as_paths(root)
        self.folders = find_sequences(roots)
        self.release = find_release(self.folders)
        names = ", ".join(map(str, roots))
        if not self.folders and (roots or labels is None):
            raise UserError(f"no sequence folders (1, 2, ...) in the roots: {names}")
        self._split_folders = list(roots)
        if labels is None:
            self._label_source = "the sequences' own folders"
            self._label_paths = find_own_labels(self.folders, self.version)
            if not self._label_paths:
                raise UserError(
                    f"no {self.version} labels in the sequence folders of {names} "
                    "(info_label/*.txt); give the folder or zip of a label revision: "
                    "--labels"
                )
        else:
            self._label_source = str(labels)
            self._label_paths = find_labels(as_path(labels))
            self._split_folders += [as_path(labels), as_path(labels).parent]
        z_m = _read_common(
            self._split_folders,
            SIMULATION_MARKER,
            lambda content: float(content["config"]["radar_from_lidar_m"][2]),
        )
        # K-Radar's own files do not contain the height offset between radar and LiDAR.
        self._radar_from_lidar_z_m = KRADAR_RADAR_FROM_LIDAR_Z_M if z_m is None else z_m
        super().__init__([], read_grid(roots), is_simulated=z_m is not None)
        self._camera_folders = _as_paths(camera_calibration)
        self._camera_folders += [r / name for r in roots for name in _CAMERA_FOLDERS]
        self._common_camera = common_camera
        # The splits of a dataset share this cache, so that no label file is read twice.
        self._read_label_file = functools.cache(
            functools.partial(
                read_label_file,
                version=self.version,
                include_unstarred=include_unstarred_v11_labels,
            )
        )
        self._read(split)

    def of_split(self, split: PathLike | None) -> KRadar:
        """Returns the dataset reopened with another split.

        Label files that were read before are not read again.

        Raises:
            UserError: There is no such split.
            DataError: The split file is malformed.
        """
        other = copy.copy(self)
        other._read(split)
        return other

    @property
    def counts(self) -> collections.Counter[str]:
        """Numbers of items that were read and skipped, by reason (`summary().counts`)."""
        return self._summary.counts

    def class_counts(self) -> dict[str, int]:
        """Returns the number of kept objects of every class."""
        counts = collections.Counter(cls for f in self._frames for cls in f.classes)
        return {cls: counts[cls] for cls in self.classes}

    def lidar_path(self, frame: Frame) -> pathlib.Path:
        """Returns the file of a frame's OS2-64 LiDAR scan.

        Raises:
            FileNotFoundError: No root has it.
        """
        name = f"os2-64_{frame.header.lidar:05d}.pcd"
        path = self.folders.get(frame.sequence, _NO_FOLDER).find("os2-64", name)
        if path is None:
            raise FileNotFoundError(f"frame {frame.key}: no os2-64/{name} in any root")
        return path

    def _read(self, split: PathLike | None) -> None:
        """Reads the label files of a split and builds its frames."""
        self._summary = Summary()
        keys = self._select(split)
        numbers = sorted({number for number, _ in keys})
        sequences = {number: self._read_sequence(number) for number in numbers}
        if self._weather is not None:
            number_before, chosen = len(keys), self._weather
            keys = [k for k in keys if sequences[k[0]]["weather"] in chosen]
            self.counts["frames left out by weather"] = number_before - len(keys)
        self._frames = self._make_frames(self._read_labels(keys), sequences)
        self.counts["frames"] = len(self._frames)
        no_objects = sum(not len(frame.boxes) for frame in self._frames)
        self.counts["frames without objects"] = no_objects
        lines = [text for kind, text in self._summary.problems if kind == "label line"]
        if lines and not self.counts["objects in the label files"]:
            raise UserError(
                f"no object could be read from {self._label_source}: {lines[0]}; give the "
                "version of these labels: --label-version VERSION, in training "
                "--config.data.label_version=VERSION, such as v1.0"
            )

    def _select(self, split: PathLike | None) -> list[Key]:
        """Returns the keys of the label files to read, sorted, and counts the others."""
        numbers = self._sequence_numbers
        labelled = {number for number, _ in self._label_paths}
        here = labelled & set(self.folders) if self.folders else labelled
        wanted = here if numbers is None else numbers
        if wanted - here:
            raise UserError(
                f"no labels in {self._label_source}, or no folders in the roots, of "
                f"sequences {sorted(wanted - here)}; there are {sorted(here)}"
            )
        keys = [key for key in self._label_paths if key[0] in wanted]
        if numbers is None:
            absent, rest = labelled - here, len(self._label_paths) - len(keys)
            self.counts["sequences with labels that are not in the roots"] = len(absent)
            self.counts["frames of sequences that are not in the roots"] = rest
        if split is None:
            return keys
        entries = self._read_split_entries(str(split), keys)
        for number, name in sorted(entries.difference(keys)):
            if number in wanted:
                self._report(
                    "label file missing",
                    f"{number}/{name}: in split {split} but not among the labels of "
                    f"{self._label_source}",
                )
            elif numbers is None:
                self.counts["split entries of sequences that are not here"] += 1
        return [key for key in keys if key in entries]

    def _read_split_entries(self, split: str, keys: Sequence[Key]) -> set[Key]:
        """Returns the frames of a split, from its file or by K-Radar's rule.

        Frames that are in both official split files are reported.
        """
        if split not in ("train", "test"):
            if not as_path(split).is_file():
                raise UserError(
                    f"split {split!r} is neither 'train', 'test', None nor a split file"
                )
            return set(read_split(split))
        paths = {name: self._split_files(name) for name in ("train", "test")}
        entries = {
            n: set[Key]().union(*map(read_split, of)) for n, of in paths.items() if of
        }
        if len(entries) == 2 and (both := sorted(entries["train"] & entries["test"])):
            train, test = (", ".join(map(str, files)) for files in paths.values())
            message = (
                f"{both[0][0]}/{both[0][1]}: the first of {len(both)} frames that are in "
                f"both {train} and {test}; a model is evaluated on frames that it was "
                "trained on"
            )
            self._report("split", message)
            _log.warning(message)
        if split in entries:
            return entries[split]
        self._summary.notes.append(
            f"no split/{split}.txt found: split by K-Radar's rule, alternating quarters"
        )
        return {
            (number, name)
            for number, group in itertools.groupby(keys, key=lambda key: key[0])
            for name in split_by_rule([name for _, name in group], split)
        }

    def _split_files(self, split: str) -> list[pathlib.Path]:
        """Returns the files of a split: of every root, or else one beside the labels."""
        names = [f"{place}/{split}.txt" for place in _SPLIT_FOLDERS]
        files = [_first_file([folder], names) for folder in self._split_folders]
        of_roots = list(filter(None, files[: len(self.roots)]))
        return of_roots or list(filter(None, files))[:1]

    def _report(self, kind: str, message: str) -> None:
        self._summary.problems.append((kind, message))

    def _read_sequence(self, number: int) -> dict[str, Any]:
        """Returns the fields that all frames of a sequence share.

        They are read from the files of the sequence; missing ones have default values.
        """
        folder = self.folders.get(number, _NO_FOLDER)
        camera, own = None, f"seq_{number:02d}/cam_1.yml"
        if not self._common_camera:
            names = f"calib_seq_v2/{own}", own
            camera = _first_file(self._camera_folders, names)
        if camera is None:
            names = "common/cam_front0.yml", "cam_front0.yml"
            camera = _first_file(self._camera_folders, names)
            kind = "with the common" if camera else "without"
            self.counts[f"sequences {kind} camera calibration"] += 1
        path = folder.find("info_calib", "calib_radar_lidar.txt")
        if path is None and folder.folders:
            self._report(
                "calibration missing",
                f"sequence {number}: no info_calib/calib_radar_lidar.txt, using K-Radar's "
                f"{RADAR_FROM_LIDAR_M[:2]}",
            )
        calibration = self._read_or_report(read_calibration, path, "calibration")
        if calibration is None:
            self.counts["sequences with the default calibration"] += 1
            calibration = (0, *RADAR_FROM_LIDAR_M[:2])
        path = folder.find(".", "description.txt")
        conditions = self._read_or_report(read_description, path, "description")
        if conditions is None:
            self.counts["sequences with built-in conditions"] += 1
            conditions = KRADAR_CONDITIONS.get(number, UNKNOWN_CONDITIONS)
        elif conditions.weather not in (*WEATHERS, "unknown"):
            self._summary.notes.append(
                f"{path}: weather {conditions.weather!r} is none of K-Radar's: "
                f"{', '.join(WEATHERS)}"
            )
        return {
            **conditions._asdict(),
            "radar_from_lidar_m": (*calibration[1:], 0.0),
            "radar_from_lidar_z_m": self._radar_from_lidar_z_m,
            "camera_calibration_path": camera,
        }

    def _read_or_report(
        self, read: Callable[[Any], T], path: LabelPath | None, kind: str
    ) -> T | None:
        """Returns the content of a file, or None if it is missing or malformed.

        A malformed file is reported.
        """
        try:
            return None if path is None else read(path)
        except DataError as error:
            self._report(kind, str(error))
            return None

    def _read_labels(self, keys: Iterable[Key]) -> dict[Key, LabelFile]:
        """Reads label files; corrupted ones are left out and reported."""
        files, counts = {}, self.counts
        for key in keys:
            path = self._label_paths[key]
            file = self._read_or_report(self._read_label_file, path, "label file")
            if file is None:
                continue
            files[key] = file
            self._summary.problems += [("label line", text) for text in file.problems]
            expected = f"{file.header.radar:05d}_{file.header.lidar:05d}"
            counts["objects in the label files"] += len(file.labels)
            counts["disabled objects (no leading *)"] += file.num_unstarred
            counts["files named unlike their header"] += key[1] != expected
        return files

    def _make_frames(
        self, files: Mapping[Key, LabelFile], sequences: Mapping[int, Mapping[str, Any]]
    ) -> list[Frame]:
        """Builds frames with filtered boxes.

        The boxes of all frames are filtered at once, which is faster.
        """
        labels = [label for file in files.values() for label in file.labels]
        sizes = np.array([len(file.labels) for file in files.values()], int)
        shifts = [sequences[number]["radar_from_lidar_m"] for number, _ in files]
        boxes = np.array([label.box for label in labels], np.float64).reshape(-1, 7)
        boxes[:, :3] += np.repeat(np.reshape(shifts, (-1, 3)), sizes, axis=0)
        classes = np.array([label.cls for label in labels], dtype=np.str_)
        flags = np.array([label.visibility for label in labels], dtype=np.str_)
        kept = np.flatnonzero(self._filter(boxes, classes, flags))
        ends = np.searchsorted(kept, np.cumsum(sizes))
        frames = []
        bounds = itertools.pairwise([0, *ends])
        for (key, file), (start, end) in zip(files.items(), bounds, strict=True):
            rows = kept[start:end]
            frame = Frame(
                sequence=key[0],
                name=key[1],
                header=file.header,
                labels=tuple(file.labels),
                boxes=boxes[rows],
                classes=classes[rows],
                visibility=flags[rows],
                is_simulated=self.is_simulated,
                **sequences[key[0]],
                **self._find_files(key, file.header),
            )
            frames.append(frame)
        return frames

    def _filter(
        self,
        boxes: Float[np.ndarray, "N 7"],
        classes: Shaped[np.ndarray, " N"],
        flags: Shaped[np.ndarray, " N"],
    ) -> Bool[np.ndarray, " N"]:
        """Returns a mask of the objects to keep and counts the others by reason."""
        is_odd = np.isin(flags, VISIBILITY_FLAGS, invert=True)
        self.counts["objects with an odd availability flag"] = int(is_odd.sum())
        is_kept = np.ones(len(classes), bool)
        rules = {
            "class": np.isin(classes, self.classes),
            "visibility": is_kept.copy(),
            "field of view": is_kept.copy(),
        }
        if self._visibility is not None:
            rules["visibility"] = np.isin(flags, list(self._visibility))
        if self._field_of_view:
            rules["field of view"] = self.grid.in_field_of_view(*boxes[:, :2].T)
        for rule, passes in rules.items():
            self.counts[f"objects left out by {rule}"] = int((is_kept & ~passes).sum())
            is_kept &= passes
        self.counts["objects kept"] = int(is_kept.sum())
        return is_kept

    def _find_files(self, key: Key, header: LabelHeader) -> dict[str, Any]:
        """Returns the paths of a frame's files, or None for missing ones.

        A missing radar tensor is reported; missing images are counted.
        """
        folder = self.folders.get(key[0], _NO_FOLDER)
        stem = f"tesseract_{header.radar:05d}"
        tesseract = folder.find("radar_tesseract", f"{stem}.mat")
        projection = folder.find("DERA_tesseract", f"DERA_{stem}.npy")
        wanted = f"radar_tesseract/{stem}.mat"
        if self.release is not None:
            wanted = f"{self.release}_{header.radar:05d}.npy"
            projection = folder.find(".", wanted)
        camera = folder.find("cam-front", f"cam-front_{header.camera_front:05d}.png")
        if folder.folders:
            if not (tesseract or projection):
                places = ", ".join(map(str, folder.folders))
                message = f"{key[0]}/{key[1]}: no {wanted} in {places}"
                self._report("tesseract missing", message)
            self.counts["frames without front image"] += camera is None
        return {
            "tesseract_path": tesseract,
            "projection_path": projection,
            "radar_path": tesseract or projection,
            "camera_path": camera,
        }


# Folders -----------------------------------------------------------------------------


class SequenceFolder:
    """Merges the folders that one sequence has under several roots.

    Every subfolder is listed only once, and the listing is cached.
    """

    def __init__(self, folders: Sequence[pathlib.Path]) -> None:
        self.folders = tuple(folders)
        self.listing = functools.cache(self._list)

    def _list(self, subfolder: str) -> dict[str, pathlib.Path]:
        """Returns the files of a subfolder by name; the first root takes precedence."""
        files: dict[str, pathlib.Path] = {}
        for folder in self.folders:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                for name in sorted(os.listdir(folder / subfolder)):
                    files.setdefault(name, folder / subfolder / name)
        return files

    def find(self, subfolder: str, name: str) -> pathlib.Path | None:
        """Returns the path of a file, or None if no root has it."""
        return self.listing(subfolder).get(name)


_NO_FOLDER = SequenceFolder([])


def _as_paths(paths: PathLike | Iterable[PathLike] | None) -> list[pathlib.Path]:
    """Converts one path, several paths or None to a list of paths."""
    if paths is None:
        return []
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    return [as_path(path) for path in paths]


def sequence_number(folder: pathlib.Path) -> int | None:
    """Returns the number of a sequence's folder, or None for any other folder."""
    return int(folder.name) if _SEQUENCE.fullmatch(folder.name) else None


def find_sequences(roots: Sequence[pathlib.Path]) -> dict[int, SequenceFolder]:
    """Finds the folders of all sequences under the roots, by sequence number.

    Raises:
        FileNotFoundError: A root does not exist.
        DataError: A root contains a sequence twice, for example as `1` and `01`.
    """
    found: dict[int, list[pathlib.Path]] = {}
    for root in roots:
        for folder in sorted(root.iterdir()):
            number = sequence_number(folder)
            if number is not None and folder.is_dir():
                same = found.setdefault(number, [])
                if same and same[-1].parent == root:
                    raise DataError(
                        f"sequence {number} is there twice, as {same[-1]} and "
                        f"{folder}: delete or move one"
                    )
                same.append(folder)
    return {number: SequenceFolder(found[number]) for number in sorted(found)}


def find_release(folders: Mapping[int, SequenceFolder]) -> str | None:
    """Returns the reduced release that the sequences contain, or None without one.

    Raises:
        UserError: The sequences contain radar data in several forms, or only points of a
            Cartesian grid.
    """
    found: dict[str, pathlib.Path] = {}
    for folder in folders.values():
        for name in ("radar_tesseract", "DERA_tesseract", "."):
            for path in folder.listing(name).values():
                form = path.name.partition("_")[0] if name == "." else "tesseract"
                if path.suffix in (".mat", ".npy"):
                    found.setdefault(form, path)
    forms = [found[form] for form in ("tesseract", *RELEASES) if form in found]
    if len(forms) > 1:
        raise UserError(
            f"{forms[0]} and {forms[1]} are different forms of radar data, which cannot "
            "be mixed in one dataset: name only roots of one form"
        )
    if not forms and "sprdr" in found:
        raise UserError(f"{found['sprdr']}: {UNUSABLE_POINTS}")
    return next((form for form in RELEASES if form in found), None)


def _first_file(
    folders: Sequence[pathlib.Path], names: Sequence[str]
) -> pathlib.Path | None:
    """Returns the first existing file, or None; all names are tried per folder."""
    paths = (folder / name for folder, name in itertools.product(folders, names))
    return next(filter(pathlib.Path.is_file, paths), None)


def read_calibration(path: PathLike) -> tuple[int, float, float]:
    """Reads `info_calib/calib_radar_lidar.txt`: a header line and three numbers.

    Returns:
        The radar frame number minus the LiDAR frame number, and the offsets in meters
        that are added to LiDAR x and y to obtain radar x and y.

    Raises:
        DataError: The file is malformed; the message names file and line.
    """
    line = "".join(read_text(path).splitlines()[1:2])
    with contextlib.suppress(ValueError):
        difference, dx_m, dy_m = map(float, line.split(","))
        is_near = abs(dx_m) <= _MAX_OFFSET_M and abs(dy_m) <= _MAX_OFFSET_M
        if is_near and difference.is_integer():
            return int(difference), dx_m, dy_m
    raise DataError(
        f"{path}:2: {line[:80]!r}, expected three numbers: frame difference (whole), x, y "
        f"up to {_MAX_OFFSET_M:g} m, such as 32,-2.54,0.3"
    )


def _read_common(
    folders: Sequence[pathlib.Path], name: str, read: Callable[[Any], T]
) -> T | None:
    """Reads the JSON files of one name in all folders; returns None if there are none.

    Raises:
        DataError: A file is malformed, or the contents of two files differ.
    """
    found: dict[pathlib.Path, T] = {}
    for path in (folder / name for folder in folders):
        if path.is_file():
            with wrap_read_errors(path, "the description of a sensor"):
                found[path] = read(read_json(path))
    if len(set(found.values())) > 1:
        raise DataError(
            f"{' and '.join(map(str, found))} differ; datasets of different sensors "
            "cannot be read as one"
        )
    return next(iter(found.values()), None)


def read_grid(roots: Sequence[pathlib.Path]) -> RadarGrid:
    """Returns the sensor axes of the `radar_grid.json` in a root, or those of K-Radar.

    Raises:
        DataError: The file is malformed, or the roots have different ones.
    """
    grid = _read_common(roots, "radar_grid.json", RadarGrid.from_dict)
    return grid or RadarGrid.kradar()


def is_elevation_axis_up(roots: Sequence[pathlib.Path]) -> bool:
    """Returns whether the elevation axis of the radar tensors in the roots points up.

    That of simulated datasets and of other radars does. K-Radar's code takes the axis of
    K-Radar's own tensors to point down.

    Raises:
        DataError: A `radar_grid.json` is malformed, or the roots have different ones.
    """
    is_simulated = any((root / SIMULATION_MARKER).is_file() for root in roots)
    return is_simulated or read_grid(roots) != RadarGrid.kradar()


# Label files -------------------------------------------------------------------------


def find_own_labels(
    sequences: dict[int, SequenceFolder], version: str
) -> dict[Key, LabelPath]:
    """Finds the label files in the sequences' own folders.

    For every sequence, the first subfolder that contains label files is used:
    `info_label_<version>`, such as `info_label_v2_1`, then `info_label_v2` for version
    v2.0, then `info_label`.
    """
    subfolders = [f"info_label_{version.replace('.', '_')}", "info_label"]
    if version == "v2.0":
        subfolders.insert(1, "info_label_v2")
    found: dict[Key, LabelPath] = {}
    for number, folder in sequences.items():
        for subfolder in subfolders:
            listing = folder.listing(subfolder)
            names = sorted(name for name in listing if _LABEL_NAME.fullmatch(name))
            for name in names:
                _add_label(found, (number, frame_key(name)), listing[name])
            if names:
                break
    return found


def _add_label(found: dict[Key, LabelPath], key: Key, file: LabelPath) -> None:
    if key in found:
        raise DataError(
            f"frame {key[0]}/{key[1]} is there twice, as {found[key]} and {file}: one "
            "revision of every label, delete or move the other"
        )
    found[key] = file


def find_labels(path: pathlib.Path) -> dict[Key, LabelPath]:
    """Finds the label files of a revision, in a folder or zip file.

    The files are named `<sequence>/<radar>_<lidar>.txt`. The sequence number is taken
    from the nearest parent folder with such a name: `1/...`, `1/info_label/...` or
    `1_info_label_revised/...`.

    Raises:
        FileNotFoundError: There is no such folder or file.
        UserError: There are no label files in it.
        DataError: It contains a frame twice, or the zip file is corrupted.
    """
    files: list[tuple[str, LabelPath]]
    if path.is_dir():
        paths = find_files(path, "*.txt")
        files = [(file.relative_to(path).as_posix(), file) for file in paths]
    else:
        with wrap_read_errors(path, "a folder or a zip file of labels"):
            archive = zipfile.ZipFile(path)  # stays open while its members are used
        files = [(name, zipfile.Path(archive, name)) for name in archive.namelist()]
    found: dict[Key, LabelPath] = {}
    for place, file in files:
        *folders, name = place.replace("\\", "/").split("/")
        matches = map(_LABELLED_SEQUENCE.fullmatch, reversed(folders))
        sequence = next(filter(None, matches), None)
        if sequence is not None and _LABEL_NAME.fullmatch(name):
            _add_label(found, (int(sequence[1]), frame_key(name)), file)
    if not found:
        raise UserError(
            f"{path}: no label files in it, expected <sequence>/<radar>_<lidar>.txt "
            "such as 1/00033_00001.txt"
        )
    return dict(sorted(found.items()))


# Splits ------------------------------------------------------------------------------


def read_split(path: PathLike) -> list[Key]:
    """Reads a split file with lines `sequence,label file`.

    Raises:
        DataError: A line is malformed; the message names file and line.
    """
    frames = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if match := _SPLIT_LINE.fullmatch(line):
            frames.append((int(match[1]), frame_key(match[2])))
        elif line.strip():
            raise DataError(
                f"{path}:{number}: {line[:80]!r}, expected 'sequence,label file', such "
                "as 1,00033_00001.txt"
            )
    return frames


def split_by_rule(names: Iterable[str], split: str) -> list[str]:
    """Splits the frames of one sequence by K-Radar's rule.

    Quarters 1 and 3 are for training, quarters 2 and 4 for testing.

    Args:
        names: Names of all labelled frames of the sequence.
        split: "train" or "test".

    Returns:
        The sorted names of the frames in the split. For complete sequences they are the
        same as in the official split files.
    """
    names = sorted(names)
    ends = [int(len(names) * quarter / 4) for quarter in range(5)]
    quarters = [names[start:end] for start, end in itertools.pairwise(ends)]
    first = 0 if split == "train" else 1
    return quarters[first] + quarters[first + 2]


def held_out(
    sequences: Collection[int], validation: Sequence[float], seed: int
) -> list[int]:
    """Returns the sequences of the train split that are held out for validation.

    Args:
        sequences: Numbers of the sequences that have training frames.
        validation: Numbers of the sequences to hold out; or a single fraction between 0
            and 1 of the sequences, of which at least one is drawn at random; or () for
            none.
        seed: Seed of the random draw.

    Returns:
        The sorted numbers of the held-out sequences.

    Raises:
        UserError: A sequence has no training frames, or none is left to train on.

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
