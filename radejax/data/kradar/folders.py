"""Where things are in K-Radar's folders: sequences over several disks, label sources.

A sequence is a folder named by its number. One sequence may have folders under several
roots (tesseracts on one disk, images on another); each file is taken from the first
root that has it.
"""

from __future__ import annotations

import contextlib
import functools
import os
import pathlib
import re
import zipfile
from collections.abc import Callable, Iterator, Sequence

from radejax.core.archives import open_zip, read_member
from radejax.core.errors import DataError, UserError
from radejax.core.files import read_json
from radejax.data.kradar.labels import MAX_LABEL_BYTES, read_label_bytes
from radejax.geometry.camera import KRADAR_RADAR_FROM_LIDAR_Z_M
from radejax.geometry.radar_grid import RadarGrid

SIMULATION_MARKER = "simulation.json"
"""File by which a data set says that it is simulated, and by what settings."""

_OWN_LABEL_FOLDERS = {
    "v1.0": ("info_label_v1_0", "info_label"),
    "v1.1": ("info_label_v1_1", "info_label"),
    "v2.0": ("info_label_v2_0", "info_label_v2", "info_label"),
    "v2.1": ("info_label_v2_1", "info_label"),
}
# As labels have it; isdecimal is also true of the digits of other scripts.
_IS_SEQUENCE = re.compile(r"[0-9]{1,6}")
_SEQUENCE_NAME = re.compile(r"([0-9]{1,6})(?:_info_label_revised)?")
_LABEL_NAME = re.compile(r"[0-9]{1,9}_[0-9]{1,9}\.txt")


class SequenceFolder:
    """All folders of one sequence, seen as one.

    Listings are read once: asking for a thousand frames costs one directory scan.
    """

    def __init__(self, folders: Sequence[pathlib.Path]) -> None:
        self.folders = tuple(folders)
        self._listings: dict[str, dict[str, pathlib.Path]] = {}

    def listing(self, subfolder: str) -> dict[str, pathlib.Path]:
        """Files of a subfolder by name, the first root winning."""
        if subfolder not in self._listings:
            files: dict[str, pathlib.Path] = {}
            for folder in self.folders:
                try:
                    names = sorted(os.listdir(folder / subfolder))
                except (FileNotFoundError, NotADirectoryError):
                    continue
                for name in names:
                    files.setdefault(name, folder / subfolder / name)
            self._listings[subfolder] = files
        return self._listings[subfolder]

    def find(self, subfolder: str, name: str) -> pathlib.Path | None:
        """Path of a file, None where no root has it."""
        return self.listing(subfolder).get(name)


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
            if _IS_SEQUENCE.fullmatch(folder.name) and folder.is_dir():
                same = found.setdefault(int(folder.name), [])
                if same and same[-1].parent == root:
                    raise DataError(
                        f"sequence {int(folder.name)} is there twice, as {same[-1]} and "
                        f"{folder}: delete or move one"
                    )
                same.append(folder)
    return {number: SequenceFolder(found[number]) for number in sorted(found)}


def nearby_roots(roots: Sequence[pathlib.Path]) -> list[pathlib.Path]:
    """Up to three roots that may be meant by a sequence's folder or a root's parent."""
    found = []
    for root in (pathlib.Path(os.path.abspath(root)) for root in roots):
        inside = sorted(root.iterdir())
        has_radar = any(p.name.startswith(("radar_", "info_label")) for p in inside)
        if _IS_SEQUENCE.fullmatch(root.name) and has_radar:
            found.append(root.parent)
        folders = [p for p in inside if p.is_dir() and os.access(p, os.R_OK)]
        found += [path for path in folders if find_sequences([path])]
    return found[:3]


class LabelSource:
    """Label files by (sequence, frame name), wherever they come from.

    Args:
        files: What opens each label file: a path, or a member of `archive`.
        archive: Zip file that the members are in, None for plain files.
        description: Names the source in messages.
    """

    def __init__(
        self,
        files: dict[tuple[int, str], pathlib.Path | str],
        archive: pathlib.Path | None,
        description: str,
    ) -> None:
        self.files = dict(sorted(files.items()))
        self.archive = archive
        self.description = description

    def where(self, key: tuple[int, str]) -> str:
        """How messages name a label file."""
        path = self.files[key]
        return str(path) if self.archive is None else f"{self.archive}/{path}"

    def read(
        self, keys: Sequence[tuple[int, str]]
    ) -> Iterator[tuple[tuple[int, str], bytes | DataError]]:
        """Contents of label files, or why one has none; the archive is opened once."""
        if self.archive is None:
            read: Callable[[tuple[int, str]], bytes] = self._read_file
            manager: contextlib.AbstractContextManager = contextlib.nullcontext()
        else:
            manager = open_zip(self.archive)
        with manager as archive:
            if archive is not None:
                read = functools.partial(self._read_member, archive)
            for key in keys:
                try:
                    content: bytes | DataError = read(key)
                except DataError as error:
                    content = error
                yield key, content

    def _read_file(self, key: tuple[int, str]) -> bytes:
        return read_label_bytes(pathlib.Path(self.files[key]))

    def _read_member(self, archive: zipfile.ZipFile, key: tuple[int, str]) -> bytes:
        name = str(self.files[key])
        return read_member(archive, name, max_bytes=MAX_LABEL_BYTES)


def own_labels(sequences: dict[int, SequenceFolder], version: str) -> LabelSource:
    """Labels from the sequences' own folders, as the data set is delivered."""
    files: dict[tuple[int, str], pathlib.Path | str] = {}
    for number, folder in sequences.items():
        for subfolder in _OWN_LABEL_FOLDERS[version]:
            listing = folder.listing(subfolder)
            names = [name for name in listing if _LABEL_NAME.fullmatch(name)]
            if names:
                files.update(
                    {(number, n.removesuffix(".txt")): listing[n] for n in names}
                )
                break
    return LabelSource(files, None, "the sequences' own folders")


def labels_from(path: pathlib.Path) -> LabelSource:
    """Labels from a revision folder or zip: `<sequence>/<radar>_<lidar>.txt` below it.

    Raises:
        FileNotFoundError: There is no such folder or file.
        UserError: It is neither a folder nor a zip, or holds no label files.
        DataError: A frame is in it twice, or the zip is damaged.
    """
    members: list[tuple[tuple[int, str] | None, pathlib.Path | str]]
    if path.is_dir():
        relative = [file.relative_to(path) for file in path.rglob("*.txt")]
        members = [(_label_key(name), path / name) for name in sorted(relative)]
        archive = None
    elif not path.exists():
        raise FileNotFoundError(f"{path}: no such labels, expected a folder or a zip")
    elif path.suffix == ".zip" or zipfile.is_zipfile(path):
        with open_zip(path) as file:
            names = file.namelist()
        members = [(_label_key(pathlib.PurePosixPath(name)), name) for name in names]
        archive = path
    else:
        raise UserError(f"{path}: labels must be a folder or a zip file")
    files: dict[tuple[int, str], pathlib.Path | str] = {}
    for key, member in members:
        if key is None:
            continue
        if key in files:
            raise DataError(
                f"{path}: frame {key[0]}/{key[1]} is there twice, as {files[key]} and "
                f"{member}: one revision of every label, delete or move the other"
            )
        files[key] = member
    if not files:
        raise UserError(
            f"{path}: no label files in it, expected <sequence>/<radar>_<lidar>.txt "
            "such as 1/00033_00001.txt"
        )
    return LabelSource(files, archive, str(path))


def _label_key(path: pathlib.PurePath) -> tuple[int, str] | None:
    """Sequence and frame name of a label file, None for any other file.

    The sequence is the nearest folder above that is named like one: `1/...`,
    `1/info_label/...` or `1_info_label_revised/...`.
    """
    if not _LABEL_NAME.fullmatch(path.name):
        return None
    for folder in reversed(path.parts[:-1]):
        if match := _SEQUENCE_NAME.fullmatch(folder):
            return int(match[1]), path.stem
    return None


def find_split_file(split: str, near: Sequence[pathlib.Path]) -> pathlib.Path | None:
    """`split/<name>.txt` in or beside the given folders, None where there is none."""
    for folder in near:
        for candidate in ("split", "resources/split", "."):
            path = folder / candidate / f"{split}.txt"
            if path.is_file():
                return path
    return None


def find_camera_calibration(
    folders: Sequence[pathlib.Path], sequence: int, *, common_only: bool = False
) -> tuple[pathlib.Path | None, bool]:
    """Calibration of the left front camera: of the sequence, else the common one.

    Args:
        folders: Where it is looked for.
        sequence: Number of the sequence.
        common_only: The common one even where the sequence has its own.

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


def are_simulated(folders: Sequence[pathlib.Path]) -> bool:
    """Whether the simulator has left its `simulation.json` in one of the folders."""
    # Impossible names are no folders; pathlib would raise.
    return any(os.path.isfile(folder / SIMULATION_MARKER) for folder in folders)


def read_radar_from_lidar_z(folders: Sequence[pathlib.Path]) -> float:
    """Metres from LiDAR up to radar as the sensors stand, not as boxes are counted.

    What a simulated data set says of its set-up, else K-Radar's own; its calibration
    files say nothing of z.

    Raises:
        DataError: A simulation's file is malformed, or two of them differ.
    """
    found: dict[pathlib.Path, float] = {}
    for path in (folder / SIMULATION_MARKER for folder in folders):
        if path.is_file():
            try:
                shift = read_json(path).get("config", {}).get("radar_from_lidar_m")
                found[path] = KRADAR_RADAR_FROM_LIDAR_Z_M if shift is None else shift[2]
            except (AttributeError, IndexError, TypeError, KeyError):
                raise DataError(
                    f"{path}: config.radar_from_lidar_m is not three numbers"
                ) from None
    if len(set(found.values())) > 1:
        raise DataError(
            f"different heights of radar over LiDAR in {', '.join(map(str, found))}; data "
            "sets of different sensors cannot be read as one"
        )
    return float(next(iter(found.values()), KRADAR_RADAR_FROM_LIDAR_Z_M))


def read_grid(roots: Sequence[pathlib.Path]) -> RadarGrid:
    """Sensor axes of a data set: `radar_grid.json` in a root, else K-Radar's.

    Raises:
        DataError: The file is malformed, or two roots have different axes.
    """
    found: dict[pathlib.Path, RadarGrid] = {}
    for root in roots:
        path = root / "radar_grid.json"
        if path.is_file():
            found[path] = read_json(path, RadarGrid)
    if len(set(found.values())) > 1:
        raise DataError(
            f"different sensor axes in {', '.join(map(str, found))}; data sets of "
            "different sensors cannot be read as one"
        )
    return next(iter(found.values()), RadarGrid.kradar())
