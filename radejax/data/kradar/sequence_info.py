"""What all frames of one sequence share: conditions, offset of the LiDAR, camera."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence

from radejax.core.errors import DataError
from radejax.data.kradar import folders, sequences
from radejax.data.kradar.findings import Findings
from radejax.data.kradar.folders import SequenceFolder

_DEFAULT_OFFSET_TEXT = "taking K-Radar's (-2.54, 0.3)"
_CAMERA_FOLDERS = ("calib", "cam_calib", "resources/cam_calib")


@dataclasses.dataclass(frozen=True, slots=True)
class SequenceInfo:
    """What all frames of a sequence share.

    Attributes:
        conditions: Environment, time and weather.
        radar_from_lidar_m: Metres to add to LiDAR positions: x, y, z.
        camera_calibration_path: Calibration of the left front camera, or None.
    """

    conditions: sequences.Conditions
    radar_from_lidar_m: tuple[float, float, float]
    camera_calibration_path: pathlib.Path | None


def read_sequence_info(
    number: int,
    folder: SequenceFolder | None,
    findings: Findings,
    *,
    radar_from_lidar: tuple[float, float] | None,
    z_offset_m: float,
    camera_folders: Sequence[pathlib.Path],
) -> SequenceInfo:
    """Reads what is in the folders of a sequence and fills in what is not.

    Args:
        number: Of the sequence.
        folder: Its folders; None when only labels are at hand.
        findings: Where missing and malformed files are reported.
        radar_from_lidar: Offset that replaces the calibration file's.
        z_offset_m: Metres to add to LiDAR z.
        camera_folders: Where camera calibrations are looked for.
    """
    if radar_from_lidar is None:
        x, y = _read_offset(number, folder, findings)
    else:
        x, y = map(float, radar_from_lidar)
    camera, is_own = folders.find_camera_calibration(camera_folders, number)
    if camera is None:
        findings.counts["sequences without camera calibration"] += 1
    elif not is_own:
        findings.counts["sequences with the common camera calibration"] += 1
    return SequenceInfo(
        _read_conditions(number, folder, findings), (x, y, z_offset_m), camera
    )


def camera_folders(
    roots: Sequence[pathlib.Path], given: Sequence[pathlib.Path]
) -> list[pathlib.Path]:
    """The given folders, then the usual places under the roots."""
    return [*given, *(root / name for root in roots for name in _CAMERA_FOLDERS)]


def _read_offset(
    number: int, folder: SequenceFolder | None, findings: Findings
) -> tuple[float, float]:
    """Metres to add to LiDAR x and y of a sequence."""
    if folder is not None:
        path = folder.find("info_calib", "calib_radar_lidar.txt")
        try:
            if path is not None:
                calibration = sequences.read_calibration(path)
                return calibration.dx_m, calibration.dy_m
            findings.report(
                "calibration missing",
                f"sequence {number}",
                f"no info_calib/calib_radar_lidar.txt, {_DEFAULT_OFFSET_TEXT}",
                error=FileNotFoundError,
            )
        except DataError as error:
            findings.report(
                "calibration", str(path), f"{error}; {_DEFAULT_OFFSET_TEXT}"
            )
    findings.counts["sequences with the default calibration"] += 1
    return sequences.DEFAULT_RADAR_FROM_LIDAR_M


def _read_conditions(
    number: int, folder: SequenceFolder | None, findings: Findings
) -> sequences.Conditions:
    """Conditions of a sequence: its own description, else the built-in table."""
    path = None if folder is None else folder.find(".", "description.txt")
    if path is not None:
        try:
            return sequences.read_description(path)
        except DataError as error:
            findings.report("description", str(path), str(error))
    findings.counts["sequences with built-in conditions"] += 1
    return sequences.KRADAR_CONDITIONS.get(number, sequences.UNKNOWN_CONDITIONS)
