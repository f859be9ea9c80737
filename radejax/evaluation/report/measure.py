"""All numbers of one run: every protocol, condition, class, space and IoU threshold."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from radejax.core.errors import UserError
from radejax.core.structures import CLASSES, MIN_SIZE_M, RARE_SHARE
from radejax.data.kradar.sequences import WEATHERS
from radejax.evaluation import protocols
from radejax.evaluation.columns import AnyColumns, Columns, are_simulated, in_roi
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import PROTOCOL_DEFAULT
from radejax.evaluation.report import published
from radejax.evaluation.result import Result, mean_ap

ENVIRONMENTS = (
    "urban highway countryside alleyway parkinglots shoulder mountain university"
)
ORDER = {
    "weather": WEATHERS,
    "environment": tuple(ENVIRONMENTS.split()),
    "time": ("day", "night"),
}
"""K-Radar's tags in the order of its papers."""

_OF_RESULT = (
    *("num_gt", "num_det", "num_frames", "score_threshold"),
    *("empty_frames", "roi", "label_version"),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What a report contains; everything that changes a number is here.

    Attributes:
        run: Name of the run in tables.
        classes: Classes evaluated.
        iou_thresholds: IoU thresholds.
        protocols: Names of protocols.
        score_threshold: Score cut of all APs.
        empty_frames: Frame rule; "protocol" takes each protocol's own.
        uncut: Protocols without the score cut and with their own frame rule.
        min_score: Predictions were stored from here on: nothing is cut below it.
        roi: Region of interest for both sides.
        label_version: Label revision of the ground truth.
        operating_score: Precision, recall, confusion and worst frames are of predictions
            above this score.
        bootstrap: Number of resamples of sequences for intervals; 0 for none.
        seed: Of the resampling.
        worst_frames: How many of the worst frames to list.
        plots: Draw curves.
        invalid_sizes: "error", or "false_positive": predicted boxes with a size that is
            not positive overlap nothing but still count.
        rare: Classes and conditions, from `rare_classes`, whose APs are marked.
        left_out_before: Counts of what loading left out already, to be printed.
        warnings: What loading has to say of the numbers, to be printed.
        draw_frame: Called with (frame id, path of a picture to write) for each of the
            worst frames, or None.
    """

    run: str = "ours"
    classes: tuple[str, ...] = CLASSES
    iou_thresholds: tuple[float, ...] = (0.3, 0.5, 0.7)
    protocols: tuple[str, ...] = tuple(protocols.PROTOCOLS)
    score_threshold: float = 0.0
    empty_frames: str | None = PROTOCOL_DEFAULT
    uncut: tuple[str, ...] = ()
    min_score: float = 0.0
    roi: str | Sequence[float] | None = "narrow"
    label_version: str | None = None
    operating_score: float = 0.3
    bootstrap: int = 0
    seed: int = 0
    worst_frames: int = 10
    plots: bool = True
    invalid_sizes: str = "error"
    rare: tuple[tuple[str, str], ...] = ()
    left_out_before: Mapping[str, int] = dataclasses.field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    draw_frame: Callable[[int, Any], None] | None = None

    @property
    def paper_protocol(self) -> str:
        """Protocol of the rows that stand beside published ones: theirs, or the first."""
        authors = published.AUTHORS_PROTOCOL
        return authors if authors in self.protocols else self.protocols[0]

    @property
    def main_protocols(self) -> tuple[str, ...]:
        """Protocols shown in full on the console: the usual ones, or else the first."""
        usual = ("all_point", "kradar_r40", "coco101")
        chosen = tuple(name for name in usual if name in self.protocols)
        return chosen or self.protocols[:1]

    def cut(self, protocol: str) -> float:
        """Score that predictions need more than."""
        own = 0.0 if protocol in self.uncut else self.score_threshold
        return max(own, self.min_score)

    def frame_rule(self, protocol: str) -> str | None:
        """As `empty_frames`."""
        return PROTOCOL_DEFAULT if protocol in self.uncut else self.empty_frames

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a report, without callbacks."""
        values = dataclasses.asdict(dataclasses.replace(self, draw_frame=None))
        del values["draw_frame"]
        return values


@dataclasses.dataclass(frozen=True)
class Measured:
    """A result, the condition it holds for and the official number.

    Attributes:
        kind: "all", or the column of the frame table: "weather".
        condition: "all" or a value of that column.
        result: The result without its curve.
        low: Lower end of the 95 % bootstrap interval, or None.
        high: Upper end.
    """

    kind: str
    condition: str
    result: Result
    low: float | None = None
    high: float | None = None

    @property
    def shown(self) -> float | None:
        """AP, or None where the class does not occur, whatever the protocol says."""
        return self.result.ap if self.result.is_defined else None

    @property
    def key(self) -> tuple[str, str, str, str, float]:
        """Protocol, condition, class, space and IoU threshold."""
        made = self.result
        return made.protocol, self.condition, made.cls, made.space, made.iou

    def to_dict(self) -> dict[str, Any]:
        """A row of metrics.json and metrics.csv."""
        made = self.result
        return {
            "name": f"{made.cls}/{self.condition}/{made.metric}",
            "protocol": made.protocol,
            "kind": self.kind,
            "condition": self.condition,
            "cls": made.cls,
            "space": made.space,
            "iou": made.iou,
            "ap": self.shown,
            "ap_low": self.low,
            "ap_high": self.high,
            "ap_official": None if math.isnan(made.ap) else made.ap,
            **{name: getattr(made, name) for name in _OF_RESULT},
        }


@dataclasses.dataclass(frozen=True)
class Origin:
    """What frames are, as far as their table says.

    Attributes:
        num_frames: How many.
        split: "train", "test", "all" or a split file; None: not known, or several.
        is_simulated: Some of them are simulated.
    """

    num_frames: int
    split: str | None
    is_simulated: bool

    @classmethod
    def of(cls, frames: Columns) -> Origin:
        """Read from a frame table."""
        splits = np.unique(np.asarray(frames.get("split", [])).astype(str))
        split = str(splits[0]) if splits.size == 1 else None
        return cls(np.size(frames["frame"]), split, are_simulated(frames))


def condition_masks(frames: AnyColumns, kind: str) -> dict[str, Bool[np.ndarray, " F"]]:
    """Masks of frames by value of a column of the frame table, K-Radar's values first."""
    if kind not in frames:
        return {}
    column = np.asarray(frames[kind]).astype(str)
    present = set(np.unique(column).tolist())
    known = [name for name in ORDER.get(kind, ()) if name in present]
    return {
        name: column == name for name in [*known, *sorted(present.difference(known))]
    }


def measure(
    data: EvaluationSet,
    frames: Columns,
    options: Options,
    *,
    kinds: Sequence[str] = ("weather",),
) -> list[Measured]:
    """Results over all frames and over every condition, in every chosen protocol.

    The last class of every group is "mean": the mean over the classes that occur.
    """
    conditions: list[tuple[str, str, np.ndarray | None]] = [("all", "all", None)]
    for kind in kinds:
        masks = condition_masks(frames, kind)
        conditions += [(kind, name, mask) for name, mask in masks.items()]
    rows = []
    for protocol, (kind, name, mask) in itertools.product(
        options.protocols, conditions
    ):
        results = data.results(
            protocol,
            iou_thresholds=options.iou_thresholds,
            empty_frames=options.frame_rule(protocol),
            score_threshold=options.cut(protocol),
            weights=mask,
            curves=False,
        )
        for start in range(0, len(results), len(data.classes)):
            group = results[start : start + len(data.classes)]
            rows += [Measured(kind, name, made) for made in (*group, _mean(group))]
    return rows


def _mean(group: Sequence[Result]) -> Result:
    """The row "mean" of the classes of one space and IoU threshold, without a curve."""
    return dataclasses.replace(
        group[0],
        cls="mean",
        ap=mean_ap(group),
        num_gt=sum(result.num_gt for result in group),
        num_det=sum(result.num_det for result in group),
        num_frames=max(result.num_frames for result in group),
    )


def rare_classes(
    objects: Columns,
    frames: Columns,
    classes: Sequence[str],
    roi: str | Sequence[float] | None,
) -> tuple[tuple[str, str], ...]:
    """Pairs of class and weather with under 2 % of the training objects of that weather.

    Args:
        objects: Columns of ground truth that is trained on.
        frames: Their frame table, with weather.
        classes: Of the detector.
        roi: Objects outside do not count.

    Returns:
        The pairs, "all" for all weathers; weathers without any object have none.

    References:
        DinoRADE, the mark of Table 2, which the narrow region gives, and section 4.2,
        whose shares are those in the field of view.
    """
    inside = in_roi(np.asarray(objects["box"], np.float64).reshape(-1, 7), roi)
    cls = np.asarray(objects["cls"]).astype(str)[inside]
    row = np.searchsorted(frames["frame"], np.asarray(objects["frame"])[inside])
    weather = np.asarray(frames["weather"]).astype(str)[row]
    masks = {name: weather == name for name in np.unique(weather).tolist()}
    masks["all"] = np.isin(cls, np.array(classes))
    return tuple(
        (name, condition)
        for condition, mask in masks.items()
        for name in classes
        if mask.any() and np.mean(cls[mask] == name) < RARE_SHARE
    )


def left_out(data: EvaluationSet, options: Options) -> dict[str, int]:
    """What the numbers do not see, and why, in words and counts."""
    counts = {**options.left_out_before, **data.left_out}
    low = data.pred.score <= options.score_threshold
    but = f" (counted by {', '.join(options.uncut)})" if options.uncut else ""
    counts[f"predictions: score not above {options.score_threshold:g}{but}"] = int(
        low.sum()
    )
    empty = data.gt_count.sum(axis=1) == 0
    counts["frames: without ground truth (left out by skip=frame)"] = int(empty.sum())
    counts["predictions: in frames without ground truth (left out by skip=frame)"] = (
        int((empty[data.pred.frame] & ~low).sum())
    )
    other = data.gt_count[data.pred.frame, data.pred.cls] == 0
    counts["predictions: in frames without their class (left out by skip=class)"] = int(
        (other & ~low).sum()
    )
    return counts


def num_clipped(predictions: Columns) -> int:
    """Predictions with a size that decoding clipped, see `decode(clip_sizes=True)`."""
    sizes = np.asarray(predictions["box"], np.float64).reshape(-1, 7)[:, 3:6]
    return int(((sizes > 0) & (sizes <= np.float32(MIN_SIZE_M))).any(axis=1).sum())


def repair_sizes(predictions: Columns, rule: str) -> tuple[Columns, int]:
    """Predictions with sizes that an untrained network may produce made harmless.

    Args:
        predictions: Columns as in `average_precision.evaluate`.
        rule: "error" leaves them as they are; "false_positive" shrinks boxes with a size
            that is not positive to a micrometre: they match nothing but still count.

    Returns:
        The predictions and how many boxes were changed.
    """
    if rule not in ("error", "false_positive"):
        raise UserError(
            f'invalid_sizes must be "error" or "false_positive", got {rule!r}'
        )
    box = np.asarray(predictions["box"], np.float64).reshape(-1, 7)
    bad = (box[:, 3:6] <= 0).any(axis=1)
    if rule == "error" or not bad.any():
        return predictions, 0
    box = box.copy()
    box[bad, 3:6] = 1e-6
    return {**predictions, "box": box}, int(bad.sum())
