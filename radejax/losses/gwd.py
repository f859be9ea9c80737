"""Gaussian Wasserstein distance between rotated boxes on the ground plane.

A box is represented by a Gaussian with mean (x, y) and covariance S^2. The matrix S has
half the length along the heading and half the width across it as eigenvalues. The squared
distance between two boxes is

    d = |mu1 - mu2|^2 + tr(S1^2) + tr(S2^2) - 2 T,   T = tr (S1 S2^2 S1)^(1/2)

Three measures make it usable as a loss in float32:

* The matrix root is computed by an eigendecomposition, and its derivative in the
  eigenbasis (from the Sylvester equation S dS + dS S = dM). The derivative has no
  difference of eigenvalues in a denominator, so it is also correct for square boxes and
  for boxes rotated by 90 deg.
* tr(S1^2) + tr(S2^2) and 2 T are large and nearly equal for similar boxes. With
  P = S1 S2, their difference is |S1 - S2|_F^2 - 2 (T - tr P), and

      T - tr P = ((P_xy - P_yx)^2 + 4 max(-det P, 0)) / (T + tr P),

  which avoids the difference of large numbers.
* sqrt(d) is smoothed below 1e-6 m, so its gradient is finite at zero distance.

In the authors' code, the width is along the heading and the length across it; here, the
length is along the heading. This corresponds to a rotation of both Gaussians by 90 deg
about their means, which changes no term of d for any length of the yaw vectors, so distance
and gradients are the same.

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
_SMOOTHING_M = 1e-6  # scale below which sqrt(d) is smoothed


def gwd(a: Boxes8, b: Boxes8) -> PerPair:
    """Computes the squared 2-Wasserstein distance between corresponding boxes' Gaussians.

    As in the authors' code, the yaw vectors are not normalized, and eigenvalues are clamped
    at 1e-12.

    Args:
        a: `[..., 8]` boxes x, y, z, l, w, h, sin yaw, cos yaw in meters; z and h are not
            used.
        b: `[..., 8]` boxes like `a`.

    Returns:
        `[...]` non-negative squared distances in square meters, in float32 (float64 for
        float64 input).

    Raises:
        ValueError: The last axis does not have length 8.

    Examples:
        >>> car = jnp.array([10.0, 2.0, 0.0, 4.0, 2.0, 1.5, 0.0, 1.0])
        >>> float(gwd(car, car)), float(gwd(car, car.at[0].add(3.0)))
        (0.0, 9.0)
    """
    if a.shape[-1:] != (8,) or b.shape[-1:] != (8,):
        raise ValueError(f"boxes must be [..., 8], got {a.shape} and {b.shape}")
    dtype = jnp.promote_types(jnp.result_type(a, b), jnp.float32)
    a = a.astype(dtype)
    b = b.astype(dtype)
    offset = a[..., :2] - b[..., :2]
    return jnp.sum(offset * offset, -1) + _shape_distance(a, b)


def gwd_loss(
    a: Boxes8, b: Boxes8, tau: float = 1.65, transform: Transform = "sqrt"
) -> PerPair:
    """Computes the loss 1 - 1 / (tau + f(d)) for corresponding boxes, where d is `gwd`.

    Args:
        a: `[..., 8]` boxes, see `gwd`.
        b: `[..., 8]` boxes, see `gwd`.
        tau: Offset tau; the loss of equal boxes is 1 - 1 / tau (0.394 for 1.65).
        transform: Function f. "none" is d (as in the authors' code), "sqrt" is sqrt(d)
            (as in the paper) and "log1p" is log(1 + d).

    Returns:
        `[...]` loss per pair of boxes.

    Raises:
        ValueError: `transform` is unknown, or the shape of `a` or `b` is not `[..., 8]`.

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
        # d is quadratic in the error near 0, so the derivative of sqrt(d) is bounded but
        # evaluates to 0 / 0 at d = 0. With smoothing, it is 0 there.
        distance = jnp.sqrt(distance + _SMOOTHING_M**2) - _SMOOTHING_M
    elif transform == "log1p":
        distance = jnp.log1p(distance)
    return 1 - 1 / (tau + distance)


def _root_entries(boxes: Boxes8) -> _Matrix:
    """Returns the entries xx, xy and yy of the symmetric matrix S."""
    length = boxes[..., 3] / 2
    width = boxes[..., 4] / 2
    sin, cos = boxes[..., 6], boxes[..., 7]
    return (
        length * cos * cos + width * sin * sin,
        (length - width) * sin * cos,
        length * sin * sin + width * cos * cos,
    )


def _root_differences(a: Boxes8, b: Boxes8) -> _Matrix:
    """Computes the difference of the `_root_entries` of two boxes.

    It is written in differences of box parameters, so that it is exactly 0 for equal boxes.
    If the entries themselves were subtracted, a compiler that fuses a product with the
    subtraction could round the two entries differently.
    """
    sin_a, cos_a = a[..., 6], a[..., 7]
    sin_b, cos_b = b[..., 6], b[..., 7]
    length = (a[..., 3] - b[..., 3]) / 2
    width = (a[..., 4] - b[..., 4]) / 2
    length_b = b[..., 3] / 2
    width_b = b[..., 4] / 2
    sin = sin_a - sin_b
    cos = cos_a - cos_b
    sin_square = sin * (sin_a + sin_b)
    cos_square = cos * (cos_a + cos_b)
    xx = length * cos_a**2 + width * sin_a**2
    yy = length * sin_a**2 + width * cos_a**2
    return (
        xx + length_b * cos_square + width_b * sin_square,
        (length - width) * sin_a * cos_a
        + (length_b - width_b) * (sin * cos_a + sin_b * cos),
        yy + length_b * sin_square + width_b * cos_square,
    )


def _shape_distance(a: Boxes8, b: Boxes8) -> PerPair:
    """Computes tr(S1^2) + tr(S2^2) - 2 T without cancellation."""
    a_xx, a_xy, a_yy = _root_entries(a)
    b_xx, b_xy, b_yy = _root_entries(b)
    # P = S1 S2 and P P^T are written out because accelerators may compute a matrix product
    # in reduced precision.
    p_xx = a_xx * b_xx + a_xy * b_xy
    p_xy = a_xx * b_xy + a_xy * b_yy
    p_yx = a_xy * b_xx + a_yy * b_xy
    p_yy = a_xy * b_xy + a_yy * b_yy
    root = trace_of_root_2x2(
        p_xx * p_xx + p_xy * p_xy,
        p_xx * p_yx + p_xy * p_yy,
        p_yx * p_yx + p_yy * p_yy,
    )
    xx, xy, yy = _root_differences(a, b)
    gap = xx**2 + 2 * xy**2 + yy**2
    # P_xy - P_yx is computed from differences of entries, so it is 0 for equal boxes.
    skew = a_xy * (xx - yy) - (a_xx - a_yy) * xy
    trace = p_xx + p_yy
    det = p_xx * p_yy - p_xy * p_yx
    # If tr P is not positive, which requires negative sizes, T - tr P has no cancellation.
    is_positive = trace > 0
    total = jnp.where(is_positive, root + trace, 1)
    excess = jnp.where(
        is_positive, (skew**2 + 4 * jnp.maximum(-det, 0)) / total, root - trace
    )
    return jnp.maximum(gap - 2 * excess, 0)


@jax.custom_jvp
def trace_of_root_2x2(xx: Entry, xy: Entry, yy: Entry) -> Entry:
    """Computes the trace of the square root of the matrix [[xx, xy], [xy, yy]], elementwise.

    The root is computed by eigendecomposition, with eigenvalues l clamped at 1e-12. The
    derivative of the root S of M solves S dS + dS S = dM, so in the eigenbasis it is
    dS_ij = dM_ij / (sqrt(l_i) + sqrt(l_j)). The trace needs only the diagonal of dS. It is
    also correct for equal eigenvalues, unlike the derivative through the eigenvectors,
    which divides by the difference of the eigenvalues.

    Args:
        xx: `[...]` first diagonal entry of a positive semi-definite matrix.
        xy: `[...]` off-diagonal entry.
        yy: `[...]` second diagonal entry.

    Returns:
        `[...]` sum of the square roots of the eigenvalues.

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
    """Returns the square roots of the two eigenvalues and the first eigenvector (cos, sin).

    One Jacobi rotation diagonalizes a 2x2 matrix exactly, without a LAPACK call per matrix.
    For a multiple of the identity, the rotation angle is 0.
    """
    angle = jnp.arctan2(2 * xy, xx - yy) / 2
    cos = jnp.cos(angle)
    sin = jnp.sin(angle)
    values = _diagonal_in_basis(xx, xy, yy, cos, sin)
    roots = [jnp.sqrt(jnp.maximum(v, _MIN_EIGENVALUE)) for v in values]
    return roots, cos, sin


def _diagonal_in_basis(
    xx: jax.Array, xy: jax.Array, yy: jax.Array, cos: jax.Array, sin: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the diagonal of a symmetric matrix in axes rotated by an angle."""
    mixed = 2 * sin * cos * xy
    first = cos * cos * xx + mixed + sin * sin * yy
    return first, sin * sin * xx - mixed + cos * cos * yy
