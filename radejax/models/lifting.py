"""Lifting of radar bins to three-dimensional queries with reference points in the image.

Each bin of the range-azimuth map becomes E queries, one per elevation segment. A query is
the bin's feature multiplied by a weight that is learned from the elevation spectrum. Its
reference point is the projection of its center into the camera image.

References:
    DinoRADE, sections 3.3 and 3.4, equations (1) and (2).
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float

from radejax.core.structures import Array
from radejax.geometry.boxes import array_module
from radejax.geometry.camera import Camera, project
from radejax.models.layers import Conv, Dense, GroupNorm, Layer
from radejax.models.options import (
    MARGIN_PX,
    OutOfViewRule,
    QueryGridOptions,
    WeightingKind,
)

OFFICIAL_OFFSET_M = (-2.08, -0.13, 0.9)
"""The `radar_from_lidar_m` of the authors' code, to be used with the "pinhole" image."""

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

    # Leaves are not validated: JAX also rebuilds the tree with shapes, specs or None.
    points: Array
    is_valid: Array
    has_image: Array | None = None


def reference_points(
    camera: Camera,
    axes: QueryGridOptions,
    num_range: int,
    num_azimuth: int,
    num_elevation: int,
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
        num_elevation: Number E of elevation segments.
        out_of_view: "official" treats the left and right `MARGIN_PX` columns of the image
            as out of view and adds 1e-6 m to the depth, as in the authors' code.

    Returns:
        Reference points, whose leading axis is 1 for one camera and B for a batch.
    """
    is_batch = np.ndim(camera.max_radius) > 0
    xp = array_module(camera.intrinsics)
    centers = axes.centers_ego(num_range, num_azimuth, num_elevation, xp)
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
            authors' code. "off" returns the weight 1 for every segment instead of a
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
