"""Gaussian Wasserstein distance between rotated boxes on the ground plane.

A box stands for a Gaussian with mean (x, y) and covariance S^2, where the square root S
has half the length along the heading and half the width across it:

    d = |mu1 - mu2|^2 + tr(S1^2) + tr(S2^2) - 2 T,   T = tr (S1 S2^2 S1)^(1/2)

Three things make it usable as a loss in float32:

* The matrix root goes through an eigendecomposition whose derivative is taken in the
  eigenbasis (the Sylvester equation S dS + dS S = dM), which has no difference of
  eigenvalues in a denominator: right for square boxes and for boxes turned by 90 deg.
* tr(S1^2) + tr(S2^2) and 2 T are large and nearly equal for similar boxes. With
  P = S1 S2, their difference is |S1 - S2|_F^2 - 2 (T - tr P), and

      T - tr P = ((P_xy - P_yx)^2 + 4 max(-det P, 0)) / (T + tr P),

  where no two large numbers are subtracted.
* sqrt(d) is smoothed below 1e-6 m, so its gradient is finite at zero distance.

The released code puts the width along the heading and the length across. Turning both
Gaussians by 90 deg about their own means changes no term of d, whatever the length of
the yaw vectors, so distance and gradients are the same; here length is along heading.

References:
    Yang et al., Rethinking Rotated Object Detection with Gaussian Wasserstein Distance
    Loss, arXiv:2101.11952.
"""

from __future__ import annotations

from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Float

from radejax.core.errors import require

Transform = Literal["none", "sqrt", "log1p"]
_TRANSFORMS = get_args(Transform)
Boxes8 = Float[jax.Array, "*#pairs 8"]
PerPair = Float[jax.Array, "*pairs"]
Entry = Float[jax.Array, "*batch"]
_Matrix = tuple[jax.Array, jax.Array, jax.Array]  # xx, xy, yy

_MIN_EIGENVALUE = 1e-12  # as released
_SMOOTHING_M = 1e-6  # scale below which sqrt(d) is rounded off


def gwd(a: Boxes8, b: Boxes8) -> PerPair:
    """Squared 2-Wasserstein distance between the Gaussians of corresponding boxes.

    Args:
        a: `[..., 8]` boxes x, y, z, l, w, h, sin yaw, cos yaw in meters; z and h do
            not count; the yaw vector is used as it is, not normalized. Eigenvalues
            are clamped at 1e-12, as released.
        b: `[..., 8]`.

    Returns:
        `[...]` square meters, not negative, in float32 (float64 for float64 input).

    Raises:
        ValueError: The last axis is not 8 long.

    Examples:
        >>> car = jnp.array([10.0, 2.0, 0.0, 4.0, 2.0, 1.5, 0.0, 1.0])
        >>> float(gwd(car, car)), float(gwd(car, car.at[0].add(3.0)))
        (0.0, 9.0)
    """
    if a.shape[-1:] != (8,) or b.shape[-1:] != (8,):
        raise ValueError(f"boxes must be [..., 8], got {a.shape} and {b.shape}")
    dtype = jnp.promote_types(jnp.result_type(a, b), jnp.float32)
    a, b = a.astype(dtype), b.astype(dtype)
    offset = a[..., :2] - b[..., :2]
    return jnp.sum(offset * offset, -1) + _shape_distance(a, b)


def gwd_loss(
    a: Boxes8, b: Boxes8, tau: float = 1.65, transform: Transform = "sqrt"
) -> PerPair:
    """1 - 1 / (tau + f(d)) for corresponding boxes, d the distance `gwd`.

    Args:
        a: `[..., 8]` boxes, see `gwd`.
        b: `[..., 8]`.
        tau: Offset; a perfect box costs 1 - 1 / tau (0.394 at 1.65).
        transform: f: "none" d (the released training), "sqrt" sqrt(d) (the paper),
            "log1p" log(1 + d).

    Returns:
        `[...]` loss per box.

    Raises:
        ValueError: `transform` is unknown, or shapes are not `[..., 8]`.

    References:
        RADE-Net, section on the Gaussian Wasserstein distance loss.

    Examples:
        >>> car = jnp.array([10.0, 2.0, 0.0, 4.0, 2.0, 1.5, 0.0, 1.0])
        >>> loss = jax.jit(gwd_loss)
        >>> round(float(loss(car, car)), 4), round(float(loss(car, car.at[0].add(3))), 4)
        (0.3939, 0.7849)
    """
    require(transform in _TRANSFORMS, "transform", transform, f"one of {_TRANSFORMS}")
    distance = gwd(a, b)
    if transform == "sqrt":
        # d grows with the square of the error, so d / sqrt(d) has a finite limit;
        # the smoothing makes its derivative 0 there instead of 0 / 0.
        distance = jnp.sqrt(distance + _SMOOTHING_M**2) - _SMOOTHING_M
    elif transform == "log1p":
        distance = jnp.log1p(distance)
    return 1 - 1 / (tau + distance)


def _root_entries(boxes: Boxes8) -> _Matrix:
    """xx, xy and yy of the symmetric S."""
    length, width = boxes[..., 3] / 2, boxes[..., 4] / 2
    sin, cos = boxes[..., 6], boxes[..., 7]
    return (
        length * cos * cos + width * sin * sin,
        (length - width) * sin * cos,
        length * sin * sin + width * cos * cos,
    )


def _root_differences(a: Boxes8, b: Boxes8) -> _Matrix:
    """Differences of `_root_entries` of two boxes.

    Expanded into differences of box parameters, which are 0 for equal boxes, whereas a
    compiler that fuses a product with a subtraction rounds the two sides unequally.
    """
    sin_a, cos_a, sin_b, cos_b = a[..., 6], a[..., 7], b[..., 6], b[..., 7]
    length, width = (a[..., 3] - b[..., 3]) / 2, (a[..., 4] - b[..., 4]) / 2
    length_b, width_b = b[..., 3] / 2, b[..., 4] / 2
    sin, cos = sin_a - sin_b, cos_a - cos_b
    sin_square, cos_square = sin * (sin_a + sin_b), cos * (cos_a + cos_b)
    xx = length * cos_a**2 + width * sin_a**2
    yy = length * sin_a**2 + width * cos_a**2
    return (
        xx + length_b * cos_square + width_b * sin_square,
        (length - width) * sin_a * cos_a
        + (length_b - width_b) * (sin * cos_a + sin_b * cos),
        yy + length_b * sin_square + width_b * cos_square,
    )


def _shape_distance(a: Boxes8, b: Boxes8) -> PerPair:
    """tr(S1^2) + tr(S2^2) - 2 T, without cancellation."""
    (a_xx, a_xy, a_yy), (b_xx, b_xy, b_yy) = _root_entries(a), _root_entries(b)
    # P = S1 S2, and P P^T; as scalars, never in an accelerator's low precision.
    p_xx, p_xy = a_xx * b_xx + a_xy * b_xy, a_xx * b_xy + a_xy * b_yy
    p_yx, p_yy = a_xy * b_xx + a_yy * b_xy, a_xy * b_xy + a_yy * b_yy
    root = trace_of_root_2x2(
        p_xx * p_xx + p_xy * p_xy,
        p_xx * p_yx + p_xy * p_yy,
        p_yx * p_yx + p_yy * p_yy,
    )
    xx, xy, yy = _root_differences(a, b)
    gap = xx**2 + 2 * xy**2 + yy**2
    # P_xy - P_yx from differences of entries: exactly 0 for equal boxes.
    skew = a_xy * (xx - yy) - (a_xx - a_yy) * xy
    trace, det = p_xx + p_yy, p_xx * p_yy - p_xy * p_yx
    # Where tr P is not positive, for negative sizes, nothing cancels in T - tr P.
    is_positive = trace > 0
    total = jnp.where(is_positive, root + trace, 1)
    excess = jnp.where(
        is_positive, (skew**2 + 4 * jnp.maximum(-det, 0)) / total, root - trace
    )
    return jnp.maximum(gap - 2 * excess, 0)


@jax.custom_jvp
def trace_of_root_2x2(xx: Entry, xy: Entry, yy: Entry) -> Entry:
    """Trace of the symmetric root of [[xx, xy], [xy, yy]], elementwise.

    By eigendecomposition, with eigenvalues l clamped at 1e-12. The derivative of the
    root S of M solves S dS + dS S = dM; in the eigenbasis dS_ij = dM_ij / (sqrt(l_i) +
    sqrt(l_j)). Its trace needs only the diagonal and is finite and right for equal
    eigenvalues, where differentiating eigenvectors divides by their difference.

    Args:
        xx: `[...]` entry of a positive semi-definite matrix, as are the others.
        xy: `[...]`.
        yy: `[...]`.

    Returns:
        `[...]` sum of the roots of the eigenvalues.

    Examples:
        >>> round(float(trace_of_root_2x2(*jnp.array([4.0, 0.0, 9.0]))), 4)
        5.0
    """
    roots, _, _ = _roots_and_axes(xx, xy, yy)
    return roots[0] + roots[1]


@trace_of_root_2x2.defjvp
def _trace_of_root_2x2_jvp(
    primals: _Matrix, tangents: _Matrix
) -> tuple[jax.Array, jax.Array]:
    roots, cos, sin = _roots_and_axes(*primals)
    first, second = _diagonal_in_basis(*tangents, cos, sin)
    return roots[0] + roots[1], first / (2 * roots[0]) + second / (2 * roots[1])


def _roots_and_axes(
    xx: jax.Array, xy: jax.Array, yy: jax.Array
) -> tuple[list[jax.Array], jax.Array, jax.Array]:
    """Roots of the two eigenvalues, and the first eigenvector (cos, sin).

    One Jacobi rotation diagonalises a 2x2 matrix exactly, elementwise and without a
    LAPACK call per matrix; a multiple of the identity keeps its axes.
    """
    angle = jnp.arctan2(2 * xy, xx - yy) / 2
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    values = _diagonal_in_basis(xx, xy, yy, cos, sin)
    roots = [jnp.sqrt(jnp.maximum(v, _MIN_EIGENVALUE)) for v in values]
    return roots, cos, sin


def _diagonal_in_basis(
    xx: jax.Array, xy: jax.Array, yy: jax.Array, cos: jax.Array, sin: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Diagonal of a symmetric matrix seen from axes turned by an angle."""
    mixed = 2 * sin * cos * xy
    first = cos * cos * xx + mixed + sin * sin * yy
    return first, sin * sin * xx - mixed + cos * cos * yy
