"""Writers of files in K-Radar's formats, which `kradar` and `tesseract` read.

The simulator writes its datasets with them. Every file is written under a temporary name
and renamed, so that it is complete if it exists.
"""

from __future__ import annotations

import json
import math
import pathlib
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Real

from radejax.core.files import PathLike, atomic_write, write_text
from radejax.data.kradar.labels import Key, Label, normalize_version
from radejax.geometry.radar_grid import RadarGrid

_SENSORS = "tesseract_os2-64_cam-front_os1-128_cam-lrr"
_MAT_TEXT = b"MATLAB 5.0 MAT-file, written by radejax"


def write_labels(
    path: PathLike,
    indices: Sequence[int],
    timestamp_s: float,
    labels: Iterable[Label],
    version: str = "v2.1",
) -> None:
    """Writes one label file, the inverse of `labels.read_labels`.

    Args:
        path: Label file, `<radar index>_<lidar index>.txt`.
        indices: Frame numbers of the radar, the OS2-64 LiDAR, the front camera, the
            OS1-128 LiDAR and the other cameras.
        timestamp_s: Unix time of the LiDAR scan.
        labels: Objects in the LiDAR frame, with full extents in meters and yaw in
            radians.
        version: Label version; v1.0 and v2.0 do not store the visibility.

    Raises:
        UserError: There is no such version.
    """
    version = normalize_version(version)
    numbers = "_".join(f"{int(index):05d}" for index in indices)
    lines = [f"* idx({_SENSORS})={numbers}, timestamp={timestamp_s:.9f}"]
    lines += [_object_line(label, version) for label in labels]
    write_text(path, "\n".join(lines) + "\n")


def write_calibration(
    path: PathLike, frame_difference: int, dx_m: float, dy_m: float
) -> None:
    """Writes `info_calib/calib_radar_lidar.txt`.

    Args:
        path: File to write.
        frame_difference: Radar frame number minus LiDAR frame number.
        dx_m: Offset that is added to LiDAR x to obtain radar x.
        dy_m: Offset that is added to LiDAR y to obtain radar y.
    """
    text = f"frame difference,x,y\n{int(frame_difference)},{float(dx_m)!r},{float(dy_m)!r}\n"
    write_text(path, text)


def write_description(
    path: PathLike, environment: str, time: str, weather: str
) -> None:
    """Writes `description.txt` with the conditions of one sequence on one line."""
    write_text(path, f"{environment},{time},{weather}\n")


def write_splits(folder: PathLike, train: Iterable[Key], test: Iterable[Key]) -> None:
    """Writes `train.txt` and `test.txt` into a folder.

    Args:
        folder: Folder to write to, normally `<root>/split`.
        train: Pairs of sequence number and frame name, such as `(1, "00033_00001")`.
        test: Such pairs for the test split.
    """
    for name, frames in (("train", train), ("test", test)):
        lines = [f"{sequence},{frame}.txt" for sequence, frame in frames]
        write_text(pathlib.Path(folder) / f"{name}.txt", "\n".join(lines))


def write_tesseract(
    path: PathLike, tesseract: Real[np.ndarray, "D R E A"], *, compress: bool = False
) -> None:
    """Writes a radar tensor as in K-Radar: MATLAB v5, variable `arrDREA`, column-major.

    MATLAB's creation date is left out, so that equal tensors give identical files.

    Args:
        path: File to write, `radar_tesseract/tesseract_<radar index>.mat`.
        tesseract: Linear power; float32 values are stored as float32.
        compress: Whether to compress the file with zlib, which makes reading 10 times
            slower.
    """
    import scipy.io  # imported here, as it is slow to import and only needed here

    with atomic_write(path) as file:
        scipy.io.savemat(file, {"arrDREA": tesseract}, do_compression=compress)
        file.seek(0)
        file.write(_MAT_TEXT.ljust(116))


def write_grid(root: PathLike, grid: RadarGrid) -> None:
    """Writes `radar_grid.json` into the root of a dataset with a sensor grid of its own."""
    write_text(pathlib.Path(root) / "radar_grid.json", json.dumps(grid.to_dict()))


def _object_line(label: Label, version: str) -> str:
    x, y, z, length, width, height, yaw = map(float, label.box)
    leading = {
        "v1.0": (label.track_id, -1),
        "v1.1": (label.visibility, label.track_id, -1),
        "v2.0": (label.track_id,),
        "v2.1": (label.visibility, label.track_id),
    }[version]
    numbers = [x, y, z, math.degrees(yaw), length / 2, width / 2, height / 2]
    return ", ".join(["*", *map(str, leading), label.cls, *map(repr, numbers)])
