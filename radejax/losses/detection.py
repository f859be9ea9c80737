"""The training loss of both systems: focal + Gaussian Wasserstein + smooth L1."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp

from radejax.core.structures import Batch, DetectionMaps
from radejax.detection.decode import boxes_at, find_peaks, suppress
from radejax.detection.matching import match_boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.focal import Sigma, focal_loss, gaussian_heatmap
from radejax.losses.gwd import Root, Transform, gwd_loss

Matching = Literal["center", "nms"]


def detection_loss(
    maps: DetectionMaps,
    batch: Batch,
    grid: RadarGrid,
    *,
    sigma: Sigma = "fixed",
    sigma_cells: float = 3.0,
    gwd_transform: Transform = "sqrt",
    gwd_tau: float = 1.65,
    gwd_root: Root = "eigh",
    normalize_yaw: bool = False,
    matching: Matching = "center",
    weights: tuple[float, float, float] = (2.0, 1.0, 1.0),
    normalize: bool = True,
    z0_m: float | jax.Array = 0.0,
    is_frame_valid: jax.Array | None = None,
    max_peaks: int = 128,
    score_threshold: float | jax.Array = 0.3,
    nms_iou: float | jax.Array = 0.3,
    match_iou: float | jax.Array = 0.0,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Weighted sum of the three losses over a batch, and its parts.

    The regression losses are means over the matched boxes of a frame, then over all
    frames; frames without any count as 0. Sums and means run over the whole batch, so
    a batch sharded over devices gives the same result under `jax.jit`. Everything is
    computed in float32 whatever the dtype of the maps.

    Args:
        maps: Predictions, `[B, R, A, C]` logits and `[B, R, A, 8]` box parameters.
        batch: Ground truth: `boxes`, `classes`, `is_valid` are read.
        grid: The grid of the maps (padded where they are).
        sigma: Target shape, see `gaussian_heatmap`.
        sigma_cells: Standard deviation of targets in bins, for "fixed".
        gwd_transform: See `gwd_loss`; "sqrt" in the paper, "none" as released.
        gwd_tau: See `gwd_loss`.
        gwd_root: See `gwd`.
        normalize_yaw: Scale the predicted yaw vector to length 1 before the Gaussian
            Wasserstein distance (released: raw). Smooth L1 always sees it raw, which
            is what teaches the network its length.
        matching: "center": the box parameters at each object's own bin are compared
            with that object (as released). "nms": every predicted box that survives
            NMS is compared with the object it overlaps most (the paper's text).
        weights: Of focal, GWD and smooth L1.
        normalize: Divide each part by its own value, held constant: the reported total
            is then constant and the gradients of the parts have the ratio `weights`.
            Parts that are 0, as in a batch without objects, add nothing.
        z0_m: Sensor height added to the regressed z.
        is_frame_valid: `[B]` bool, False for frames that only fill up a batch.
        max_peaks: Peaks that enter NMS, for "nms".
        score_threshold: Peaks must score above it, for "nms".
        nms_iou: Overlap that suppresses, for "nms".
        match_iou: A box has an object where they overlap more than this, for "nms".

    Returns:
        Scalar total, and a dict of scalars: raw `focal`, `gwd`, `smooth_l1` and their
        weighted sum `weighted_sum` for logging, `num_objects`, `num_positive` (bins
        that count as positive), `num_matched` (boxes in the regression losses).

    Raises:
        ValueError: Unknown option, or shapes of maps, batch and grid disagree.

    References:
        RADE-Net, equation (17).
    """
    _check(maps, batch, grid, matching)
    is_valid, boxes = batch.is_valid, batch.boxes.astype(jnp.float32)
    if is_frame_valid is not None:
        is_valid &= is_frame_valid[:, None]
    # Padding rows may hold anything; NaN times 0 would reach the gradients.
    boxes = jnp.where(is_valid[..., None], boxes, 0.0)
    target = gaussian_heatmap(
        boxes,
        batch.classes,
        is_valid,
        grid,
        num_classes=maps.heatmap_logits.shape[-1],
        sigma=sigma,
        sigma_cells=sigma_cells,
    )
    focal = focal_loss(maps.heatmap_logits, target, is_frame_valid=is_frame_valid)
    if matching == "center":
        predicted, wanted, is_matched = _pairs_at_centers(
            maps, boxes, is_valid, grid, z0_m
        )
    else:
        predicted, wanted, is_matched = _pairs_after_nms(
            maps,
            boxes,
            is_valid,
            grid,
            z0_m,
            max_peaks=max_peaks,
            score_threshold=score_threshold,
            nms_iou=nms_iou,
            match_iou=match_iou,
        )
    for_gwd = _with_unit_yaw(predicted) if normalize_yaw else predicted
    per_box_gwd = gwd_loss(for_gwd, wanted, gwd_tau, gwd_transform, root=gwd_root)
    gwd = _mean_of_frames(per_box_gwd, is_matched, is_frame_valid)
    per_box_l1 = jnp.mean(smooth_l1(predicted - wanted), axis=-1)
    l1 = _mean_of_frames(per_box_l1, is_matched, is_frame_valid)
    parts = {"focal": focal, "gwd": gwd, "smooth_l1": l1}
    total = _weighted_sum(parts, weights, normalize)
    parts["weighted_sum"] = _weighted_sum(parts, weights, False)
    parts["num_objects"] = jnp.sum(is_valid, dtype=jnp.int32)
    parts["num_positive"] = jnp.sum(target >= 1, dtype=jnp.int32)
    parts["num_matched"] = jnp.sum(is_matched, dtype=jnp.int32)
    return total, parts


def smooth_l1(difference: jax.Array) -> jax.Array:
    """Quadratic below 1, linear above: `[...]` -> `[...]`.

    `optax.huber_loss` has the same values, but forms gradients as (x - 1) + 1, which
    loses the digits of small differences.
    """
    size = jnp.abs(difference)
    return jnp.where(size < 1.0, 0.5 * size * size, size - 0.5)


def _pairs_at_centers(
    maps: DetectionMaps,
    boxes: jax.Array,
    is_valid: jax.Array,
    grid: RadarGrid,
    z0_m: float | jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Predictions at the objects' bins and the objects: `[B, N, 8]` each, `[B, N]`."""
    cell = grid.nearest_cell(boxes[..., 0], boxes[..., 1])  # [B, N, 2]
    predicted = boxes_at(_params_at(maps.box_params, cell), cell, grid, z0_m)
    return _neutral(predicted, boxes, is_valid)


def _pairs_after_nms(
    maps: DetectionMaps,
    boxes: jax.Array,
    is_valid: jax.Array,
    grid: RadarGrid,
    z0_m: float | jax.Array,
    *,
    max_peaks: int,
    score_threshold: float | jax.Array,
    nms_iou: float | jax.Array,
    match_iou: float | jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Predictions that survive NMS and their objects: `[B, P, 8]` each, `[B, P]`."""
    # Which boxes are compared is a choice, not a function to differentiate.
    fixed = jax.lax.stop_gradient(maps)
    peaks = find_peaks(
        fixed, grid, max_peaks=max_peaks, score_threshold=score_threshold, z0_m=z0_m
    )
    keep = suppress(peaks, nms_iou)

    def match(predicted, is_predicted, objects, is_object):
        return match_boxes(
            predicted, is_predicted, objects, is_object, iou_threshold=match_iou
        )

    matches = jax.vmap(match)(peaks.boxes, keep, boxes, is_valid)
    wanted = jax.vmap(lambda boxes, idx: boxes[idx])(boxes, matches.object_idx)
    params = _params_at(maps.box_params, peaks.cell)
    predicted = boxes_at(params, peaks.cell, grid, z0_m)
    return _neutral(predicted, wanted, matches.is_matched)


def _params_at(params: jax.Array, cell: jax.Array) -> jax.Array:
    """`[B, R, A, 8]` at `[B, N, 2]` -> `[B, N, 8]`; one gather per frame, so that a
    batch axis sharded over devices stays local."""
    return jax.vmap(lambda params, cell: params[cell[:, 0], cell[:, 1]])(params, cell)


def _neutral(
    predicted: jax.Array, wanted: jax.Array, is_matched: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Both boxes of unmatched rows replaced by one harmless box, without gradient."""
    row = is_matched[..., None]
    return jnp.where(row, predicted, 1.0), jnp.where(row, wanted, 1.0), is_matched


def _with_unit_yaw(boxes: jax.Array) -> jax.Array:
    """Yaw vectors scaled to length 1; (0, 0) stays, with a finite gradient."""
    yaw = boxes[..., 6:8]
    square = jnp.sum(yaw * yaw, axis=-1, keepdims=True)
    is_long = square > 1e-12
    length = jnp.sqrt(jnp.where(is_long, square, 1.0))
    return jnp.concatenate([boxes[..., :6], yaw / length], axis=-1)


def _mean_of_frames(
    values: jax.Array, is_counted: jax.Array, is_frame_valid: jax.Array | None
) -> jax.Array:
    """Mean over the counted rows of a frame, then over frames: `[B, N]` -> scalar."""
    total = jnp.sum(jnp.where(is_counted, values, 0.0), axis=1)
    per_frame = total / jnp.maximum(jnp.sum(is_counted, axis=1), 1)
    if is_frame_valid is None:
        return jnp.mean(per_frame)
    num_frames = jnp.sum(is_frame_valid, dtype=jnp.float32)
    return jnp.sum(per_frame * is_frame_valid) / jnp.maximum(num_frames, 1.0)


def _weighted_sum(
    parts: dict[str, jax.Array], weights: tuple[float, float, float], normalize: bool
) -> jax.Array:
    total = jnp.zeros((), jnp.float32)
    for weight, name in zip(weights, ("focal", "gwd", "smooth_l1"), strict=True):
        part = parts[name]
        if normalize:
            constant = jax.lax.stop_gradient(part)
            part = part / jnp.where(constant > 0, constant, 1.0)
        total = total + weight * part
    return total


def _check(maps: DetectionMaps, batch: Batch, grid: RadarGrid, matching: str) -> None:
    if matching not in ("center", "nms"):
        raise ValueError(f"matching must be 'center' or 'nms', got {matching!r}")
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
