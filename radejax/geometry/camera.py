"""Where points of the radar's world appear in the camera image, in NumPy or in JAX.

Frames and pixels as in `camera`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import chex
import jax
import numpy as np
from flax import struct
from jaxtyping import Float, Real

from radejax.geometry.boxes import array_module


class Camera(struct.PyTreeNode):
    """A calibrated camera as arrays, one or a batch of them: a pytree for jitted code.

    Attributes:
        cam_from_ego: `[..., 3, 4]` rotation and translation, metres.
        intrinsics: `[..., 4]` fx, fy, cx, cy in pixels.
        distortion: `[..., 5]` k1, k2, p1, p2, k3 (OpenCV's order); zeros for none.
        max_radius: `[...]` largest tangent of the viewing angle at which the distortion
            is still one-to-one.
        size_px: `[..., 2]` width and height of the image.
        is_valid: `[...]` bool, False where the frame has no usable image.
    """

    # Any leaf passes: trees of arrays are rebuilt from shapes, specs or None as well.
    cam_from_ego: Any
    intrinsics: Any
    distortion: Any
    max_radius: Any
    size_px: Any
    is_valid: Any


def project(
    points_ego: Real[Any, "*points 3"], camera: Camera, *, depth_offset_m: float = 0.0
) -> tuple[Float[Any, "*points 2"], Float[Any, "*points"]]:
    """Pixels and depth of points in the ego frame.

    With `(x, y, z) = cam_from_ego (p, 1)`, the pixel is `fx d(x/z) + cx` and likewise
    for v, where d is the lens distortion (Brown's model as in OpenCV).

    Args:
        points_ego: `[..., 3]` metres.
        camera: A single camera, or a batch of them whose axes are the points' first.
        depth_offset_m: Added to the depth before the division; the released DinoRADE
            adds 1e-6.

    Returns:
        Pixels `[..., 2]` (u, v) and depth `[...]` in metres. Where the depth is not
        positive the pixels are finite but mean nothing.

    Raises:
        AssertionError: Points are not `[..., 3]`, or their first axes not the cameras'.

    Examples:
        >>> lens = np.array([100.0, 100, 320, 240])
        >>> camera = Camera(np.eye(3, 4), lens, np.zeros(5), 9.0, np.array([640, 480]), True)
        >>> pixels, depth = project(np.array([1.0, 0, 5]), camera)
        >>> pixels.tolist(), float(depth)
        ([340.0, 240.0], 5.0)
    """
    batch = np.shape(camera.max_radius)
    chex.assert_shape(points_ego, (*batch, ..., 3))
    chex.assert_shape(camera.cam_from_ego, (*batch, 3, 4))
    chex.assert_shape(camera.intrinsics, (*batch, 4))
    chex.assert_shape(camera.distortion, (*batch, 5))
    points_cam = to_camera(points_ego, camera)
    return to_pixels(points_cam, camera, depth_offset_m), points_cam[..., 2]


def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """A batch from single cameras, float32 as the accelerator computes.

    Examples:
        >>> one = Camera(np.eye(3, 4), np.ones(4), np.zeros(5), 9.0, np.ones(2), True)
        >>> stack_cameras([one, one]).cam_from_ego.shape
        (2, 3, 4)
    """

    def stack(*leaves: Any) -> np.ndarray:
        stacked = np.stack(leaves)
        return stacked if stacked.dtype == bool else stacked.astype(np.float32)

    return jax.tree.map(stack, *cameras)


def to_camera(
    points: Real[Any, "*points 3"], camera: Camera
) -> Float[Any, "*points 3"]:
    """Points `[..., 3]` of the ego frame in the camera frame, metres.

    Examples:
        >>> raised = np.column_stack([np.eye(3), [0, 0, 2.0]])
        >>> one = Camera(raised, np.ones(4), np.zeros(5), 9.0, np.ones(2), True)
        >>> to_camera(np.array([1.0, 0, 5]), one).tolist()
        [1.0, 0.0, 7.0]
    """
    xp = array_module(points, camera.cam_from_ego)
    rotation, shift = camera.cam_from_ego[..., :3], camera.cam_from_ego[..., 3]
    batch = shift.shape[:-1]
    ones = (1,) * (points.ndim - shift.ndim)  # several points a camera
    rotation = xp.reshape(rotation, batch + ones + (3, 3))
    shift = xp.reshape(shift, batch + ones + (3,))
    # Products and sums rather than a matrix product, which accelerators may round.
    return xp.sum(rotation * points[..., None, :], -1) + shift


def to_pixels(
    points_cam: Float[Any, "*points 3"], camera: Camera, depth_offset_m: float
) -> Float[Any, "*points 2"]:
    """Pixels `[..., 2]` of points `[..., 3]` of the camera frame, see `project`.

    Examples:
        >>> lens = np.array([100.0, 100, 320, 240])
        >>> one = Camera(np.eye(3, 4), lens, np.zeros(5), 9.0, np.array([640, 480]), True)
        >>> to_pixels(np.array([1.0, 0, 5]), one, 0.0).tolist()
        [340.0, 240.0]
    """
    xp = array_module(points_cam, camera.intrinsics)
    depth = points_cam[..., 2] + depth_offset_m
    depth = xp.where(depth == 0, 1e-12, depth)
    extra = depth.ndim - np.ndim(camera.max_radius)

    def spread(value: Any) -> Any:  # batch axes of the camera to the front
        return xp.reshape(value, np.shape(value) + (1,) * extra)

    fx, fy, cx, cy = (spread(camera.intrinsics[..., i]) for i in range(4))
    k1, k2, p1, p2, k3 = (spread(camera.distortion[..., i]) for i in range(5))
    x, y = points_cam[..., 0] / depth, points_cam[..., 1] / depth
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    x_seen = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    y_seen = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    # Past the fold the polynomial brings points back into the image: leave them out.
    folds = square > spread(camera.max_radius) ** 2
    x_seen, y_seen = xp.where(folds, x * 1e3, x_seen), xp.where(folds, y * 1e3, y_seen)
    return xp.stack([fx * x_seen + cx, fy * y_seen + cy], -1)
