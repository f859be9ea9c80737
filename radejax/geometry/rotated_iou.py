"""Exact and branch-free overlap of rotated boxes for JAX and NumPy.

By Green's theorem, the area of the intersection is half the integral of x dy - y dx along
its boundary. That boundary consists of the parts of each box's edges inside the other box,
so

    area = 1/2 sum over the edges of both boxes of
           (length of the edge inside the other box) x (distance of its line from O).

No polygon is built and nothing is sorted: the 16 edge pairs are a fixed sequence of array
expressions. The result is exact for coincident edges because both boxes use the same
crossing point of a pair of edge lines. On (nearly) coincident lines, rounding may move that
point arbitrarily far, but it shortens one edge by as much as it extends the other. O is the
center of the first box, which keeps coordinates small and float32 errors below 1e-6 of the
area.

The same code runs on `jax.numpy` (float32, jit) and on NumPy (float64, for evaluation).
"""

from __future__ import annotations

import types

import chex
from jaxtyping import Float, Real

from radejax.geometry.boxes import ArrayT, array_module, as_floats

_FAR = 1e6  # meters; represents infinity along a line, but finite so that 0 * _FAR is 0


def bev_iou(
    a: Real[ArrayT, "*batch N _"], b: Real[ArrayT, "*batch M _"]
) -> Float[ArrayT, "*batch N M"]:
    """Computes the bird's-eye-view IoU of every box of `a` with every box of `b`.

    To compare corresponding boxes only, add a batch axis: `bev_iou(a[:, None], b[:, None])`.

    Args:
        a: `[..., N, 7]` boxes x, y, z, l, w, h, yaw; or `[..., N, 8]` with sin and cos of
            yaw. Length and width of the latter are multiplied by the length of the
            (sin, cos) vector, as in the released NMS and metrics.
        b: `[..., M, 7]` or `[..., M, 8]` boxes.

    Returns:
        `[..., N, M]` IoU in [0, 1], a NumPy array in float64 for NumPy input, otherwise a
        JAX array in float32. Boxes of zero or negative size have an IoU of 0.

    Raises:
        ValueError: The last axis does not have length 7 or 8.
        AssertionError: `a` and `b` have different leading axes.

    Examples:
        >>> import jax.numpy as jnp
        >>> car = jnp.array([[0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
        >>> moved = car.at[0, 0].set(2.0)
        >>> round(float(bev_iou(car, moved)[0, 0]), 4)
        0.3333
    """
    xp, a, b = _all_pairs(a, b)
    ground_a = _footprint(xp, a)
    ground_b = _footprint(xp, b)
    area_a = ground_a[2] * ground_a[3]
    area_b = ground_b[2] * ground_b[3]
    return _ratio(xp, _intersection(xp, ground_a, ground_b), area_a, area_b)


def iou_3d(
    a: Real[ArrayT, "*batch N _"], b: Real[ArrayT, "*batch M _"], z_center: float = 0.5
) -> Float[ArrayT, "*batch N M"]:
    """Computes the volume IoU of every box of `a` with every box of `b`.

    Args:
        a: `[..., N, 7]` or `[..., N, 8]` boxes, as for `bev_iou`.
        b: `[..., M, 7]` or `[..., M, 8]` boxes.
        z_center: Position of z within the height of a box: 0 at the bottom, 0.5 in the
            middle, 1 at the top.

    Returns:
        `[..., N, M]` IoU in [0, 1].

    Examples:
        >>> import jax.numpy as jnp
        >>> car = jnp.array([[0.0, 0, 0, 4, 2, 1.5, 0]])
        >>> round(float(iou_3d(car, car.at[0, 2].set(0.75))[0, 0]), 4)
        0.3333
    """
    xp, a, b = _all_pairs(a, b)
    ground_a = _footprint(xp, a)
    ground_b = _footprint(xp, b)
    area = _intersection(xp, ground_a, ground_b)
    height_a: ArrayT = xp.maximum(a[..., 5], 0)
    height_b: ArrayT = xp.maximum(b[..., 5], 0)
    # The difference of top and bottom may round to more than either height.
    shared = xp.minimum(shared_height(a, b, z_center), xp.minimum(height_a, height_b))
    volume: ArrayT = area * shared
    volume_a = ground_a[2] * ground_a[3] * height_a
    volume_b = ground_b[2] * ground_b[3] * height_b
    return _ratio(xp, volume, volume_a, volume_b)


def bev_intersection(
    a: Real[ArrayT, "*#pairs _"], b: Real[ArrayT, "*#pairs _"]
) -> Float[ArrayT, "*pairs"]:
    """Computes the area in square meters that the footprints of corresponding boxes share.

    Args:
        a: `[..., 7]` or `[..., 8]` boxes, as for `bev_iou`; leading axes broadcast.
        b: `[..., 7]` or `[..., 8]` boxes.

    Examples:
        >>> import numpy as np
        >>> car = np.array([[0.0, 0, 0, 4, 2, 1.5, 0]])
        >>> bev_intersection(car, car + [3, 0, 0, 0, 0, 0, 0]).round(6).tolist()
        [2.0]
    """
    xp, (a, b) = as_floats(a, b)
    return _intersection(xp, _footprint(xp, a), _footprint(xp, b))


def shared_height(
    a: Real[ArrayT, "*#pairs _"], b: Real[ArrayT, "*#pairs _"], z_center: float = 0.5
) -> Float[ArrayT, "*pairs"]:
    """Computes the height in meters that boxes share, 0 where they do not overlap in height.

    Examples:
        >>> import numpy as np
        >>> car = np.array([[0.0, 0, 0, 4, 2, 1.5, 0]])
        >>> shared_height(car, car + [0, 0, 0.5, 0, 0, 0, 0]).tolist()
        [1.0]
    """
    xp = array_module(a, b)
    above, below = 1 - z_center, z_center
    top = xp.minimum(a[..., 2] + above * a[..., 5], b[..., 2] + above * b[..., 5])
    bottom = xp.maximum(a[..., 2] - below * a[..., 5], b[..., 2] - below * b[..., 5])
    height: ArrayT = xp.maximum(top - bottom, 0)
    return height


def _all_pairs(a: ArrayT, b: ArrayT) -> tuple[types.ModuleType, ArrayT, ArrayT]:
    """Returns the array module, `a` as `[..., N, 1, _]` and `b` as `[..., 1, M, _]`."""
    xp, (a, b) = as_floats(a, b)
    chex.assert_equal_rank([a, b])
    chex.assert_equal_shape_prefix([a, b], a.ndim - 2)
    return xp, a[..., :, None, :], b[..., None, :, :]


def _footprint(xp: types.ModuleType, boxes: ArrayT) -> tuple[ArrayT, ...]:
    """Returns center x and y, non-negative length and width, sin and cos of the heading."""
    width = boxes.shape[-1] if boxes.ndim else 0
    if width not in (7, 8):
        raise ValueError(f"boxes must be [..., 7] or [..., 8], got {boxes.shape}")
    x, y, length, breadth = (boxes[..., i] for i in (0, 1, 3, 4))
    if width == 7:
        sin, cos = xp.sin(boxes[..., 6]), xp.cos(boxes[..., 6])
        return x, y, xp.maximum(length, 0), xp.maximum(breadth, 0), sin, cos
    scale = xp.sqrt(boxes[..., 6] ** 2 + boxes[..., 7] ** 2)
    divisor = xp.where(scale > 0, scale, 1)
    sin = boxes[..., 6] / divisor
    cos = xp.where(scale > 0, boxes[..., 7] / divisor, 1)
    return x, y, xp.maximum(length * scale, 0), xp.maximum(breadth * scale, 0), sin, cos


def _intersection(
    xp: types.ModuleType, a: tuple[ArrayT, ...], b: tuple[ArrayT, ...]
) -> ArrayT:
    """Computes the area common to two footprints, elementwise with broadcasting."""
    ax, ay, a_length, a_width, a_sin, a_cos = a
    bx, by, b_length, b_width, b_sin, b_cos = b
    # Center and heading of b in the frame of a.
    dx, dy = bx - ax, by - ay
    x = a_cos * dx + a_sin * dy
    y = a_cos * dy - a_sin * dx
    sin = a_cos * b_sin - a_sin * b_cos
    cos = a_cos * b_cos + a_sin * b_sin
    # An edge has a direction, a distance from the center of its box and a half length. The
    # directions differ by quarter turns, and the box lies to the left of each edge.
    zero = xp.zeros_like(sin)
    one = xp.ones_like(sin)
    a_direction = [(one, zero), (zero, one), (-one, zero), (zero, -one)]
    b_direction = [(cos, sin), (-sin, cos), (-cos, -sin), (sin, -cos)]
    a_half = [(a_width / 2, a_length / 2), (a_length / 2, a_width / 2)] * 2
    b_half = [(b_width / 2, b_length / 2), (b_length / 2, b_width / 2)] * 2

    a_low = [-h for _, h in a_half]
    a_high = [h for _, h in a_half]
    b_low = [-h for _, h in b_half]
    b_high = [h for _, h in b_half]
    for i, (ux, uy) in enumerate(a_direction):
        for j, (vx, vy) in enumerate(b_direction):
            # From the middle of edge i of a to the middle of edge j of b.
            gap_x = x + b_half[j][0] * vy - a_half[i][0] * uy
            gap_y = y - b_half[j][0] * vx + a_half[i][0] * ux
            turn = ux * vy - uy * vx
            offset = gap_x * vy - gap_y * vx
            is_left = turn > 0
            # Parallel lines cross infinitely far away. The sign of the crossing says
            # whether edge i lies inside. If both lines are identical, all of edge i
            # counts: of two edges in the same direction only edge i is counted; two edges
            # in opposite directions are both counted and cancel.
            divisor = xp.where(turn == 0, 1, turn)
            far = xp.where(offset >= 0, _FAR, -_FAR)
            # As turn == 0 is treated as not left, edge i is inside beyond the crossing.
            at_a = xp.where(turn == 0, -far, xp.clip(offset / divisor, -_FAR, _FAR))
            at_b = at_a * (ux * vx + uy * vy) - (gap_x * vx + gap_y * vy)
            a_high[i] = xp.where(is_left, xp.minimum(a_high[i], at_a), a_high[i])
            a_low[i] = xp.where(is_left, a_low[i], xp.maximum(a_low[i], at_a))
            b_low[j] = xp.where(is_left, xp.maximum(b_low[j], at_b), b_low[j])
            b_high[j] = xp.where(is_left, b_high[j], xp.minimum(b_high[j], at_b))

    twice_area = zero
    for i in range(4):
        inside = xp.maximum(a_high[i] - a_low[i], 0)
        twice_area = twice_area + inside * a_half[i][0]
    for j, (vx, vy) in enumerate(b_direction):
        inside = xp.maximum(b_high[j] - b_low[j], 0)
        twice_area = twice_area + inside * (b_half[j][0] + x * vy - y * vx)
    smaller = xp.minimum(a_length * a_width, b_length * b_width)
    area: ArrayT = xp.clip(twice_area / 2, 0, smaller)
    return area


def _ratio(
    xp: types.ModuleType, shared: ArrayT, size_a: ArrayT, size_b: ArrayT
) -> ArrayT:
    """Computes intersection over union, 0 where both boxes are empty."""
    union = size_a + size_b - shared
    ratio: ArrayT = shared / xp.where(union > 0, union, 1)
    return ratio
