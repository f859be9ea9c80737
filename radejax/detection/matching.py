"""Which predicted box belongs to which object, for padded sets of boxes."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float

from radejax.geometry.rotated_iou import bev_iou


class Matches(struct.PyTreeNode):
    """The object of each prediction.

    Attributes:
        object_idx: `[K]` int32 row of the object; 0 where not `is_matched`.
        is_matched: `[K]` bool, True where the prediction has an object.
        iou: `[K]` IoU with that object; 0 where not `is_matched`.
    """

    object_idx: jax.Array
    is_matched: jax.Array
    iou: jax.Array


def match_boxes(
    predicted: Float[jax.Array, "K _"],
    is_predicted: Bool[jax.Array, " K"],
    objects: Float[jax.Array, "N _"],
    is_object: Bool[jax.Array, " N"],
    *,
    iou_threshold: float | Float[jax.Array, ""] = 0.0,
) -> Matches:
    """Matches each prediction with the object it overlaps most on the ground plane.

    Args:
        predicted: `[K, 7]` or `[K, 8]` boxes.
        is_predicted: `[K]` bool, False for padding.
        objects: `[N, 7]` or `[N, 8]` boxes.
        is_object: `[N]` bool, False for padding.
        iou_threshold: Only overlaps strictly greater count.

    Returns:
        Matches of the K predictions; several may have the same object.

    Raises:
        AssertionError: The arrays have not one row per prediction and object.

    Examples:
        >>> cars = jnp.array([[0.0, 0, 0, 4, 2, 1, 0], [9.0, 0, 0, 4, 2, 1, 0]])
        >>> all_valid = jnp.array([True, True])
        >>> found = jax.jit(match_boxes)(cars[::-1], all_valid, cars, all_valid)
        >>> found.object_idx.tolist()
        [1, 0]
    """
    chex.assert_rank([predicted, objects], 2)
    chex.assert_shape(is_predicted, predicted.shape[:1])
    chex.assert_shape(is_object, objects.shape[:1])
    iou = bev_iou(predicted, objects)  # [K, N]
    allowed = is_predicted[:, None] & is_object[None, :] & (iou > iou_threshold)
    iou = jnp.where(allowed, iou, 0.0)
    best = jnp.max(iou, axis=1)
    object_idx = jnp.argmax(iou, axis=1).astype(jnp.int32)
    return Matches(object_idx=object_idx, is_matched=best > 0, iou=best)
