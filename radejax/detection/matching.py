"""Which predicted box belongs to which object, for padded sets of boxes."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from flax import struct

from radejax.geometry.rotated_iou import bev_iou, iou_3d


@struct.dataclass
class Matches:
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
    predicted: jax.Array,
    is_predicted: jax.Array,
    objects: jax.Array,
    is_object: jax.Array,
    *,
    iou_threshold: float | jax.Array = 0.0,
    predicted_classes: jax.Array | None = None,
    object_classes: jax.Array | None = None,
    one_to_one: bool = False,
    space: str = "bev",
) -> Matches:
    """Matches each prediction with the object it overlaps most.

    Args:
        predicted: `[K, 7]` or `[K, 8]` boxes; with `one_to_one`, by descending score.
        is_predicted: `[K]` bool, False for padding.
        objects: `[N, 7]` or `[N, 8]` boxes.
        is_object: `[N]` bool, False for padding.
        iou_threshold: Only overlaps strictly greater count.
        predicted_classes: `[K]`; given with `object_classes`, classes must agree.
        object_classes: `[N]`.
        one_to_one: Each object is given to one prediction only, the first in order
            for which it is the best object not yet taken.
        space: IoU in the "bev" or in "3d".

    Returns:
        Matches of the K predictions.

    Raises:
        ValueError: `space` is unknown, or only one of the class arrays is given.
        AssertionError: The arrays have not one row per prediction and object.

    Examples:
        >>> cars = jnp.array([[0.0, 0, 0, 4, 2, 1, 0], [9.0, 0, 0, 4, 2, 1, 0]])
        >>> all_valid = jnp.array([True, True])
        >>> found = jax.jit(match_boxes)(cars[::-1], all_valid, cars, all_valid)
        >>> found.object_idx.tolist()
        [1, 0]
    """
    if space not in ("bev", "3d"):
        raise ValueError(f"space must be 'bev' or '3d', got {space!r}")
    if (predicted_classes is None) != (object_classes is None):
        raise ValueError("give both predicted_classes and object_classes, or neither")
    chex.assert_rank([predicted, objects], 2)
    chex.assert_shape(is_predicted, predicted.shape[:1])
    chex.assert_shape(is_object, objects.shape[:1])
    iou = (bev_iou if space == "bev" else iou_3d)(predicted, objects)  # [K, N]
    allowed = is_predicted[:, None] & is_object[None, :] & (iou > iou_threshold)
    if predicted_classes is not None and object_classes is not None:
        chex.assert_equal_shape([predicted_classes, is_predicted])
        chex.assert_equal_shape([object_classes, is_object])
        allowed &= predicted_classes[:, None] == object_classes[None, :]
    iou = jnp.where(allowed, iou, 0.0)
    if one_to_one:
        return _match_in_order(iou)
    best = jnp.max(iou, axis=1)
    object_idx = jnp.argmax(iou, axis=1).astype(jnp.int32)
    return Matches(object_idx=object_idx, is_matched=best > 0, iou=best)


def _match_in_order(iou: jax.Array) -> Matches:
    """Greedy one-to-one matching, rows first come first served: `[K, N]`."""

    def match_row(
        is_free: jax.Array, row: jax.Array
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        row = jnp.where(is_free, row, 0.0)
        idx = jnp.argmax(row).astype(jnp.int32)
        best = row[idx]
        is_free &= (jnp.arange(row.size) != idx) | (best <= 0)
        return is_free, (jnp.where(best > 0, idx, 0), best)

    is_free = jnp.ones(iou.shape[1], bool)
    _, (object_idx, best) = jax.lax.scan(match_row, is_free, iou)
    return Matches(object_idx=object_idx, is_matched=best > 0, iou=best)
