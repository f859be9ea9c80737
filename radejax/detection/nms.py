"""Rotated non-maximum suppression and matching of padded sets of boxes."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from radejax.core.structures import Array
from radejax.geometry.rotated_iou import bev_iou

Boxes = Float[jax.Array, "*batch K _"]
Mask = Bool[jax.Array, "*batch K"]
Threshold = float | Float[Array, ""]


def rotated_nms(
    boxes: Boxes,
    is_valid: Mask,
    iou_threshold: Threshold,
    *,
    classes: Int[jax.Array, "*batch K"] | None = None,
) -> Mask:
    """Returns a mask of the boxes that survive greedy bird's-eye-view NMS.

    In the order of the rows, a box is kept unless it overlaps a box that was kept before:

        for j in range(K):
            keep[j] = valid[j] and not any(keep[i] and iou[i, j] >= t for i < j)

    Args:
        boxes: `[..., K, 7]` or `[..., K, 8]` boxes by descending score. The length of the
            latter's yaw vector scales the box, as in the authors' code (see `bev_iou`).
        is_valid: `[..., K]` bool, False for rows that are not kept and suppress no others.
        iou_threshold: IoU at or above which the later box is suppressed.
        classes: `[..., K]` class indices. If given, only boxes of the same class suppress
            each other.

    Returns:
        `[..., K]` bool, True where a box is kept.

    Raises:
        AssertionError: `is_valid` or `classes` does not have one row per box.

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
    """Computes greedy suppression for given overlaps, with rows by descending score.

    Instead of K sequential steps, each iteration updates all rows from the previous mask
    until the mask does not change. Row j depends only on the rows before it. After n
    iterations, the first n rows are therefore final, and the unique fixed point is the
    result of the sequential algorithm. The number of iterations depends on the longest
    chain of boxes in which each decides about the next; it is usually small and never
    exceeds K.

    Args:
        overlaps: `[..., K, K]` bool, True for pairs of which only one may be kept.
        is_valid: `[..., K]` bool, False for rows that are not kept and suppress no others.

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

    keep, _ = jax.lax.while_loop(
        lambda state: jnp.any(state[0] != state[1]),
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
    """Matches each prediction with the object that it overlaps most on the ground plane.

    Args:
        predicted: `[K, 7]` or `[K, 8]` boxes.
        is_predicted: `[K]` bool, False for padding.
        objects: `[N, 7]` or `[N, 8]` boxes.
        is_object: `[N]` bool, False for padding.

    Returns:
        `[K]` int32 row of the object that a prediction matches, 0 if it matches none, and
        `[K]` bool, True where it matches one. Several predictions may match the same
        object.

    Raises:
        AssertionError: A mask does not have one row per prediction or object, or the
            inputs have a batch axis.

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
