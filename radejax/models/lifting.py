"""Lifting of radar bins to three-dimensional queries with reference points in the image.

Each bin of the range-azimuth map becomes E queries, one per elevation segment. A query is
the bin's feature multiplied by a weight that is learned from the elevation spectrum. Its
reference point is the projection of its center into the camera image.

References:
    DinoRADE, sections 3.3 and 3.4, equations (1) and (2).
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float

from radejax.core.errors import require
from radejax.geometry.camera import Camera, project
from radejax.geometry.radar_grid import RadarGrid, is_uniform, values_at
from radejax.models.layers import Conv, Dense, GroupNorm, Layer

OutOfViewRule = Literal["drop", "official"]
WeightingKind = Literal["mlp", "cnn", "off"]

OFFICIAL_OFFSET_M = (-2.08, -0.13, 0.9)
"""The `radar_from_lidar_m` of the released code, to be used with the "pinhole" image."""

MARGIN_PX = 280
"""Columns at the left and right border that `out_of_view="official"` treats as out of view.

They are a remnant of square crops of images 1280 pixels wide.
"""

_OFFICIAL_DEPTH_OFFSET_M = 1e-6


class ReferencePoints(struct.PyTreeNode):
    """Positions of a radar map's queries in the image.

    Attributes:
        points: `[B or 1, R, A, E, 2]` (x, y) in 0..1 from edge to edge of the image.
            Points outside the image are clipped to its border.
        is_valid: `[B or 1, R, A, E]` bool, True where the query's center is in front
            of the camera and in the image.
        has_image: `[B]` bool, False for frames without a usable image; None if all frames
            have one.
    """

    # The leaves have type Any for the reason given in `radejax.geometry.camera.Camera`.
    points: Any
    is_valid: Any
    has_image: Any = None


@dataclasses.dataclass(frozen=True)
class LiftingAxes:
    """Axes of the query centers in range, azimuth and elevation.

    Instances are hashable, so that they can be attributes of a module.

    Attributes:
        range_m: First bin center and step in meters; for an axis that is not uniform, the
            centers of all bins, of which there are at least three.
        azimuth_deg: The same in degrees, positive to the right.
        elevation_deg: Start and end in degrees, positive up, of the interval that is
            divided into `num_elevation` segments. Use (18, -18) for a tensor whose
            elevation axis points down; code bases disagree about K-Radar's.
        num_elevation: Number E of elevation segments.
    """

    range_m: tuple[float, ...]
    azimuth_deg: tuple[float, ...]
    elevation_deg: tuple[float, float]
    num_elevation: int

    def __post_init__(self) -> None:
        for name in ("range_m", "azimuth_deg", "elevation_deg"):
            axis = getattr(self, name)
            is_axis = len(axis) == 2 or (len(axis) > 2 and name != "elevation_deg")
            is_axis = is_axis and bool(np.isfinite(axis).all())
            expected = "two numbers, or for range and azimuth the centers of all bins"
            require(is_axis, f"config.model.query_grid.{name}", axis, expected)

    @classmethod
    def of_grid(cls, grid: RadarGrid, num_elevation: int = 10) -> LiftingAxes:
        """Returns axes through the bin centers of the grid, which continue into padding.

        A grid with fewer than two elevations gets those of K-Radar, -18 to 18 degrees.
        """
        range_m, azimuth, elevation = grid.range_m, grid.azimuth_rad, grid.elevation_rad
        if is_uniform(range_m):
            range_m = np.array([range_m[0], grid.range_step_m])
        if is_uniform(azimuth):
            azimuth = np.array([azimuth[0], grid.azimuth_step_rad])
        if elevation.size < 2:
            elevation = RadarGrid.kradar().elevation_rad
        return cls(
            range_m=tuple(range_m.tolist()),
            azimuth_deg=tuple(np.rad2deg(azimuth).tolist()),
            elevation_deg=tuple(np.rad2deg(elevation[[0, -1]]).tolist()),
            num_elevation=num_elevation,
        )

    @classmethod
    def official(cls) -> LiftingAxes:
        """Returns the released code's axes, 256 range and 112 azimuth bins in the FOV."""
        return cls(
            range_m=(118 / 256 / 2, 118 / 256),
            azimuth_deg=(-53 + 106 / 112 / 2, 106 / 112),
            elevation_deg=(-18.0, 18.0),
            num_elevation=10,
        )

    def centers_ego(
        self, num_range: int, num_azimuth: int, xp: Any = np
    ) -> Float[Any, "{num_range} {num_azimuth} {self.num_elevation} 3"]:
        """Returns the query centers `[R, A, E, 3]` in the ego frame in meters.

        They are computed as an outer product of small tables, so that with `jax.numpy` as
        `xp` a compiled program does not contain all centers as a constant. The result is
        float64 for NumPy and float32 for JAX.
        """
        range_m = _centers(self.range_m, num_range)
        azimuth = np.deg2rad(_centers(self.azimuth_deg, num_azimuth))
        low, high = self.elevation_deg
        part = (np.arange(self.num_elevation) + 0.5) / self.num_elevation
        elevation = np.deg2rad(low + (high - low) * part)
        x = np.cos(elevation) * np.cos(azimuth)[:, None]  # [A, E]
        y = -np.cos(elevation) * np.sin(azimuth)[:, None]
        axes = np.broadcast_arrays(x, y, np.sin(elevation))
        dtype = np.float64 if xp is np else np.float32
        unit = xp.asarray(np.stack(axes, -1)[None], dtype)
        return xp.asarray(range_m.reshape(-1, 1, 1, 1), dtype) * unit


def _centers(axis: tuple[float, ...], count: int) -> Float[np.ndarray, " {count}"]:
    if len(axis) == 2:
        return axis[0] + axis[1] * np.arange(count)
    return values_at(np.array(axis), np.arange(count))


def reference_points(
    camera: Camera,
    axes: LiftingAxes,
    num_range: int,
    num_azimuth: int,
    out_of_view: OutOfViewRule = "drop",
) -> ReferencePoints:
    """Projects the centers of all queries of a map into the image.

    The projection runs on the host in float64 for a NumPy camera, and in the program in
    float32 for a JAX camera.

    Args:
        camera: One camera for all samples, or a batch with one camera per sample.
        axes: Axes of the query centers.
        num_range: Range bins R of the map, including padding.
        num_azimuth: Azimuth bins A of the map, including padding.
        out_of_view: "official" treats the left and right `MARGIN_PX` columns of the image
            as out of view and adds 1e-6 m to the depth, as in the released code.

    Returns:
        Reference points, whose leading axis is 1 for one camera and B for a batch.
    """
    is_batch = np.ndim(camera.max_radius) > 0
    on_host = isinstance(camera.intrinsics, np.ndarray)
    xp = np if on_host else jnp
    centers = axes.centers_ego(num_range, num_azimuth, xp)
    if not is_batch:
        camera = jax.tree.map(lambda x: xp.asarray(x)[None], camera)
    centers = xp.broadcast_to(centers[None], (*camera.max_radius.shape, *centers.shape))
    is_official = out_of_view == "official"
    offset = _OFFICIAL_DEPTH_OFFSET_M if is_official else 0.0
    pixels, depth = project(centers, camera, depth_offset_m=offset)
    width, height = (camera.size_px[:, i, None, None, None] for i in (0, 1))
    margin = MARGIN_PX if is_official else 0.0
    u, v = pixels[..., 0], pixels[..., 1]
    is_valid = (depth > 0) & (u >= margin) & (u < width - margin)
    is_valid = is_valid & (v >= 0) & (v < height)
    points = xp.stack([u / width, v / height], -1)
    # Cameras of frames without an image may be all zeros. Their gradients must be finite.
    points = xp.nan_to_num(points, nan=0.0, posinf=1.0, neginf=0.0)
    return ReferencePoints(
        points=xp.clip(points, 0.0, 1.0).astype(np.float32),
        is_valid=is_valid,
        has_image=camera.is_valid if is_batch else None,
    )


def query_weights(
    is_valid: Bool[jax.Array, "*bins E"], out_of_view: OutOfViewRule
) -> Float[jax.Array, "*bins E"]:
    """Returns the weights of the mean over a bin's queries.

    With "drop", valid queries have equal weights, and invalid queries have weight zero.
    With "official", all queries have equal weights, whether they are valid or not.
    """
    if out_of_view == "official":
        return jnp.full(is_valid.shape, 1.0 / is_valid.shape[-1], jnp.float32)
    weights = is_valid.astype(jnp.float32)
    return weights / jnp.maximum(weights.sum(-1, keepdims=True), 1.0)


class WeightingNetwork(Layer):
    """Elevation channels `[B, R, A, D]` -> weights `[B, R, A, E]`, a softmax over segments.

    Attributes:
        num_elevation: Number E of elevation segments.
        kind: "mlp" has two layers per bin, as in the paper, which does not state their
            widths. "cnn" has three 3x3 convolutions and a 1x1 convolution, as in the
            released code. "off" returns the weight 1 for every segment instead of a
            softmax, for the ablation in which all queries of a bin are equal.
        dtype: Dtype of the computation; the weights are float32.
    """

    num_elevation: int = 10
    kind: WeightingKind = "mlp"

    @nn.compact
    def __call__(
        self, elevation: Float[jax.Array, "B R A D"]
    ) -> Float[jax.Array, "B R A {self.num_elevation}"]:
        if self.kind == "off":
            return jnp.ones((*elevation.shape[:3], self.num_elevation))
        if self.kind == "mlp":
            x = nn.relu(Dense(64, dtype=self.dtype, name="hidden")(elevation))
        else:
            x = elevation
            for i, features in enumerate((32, 64, 32), 1):
                x = Conv(features, dtype=self.dtype, name=f"conv_{i}")(x)
                x = nn.relu(GroupNorm(8, dtype=self.dtype, name=f"norm_{i}")(x))
        logits = Dense(self.num_elevation, dtype=self.dtype, name="out")(x)
        return nn.softmax(logits.astype(jnp.float32), -1)
