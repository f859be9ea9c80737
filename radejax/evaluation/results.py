"""Results of an evaluation for all protocols, conditions, classes, spaces and IoUs.

Confidence intervals are computed by resampling whole sequences (cluster bootstrap),
because the frames of a sequence show the same few cars and are not independent. A
resample draws as many sequences as there are, with replacement. Every frame counts as
often as its sequence was drawn, which all protocols handle exactly.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, TypedDict

import numpy as np
import pydantic
from annotated_types import MinLen
from jaxtyping import Bool, Float, Int, Shaped

from radejax.core.errors import UserError, require
from radejax.core.files import JsonObject
from radejax.core.options import (
    AtLeastOne,
    BelowOne,
    Count,
    Fraction,
    Options,
    find_function,
)
from radejax.core.structures import CLASSES, MIN_SIZE_M, NARROW_ROI, Boxes
from radejax.data.kradar.conditions import WEATHERS
from radejax.evaluation import protocols
from radejax.evaluation.boxes import (
    AnyBoxes,
    AnyColumns,
    Columns,
    read_boxes,
    roi_bounds,
)
from radejax.evaluation.evaluation_set import EvaluationSet, Result, mean_ap

LEVEL = 0.95
"""Confidence level of all intervals."""

HOW_TO_CHOOSE = (
    "`radejax evaluate RUN` does so with config.data.validation, or on other labeled "
    "sequences that --split or --data name"
)
"""How to choose score thresholds, which is not done on a test split."""

Metric = Callable[[Boxes, Boxes], Float[np.ndarray, " K"]]
"""Own error of matched boxes: a function of the predictions and their objects, row by row."""

Region = Literal["narrow", "wide"] | tuple[float, ...] | None
Names = Annotated[tuple[str, ...], MinLen(1)]
Thresholds = Annotated[tuple[BelowOne, ...], MinLen(1)]


class EvaluationOptions(Options, section="config.evaluation"):
    """Options of every evaluation of a run."""

    roi: Region = NARROW_ROI
    """Region of interest: x0, x1, y0, y1, z0, z1 in meters; None: everywhere."""
    protocols: Names = ("coco101", "all_point", "kradar_r40")
    """Evaluation protocols, or module:Object; the first chooses the best checkpoint."""
    empty_frames: Literal["protocol", "class", "frame", "none"] = "protocol"
    """Frames that are excluded: protocol (by the protocol's own rule), class (frames
    without an object of the class), frame (frames without any object), none."""
    metrics: tuple[str, ...] = ()
    """Further errors of matched boxes, each module:function."""
    iou_thresholds: Thresholds = (0.3, 0.5)
    """IoU thresholds."""
    score_threshold: Fraction = 0.3
    """Score threshold of all protocols except all_point."""
    min_score: Fraction = 0.05
    """Predictions below this score are not stored."""
    wanted_precision: Fraction = 0.9
    """Precision for which a report chooses score thresholds, besides those of the best F1."""
    bootstrap: Count = 0
    """Number of bootstrap resamples of sequences for 95 % confidence intervals; 0: no
    intervals."""
    batch_size: AtLeastOne = 8
    """Frames per call of the detector."""
    num_visualizations: Count = 8
    """Number of figures of frames in a report."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> EvaluationOptions:
        for name in ("protocols", "iou_thresholds"):
            values = getattr(self, name)
            is_different = len(set(values)) == len(values)
            require(is_different, f"config.evaluation.{name}", values, "different ones")
        self.find_protocols(name for name in self.protocols if ":" not in name)
        roi_bounds(self.roi, "config.evaluation.roi")
        return self

    def find_protocols(self, names: Iterable[str] | None = None) -> None:
        """Raises `UserError` if one of the names (by default `protocols`) is not a protocol."""
        for name in self.protocols if names is None else names:
            protocols.get_protocol(name, "config.evaluation.protocols")

    def find_metrics(self) -> dict[str, Metric]:
        """Returns the functions of `metrics` by name.

        Raises:
            UserError: One of them cannot be imported.
        """
        field = "config.evaluation.metrics"
        return {
            place.partition(":")[2]: find_function(place, field)
            for place in self.metrics
        }


class Settings(TypedDict):
    """Settings of one protocol in a report, see `evaluate`."""

    score_threshold: float
    empty_frames: str


class ReportOptions(EvaluationOptions):
    """Options of one report, which may be of boxes without a run.

    Five defaults differ from those of a run. Boxes in files have no score threshold of
    their own, so that all of them count, in every protocol; and folders of results are named
    after changes of options, in which the region has its name and not its bounds.
    """

    iou_thresholds: Thresholds = (0.3, 0.5, 0.7)
    """IoU thresholds."""
    protocols: Names = tuple(protocols.PROTOCOLS)
    """Evaluation protocols."""
    score_threshold: Fraction = 0.0
    """Score threshold of all protocols except all_point."""
    min_score: Fraction = 0.0
    """Predictions below this score are neither stored nor evaluated."""
    roi: Region = "narrow"
    """Region of interest of ground truth and predictions."""
    classes: tuple[str, ...] = CLASSES
    """Classes to evaluate."""
    known_classes: tuple[str, ...] = ()
    """Further classes of the data, whose boxes are not evaluated unless they are in
    `classes`."""
    label_version: str | None = None
    """Label revision of the ground truth."""
    invalid_sizes: Literal["error", "false_positive"] = "error"
    """Treatment of predicted boxes with a size that is not positive: error, or
    false_positive to count them as predictions without a match."""
    plots: bool = True
    """Draw curves."""
    figures: Literal["png", "pdf"] = "png"
    """Format of the figures."""
    kitti: bool = False
    """Write the boxes as text files for K-Radar's evaluation script."""

    @property
    def paper_protocol(self) -> str:
        """Protocol for comparison with published rows: the authors', or else the first."""
        authors = protocols.AUTHORS_PROTOCOL
        return authors if authors in self.protocols else self.protocols[0]

    @property
    def main_protocols(self) -> tuple[str, ...]:
        """Protocols shown in full on the console and with intervals per weather."""
        shown = protocols.RECOMMENDED, "kradar_r40", self.paper_protocol
        return tuple(name for name in dict.fromkeys(shown) if name in self.protocols)

    def settings_of(self, protocol: str) -> Settings:
        """Returns the score threshold and empty-frame rule of a protocol for `results`."""
        if protocols.get_protocol(protocol).is_fixed:
            return {"score_threshold": self.min_score, "empty_frames": "protocol"}
        threshold = max(self.score_threshold, self.min_score)
        return {"score_threshold": threshold, "empty_frames": self.empty_frames}


SAME_NUMBERS = frozenset(
    [
        "batch_size",
        "bootstrap",
        "figures",
        "kitti",
        "num_visualizations",
        "plots",
        "wanted_precision",
    ]
)
"""Options of an evaluation that do not change its APs."""


def name_of_changes(changes: Mapping[str, object], usual: Mapping[str, object]) -> str:
    """Returns the end of a folder's name for options that change APs: `_roi_wide`.

    Args:
        changes: Options that were given.
        usual: Options otherwise.
    """
    words = [""]
    for field, value in changes.items():
        if field not in SAME_NUMBERS and value != usual.get(field):
            values = value if isinstance(value, tuple) else (value,)
            words += [field, *(re.sub(r"[\\/ ]+", "-", str(x)) for x in values)]
    return "_".join(words)


def make_set(
    ground_truth: AnyBoxes,
    predictions: AnyBoxes,
    frames: AnyColumns,
    options: ReportOptions,
) -> EvaluationSet:
    """Builds the evaluation set; repaired and clipped predictions are counted in it.

    Args:
        ground_truth: Boxes or columns as for `evaluation.evaluate`.
        predictions: The same with scores.
        frames: Frame table.
        options: Settings of the evaluation.

    Raises:
        UserError: An option is invalid, or a column is missing.
        DataError: A row is invalid; the message names the table, frame and row.
    """
    num_truncated = predictions.num_truncated if isinstance(predictions, Boxes) else 0
    predictions, num_invalid = repair_sizes(predictions, options.invalid_sizes)
    num_clipped = int(predictions.is_clipped.sum()) - num_invalid
    data = EvaluationSet(
        ground_truth,
        predictions,
        classes=options.classes,
        frames=frames,
        roi=options.roi,
        label_version=options.label_version,
        known=options.known_classes,
    )
    data.left_out |= {
        "predictions: size not positive, kept as false positives": num_invalid,
        f"predictions: size clipped to {MIN_SIZE_M} m, kept": num_clipped,
        "predictions: dropped at max_detections, as far as known": num_truncated,
    }
    return data


def compute_results(
    data: EvaluationSet, frames: Columns, options: ReportOptions
) -> list[Result]:
    """Computes the results of every protocol over all frames and the frames of weathers.

    With `options.bootstrap` and known sequences, all protocols have intervals over all
    frames, and the main protocols also per weather. The interval of a weather is computed
    by resampling its sequences. There is none if the frames, or those with objects of the
    class, are of a single sequence.

    Args:
        data: Evaluation set.
        frames: Frame table; only its columns weather and sequence are used.
        options: Settings of the evaluation.

    Returns:
        The results of all protocols. The last class of every group is "mean".
    """
    rows = []
    is_resampled = options.bootstrap and "sequence" in frames
    sequence = np.asarray(frames["sequence"]) if is_resampled else None
    everything = {"all": np.ones(data.frame.size, bool)}
    for condition, mask in (everything | condition_masks(frames, "weather")).items():
        resampled = options.protocols if condition == "all" else options.main_protocols
        part = data
        weights = None
        if sequence is not None and np.unique(sequence[mask]).size > 1:
            part = data if mask.all() else data.of_frames(mask)
            is_single = in_one_sequence(part, sequence[mask])
            weights = sequence_weights(sequence[mask], resamples=options.bootstrap)
        for protocol in options.protocols:
            settings = options.settings_of(protocol)
            results = data.results(
                protocol,
                iou_thresholds=options.iou_thresholds,
                weights=mask,
                curves=False,
                **settings,
            )
            for start in range(0, len(results), len(data.classes)):
                group = results[start : start + len(data.classes)]
                group.append(_mean(group))
                if weights is not None and protocol in resampled:
                    metric = protocol, group[0].space, group[0].iou
                    samples = resample(part, weights, *metric, **settings)
                    samples[:, is_single] = np.nan
                    pairs = zip(group, map(interval, samples.T), strict=True)
                    group = [
                        dataclasses.replace(row, low=low, high=high)
                        for row, (low, high) in pairs
                    ]
                rows += [dataclasses.replace(row, condition=condition) for row in group]
    # The results are sorted by protocol, then by condition.
    return sorted(rows, key=lambda row: options.protocols.index(row.protocol))


def _mean(group: Sequence[Result]) -> Result:
    """Returns the result "mean" over the classes of one space and IoU threshold."""
    return dataclasses.replace(
        group[0],
        cls="mean",
        ap=mean_ap(group),
        num_gt=sum(result.num_gt for result in group),
        num_det=sum(result.num_det for result in group),
        num_frames=max(result.num_frames for result in group),
    )


def sequence_weights(
    sequence: Shaped[np.ndarray, " F"], *, resamples: int, seed: int = 0
) -> Int[np.ndarray, "B F"]:
    """Draws how often each frame counts in each resample, as int16.

    Args:
        sequence: Sequence of every frame.
        resamples: Number of resamples B.
        seed: Random seed; the same seed draws the same sequences.

    Raises:
        UserError: There are fewer than two sequences.
    """
    names, inverse = np.unique(sequence, return_inverse=True)
    if names.size < 2:
        raise UserError(
            f"intervals need at least 2 sequences to resample, found {names.size}: evaluate "
            "more, such as --split all, or give --bootstrap 0"
        )
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(names.size, np.full(names.size, 1 / names.size), resamples)
    return drawn.astype(np.int16)[:, inverse]


def resample(
    data: EvaluationSet,
    weights: Int[np.ndarray, "B F"],
    protocol: str,
    space: str,
    iou: float,
    **settings: Any,
) -> Float[np.ndarray, "B _"]:
    """Computes `[B, C + 1]` APs of every class and their mean in every resample.

    The AP is NaN if a resample has no object of the class. The mean is over the classes
    that occur.

    Args:
        data: Predictions and ground truth.
        weights: How often each frame counts in each resample, see `sequence_weights`.
        protocol: One of `protocols.PROTOCOLS`.
        space: "bev" or "3d".
        iou: A match needs an IoU above it.
        **settings: Further arguments of `EvaluationSet.results`.
    """
    settings |= {"iou_thresholds": iou, "spaces": space}
    samples = []
    for weight in weights:
        results = data.results(protocol, weights=weight, curves=False, **settings)
        samples.append([*(result.ap_or_none for result in results), mean_ap(results)])
    return np.array(samples, np.float64)  # None becomes NaN


def in_one_sequence(
    data: EvaluationSet, sequence: Shaped[np.ndarray, " F"]
) -> Bool[np.ndarray, " _"]:
    """Returns a mask `[C + 1]` of the classes whose objects are in a single sequence.

    Their APs hardly vary when sequences are resampled. The last entry, of the mean, is True
    if this holds for every class that occurs.

    Args:
        data: Predictions and ground truth.
        sequence: Sequence of every frame.
    """
    counts = [np.unique(sequence[has]).size for has in data.gt_count.T > 0]
    return np.array([*(count == 1 for count in counts), max(counts) < 2])


def interval(samples: Float[np.ndarray, " B"]) -> tuple[float, float]:
    """Computes the 95 % percentile interval of the samples that are not NaN.

    Both ends are NaN if there are none.
    """
    samples = samples[~np.isnan(samples)]
    if not samples.size:
        return float("nan"), float("nan")
    low, high = np.quantile(samples, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def condition_masks(frames: AnyColumns, kind: str) -> dict[str, Bool[np.ndarray, " F"]]:
    """Returns the mask of frames for each value in a column of the frame table.

    K-Radar's weathers come first, in their order.

    Args:
        frames: Frame table.
        kind: Name of the column, such as "weather".
    """
    if kind not in frames:
        return {}
    column = np.asarray(frames[kind]).astype(str)
    present = np.unique(column).tolist()
    ordered = dict.fromkeys((*WEATHERS, *present))
    return {name: column == name for name in ordered if name in present}


def exclusion_counts(data: EvaluationSet, options: ReportOptions) -> dict[str, int]:
    """Counts the boxes and frames that are excluded from the results, by reason."""
    fixed = [p for p in options.protocols if protocols.get_protocol(p).is_fixed]
    threshold = max(options.score_threshold, options.min_score)
    is_kept = data.score > threshold
    but = f" (counted by {', '.join(fixed)})" if threshold > options.min_score else ""
    is_empty = data.gt_count.sum(axis=1) == 0
    is_other = data.gt_count[data.pred.frame, data.pred.cls] == 0
    in_empty = is_empty[data.pred.frame] & is_kept
    in_other = is_other & is_kept
    is_unknown = data.gt_count.sum(axis=0)[data.pred.cls] == 0
    masks = {
        f"predictions: score not above {threshold:g}{but}": ~is_kept,
        "frames: without ground truth (ignored by skip=frame)": is_empty,
        "predictions: in frames without ground truth (ignored by skip=frame)": in_empty,
        "predictions: in frames without their class (ignored by skip=class)": in_other,
        "predictions: of classes without ground truth, which have no AP": is_unknown,
    }
    return data.left_out | {what: int(mask.sum()) for what, mask in masks.items()}


def repair_sizes(predictions: AnyBoxes, rule: str) -> tuple[Boxes, int]:
    """Repairs boxes with sizes that are not positive, as of an untrained network.

    Args:
        predictions: Boxes or columns as for `evaluation.evaluate`.
        rule: "error" does not change them; "false_positive" sets all sizes of such boxes
            to a micrometer, so that they match nothing but count as predictions.

    Returns:
        The predictions and the number of changed boxes.
    """
    found = read_boxes(predictions, "predictions", scored=True)
    is_invalid = (found.box[:, 3:6] <= 0).any(axis=1) & (rule == "false_positive")
    box = found.box.copy()
    box[is_invalid, 3:6] = 1e-6
    return dataclasses.replace(found, box=box), int(is_invalid.sum())


def to_row(result: Result) -> JsonObject:
    """Converts a result to one row of metrics.json and metrics.csv."""
    others = ["ap", "precision", "recall", "score", "low", "high", "is_simulated"]
    terms = {name: value for name, value in vars(result).items() if name not in others}
    return {
        "name": f"{result.cls}/{result.condition}/{result.metric}",
        **terms,
        "ap": result.ap_or_none,
        "ap_low": result.low,
        "ap_high": result.high,
        "ap_official": result.ap,
    }
