"""Rotated non-maximum suppression of a fixed number of boxes."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from radejax.geometry.rotated_iou import bev_iou


def rotated_nms(
    boxes: Float[jax.Array, "*batch K _"],
    is_valid: Bool[jax.Array, "*batch K"],
    iou_threshold: float | Float[jax.Array, ""],
    *,
    classes: Int[jax.Array, "*batch K"] | None = None,
) -> Bool[jax.Array, "*batch K"]:
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


def greedy_suppression(
    overlaps: Bool[jax.Array, "*batch K K"], is_valid: Bool[jax.Array, "*batch K"]
) -> Bool[jax.Array, "*batch K"]:
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

    def decide(keep: Bool[jax.Array, "*batch K"]) -> Bool[jax.Array, "*batch K"]:
        return is_valid & ~jnp.any(before & keep[..., :, None], axis=-2)

    def changed(state: tuple[jax.Array, jax.Array]) -> Bool[jax.Array, ""]:
        return jnp.any(state[0] != state[1])

    keep, _ = jax.lax.while_loop(
        changed,
        lambda state: (decide(state[0]), state[0]),
        (decide(is_valid), is_valid),
    )
    return keep
