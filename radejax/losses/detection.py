"""The training loss of both systems: focal, Gaussian Wasserstein and smooth L1."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Num

from radejax.core.errors import UserError
from radejax.core.structures import Batch, DetectionMaps
from radejax.detection.decode import boxes_at, find_peaks, suppress
from radejax.detection.matching import match_boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.focal import SigmaMode, focal_loss, gaussian_heatmap
from radejax.losses.gwd import Transform, gwd_loss

Assignment = Literal["center", "nms"]
Pairs = tuple[
    Float[jax.Array, "B M 8"], Float[jax.Array, "B M 8"], Bool[jax.Array, "B M"]
]
"""Predictions and their objects, and where they count; M objects, or peaks after NMS."""

BoxLoss = Callable[
    [Float[jax.Array, "B N 8"], Float[jax.Array, "B N 8"]], Float[jax.Array, "B N"]
]
BOX_LOSSES: dict[str, BoxLoss] = {
    "smooth_l1": lambda predicted, wanted: jnp.mean(smooth_l1(predicted - wanted), -1)
}
"""Losses of predicted boxes and their objects, `[B, N, 8]` each, by name: `[B, N]`. The
Gaussian Wasserstein distance, which has options, and the focal loss come on top."""

Scalar = float | Num[jax.Array, ""]
Weights = Mapping[str, Scalar]
_WEIGHTS: Weights = MappingProxyType({"focal": 2.0, "gwd": 1.0, "smooth_l1": 1.0})


def loss_names() -> tuple[str, ...]:
    """Parts that the loss may have: what `weights` may name.

    Examples:
        >>> loss_names()
        ('focal', 'gwd', 'smooth_l1')
    """
    return ("focal", "gwd", *BOX_LOSSES)


class NmsAssignment(NamedTuple):
    """Which predicted boxes are compared with an object where NMS chooses them.

    Attributes:
        max_peaks: Peaks that enter NMS.
        score_threshold: Peaks must score above it.
        nms_iou: Overlap that suppresses.
        match_iou: A box has an object where they overlap more than this.
        threshold_inclusive: Peaks that score exactly the threshold count too.
        per_class: Only boxes of the same class suppress each other.
    """

    max_peaks: int = 128
    score_threshold: Scalar = 0.3
    nms_iou: Scalar = 0.3
    match_iou: Scalar = 0.0
    threshold_inclusive: bool = False
    per_class: bool = False


def detection_loss(
    maps: DetectionMaps,
    batch: Batch,
    grid: RadarGrid,
    *,
    heatmap_sigma_mode: SigmaMode = "fixed",
    heatmap_sigma_bins: float = 3.0,
    gwd_transform: Transform = "sqrt",
    gwd_tau: float = 1.65,
    normalize_yaw: bool = False,
    assignment: Assignment = "center",
    weights: Weights = _WEIGHTS,
    normalize: bool = True,
    z0_m: Scalar = 0.0,
    is_frame_valid: Bool[jax.Array, " B"] | None = None,
    nms: NmsAssignment = NmsAssignment(),  # noqa: B008, immutable
) -> tuple[Float[jax.Array, ""], dict[str, Num[jax.Array, ""]]]:
    """Weighted sum of the losses that `weights` names, and its parts; in float32.

    Losses of boxes are means over the matched ones of a frame (0 without any), then over
    all frames of the batch, sharded or not.

    Args:
        maps: Predictions, `[B, R, A, C]` logits and `[B, R, A, 8]` box parameters.
        batch: Ground truth: `boxes`, `classes`, `is_valid` are read.
        grid: The grid of the maps (padded where they are).
        heatmap_sigma_mode: Target shape, see `gaussian_heatmap`.
        heatmap_sigma_bins: Standard deviation of targets in bins, for "fixed".
        gwd_transform: See `gwd_loss`; "sqrt" in the paper, "none" as released.
        gwd_tau: Likewise.
        normalize_yaw: Scale the predicted yaw vector to length 1 for the GWD (released: raw).
            Smooth L1 always sees it raw, which teaches the network its length.
        assignment: "center": boxes at each object's own bin (as released); "nms": those
            that survive NMS with the object that they overlap most (the paper).
        weights: Of some of `loss_names()`; a part without one is not computed.
        normalize: Divide each part by its own value, held constant: gradients of the
            parts have the ratio `weights`, the total is constant, parts of 0 add nothing.
        z0_m: Sensor height, added to the regressed z.
        is_frame_valid: `[B]` bool, False for frames that only fill up a batch.
        nms: Which predicted boxes have an object, for "nms".

    Returns:
        Scalar total, and scalars by name: the raw parts, their `weighted_sum`,
        `num_objects`, `num_positive` (bins), `num_matched` (boxes).

    Raises:
        UserError: Unknown option or part; or shapes of maps, batch and grid disagree.

    References:
        RADE-Net, equation (17).

    Examples:
        >>> maps = DetectionMaps(jnp.zeros((1, 256, 107, 2)), jnp.ones((1, 256, 107, 8)))
        >>> car = jnp.array([[[20.0, 0, 0, 4, 2, 1.5, 0, 1]]])
        >>> batch = Batch(None, car, jnp.array([[0]]), jnp.array([[True]]), frame=None)
        >>> loss = jax.jit(detection_loss, static_argnames="grid")
        >>> float(loss(maps, batch, RadarGrid.kradar())[0])
        4.0
    """
    check_weights(weights)
    _check(maps, batch, grid, assignment)
    boxes, is_valid = _objects(batch, is_frame_valid)
    logits = maps.heatmap_logits
    draw = partial(
        gaussian_heatmap, sigma_mode=heatmap_sigma_mode, sigma_bins=heatmap_sigma_bins
    )
    target = draw(boxes, batch.classes, is_valid, grid, num_classes=logits.shape[-1])
    pair = _pairs_at_centers if assignment == "center" else partial(_after_nms, nms)
    predicted, wanted, is_matched = pair(maps, boxes, is_valid, grid, z0_m)
    losses = BOX_LOSSES | {"gwd": partial(_gwd, gwd_tau, gwd_transform, normalize_yaw)}
    parts = {}
    for name in weights:
        if name == "focal":
            parts[name] = focal_loss(logits, target, is_frame_valid=is_frame_valid)
            continue
        values = losses[name](predicted, wanted)
        parts[name] = _mean_of_frames(values, is_matched, is_frame_valid)
    total = _weighted_sum(parts, weights, normalize)
    parts["weighted_sum"] = _weighted_sum(parts, weights, False)
    counted = {"objects": is_valid, "positive": target >= 1, "matched": is_matched}
    parts |= {f"num_{k}": jnp.sum(of, dtype=jnp.int32) for k, of in counted.items()}
    return total, parts


def whole_batch_loss(
    parts: dict[str, Num[jax.Array, " P"]],
    num_bins: Scalar | Int[jax.Array, " P"],
    weights: Weights = _WEIGHTS,
    normalize: bool = True,
) -> tuple[
    dict[str, Float[jax.Array, " P"]],
    Float[jax.Array, ""],
    dict[str, Num[jax.Array, ""]],
]:
    """The loss of a batch from those of its equal parts, and how parts sum to it.

    A part divides by its own positive bins and loss values, the batch by those of all.

    Args:
        parts: `[P]` each, what `detection_loss` gives beside the total for every part.
        num_bins: Of the heatmaps of one part, as many in all; counts where it has no
            positive bin.
        weights: As for `detection_loss`.
        normalize: Likewise.

    Returns:
        `[P]` weights by name: the mean over the parts of their losses, so weighted and
        not normalised, has the gradient of the batch. Then what `detection_loss` gives for
        the batch: total and its parts.

    Examples:
        >>> parts = dict.fromkeys(("focal", "gwd", "smooth_l1"), jnp.array([1.0, 3.0]))
        >>> parts["num_positive"] = jnp.array([1, 1])
        >>> _, total, whole = whole_batch_loss(parts, 100)
        >>> float(total), float(whole["focal"])
        (4.0, 2.0)
    """
    positive = parts["num_positive"].astype(jnp.float32)
    of_part = jnp.where(positive > 0, positive, num_bins)
    mean = jnp.mean(positive)
    share = of_part / jnp.where(mean > 0, mean, num_bins)
    shares = {k: share if k == "focal" else jnp.ones_like(share) for k in weights}
    whole = {name: jnp.mean(parts[name] * shares[name]) for name in weights}
    total = _weighted_sum(whole, weights, normalize)
    for name, weight in weights.items():
        value = whole[name] if normalize else jnp.float32(0.0)
        shares[name] *= weight / jnp.where(value > 0, value, 1.0)
    whole["weighted_sum"] = _weighted_sum(whole, weights, False)
    counts = {k: jnp.sum(v, axis=0) for k, v in parts.items() if k.startswith("num_")}
    return shares, total, whole | counts


def _objects(
    batch: Batch, is_frame_valid: Bool[jax.Array, " B"] | None
) -> tuple[Float[jax.Array, "B N 8"], Bool[jax.Array, "B N"]]:
    """Boxes as float32, and where they are objects."""
    is_valid = jnp.asarray(batch.is_valid)
    if is_frame_valid is not None:
        is_valid &= is_frame_valid[:, None]
    # Padding rows may hold anything; NaN times 0 would reach the gradients.
    boxes = jnp.where(is_valid[..., None], batch.boxes.astype(jnp.float32), 0.0)
    return boxes, is_valid


def smooth_l1(difference: Float[jax.Array, "*batch"]) -> Float[jax.Array, "*batch"]:
    """Quadratic below 1, linear above: `[...]` -> `[...]`.

    `optax.huber_loss` has the same values, but forms gradients as (x - 1) + 1, which
    loses the digits of small differences.

    Examples:
        >>> smooth_l1(jnp.array([0.5, 3.0])).tolist()
        [0.125, 2.5]
    """
    size = jnp.abs(difference)
    return jnp.where(size < 1.0, 0.5 * size * size, size - 0.5)


def _pairs_at_centers(
    maps: DetectionMaps,
    boxes: Float[jax.Array, "B N 8"],
    is_valid: Bool[jax.Array, "B N"],
    grid: RadarGrid,
    z0_m: Scalar,
) -> Pairs:
    """Predictions at the objects' own bins."""
    cell = grid.nearest_bin(boxes[..., 0], boxes[..., 1])  # [B, N, 2]
    predicted = boxes_at(_params_at(maps.box_params, cell), cell, grid, z0_m)
    return _neutral(predicted, boxes, is_valid)


def _after_nms(
    nms: NmsAssignment,
    maps: DetectionMaps,
    boxes: Float[jax.Array, "B N 8"],
    is_valid: Bool[jax.Array, "B N"],
    grid: RadarGrid,
    z0_m: Scalar,
) -> Pairs:
    """Predictions that survive NMS, and the objects that they overlap."""
    # Which boxes are compared is a choice, not a function to differentiate.
    fixed = jax.lax.stop_gradient(maps)
    peaks = find_peaks(
        fixed,
        grid,
        max_peaks=nms.max_peaks,
        score_threshold=nms.score_threshold,
        threshold_inclusive=nms.threshold_inclusive,
        z0_m=z0_m,
    )
    keep = suppress(peaks, nms.nms_iou, per_class=nms.per_class)

    match = partial(match_boxes, iou_threshold=nms.match_iou)
    matches = jax.vmap(match)(peaks.boxes, keep, boxes, is_valid)
    wanted = jax.vmap(lambda boxes, idx: boxes[idx])(boxes, matches.object_idx)
    params = _params_at(maps.box_params, peaks.cell)
    predicted = boxes_at(params, peaks.cell, grid, z0_m)
    return _neutral(predicted, wanted, matches.is_matched)


def _params_at(
    params: Float[jax.Array, "B R A 8"], cell: Int[jax.Array, "B N 2"]
) -> Float[jax.Array, "B N 8"]:
    """One gather per frame, so that a batch axis sharded over devices stays local."""
    return jax.vmap(lambda params, cell: params[cell[:, 0], cell[:, 1]])(params, cell)


def _neutral(
    predicted: Float[jax.Array, "B N 8"],
    wanted: Float[jax.Array, "B N 8"],
    is_matched: Bool[jax.Array, "B N"],
) -> Pairs:
    """Both boxes of unmatched rows replaced by one harmless box, without gradient."""
    row = is_matched[..., None]
    return jnp.where(row, predicted, 1.0), jnp.where(row, wanted, 1.0), is_matched


def _gwd(
    tau: float,
    transform: Transform,
    normalize_yaw: bool,
    predicted: Float[jax.Array, "B N 8"],
    wanted: Float[jax.Array, "B N 8"],
) -> Float[jax.Array, "B N"]:
    predicted = _with_unit_yaw(predicted) if normalize_yaw else predicted
    return gwd_loss(predicted, wanted, tau, transform)


def _with_unit_yaw(boxes: Float[jax.Array, "B N 8"]) -> Float[jax.Array, "B N 8"]:
    """Yaw vectors scaled to length 1; (0, 0) stays, with a finite gradient."""
    yaw = boxes[..., 6:8]
    square = jnp.sum(yaw * yaw, axis=-1, keepdims=True)
    is_long = square > 1e-12
    length = jnp.sqrt(jnp.where(is_long, square, 1.0))
    return jnp.concatenate([boxes[..., :6], yaw / length], axis=-1)


def _mean_of_frames(
    values: Float[jax.Array, "B N"],
    is_counted: Bool[jax.Array, "B N"],
    is_frame_valid: Bool[jax.Array, " B"] | None,
) -> Float[jax.Array, ""]:
    """Mean over the counted rows of a frame, then over frames."""
    total = jnp.sum(jnp.where(is_counted, values, 0.0), axis=1)
    per_frame = total / jnp.maximum(jnp.sum(is_counted, axis=1), 1)
    if is_frame_valid is None:
        return jnp.mean(per_frame)
    num_frames = jnp.sum(is_frame_valid, dtype=jnp.float32)
    return jnp.sum(per_frame * is_frame_valid) / jnp.maximum(num_frames, 1.0)


def _weighted_sum(
    parts: Mapping[str, Num[jax.Array, ""]], weights: Weights, normalize: bool
) -> Float[jax.Array, ""]:
    total = jnp.zeros((), jnp.float32)
    for name, weight in weights.items():
        part = parts[name]
        if normalize:
            constant = jax.lax.stop_gradient(part)
            part = part / jnp.where(constant > 0, constant, 1.0)
        total = total + weight * part
    return total


def check_weights(weights: Weights) -> None:
    """`UserError` for weights of no part, or of one that there is not.

    Examples:
        >>> check_weights({"focal": 2.0, "gwd": 1.0})
    """
    unknown = [name for name in weights if name not in loss_names()]
    if unknown or not weights:
        raise UserError(
            f"config.loss.weights has {unknown[0] if unknown else 'no part'!r}, expected "
            f"some of {', '.join(loss_names())}"
        )


def _check(maps: DetectionMaps, batch: Batch, grid: RadarGrid, assignment: str) -> None:
    if assignment not in ("center", "nms"):
        raise ValueError(f"assignment must be 'center' or 'nms', got {assignment!r}")
    logits, boxes = maps.heatmap_logits.shape, batch.boxes.shape
    if logits[1:3] != (grid.num_range, grid.num_azimuth):
        raise ValueError(
            f"maps have {logits[1]} x {logits[2]} range x azimuth bins, the grid "
            f"{grid.num_range} x {grid.num_azimuth}: pass the grid of the maps "
            "(grid.padded(...) where the model pads and does not crop)"
        )
    if len(boxes) != 3 or boxes[0] != logits[0] or boxes[2] != 8:
        raise ValueError(
            f"batch.boxes must be [{logits[0]}, N, 8] for these maps, got {boxes}"
        )
