"""Writers of K-Radar's files: what `kradar` and `projection` read, byte for byte.

The simulator writes its datasets with these. Every file appears under its name only
when it is complete: writers write beside it and rename.
"""

from __future__ import annotations

import json
import math
import os
import pathlib
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Real

from radejax.core.files import atomic_write, write_text
from radejax.data.kradar.labels import Label, normalize_version
from radejax.geometry.radar_grid import RadarGrid

_SENSORS = "tesseract_os2-64_cam-front_os1-128_cam-lrr"
_MAT_TEXT = b"MATLAB 5.0 MAT-file, written by radejax"


def write_labels(
    path: str | os.PathLike,
    indices: Sequence[int],
    timestamp_s: float,
    labels: Iterable[Label],
    version: str = "v2.1",
) -> None:
    """Writes one label file, the inverse of `labels.read_labels`.

    Args:
        path: Label file, `<radar index>_<lidar index>.txt`.
        indices: Frame numbers of radar, LiDAR OS2-64, front camera, LiDAR OS1-128 and
            the other cameras.
        timestamp_s: Unix time of the LiDAR scan.
        labels: Objects in the LiDAR frame, full extents, radians.
        version: Label version; v1.0 and v2.0 cannot keep the visibility.

    Raises:
        UserError: There is no such version.
    """
    version = normalize_version(version)
    numbers = "_".join(f"{int(index):05d}" for index in indices)
    lines = [f"* idx({_SENSORS})={numbers}, timestamp={timestamp_s:.9f}"]
    lines += [_object_line(label, version) for label in labels]
    write_text(path, "\n".join(lines) + "\n")


def write_calibration(
    path: str | os.PathLike, frame_difference: int, dx_m: float, dy_m: float
) -> None:
    """Writes `info_calib/calib_radar_lidar.txt`: meters to add to LiDAR positions."""
    text = f"frame difference,x,y\n{int(frame_difference)},{float(dx_m)!r},{float(dy_m)!r}\n"
    write_text(path, text)


def write_description(
    path: str | os.PathLike, environment: str, time: str, weather: str
) -> None:
    """Writes `description.txt`: the conditions of one sequence on one line."""
    write_text(path, f"{environment},{time},{weather}\n")


def write_splits(
    folder: str | os.PathLike,
    train: Iterable[tuple[int, str]],
    test: Iterable[tuple[int, str]],
) -> None:
    """Writes `train.txt` and `test.txt` into a folder.

    Args:
        folder: Where to write, normally `<root>/split`.
        train: Pairs of sequence and frame name, such as `(1, "00033_00001")`.
        test: The same for the test split.
    """
    for name, frames in (("train", train), ("test", test)):
        lines = [f"{sequence},{frame}.txt" for sequence, frame in frames]
        write_text(pathlib.Path(folder) / f"{name}.txt", "\n".join(lines))


def write_tesseract(
    path: str | os.PathLike,
    tesseract: Real[np.ndarray, "D R E A"],
    *,
    compress: bool = False,
) -> None:
    """Writes a tesseract as K-Radar does: MATLAB v5, `arrDREA`, column-major.

    Equal tensors give equal bytes: MATLAB's creation date is left out.

    Args:
        path: `radar_tesseract/tesseract_<radar index>.mat`.
        tesseract: Linear power; float32 stays float32.
        compress: zlib-compress, 10 times slower to read.
    """
    import scipy.io  # loads slowly, and label writers do not need it

    with atomic_write(path) as file:
        scipy.io.savemat(file, {"arrDREA": tesseract}, do_compression=compress)
        file.seek(0)
        file.write(_MAT_TEXT.ljust(116))


def write_grid(root: str | os.PathLike, grid: RadarGrid) -> None:
    """Writes `radar_grid.json` at the root of a dataset of another sensor grid."""
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
