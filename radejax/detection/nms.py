"""Rotated non-maximum suppression and matching of padded sets of boxes."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from radejax.geometry.rotated_iou import bev_iou

Boxes = Float[jax.Array, "*batch K _"]
Mask = Bool[jax.Array, "*batch K"]
Threshold = float | Float[jax.Array, ""]


def rotated_nms(
    boxes: Boxes,
    is_valid: Mask,
    iou_threshold: Threshold,
    *,
    classes: Int[jax.Array, "*batch K"] | None = None,
) -> Mask:
    """Which boxes survive greedy bird's-eye-view non-maximum suppression.

    In order of the rows, a box is kept unless it overlaps a box kept before:

        for j in range(K):
            keep[j] = valid[j] and not any(keep[i] and iou[i, j] >= t for i < j)

    Args:
        boxes: `[..., K, 7]` or `[..., K, 8]`, by descending score; the yaw vector of
            the latter scales the box, as in the released code (see `bev_iou`).
        is_valid: `[..., K]` bool; False rows are neither kept nor suppress others.
        iou_threshold: Boxes overlapping this much or more are suppressed.
        classes: `[..., K]` class indices; given, only boxes of one class suppress each
            other.

    Returns:
        `[..., K]` bool, True where a box is kept.

    Raises:
        AssertionError: The arrays have not one row per box.

    Examples:
        >>> boxes = jnp.array([[0.0, 0, 0, 4, 2, 1, 0], [0.5, 0, 0, 4, 2, 1, 0]])
        >>> jax.jit(rotated_nms)(boxes, jnp.array([True, True]), 0.3).tolist()
        [True, False]
    """
    overlaps = bev_iou(boxes, boxes) >= iou_threshold
    if classes is not None:
        chex.assert_shape(classes, boxes.shape[:-1])
        overlaps &= classes[..., :, None] == classes[..., None, :]
    return greedy_suppression(overlaps, is_valid)


def greedy_suppression(overlaps: Bool[jax.Array, "*batch K K"], is_valid: Mask) -> Mask:
    """The greedy choice for a given overlap relation, rows by descending score.

    Instead of K steps one after the other, all rows are decided together from the
    previous guess until nothing changes. Row j depends on rows before it only, so
    after n rounds the first n rows are final, the fixed point is unique, and it is the
    greedy answer. Rounds needed: the longest chain of boxes each suppressed by or
    freed by the one before, a handful, never more than K.

    Args:
        overlaps: `[..., K, K]` bool, True where a pair may not both be kept.
        is_valid: `[..., K]` bool.

    Returns:
        `[..., K]` bool, True where a row is kept.

    Examples:
        >>> chain = jnp.eye(3, k=1, dtype=bool)  # 0 overlaps 1, 1 overlaps 2
        >>> greedy_suppression(chain, jnp.ones(3, bool)).tolist()
        [True, False, True]
    """
    chex.assert_shape(overlaps, (*is_valid.shape, is_valid.shape[-1]))
    before = jnp.triu(overlaps, 1)  # [i, j]: i would suppress j

    def decide(keep: Mask) -> Mask:
        return is_valid & ~jnp.any(before & keep[..., :, None], axis=-2)

    def changed(state: tuple[jax.Array, jax.Array]) -> Bool[jax.Array, ""]:
        return jnp.any(state[0] != state[1])

    keep, _ = jax.lax.while_loop(
        changed,
        lambda state: (decide(state[0]), state[0]),
        (decide(is_valid), is_valid),
    )
    return keep


def match_boxes(
    predicted: Float[jax.Array, "K _"],
    is_predicted: Bool[jax.Array, " K"],
    objects: Float[jax.Array, "N _"],
    is_object: Bool[jax.Array, " N"],
) -> tuple[Int[jax.Array, " K"], Bool[jax.Array, " K"]]:
    """Match each prediction with the object it overlaps most on the ground plane.

    Args:
        predicted: `[K, 7]` or `[K, 8]` boxes.
        is_predicted: `[K]` bool, False for padding.
        objects: `[N, 7]` or `[N, 8]` boxes.
        is_object: `[N]` bool, False for padding.

    Returns:
        `[K]` int32 row of the object, 0 without one, and `[K]` bool, True where there is
        one. Several predictions may have the same object.

    Raises:
        AssertionError: The arrays do not have one row per prediction and object.

    Examples:
        >>> cars = jnp.array([[0.0, 0, 0, 4, 2, 1, 0], [9.0, 0, 0, 4, 2, 1, 0]])
        >>> all_valid = jnp.array([True, True])
        >>> object_idx, _ = jax.jit(match_boxes)(cars[::-1], all_valid, cars, all_valid)
        >>> object_idx.tolist()
        [1, 0]
    """
    chex.assert_rank([predicted, objects], 2)
    chex.assert_shape(is_predicted, predicted.shape[:1])
    chex.assert_shape(is_object, objects.shape[:1])
    iou = bev_iou(predicted, objects)  # [K, N]
    iou = jnp.where(is_predicted[:, None] & is_object[None, :], iou, 0.0)
    return jnp.argmax(iou, axis=1).astype(jnp.int32), jnp.max(iou, axis=1) > 0
