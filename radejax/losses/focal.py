"""Gaussian center-point targets and the focal loss that compares heatmaps with them."""

from __future__ import annotations

from typing import Literal, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from radejax.core.errors import require
from radejax.core.structures import Array
from radejax.geometry.radar_grid import RadarGrid

SigmaMode = Literal["fixed", "adaptive", "anisotropic"]
Maps = Float[jax.Array, "B R A C"]
Bins = Float[jax.Array, "*bins"]
PerObject = Float[jax.Array, "*objects"]

# Logits of the bounds [1e-6, 1 - 1e-6] to which probabilities are clipped, as float32
# rounds them: 1 - 1e-6 becomes 1 - 1.013e-6.
_LOWEST = float(np.log(1e-6) - np.log1p(-1e-6))
_HIGHEST = float(-np.log(17 * 2.0**-24) + np.log1p(-17 * 2.0**-24))
_MIN_SIGMA = 1e-3  # bins; an object of zero size is a single bin


def gaussian_heatmap(
    boxes: Float[jax.Array, "*batch N _"],
    classes: Int[Array, "*batch N"],
    is_valid: Bool[jax.Array, "*batch N"],
    grid: RadarGrid,
    *,
    num_classes: int,
    sigma_mode: SigmaMode = "fixed",
    sigma_bins: float = 3.0,
) -> Float[jax.Array, "*batch R A C"]:
    """Target heatmaps: per class the clipped sum of Gaussians at the objects' bins.

    With (i0, j0) the bin nearest to an object's center, bin (i, j) of its class gets
    exp(-(i - i0)^2 / (2 sr^2) - (j - j0)^2 / (2 sa^2)), and sums are clipped to 1. A
    Gaussian is separable, so all objects together are one matrix product of their
    range profiles with their azimuth profiles; no `[N, R, A, C]` is built. The value at
    an object's bin is exactly 1.

    Args:
        boxes: `[..., N, 7 or 8]` boxes in the ego frame, meters; only x, y, l, w count.
        classes: `[..., N]` class indices; indices outside `[0, C)` draw nothing.
        is_valid: `[..., N]` bool, True where a box is an object.
        grid: The grid of the maps.
        num_classes: C.
        sigma_mode: "fixed": `sigma_bins` in both axes. "adaptive": 0.3 max(l, w) in both.
            "anisotropic": l / 6 along range and w / 6 along azimuth. The latter two
            read meters as bins, as released.
        sigma_bins: Standard deviation for "fixed", in bins.

    Returns:
        `[..., R, A, C]` float32 in [0, 1].

    Raises:
        ValueError: `sigma_mode` is unknown.
        AssertionError: Shapes of boxes, classes and mask do not fit together.

    References:
        RADE-Net, section on the focal loss (sigma 3); DinoRADE (sigma 0.75).

    Examples:
        >>> grid = RadarGrid.kradar()
        >>> car = jnp.array([[20.0, 0, 0, 4, 2, 1.5, 0]])
        >>> target = gaussian_heatmap(
        ...     car, jnp.array([0]), jnp.array([True]), grid, num_classes=5)
        >>> target.shape, int((target == 1).sum())
        ((256, 107, 5), 1)
    """
    chex.assert_equal_shape_prefix([boxes, classes, is_valid], boxes.ndim - 1)
    chex.assert_equal_rank([classes, is_valid])
    boxes = boxes.astype(jnp.float32)
    bins = grid.nearest_bin(boxes[..., 0], boxes[..., 1])  # [..., N, 2]
    sigma_range, sigma_azimuth = _sigmas(boxes, sigma_mode, sigma_bins)
    range_profile = _profile(bins[..., 0], sigma_range, grid.num_range)
    azimuth_profile = _profile(bins[..., 1], sigma_azimuth, grid.num_azimuth)
    one_hot = jax.nn.one_hot(classes, num_classes) * is_valid[..., None]
    # Zero weight is not enough against NaN boxes in padding rows.
    range_profile = jnp.where(is_valid[..., None], range_profile, 0.0)
    azimuth_profile = jnp.where(is_valid[..., None], azimuth_profile, 0.0)
    columns = azimuth_profile[..., :, None] * one_hot[..., None, :]  # [..., N, A, C]
    # Reduced precision would lose the ones at the centers on accelerators.
    heatmap = jnp.einsum(
        "...nr,...nac->...rac",
        range_profile,
        columns,
        precision=jax.lax.Precision.HIGHEST,
    )
    # Computed once: where compilers join it with what uses it, sums that are nearly one
    # are positive for one user and not for the next (jax 0.10.0 on CPUs).
    return jax.lax.optimization_barrier(jnp.minimum(heatmap, 1.0))


def focal_loss(
    logits: Maps, target: Maps, alpha: float = 2, beta: float = 4
) -> Float[jax.Array, ""]:
    """Center-point focal loss of a batch of heatmaps, averaged over positive bins.

    With p the probability: -(1 - p)^alpha log p where the target t is 1, elsewhere
    -(1 - t)^beta p^alpha log(1 - p); the sum divided by the number of positive bins,
    or the mean over all bins where the batch has none. p is clipped to
    [1e-6, 1 - 1e-6] as released, with no gradient beyond.

    Args:
        logits: `[B, R, A, C]`, any float dtype; computed in float32.
        target: `[B, R, A, C]` in [0, 1], from `gaussian_heatmap`.
        alpha: Exponent on the error of the prediction.
        beta: Exponent that spares bins near a center.

    Returns:
        Scalar float32.

    Raises:
        AssertionError: Logits and target differ in shape.

    References:
        Law and Deng, CornerNet, arXiv:1808.01244, equation (1).

    Examples:
        >>> target = jnp.array([1.0, 0.0]).reshape(1, 1, 2, 1)
        >>> round(float(focal_loss(jnp.zeros((1, 1, 2, 1)), target)), 4)  # log(2) / 2
        0.3466
    """
    chex.assert_equal_shape([logits, target])
    loss = focal_loss_per_bin(logits, target, alpha, beta)
    num_positive = jnp.sum(target >= 1, dtype=jnp.float32)
    num_bins = jnp.float32(loss.size)
    return jnp.sum(loss) / jnp.where(num_positive > 0, num_positive, num_bins)


def focal_loss_per_bin(
    logits: Bins, target: Bins, alpha: float = 2, beta: float = 4
) -> Bins:
    """The terms that `focal_loss` sums: `[...]` and `[...]` -> `[...]` float32.

    log p and log(1 - p) are taken from the logits: log(1 - sigmoid(x)) rounds to 0 or
    -inf in float32 where log_sigmoid(-x) is accurate.

    Examples:
        >>> loss = focal_loss_per_bin(jnp.zeros(3), jnp.array([1.0, 0.0, 0.5]))
        >>> [round(value, 4) for value in loss.tolist()]
        [0.1733, 0.1733, 0.0108]
    """
    logits = logits.astype(jnp.float32)
    # Unlike jnp.clip, full gradient on the bounds themselves, as the released clamp.
    logits = jnp.where(logits < _LOWEST, _LOWEST, logits)
    logits = jnp.where(logits > _HIGHEST, _HIGHEST, logits)
    target = target.astype(jnp.float32)
    hit = -jax.nn.log_sigmoid(logits) * _power(jax.nn.sigmoid(-logits), alpha)
    miss = -jax.nn.log_sigmoid(-logits) * _power(jax.nn.sigmoid(logits), alpha)
    return jnp.where(target >= 1, hit, miss * _power(1 - target, beta))


def _sigmas(
    boxes: Float[jax.Array, "*objects _"], sigma_mode: str, sigma_bins: float
) -> tuple[PerObject, PerObject]:
    """Standard deviations along range and azimuth, in bins: `[..., N]` each."""
    modes = get_args(SigmaMode)
    require(sigma_mode in modes, "sigma_mode", sigma_mode, f"one of {modes}")
    length, width = boxes[..., 3], boxes[..., 4]
    if sigma_mode == "fixed":
        along_range = along_azimuth = jnp.full_like(length, sigma_bins)
    elif sigma_mode == "adaptive":
        along_range = along_azimuth = 0.3 * jnp.maximum(length, width)
    else:
        along_range, along_azimuth = length / 6, width / 6
    return jnp.maximum(along_range, _MIN_SIGMA), jnp.maximum(along_azimuth, _MIN_SIGMA)


def _profile(
    center: Int[jax.Array, "*objects"], sigma: PerObject, size: int
) -> Float[jax.Array, "*objects {size}"]:
    """Unnormalized Gaussians over `size` bins: `[...]` centers -> `[..., size]`."""
    bins = jnp.arange(size, dtype=jnp.float32)
    bins = bins.reshape((1,) * center.ndim + (size,))
    distance = (bins - center[..., None]) / sigma[..., None]
    return jnp.exp(-0.5 * distance * distance)


def _power(base: jax.Array, exponent: float) -> jax.Array:
    """Whole exponents by multiplication: exact, and with finite gradients at 0."""
    whole = int(exponent)
    return base**whole if whole == exponent else base**exponent
