"""Augmentation of single samples, consistent for radar, boxes, image and camera.

It is off by default, as the papers train without augmentation. Mirroring is exact on
every grid whose azimuth axis is symmetric.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int, Real

from radejax.core.errors import UserError, require
from radejax.data.projection import LOG_SCALE_DB, decode, encode
from radejax.geometry.camera import Camera
from radejax.geometry.radar_grid import RadarGrid


@dataclasses.dataclass(frozen=True)
class Sample:
    """One row of a batch before it is written into the batch.

    Attributes:
        projection: Projection of the frame and of those that precede it, in the dtype of
            the records.
        boxes: x, y, z, l, w, h, sin yaw, cos yaw, padded with zeros.
        classes: Class indices, padded with -1.
        image: Image or features; None for radar-only models.
        camera: Camera; None for radar-only models.
        targets: Columns of `config.data.targets` `[N, ...]` by name.
    """

    projection: Real[np.ndarray, "R A C"]
    boxes: Float[np.ndarray, "N 8"]
    classes: Int[np.ndarray, " N"]
    image: Real[np.ndarray, "_ _ _"] | None = None
    camera: Camera | None = None
    targets: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Augmentation:
    """Random augmentation, called with the sample of one frame and a random generator.

    Attributes:
        grid: Sensor axes of the projections.
        mirror_probability: Probability of swapping left and right.
        random_gain_db: Largest change of the power, or None.
        others: Functions that are called afterwards in the same way, in their order.

    Raises:
        UserError: Mirroring is enabled for a grid whose azimuth axis is not symmetric.
    """

    grid: RadarGrid
    mirror_probability: float = 0.0
    random_gain_db: float | None = None
    others: Sequence[Callable[[Sample, np.random.Generator], Sample]] = ()

    def __post_init__(self) -> None:
        azimuth = self.grid.azimuth_rad
        asymmetry = np.abs(azimuth + azimuth[::-1]).max()
        largest = 1e-3 * abs(self.grid.azimuth_step_rad)
        if self.mirror_probability and asymmetry > largest:
            raise UserError(
                f"cannot mirror: azimuths {azimuth[0]:.4f} to {azimuth[-1]:.4f} rad are "
                "not symmetric; set config.data.mirror_probability to 0"
            )

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        """Returns the sample or a changed copy of it."""
        if rng.random() < self.mirror_probability:
            sample = mirror(sample)
        if (limit_db := self.random_gain_db) is not None:
            sample = change_gain(sample, rng.uniform(-limit_db, limit_db))
        for function in self.others:
            sample = function(sample, rng)
            kind = type(sample).__name__
            name = getattr(function, "__name__", "a function")
            name = f"the result of {name} in config.data.augmentation"
            require(isinstance(sample, Sample), name, kind, "a Sample")
        return sample


def change_gain(sample: Sample, gain_db: float) -> Sample:
    """Adds decibels to all power, as a receiver of another gain would."""
    stored = sample.projection
    levels = decode(stored) + np.float32(gain_db / LOG_SCALE_DB)
    return dataclasses.replace(sample, projection=encode(levels, stored.dtype.name))


def mirror(sample: Sample) -> Sample:
    """Swaps left and right: y becomes -y in the radar frame and u becomes W - u in the image.

    Radial velocity, elevation and range do not change. Padding boxes remain zero.
    """
    # y and sin yaw change their sign.
    signs = np.array([1, -1, 1, 1, 1, 1, -1, 1], sample.boxes.dtype)
    return dataclasses.replace(
        sample,
        projection=sample.projection[:, ::-1],
        boxes=sample.boxes * signs,
        image=None if sample.image is None else sample.image[:, ::-1],
        camera=None if sample.camera is None else mirror_camera(sample.camera),
    )


def mirror_camera(camera: Camera) -> Camera:
    """Returns the camera whose image of the mirrored scene is the mirrored image.

    With M = diag(-1, 1, 1) in the camera frame, p_cam' = M [R | t] (x, -y, z, 1) and
    u' = W - u. The distortion coefficient p2 changes its sign: its term in the distorted
    x, p2 (r^2 + 2 x^2), is even in x, and its term in y, 2 p2 x y, is odd.
    """
    cam_from_ego = np.array(camera.cam_from_ego)
    cam_from_ego[..., 0, :] *= -1
    cam_from_ego[..., :, 1] *= -1
    intrinsics = np.array(camera.intrinsics)
    intrinsics[..., 2] = np.asarray(camera.size_px)[..., 0] - intrinsics[..., 2]
    distortion = np.array(camera.distortion)
    distortion[..., 3] *= -1
    return camera.replace(
        cam_from_ego=cam_from_ego, intrinsics=intrinsics, distortion=distortion
    )
