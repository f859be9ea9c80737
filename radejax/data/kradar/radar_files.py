"""Radar files in folders, for commands that need no labels."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import PathLike
from radejax.core.structures import frame_key
from radejax.data.kradar.conditions import check_weather, read_description
from radejax.data.kradar.folders import sequence_number
from radejax.data.kradar.reduced import is_reduced_file

PATTERNS = ("tesseract_*.mat", "DERA_tesseract_*.npy", "polar3d_*.npy", "rpc_*.npy")
"""Patterns of the names of radar files."""


def find_frames(
    paths: Sequence[PathLike],
    sequences: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
) -> list[pathlib.Path]:
    """Finds radar files in files and folders.

    If a frame has both files, only the projection is returned.

    Args:
        paths: Files, which are taken whatever their name, and folders, which are searched
            recursively.
        sequences: Numbers of the sequences to take; all if None.
        weather: Kinds of weather to take, according to the `description.txt` of each
            sequence; all if None.

    Returns:
        Sorted paths of the files.

    Raises:
        FileNotFoundError: A path, or a `description.txt`, does not exist.
        UserError: There is no frame; the message names what was searched.
    """
    found: set[pathlib.Path] = set()
    for path in map(files.as_path, paths):
        if not path.exists():
            raise FileNotFoundError(f"no such file or folder: {path}")
        found.update([path] if path.is_file() else files.find_files(path, *PATTERNS))
        # Several sequences may be links to one folder, which is searched for each.
        for folder in path.glob("[0-9]*/"):
            if sequence_number(folder) is not None:
                found.update(files.find_files(folder, *PATTERNS))
    folders = {sequence_folder(path) for path in found}
    if sequences:
        folders = {f for f in folders if sequence_number(f) in sequences}
    if weather:
        check_weather(weather)
        descriptions = {f: read_description(f / "description.txt") for f in folders}
        folders = {f for f in folders if descriptions[f].weather in weather}
    frames = {
        _without_form(path): path
        for path in sorted(found, key=lambda path: (path.suffix == ".npy", path))
        if sequence_folder(path) in folders
    }
    if not frames:
        asked = map(str, [*paths, *(sequences or ()), *(weather or ())])
        raise UserError(
            f"no frames for {', '.join(asked)}: looked for {' and '.join(PATTERNS)}"
        )
    return sorted(frames.values())


def _without_form(path: pathlib.Path) -> pathlib.Path:
    """Returns a path that is the same for the tensor and the projection of a frame."""
    folder = path.absolute().parent
    if folder.name == "DERA_tesseract":
        folder = folder.with_name("radar_tesseract")
    return folder / path.stem.removeprefix("DERA_")


def sequence_folder(path: pathlib.Path) -> pathlib.Path:
    """Returns the folder of the sequence of a radar file."""
    folder = path.absolute().parent
    return folder if is_reduced_file(path) else folder.parent


def key_of(path: pathlib.Path) -> str:
    """Returns the key of the frame of a radar file without the LiDAR index: "5/00033".

    Only label files contain the LiDAR index.
    """
    radar = path.stem
    for pattern in ("DERA_*", *PATTERNS):
        radar = radar.removeprefix(pattern.partition("*")[0])
    sequence = sequence_folder(path).name
    return frame_key(f"{sequence}/{radar}" if sequence else radar)
