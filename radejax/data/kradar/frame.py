"""One labelled frame of a data set."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np
from jaxtyping import Float, Shaped

from radejax.data.kradar.labels import Label, LabelHeader
from radejax.data.tesseract import read_frame
from radejax.geometry.camera import KRADAR_RADAR_FROM_LIDAR_Z_M, CameraCalibration
from radejax.geometry.radar_grid import RadarGrid


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One labelled frame.

    Attributes:
        sequence: Number of the sequence.
        name: Radar and LiDAR frame numbers, such as `"00033_00001"`.
        header: Frame numbers of all sensors and the time stamp.
        environment, time, weather: Conditions of the sequence.
        labels: Every object of the file, in the LiDAR frame, unfiltered.
        boxes: float64 x, y, z, l, w, h, yaw in the radar frame, of the
            objects that the filters of the data set keep.
        classes: Class names of `boxes`.
        visibility: Availability flags of `boxes`.
        radar_from_lidar_m: Offset that was added to LiDAR positions: x, y, z.
        tesseract_path: The tesseract, None where it is missing.
        projection_path: An official `.npy` projection, None where there is none.
        camera_path: Front image (stereo pair), None where it is missing.
        camera_calibration_path: Calibration of the left front camera, or None.
        is_simulated: Nothing of it was measured.
        radar_from_lidar_z_m: By which the radar itself is above the LiDAR, whatever z
            was added to the boxes.
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
        """File of the radar: the tesseract, or without one the official projection."""
        return self.tesseract_path or self.projection_path

    def read_projection(self, grid: RadarGrid) -> Float[np.ndarray, "R A DE"]:
        """float32 projection; see `tesseract.read_frame`.

        Raises:
            FileNotFoundError: There is no file of the radar.
            DataError: It is damaged, or of another shape than the grid.
        """
        if self.radar_path is None:
            raise FileNotFoundError("no tesseract in any root")
        return read_frame(self.radar_path, grid)

    def read_calibration(
        self, radar_from_lidar_m: tuple[float, ...] | None = None
    ) -> CameraCalibration:
        """Of the camera, with the frame's own offset or another; see `from_kradar`."""
        assert self.camera_calibration_path is not None  # for those who look first
        return CameraCalibration.from_kradar(
            self.camera_calibration_path,
            radar_from_lidar_m=radar_from_lidar_m or self.radar_from_lidar_m,
        )
