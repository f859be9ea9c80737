"""The training loss of both detectors: focal, Gaussian Wasserstein and smooth L1 loss."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import pydantic
from flax.core import freeze
from jaxtyping import Bool, Float, Int, Num, Shaped

from radejax.core.errors import require
from radejax.core.options import NotNegative, Options, Positive, find_function
from radejax.core.structures import Batch, DetectionMaps
from radejax.detection.decode import DecodeOptions, find_peaks, rows_at
from radejax.detection.nms import match_boxes, rotated_nms
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.focal import SigmaMode, focal_loss, gaussian_heatmap
from radejax.losses.gwd import Transform, gwd_loss

Scalar = Num[jax.Array, ""]
Maps = Float[jax.Array, "B R A C"]
Boxes8 = Float[jax.Array, "B N 8"]
Mask = Bool[jax.Array, "B N"]

_MAX_PEAKS = 128
"""Maximum number of peaks that enter NMS for the assignment "nms"."""


class LossOptions(Options, section="config.loss"):
    """Options of `detection_loss`."""

    heatmap_sigma_mode: SigmaMode = "fixed"
    """Standard deviation of the Gaussian heatmap targets: fixed, adaptive (depends on
    the size of the box), anisotropic (depends on its length and width)."""
    heatmap_sigma_bins: Positive = 3.0
    """Standard deviation in the mode fixed, in bins."""
    gwd_transform: Transform = "sqrt"
    """Transform of the Wasserstein distance: sqrt (paper), none (authors' code), log1p."""
    gwd_tau: Positive = 1.65
    """Loss of a distance d: 1 - 1 / (tau + transform(d))."""
    normalize_yaw: bool = False
    """Normalize the predicted yaw vector before the Wasserstein distance. The authors' code
    does not. Smooth L1 always uses the raw vector, so that the network learns to predict
    unit length."""
    assignment: Literal["center", "nms"] = "center"
    """Boxes of the regression losses: center (predictions at the objects' own bins, as
    released) or nms (predictions that overlap an object after NMS, with the thresholds of
    decode, as in the paper)."""
    own_terms: tuple[str, ...] = ()
    """Other loss terms, each module:function."""
    weights: Annotated[
        Mapping[str, NotNegative],
        pydantic.AfterValidator(freeze),
        pydantic.PlainSerializer(dict),
    ] = freeze({"focal": 2.0, "gwd": 1.0, "smooth_l1": 1.0})
    """Weight of every loss term: focal, gwd, smooth_l1 and the functions of `own_terms` by
    name. A loss without a weight is not computed."""
    normalize: bool = True
    """Divide each term by its own value, without a gradient through the divisor. The
    value of the loss is then the sum of the weights."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> LossOptions:
        are_places = all(":" in place for place in self.own_terms)
        name = "config.loss.own_terms"
        require(are_places, name, self.own_terms, "names like module:function")
        own = {place.partition(":")[2] for place in self.own_terms}
        terms = [*LOSSES, *sorted(own)]
        is_complete = own <= set(self.weights) <= set(terms)
        expected = (
            f"numbers of at least 0, not all 0, for some of {', '.join(terms)}, and for "
            "all of own_terms"
        )
        is_fine = is_complete and any(self.weights.values())
        require(is_fine, "config.loss.weights", dict(self.weights), expected)
        return self

    def find_terms(self) -> dict[str, Callable[..., Float[jax.Array, ""]]]:
        """Returns all loss functions by name, those of `own_terms` included.

        Raises:
            UserError: One of `own_terms` cannot be imported.
        """
        terms = dict(LOSSES)
        for place in self.own_terms:
            name = place.partition(":")[2]
            terms[name] = find_function(place, "config.loss.own_terms")
        return terms


def detection_loss(
    maps: DetectionMaps,
    batch: Batch,
    grid: RadarGrid,
    options: LossOptions | None = None,
    decoding: DecodeOptions | None = None,
) -> tuple[Float[jax.Array, ""], dict[str, Scalar]]:
    """Computes the weighted sum of the losses in `weights`, and its terms, in float32.

    Box losses are averaged over the matched boxes of each frame (0 if it has none), then
    over all frames of the batch, whether it is sharded or not.

    Args:
        maps: Predictions, `[B, R, A, C]` logits and `[B, R, A, 8]` box parameters.
        batch: Ground truth, of which `boxes`, `classes`, `is_valid` and `targets` are
            used; own terms may use all of it.
        grid: The grid of the maps, padded if they are.
        options: Options of the loss; the defaults are the paper's except for `assignment`.
        decoding: Thresholds of peaks and NMS for the assignment "nms", which should be
            those of inference.

    Returns:
        Scalar total, and a dictionary of scalars: the raw losses, their `weighted_sum`,
        `num_objects`, `num_positive` (bins) and `num_matched` (boxes).

    Raises:
        ValueError: The shapes of maps, batch and grid do not match.

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
    options = options or LossOptions()
    grid.check_maps(maps.heatmap_logits, maps.box_params)
    shape = batch.boxes.shape
    if len(shape) != 3 or shape[0] != len(maps.heatmap_logits) or shape[2] != 8:
        raise ValueError(
            f"batch.boxes must be [{len(maps.heatmap_logits)}, N, 8] for these maps, "
            f"got {shape}"
        )
    is_valid = jnp.asarray(batch.is_valid)
    # Padding rows may contain NaN, which a mask of zeros would not keep from the gradients.
    boxes = jnp.where(is_valid[..., None], batch.boxes.astype(jnp.float32), 0.0)
    target = gaussian_heatmap(
        boxes,
        batch.classes,
        is_valid,
        grid,
        num_classes=maps.heatmap_logits.shape[-1],
        sigma_mode=options.heatmap_sigma_mode,
        sigma_bins=options.heatmap_sigma_bins,
    )
    # The bins of the predictions that are compared, their objects, and a mask of those
    # that have one.
    truth = {"boxes": boxes}
    truth |= {name: jnp.asarray(x) for name, x in batch.targets.items()}
    if options.assignment == "center":
        bins = grid.nearest_bin(boxes[..., 0], boxes[..., 1])  # [B, N, 2]
        is_matched = is_valid
    else:
        bins, object_idx, is_matched = _after_nms(
            decoding or DecodeOptions(), maps, boxes, is_valid, grid
        )
        truth = {name: rows_at(x, object_idx) for name, x in truth.items()}
    expected = truth.pop("boxes")
    predicted = grid.boxes_at(_at_bins(maps.box_params, bins), bins)
    row = is_matched[..., None]
    pairs = Pairs(
        maps.heatmap_logits,
        target,
        # In unmatched rows, both boxes are replaced by the same constant box, so that the
        # losses and their gradients are finite.
        jnp.where(row, predicted, 1.0),
        jnp.where(row, expected, 1.0),
        is_matched,
        outputs={name: _at_bins(x, bins) for name, x in maps.outputs.items()},
        targets={name: jnp.nan_to_num(x) for name, x in truth.items()},
        is_known={
            name: is_matched & jnp.isfinite(x).reshape(*is_matched.shape, -1).all(-1)
            for name, x in truth.items()
        },
        maps=maps,
        batch=batch,
    )
    functions = options.find_terms()
    terms = {name: functions[name](pairs, options) for name in options.weights}
    total = _weighted_sum(terms, options.weights, options.normalize)
    terms["weighted_sum"] = _weighted_sum(terms, options.weights, False)
    counted = {"objects": is_valid, "positive": target >= 1, "matched": is_matched}
    terms |= {f"num_{k}": jnp.sum(of, dtype=jnp.int32) for k, of in counted.items()}
    return total, terms


# A gather per frame needs no communication if the batch is sharded over devices.
@jax.vmap
def _at_bins(
    values: Shaped[jax.Array, "R A ..."], bins: Int[jax.Array, "K 2"]
) -> Shaped[jax.Array, "K ..."]:
    """Returns the values of every frame at bins: `[B, R, A, ...]` -> `[B, K, ...]`."""
    return values[bins[:, 0], bins[:, 1]]


# Terms -------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Predictions and their targets, which the loss terms compare.

    Attributes:
        logits: `[B, R, A, C]` heatmap logits.
        target: `[B, R, A, C]` target heatmap.
        predicted: `[B, N, 8]` predicted boxes, where N is the number of objects, or of
            peaks for the assignment "nms".
        expected: `[B, N, 8]` boxes of the matched objects.
        is_matched: `[B, N]` bool, True where a predicted box is matched with an object.
        outputs: `[B, N, ...]` further outputs of the model at the predicted boxes' bins, by
            name, see `config.model.outputs`.
        targets: `[B, N, ...]` columns of the matched objects by name, see
            `config.data.targets`; 0 where they are not known.
        is_known: `[B, N]` bool by name, True where a matched object has all values of a
            target.
        maps: All predictions.
        batch: Whole ground truth and inputs.
    """

    logits: Maps
    target: Maps
    predicted: Boxes8
    expected: Boxes8
    is_matched: Mask
    outputs: Mapping[str, jax.Array]
    targets: Mapping[str, jax.Array]
    is_known: Mapping[str, Mask]
    maps: DetectionMaps
    batch: Batch

    def mean(
        self, values: Float[jax.Array, "B N"], where: Mask | None = None
    ) -> Float[jax.Array, ""]:
        """Averages values over the matched boxes of each frame, then over frames.

        Args:
            values: `[B, N]` values.
            where: `[B, N]` mask of the boxes that count; `is_matched` if None.
        """
        counts = self.is_matched if where is None else where
        total = jnp.sum(jnp.where(counts, values, 0.0), axis=1)
        return jnp.mean(total / jnp.maximum(jnp.sum(counts, axis=1), 1))


def _focal(pairs: Pairs, _: LossOptions) -> Float[jax.Array, ""]:
    return focal_loss(pairs.logits, pairs.target)


def _gwd(pairs: Pairs, options: LossOptions) -> Float[jax.Array, ""]:
    predicted = pairs.predicted
    if options.normalize_yaw:
        predicted = _with_unit_yaw(predicted)
    loss = gwd_loss(predicted, pairs.expected, options.gwd_tau, options.gwd_transform)
    return pairs.mean(loss)


def _smooth_l1(pairs: Pairs, _: LossOptions) -> Float[jax.Array, ""]:
    return pairs.mean(jnp.mean(smooth_l1(pairs.predicted - pairs.expected), -1))


LOSSES: dict[str, Callable[..., Float[jax.Array, ""]]] = {
    "focal": _focal,
    "gwd": _gwd,
    "smooth_l1": _smooth_l1,
}
"""Terms of the loss by their name in `LossOptions.weights`."""


def smooth_l1(difference: Float[jax.Array, "*batch"]) -> Float[jax.Array, "*batch"]:
    """Computes the smooth L1 loss, which is quadratic below 1 and linear above, elementwise.

    `optax.huber_loss` has the same values, but computes gradients as (x - 1) + 1, which
    loses precision for small differences.

    Args:
        difference: Predicted minus expected values.

    Examples:
        >>> smooth_l1(jnp.array([0.5, 3.0])).tolist()
        [0.125, 2.5]
    """
    size = jnp.abs(difference)
    return jnp.where(size < 1.0, 0.5 * size * size, size - 0.5)


def _with_unit_yaw(boxes: Boxes8) -> Boxes8:
    """Normalizes yaw vectors; (0, 0) is unchanged and has a finite gradient."""
    yaw = boxes[..., 6:8]
    square = jnp.sum(yaw * yaw, axis=-1, keepdims=True)
    is_long = square > 1e-12
    length = jnp.sqrt(jnp.where(is_long, square, 1.0))
    return jnp.concatenate([boxes[..., :6], yaw / length], axis=-1)


def _weighted_sum(
    terms: Mapping[str, Scalar], weights: Mapping[str, float], normalize: bool
) -> Float[jax.Array, ""]:
    total = jnp.zeros((), jnp.float32)
    for name, weight in weights.items():
        term = terms[name]
        if normalize:
            constant = jax.lax.stop_gradient(term)
            term = term / jnp.where(constant > 0, constant, 1.0)
        total = total + weight * term
    return total


# Assignment --------------------------------------------------------------------------


def _after_nms(
    decoding: DecodeOptions,
    maps: DetectionMaps,
    boxes: Boxes8,
    is_valid: Mask,
    grid: RadarGrid,
) -> tuple[Int[jax.Array, "B K 2"], Int[jax.Array, "B K"], Bool[jax.Array, "B K"]]:
    """Assigns to each prediction that survives NMS the object that it overlaps most.

    Returns:
        Bins of K peaks, the indices of their objects, and a mask of the peaks that have one.
    """
    # The selection of boxes is not differentiable.
    peaks = find_peaks(
        jax.lax.stop_gradient(maps),
        grid,
        max_peaks=_MAX_PEAKS,
        score_threshold=decoding.score_threshold,
        threshold_inclusive=decoding.threshold_inclusive,
    )
    classes = peaks.classes if decoding.per_class_nms else None
    keep = rotated_nms(peaks.boxes, peaks.is_valid, decoding.nms_iou, classes=classes)
    match = jax.vmap(match_boxes)
    object_idx, is_matched = match(peaks.boxes, keep, boxes, is_valid)
    return peaks.bins, object_idx, is_matched
