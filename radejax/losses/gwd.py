"""Gaussian Wasserstein distance between rotated boxes on the ground plane.

A box stands for a Gaussian with mean (x, y) and covariance S^2, where the square root S
has half the length along the heading and half the width across it:

    d = |mu1 - mu2|^2 + tr(S1^2) + tr(S2^2) - 2 tr (S1 S2^2 S1)^(1/2)

Three things make it usable as a loss in float32:

* The matrix root goes through an eigendecomposition whose derivative is taken in the
  eigenbasis (the Sylvester equation S dS + dS S = dM), which has no difference of
  eigenvalues in a denominator: right for square boxes and for boxes turned by 90 deg.
* tr(S1^2) + tr(S2^2) and the root are large and nearly equal for similar boxes. Their
  difference A - 2 T is taken as (A^2 - 4 T^2) / (A + 2 T), where the numerator, written
  in mean sizes and anisotropies, is a sum of squares: zero for identical boxes and
  never negative.
* sqrt(d) is smoothed below 1e-6 m, so its gradient is finite at zero distance.

The released code puts the width along the heading and the length across. Turning both
Gaussians by 90 deg about their own means changes no term of d, whatever the length of
the yaw vectors, so distance and gradients are the same; here length is along heading.

References:
    Yang et al., Rethinking Rotated Object Detection with Gaussian Wasserstein Distance
    Loss, arXiv:2101.11952.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Float

Root = Literal["eigh", "closed_form"]
Transform = Literal["none", "sqrt", "log1p"]
_Matrix = tuple[jax.Array, jax.Array, jax.Array]  # xx, xy, yy

_SMALLEST_EIGENVALUE = 1e-12  # as released
_SMOOTHING_M = 1e-6  # scale below which sqrt(d) is rounded off


def gwd(
    a: Float[jax.Array, "*#pairs 8"],
    b: Float[jax.Array, "*#pairs 8"],
    *,
    root: Root = "eigh",
) -> Float[jax.Array, "*pairs"]:
    """Squared 2-Wasserstein distance between the Gaussians of corresponding boxes.

    Args:
        a: `[..., 8]` boxes x, y, z, l, w, h, sin yaw, cos yaw in metres; z and h do
            not count; the yaw vector is used as it is, not normalised.
        b: `[..., 8]`.
        root: "eigh": trace of the matrix root by eigendecomposition, eigenvalues
            clamped at 1e-12, as released. "closed_form": by trace and determinants,
            several times faster and a little more accurate.

    Returns:
        `[...]` square metres, not negative, in float32 (float64 for float64 input).

    Raises:
        ValueError: The last axis is not 8 long, or `root` is unknown.

    Examples:
        >>> car = jnp.array([10.0, 2.0, 0.0, 4.0, 2.0, 1.5, 0.0, 1.0])
        >>> float(gwd(car, car)), float(gwd(car, car.at[0].add(3.0)))
        (0.0, 9.0)
    """
    if a.shape[-1:] != (8,) or b.shape[-1:] != (8,):
        raise ValueError(f"boxes must be [..., 8], got {a.shape} and {b.shape}")
    if root not in ("eigh", "closed_form"):
        raise ValueError(f"root must be 'eigh' or 'closed_form', got {root!r}")
    dtype = jnp.promote_types(jnp.result_type(a, b), jnp.float32)
    a, b = a.astype(dtype), b.astype(dtype)
    offset = a[..., :2] - b[..., :2]
    return jnp.sum(offset * offset, -1) + _shape_distance(a, b, root)


def gwd_loss(
    a: Float[jax.Array, "*#pairs 8"],
    b: Float[jax.Array, "*#pairs 8"],
    tau: float = 1.65,
    transform: Transform = "sqrt",
    *,
    root: Root = "eigh",
) -> Float[jax.Array, "*pairs"]:
    """1 - 1 / (tau + f(d)) for corresponding boxes, d the distance `gwd`.

    Args:
        a: `[..., 8]` boxes, see `gwd`.
        b: `[..., 8]`.
        tau: Offset; a perfect box costs 1 - 1 / tau (0.394 at 1.65).
        transform: f: "none" d (the released training), "sqrt" sqrt(d) (the paper),
            "log1p" log(1 + d).
        root: See `gwd`.

    Returns:
        `[...]` loss per box.

    Raises:
        ValueError: `transform` or `root` is unknown, or shapes are not `[..., 8]`.

    References:
        RADE-Net, section on the Gaussian Wasserstein distance loss.

    Examples:
        >>> car = jnp.array([10.0, 2.0, 0.0, 4.0, 2.0, 1.5, 0.0, 1.0])
        >>> loss = jax.jit(gwd_loss)
        >>> round(float(loss(car, car)), 4), round(float(loss(car, car.at[0].add(3))), 4)
        (0.3939, 0.7849)
    """
    distance = gwd(a, b, root=root)
    if transform == "sqrt":
        # d grows with the square of the error, so d / sqrt(d) has a finite limit;
        # the smoothing makes its derivative 0 there instead of 0 / 0.
        smooth = jnp.sqrt(distance + _SMOOTHING_M**2)
        distance = smooth - _SMOOTHING_M
    elif transform == "log1p":
        distance = jnp.log1p(distance)
    elif transform != "none":
        raise ValueError(
            f"transform must be 'none', 'sqrt' or 'log1p', got {transform!r}"
        )
    return 1 - 1 / (tau + distance)


def gaussian_root(
    boxes: Float[jax.Array, "*batch 8"],
) -> Float[jax.Array, "*batch 2 2"]:
    """Square root S of the covariance of boxes: `[..., 8]` -> `[..., 2, 2]`.

    Examples:
        >>> gaussian_root(jnp.array([0.0, 0, 0, 4, 2, 1.5, 0, 1])).tolist()
        [[2.0, 0.0], [0.0, 1.0]]
    """
    xx, xy, yy = _root_entries(boxes)
    return jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], -2)


def _root_entries(boxes: Float[jax.Array, "*batch 8"]) -> _Matrix:
    """xx, xy and yy of the symmetric S."""
    length, width = boxes[..., 3] / 2, boxes[..., 4] / 2
    sin, cos = boxes[..., 6], boxes[..., 7]
    return (
        length * cos * cos + width * sin * sin,
        (length - width) * sin * cos,
        length * sin * sin + width * cos * cos,
    )


def _shape_distance(a: jax.Array, b: jax.Array, root: Root) -> jax.Array:
    """tr(S1^2) + tr(S2^2) - 2 tr (S1 S2^2 S1)^(1/2), without cancellation."""
    mean_a, skew_a = _mean_and_anisotropy(a)
    mean_b, skew_b = _mean_and_anisotropy(b)
    square_a, square_b = _dot(skew_a, skew_a), _dot(skew_b, skew_b)
    norm_a, norm_b = mean_a**2 + square_a, mean_b**2 + square_b  # tr(S^2) / 2
    norms = 2 * (norm_a + norm_b)
    # Negative where one box, and not both, has exactly one negative size.
    dets = (mean_a**2 - square_a) * (mean_b**2 - square_b)
    mean_gap, skew_gap = _gaps(a, b)
    # norm_a - norm_b, and mean_b skew_a - mean_a skew_b.
    skew_sum = [p + q for p, q in zip(skew_a, skew_b, strict=True)]
    norm_gap = mean_gap * (mean_a + mean_b) + _dot(skew_gap, skew_sum)
    cross = [mean_a * g - mean_gap * p for p, g in zip(skew_a, skew_gap, strict=True)]
    numerator = 4 * (norm_gap**2 + 4 * _dot(cross, cross)) + 16 * jnp.minimum(dets, 0)
    numerator = jnp.maximum(numerator, 0)
    if root == "eigh":
        trace = _trace_of_root(a, b)
    else:
        overlap = 2 * norm_a * norm_b + 8 * mean_a * mean_b * _dot(skew_a, skew_b)
        trace = _safe_sqrt(overlap + 2 * jnp.abs(dets))
    return numerator / jnp.maximum(norms + 2 * trace, _SMALLEST_EIGENVALUE)


def _mean_and_anisotropy(boxes: jax.Array) -> tuple[jax.Array, list[jax.Array]]:
    """S = mean I + [[p, q], [q, -p]]: mean and [p, q], `[...]` each."""
    half_sum = (boxes[..., 3] + boxes[..., 4]) / 4
    half_gap = (boxes[..., 3] - boxes[..., 4]) / 4
    sin, cos = boxes[..., 6], boxes[..., 7]
    mean = half_sum * (cos * cos + sin * sin)
    return mean, [half_gap * (cos - sin) * (cos + sin), half_gap * 2 * sin * cos]


def _gaps(a: jax.Array, b: jax.Array) -> tuple[jax.Array, list[jax.Array]]:
    """Differences of `_mean_and_anisotropy` of two boxes.

    Expanded into differences of box parameters: those are 0 for equal boxes, whereas
    a compiler that fuses a product with a subtraction rounds the two sides unequally.
    """
    sin_a, cos_a, sin_b, cos_b = a[..., 6], a[..., 7], b[..., 6], b[..., 7]
    length, width = a[..., 3] - b[..., 3], a[..., 4] - b[..., 4]
    half_sum_b, half_gap_b = (b[..., 3] + b[..., 4]) / 4, (b[..., 3] - b[..., 4]) / 4
    sin, cos = sin_a - sin_b, cos_a - cos_b
    sin_square, cos_square = sin * (sin_a + sin_b), cos * (cos_a + cos_b)
    mean = (length + width) / 4 * (cos_a * cos_a + sin_a * sin_a)
    mean = mean + half_sum_b * (cos_square + sin_square)
    p = (length - width) / 4 * (cos_a - sin_a) * (cos_a + sin_a)
    p = p + half_gap_b * (cos_square - sin_square)
    q = (length - width) / 2 * sin_a * cos_a
    q = q + 2 * half_gap_b * (sin * cos_a + sin_b * cos)
    return mean, [p, q]


def _dot(p: list[jax.Array], q: list[jax.Array]) -> jax.Array:
    return p[0] * q[0] + p[1] * q[1]


def _safe_sqrt(value: jax.Array) -> jax.Array:
    """Square root with derivative 0 where the value is not positive."""
    is_positive = value > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, value, 1)), 0)


def _trace_of_root(a: jax.Array, b: jax.Array) -> jax.Array:
    """tr (S1 S2^2 S1)^(1/2) of the boxes' roots: `[...]`."""
    (a_xx, a_xy, a_yy), (b_xx, b_xy, b_yy) = _root_entries(a), _root_entries(b)
    # P = S1 S2, and M = P P^T; as scalars, never in an accelerator's low precision.
    p_xx, p_xy = a_xx * b_xx + a_xy * b_xy, a_xx * b_xy + a_xy * b_yy
    p_yx, p_yy = a_xy * b_xx + a_yy * b_xy, a_xy * b_xy + a_yy * b_yy
    xx, yy = p_xx * p_xx + p_xy * p_xy, p_yx * p_yx + p_yy * p_yy
    return trace_of_root_2x2(xx, p_xx * p_yx + p_xy * p_yy, yy)


@jax.custom_jvp
def trace_of_root_2x2(
    xx: Float[jax.Array, "*batch"],
    xy: Float[jax.Array, "*batch"],
    yy: Float[jax.Array, "*batch"],
) -> Float[jax.Array, "*batch"]:
    """Trace of the symmetric root of [[xx, xy], [xy, yy]], elementwise.

    By eigendecomposition, with eigenvalues l clamped at 1e-12. The derivative of the
    root S of M solves S dS + dS S = dM; in the eigenbasis dS_ij = dM_ij / (sqrt(l_i) +
    sqrt(l_j)). Its trace needs the diagonal alone and is finite and right for equal
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
    roots = [jnp.sqrt(jnp.maximum(v, _SMALLEST_EIGENVALUE)) for v in values]
    return roots, cos, sin


def _diagonal_in_basis(
    xx: jax.Array, xy: jax.Array, yy: jax.Array, cos: jax.Array, sin: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Diagonal of a symmetric matrix seen from axes turned by an angle."""
    mixed = 2 * sin * cos * xy
    first = cos * cos * xx + mixed + sin * sin * yy
    return first, sin * sin * xx - mixed + cos * cos * yy
