"""Files of K-Radar's folders: sequences, label revisions, splits and calibrations.

The folders are described in `docs/file_formats.md`. A sequence is a folder named by its
number. One sequence may have folders under several roots (tensors on one disk, images on
another); each file is taken from the first root that has it.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import pathlib
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

from radejax.core import files
from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.core.structures import frame_key
from radejax.data.kradar.labels import Key, LabelPath
from radejax.data.kradar.reduced import RELEASES, UNUSABLE_POINTS
from radejax.geometry.radar_grid import RadarGrid

T = TypeVar("T")

SIMULATION_MARKER = "simulation.json"
"""File that marks a dataset as simulated and has the settings of the simulator."""

# Regular expressions are used because str.isdecimal also accepts digits of other scripts.
_SEQUENCE = re.compile(r"[0-9]{1,6}")
_LABELED_SEQUENCE = re.compile(r"([0-9]{1,6})(?:_info_label_revised)?")
_LABEL_NAME = re.compile(r"[0-9]{1,9}_[0-9]{1,9}\.txt")
_SPLIT_LINE = re.compile(r"\s*([0-9]{1,6})\s*,\s*([0-9]{1,9}_[0-9]{1,9})(?:\.txt)?\s*")
_MAX_OFFSET_M = 100.0


class SequenceFolder:
    """Merges the folders that one sequence has under several roots.

    Every subfolder is listed only once, and the listing is cached.
    """

    def __init__(self, folders: Sequence[pathlib.Path]) -> None:
        self.folders = tuple(folders)
        self.listing = functools.cache(self._list)

    def _list(self, subfolder: str) -> dict[str, pathlib.Path]:
        """Returns the files of a subfolder by name; the first root takes precedence."""
        found: dict[str, pathlib.Path] = {}
        for folder in self.folders:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                for name in sorted(os.listdir(folder / subfolder)):
                    found.setdefault(name, folder / subfolder / name)
        return found

    def find(self, subfolder: str, name: str) -> pathlib.Path | None:
        """Returns the path of a file, or None if no root has it."""
        return self.listing(subfolder).get(name)


NO_FOLDER = SequenceFolder([])


def as_paths(paths: PathLike | Iterable[PathLike] | None) -> list[pathlib.Path]:
    """Converts one path, several paths or None to a list of paths."""
    if paths is None:
        return []
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    return [files.as_path(path) for path in paths]


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


def first_file(
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
    line = "".join(files.read_text(path).splitlines()[1:2])
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
    folders: Sequence[pathlib.Path], name: str, read: Callable[[files.JsonObject], T]
) -> T | None:
    """Reads the JSON files of one name in all folders; returns None if there are none.

    Raises:
        DataError: A file is malformed, or the contents of two files differ.
    """
    found: dict[pathlib.Path, T] = {}
    for path in (folder / name for folder in folders):
        if path.is_file():
            with wrap_read_errors(path, "the description of a sensor"):
                found[path] = read(files.read_json(path))
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


def read_simulated_z_m(places: Sequence[pathlib.Path]) -> float | None:
    """Returns z of `radar_from_lidar_m` of a simulated dataset; None for recorded ones.

    Raises:
        DataError: A `simulation.json` is malformed, or the folders have different ones.
    """
    return _read_common(
        places,
        SIMULATION_MARKER,
        lambda content: float(content["config"]["radar_from_lidar_m"][2]),
    )


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
    return dict(sorted(found.items()))


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
    members: list[tuple[str, LabelPath]]
    if path.is_dir():
        paths = files.find_files(path, "*.txt")
        members = [(file.relative_to(path).as_posix(), file) for file in paths]
    else:
        with wrap_read_errors(path, "a folder or a zip file of labels"):
            archive = zipfile.ZipFile(path)  # stays open while its members are used
        members = [(name, zipfile.Path(archive, name)) for name in archive.namelist()]
    found: dict[Key, LabelPath] = {}
    for place, file in members:
        *folders, name = place.replace("\\", "/").split("/")
        matches = map(_LABELED_SEQUENCE.fullmatch, reversed(folders))
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
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
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
        names: Names of all labeled frames of the sequence.
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
