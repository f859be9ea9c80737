"""Target heatmaps with Gaussians at object centers, and the focal loss of heatmaps."""

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
_MIN_SIGMA = 1e-3  # bins; the target of an object of zero size is a single bin


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
    """Computes target heatmaps, per class the clipped sum of Gaussians at objects' bins.

    If (i0, j0) is the bin nearest to an object's center, the object adds
    exp(-(i - i0)^2 / (2 sr^2) - (j - j0)^2 / (2 sa^2)) to bin (i, j) of its class. Sums are
    clipped to 1, so the value at an object's bin is exactly 1. As Gaussians are separable,
    the sum over objects is a matrix product of their range profiles and azimuth profiles,
    which needs no array `[N, R, A, C]`.

    Args:
        boxes: `[..., N, 7 or 8]` boxes in the ego frame in meters, of which x, y, l and w
            are used.
        classes: `[..., N]` class indices; objects with an index outside `[0, C)` are
            ignored.
        is_valid: `[..., N]` bool, True where a box is an object.
        grid: The grid of the maps.
        num_classes: Number C of classes.
        sigma_mode: Standard deviations sr and sa along range and azimuth. "fixed" uses
            `sigma_bins` for both, "adaptive" 0.3 max(l, w) for both, and "anisotropic"
            l / 6 for sr and w / 6 for sa. The latter two use values in meters as bins, as
            in the authors' code.
        sigma_bins: Standard deviation in bins, for "fixed".

    Returns:
        `[..., R, A, C]` float32 in [0, 1].

    Raises:
        ValueError: `sigma_mode` is unknown.
        AssertionError: The shapes of boxes, classes and mask do not match.

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
    # Padding rows may contain NaN, which multiplication by zero does not remove.
    range_profile = jnp.where(is_valid[..., None], range_profile, 0.0)
    azimuth_profile = jnp.where(is_valid[..., None], azimuth_profile, 0.0)
    columns = azimuth_profile[..., :, None] * one_hot[..., None, :]  # [..., N, A, C]
    # In an accelerator's reduced precision, values at the centers might not be exactly 1.
    heatmap = jnp.einsum(
        "...nr,...nac->...rac", range_profile, columns, precision="highest"
    )
    # The barrier prevents the compiler from fusing the sum separately into each of its
    # uses. Rounding then differs, and a sum near 1 counts as positive in one use but not
    # in another (jax 0.10.0 on CPUs).
    target: jax.Array = jax.lax.optimization_barrier(jnp.minimum(heatmap, 1.0))
    return target


def focal_loss(logits: Maps, target: Maps) -> Float[jax.Array, ""]:
    """Computes the focal loss of a batch of heatmaps, averaged over positive bins.

    For the predicted probability p, the loss of a bin is -(1 - p)^2 log p where the target
    t is 1, and -(1 - t)^4 p^2 log(1 - p) elsewhere. The sum is divided by the number of bins
    with target 1, or by the number of all bins if there are none. As in the authors' code,
    p is clipped to [1e-6, 1 - 1e-6], with no gradient outside.

    Args:
        logits: `[B, R, A, C]` heatmap logits of any float dtype; the loss is computed in
            float32.
        target: `[B, R, A, C]` target in [0, 1], from `gaussian_heatmap`.

    Returns:
        Scalar float32 loss.

    Raises:
        AssertionError: `logits` and `target` have different shapes.

    References:
        Law and Deng, CornerNet, arXiv:1808.01244, equation (1).

    Examples:
        >>> target = jnp.array([1.0, 0.0]).reshape(1, 1, 2, 1)
        >>> round(float(focal_loss(jnp.zeros((1, 1, 2, 1)), target)), 4)  # log(2) / 2
        0.3466
    """
    chex.assert_equal_shape([logits, target])
    loss = focal_loss_per_bin(logits, target)
    num_positive = jnp.sum(target >= 1, dtype=jnp.float32)
    num_bins = jnp.float32(loss.size)
    return jnp.sum(loss) / jnp.where(num_positive > 0, num_positive, num_bins)


def focal_loss_per_bin(logits: Bins, target: Bins) -> Bins:
    """Computes the float32 loss of each bin, which `focal_loss` averages.

    log p and log(1 - p) are computed from the logits, because log(1 - sigmoid(x)) rounds to
    0 or -inf in float32 where log_sigmoid(-x) is accurate.

    Args:
        logits: Logits of the heatmap.
        target: Target heatmap in [0, 1]; bins with 1 are positive.

    Examples:
        >>> loss = focal_loss_per_bin(jnp.zeros(3), jnp.array([1.0, 0.0, 0.5]))
        >>> [round(value, 4) for value in loss.tolist()]
        [0.1733, 0.1733, 0.0108]
    """
    logits = logits.astype(jnp.float32)
    # Unlike jnp.clip, this has the full gradient on the bounds, like the released clamp.
    logits = jnp.where(logits < _LOWEST, _LOWEST, logits)
    logits = jnp.where(logits > _HIGHEST, _HIGHEST, logits)
    target = target.astype(jnp.float32)
    hit = -jax.nn.log_sigmoid(logits) * jax.nn.sigmoid(-logits) ** 2
    miss = -jax.nn.log_sigmoid(-logits) * jax.nn.sigmoid(logits) ** 2
    return jnp.where(target >= 1, hit, miss * (1 - target) ** 4)


def _sigmas(
    boxes: Float[jax.Array, "*objects _"], sigma_mode: str, sigma_bins: float
) -> tuple[PerObject, PerObject]:
    """Returns the standard deviations along range and azimuth in bins, `[..., N]` each."""
    modes = get_args(SigmaMode)
    require(sigma_mode in modes, "sigma_mode", sigma_mode, f"one of {modes}")
    length = boxes[..., 3]
    width = boxes[..., 4]
    if sigma_mode == "fixed":
        along_range = along_azimuth = jnp.full_like(length, sigma_bins)
    elif sigma_mode == "adaptive":
        along_range = along_azimuth = 0.3 * jnp.maximum(length, width)
    else:
        along_range = length / 6
        along_azimuth = width / 6
    return jnp.maximum(along_range, _MIN_SIGMA), jnp.maximum(along_azimuth, _MIN_SIGMA)


def _profile(
    center: Int[jax.Array, "*objects"], sigma: PerObject, size: int
) -> Float[jax.Array, "*objects {size}"]:
    """Computes unnormalized Gaussians over `size` bins, `[...]` centers -> `[..., size]`."""
    bins = jnp.arange(size, dtype=jnp.float32)
    bins = bins.reshape((1,) * center.ndim + (size,))
    distance = (bins - center[..., None]) / sigma[..., None]
    return jnp.exp(-0.5 * distance * distance)
