"""Conversions and simple geometry of upright 3D boxes.

A box is `[..., 7]` with x, y, z of its center, its full length (along its heading), width
and height, and yaw; or `[..., 8]` with sin yaw and cos yaw in place of yaw, as networks
regress it. Functions return NumPy arrays for NumPy input and JAX arrays otherwise.
"""

from __future__ import annotations

import types
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Real

MIN_OBJECTS = 10
"""Number of objects from which medians are compared."""

MAX_SCALE = 1.6
"""Largest plausible ratio of the sizes of two sets of boxes. The sizes in one sequence of
K-Radar's labels and in all differ by up to 1.5; of half sizes, the ratio is 2."""

MIN_SLENDERNESS = 0.3
"""Smallest plausible ratio of length and width, relative to the usual one. In one sequence of
K-Radar's labels, it is 0.43; with both exchanged, it is about 0.2 for cars."""

ArrayT = TypeVar("ArrayT", np.ndarray, jax.Array)
"""An array type, NumPy's or JAX's, that is the same for input and output."""

Number = float | np.number

# Signs of the half extents at the corners, counter-clockwise from front left.
_SIGN_LENGTH = (1.0, -1.0, -1.0, 1.0)
_SIGN_WIDTH = (1.0, 1.0, -1.0, -1.0)


def array_module(*values: object) -> types.ModuleType:
    """Returns numpy if every value is a NumPy or Python object, otherwise jax.numpy.

    Examples:
        >>> array_module(np.ones(3), 2.0) is np, array_module(jnp.ones(3)) is jnp
        (True, True)
    """
    host_types = (np.ndarray, np.generic, float, int, list, tuple)
    return np if all(isinstance(v, host_types) for v in values) else jnp


def as_floats(*values: Number | ArrayT) -> tuple[types.ModuleType, list[ArrayT]]:
    """Returns the array module and the values as floating-point arrays.

    NumPy arrays are float64; JAX arrays have a common type of at least float32.

    Examples:
        >>> as_floats(1)[1][0].dtype, as_floats(jnp.ones(3, jnp.bfloat16))[1][0].dtype
        (dtype('float64'), dtype('float32'))
    """
    xp = array_module(*values)
    if xp is np:
        return xp, [xp.asarray(v, np.float64) for v in values]
    arrays = [xp.asarray(v) for v in values]
    dtype = xp.promote_types(xp.result_type(*arrays), np.float32)
    return xp, [v.astype(dtype) for v in arrays]


def boxes8_from_7(boxes: Real[ArrayT, "*batch 7"]) -> Float[ArrayT, "*batch 8"]:
    """Converts boxes `[..., 7]` with a yaw angle to `[..., 8]` with sin and cos of yaw.

    Args:
        boxes: `[..., 7]` x, y, z, l, w, h, yaw; meters and radians.

    Returns:
        `[..., 8]` x, y, z, l, w, h, sin yaw, cos yaw.

    Raises:
        ValueError: The last axis does not have length 7.

    Examples:
        >>> boxes8_from_7(np.array([1.0, 2, 3, 4, 2, 1, 0])).tolist()
        [1.0, 2.0, 3.0, 4.0, 2.0, 1.0, 0.0, 1.0]
    """
    xp = array_module(boxes)
    boxes = _checked(xp.asarray(boxes), 7)
    yaw = boxes[..., 6:7]
    converted: ArrayT = xp.concatenate([boxes[..., :6], xp.sin(yaw), xp.cos(yaw)], -1)
    return converted


def boxes7_from_8(boxes: Real[ArrayT, "*batch 8"]) -> Float[ArrayT, "*batch 7"]:
    """Converts boxes `[..., 8]` with sin and cos of yaw to `[..., 7]` with a yaw angle.

    The (sin, cos) vector may have any length; sin = cos = 0 gives yaw 0.

    Args:
        boxes: `[..., 8]` x, y, z, l, w, h, sin yaw, cos yaw.

    Returns:
        `[..., 7]` x, y, z, l, w, h, yaw in (-pi, pi].

    Raises:
        ValueError: The last axis does not have length 8.

    Examples:
        >>> boxes7_from_8(np.array([1.0, 2, 3, 4, 2, 1, 0, 5])).tolist()
        [1.0, 2.0, 3.0, 4.0, 2.0, 1.0, 0.0]
    """
    xp = array_module(boxes)
    boxes = _checked(xp.asarray(boxes), 8)
    yaw = xp.arctan2(boxes[..., 6:7], boxes[..., 7:8])
    converted: ArrayT = xp.concatenate([boxes[..., :6], yaw], -1)
    return converted


def bev_corners(boxes: Real[ArrayT, "*batch _"]) -> Float[ArrayT, "*batch 4 2"]:
    """Returns the corners of the boxes' footprints, counter-clockwise from front left.

    ```
        x (heading)
        ^      0 ---- 3
        |      |      |      y points left
        +-->   1 ---- 2
    ```

    Args:
        boxes: `[..., 7]` or `[..., 8]`; the yaw vector of the latter is normalized first.

    Returns:
        `[..., 4, 2]` x and y in meters.

    Examples:
        >>> bev_corners(np.array([10.0, 0, 0, 4, 2, 1.5, 0])).tolist()
        [[12.0, 1.0], [8.0, 1.0], [8.0, -1.0], [12.0, -1.0]]
    """
    xp = array_module(boxes)
    boxes = xp.asarray(boxes)
    boxes = boxes7_from_8(boxes) if boxes.shape[-1] == 8 else _checked(boxes, 7)
    sin, cos = xp.sin(boxes[..., 6, None]), xp.cos(boxes[..., 6, None])
    shape = (1,) * (boxes.ndim - 1) + (4,)
    along = xp.asarray(_SIGN_LENGTH, boxes.dtype).reshape(shape)
    across = xp.asarray(_SIGN_WIDTH, boxes.dtype).reshape(shape)
    ahead = boxes[..., 3, None] / 2 * along  # [..., 4]
    left = boxes[..., 4, None] / 2 * across
    x = boxes[..., 0, None] + cos * ahead - sin * left
    y = boxes[..., 1, None] + sin * ahead + cos * left
    ends: ArrayT = xp.stack([x, y], -1)
    return ends


def corners(boxes: Real[ArrayT, "*batch _"]) -> Float[ArrayT, "*batch 8 3"]:
    """Returns the corners of boxes, the four at the bottom before the four at the top.

    Both fours are in the order of `bev_corners`.

    Args:
        boxes: `[..., 7]` or `[..., 8]` boxes, as for `bev_corners`.

    Returns:
        `[..., 8, 3]` x, y, z in meters.

    Examples:
        >>> corners(np.array([10.0, 0, 0, 4, 2, 1.5, 0]))[[0, 4]].tolist()
        [[12.0, 1.0, -0.75], [12.0, 1.0, 0.75]]
    """
    xp = array_module(boxes)
    boxes = xp.asarray(boxes)
    ground = bev_corners(boxes)  # [..., 4, 2]
    center = xp.zeros_like(ground[..., :1]) + boxes[..., 2, None, None]
    half = boxes[..., 5, None, None] / 2
    bottom = xp.concatenate([ground, center - half], -1)
    top = xp.concatenate([ground, center + half], -1)
    ends: ArrayT = xp.concatenate([bottom, top], -2)
    return ends


def _checked(boxes: ArrayT, width: int) -> ArrayT:
    if boxes.ndim < 1 or boxes.shape[-1] != width:
        raise ValueError(f"boxes must be [..., {width}], got shape {boxes.shape}")
    return boxes


def find_size_problem(
    sizes_m: Float[np.ndarray, "N 3"], usual_m: Float[np.ndarray, "N 3"]
) -> str | None:
    """Describes why the sizes of boxes cannot be meant; returns None if they can.

    They cannot if they are too large or too small as a whole, or length and width seem to be
    exchanged.

    Args:
        sizes_m: Length, width and height of every box.
        usual_m: Sizes that are usual for these boxes, such as those of the ground truth.

    Examples:
        >>> usual_m = np.array([[4.0, 2.0, 1.5], [10.0, 3.0, 3.5]])
        >>> find_size_problem(usual_m + 0.1, usual_m)
        >>> find_size_problem(usual_m / 2, usual_m)
        '0.50, 0.50, 0.50 times the length, width and height'
        >>> find_size_problem(usual_m[:, [1, 0, 2]], usual_m)
        '0.40, 2.67, 1.00 times the length, width and height'
    """
    ratio = np.median(sizes_m / usual_m, axis=0)
    scale = np.prod(ratio) ** (1 / 3)
    if 1 / MAX_SCALE <= scale <= MAX_SCALE and ratio[0] > MIN_SLENDERNESS * ratio[1]:
        return None
    ratios = ", ".join(f"{x:.2f}" for x in ratio)
    return f"{ratios} times the length, width and height"
