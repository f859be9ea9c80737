"""Ground truth and predictions that are paired once and evaluated many times."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from radejax.core.errors import DataError, UserError
from radejax.core.structures import CLASSES, Boxes
from radejax.evaluation import boxes, matching, protocols
from radejax.evaluation.boxes import AnyColumns, Roi
from radejax.evaluation.protocols import Curve
from radejax.geometry.rotated_iou import bev_intersection, shared_height

T = TypeVar("T")

SPACES = ("bev", "3d")

MAX_PAIRS = 1_000_000
"""Largest number of pairs of predictions and objects per class and frame.

A frame rarely has more than 100 predictions and 20 objects of a class."""

Rows = Bool[np.ndarray, " _"] | slice
ALL = slice(None)

Matches = matching.KradarMatches | Int[np.ndarray, " M"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result(Curve):
    """One average precision with its curve and the settings it was computed with.

    Attributes:
        cls: Class name; in reports also "mean" for the mean over the classes that occur.
        space: "bev" or "3d".
        iou: IoU threshold; a match needs an IoU above it.
        protocol: Name of the protocol.
        num_frames: Number of frames that were evaluated.
        score_threshold: Score threshold; predictions need a score above it.
        empty_frames: Frames that were ignored: "class", "frame" or "none".
        roi: Name of the region of interest.
        label_version: Label revision of the ground truth, if known.
        is_simulated: Whether the frames are simulated.
        condition: "all", or a weather.
        low: Lower end of the 95 % bootstrap interval; None if it was not computed, NaN if
            the objects of the class are in fewer than two sequences.
        high: Upper end of this interval.
    """

    cls: str
    space: str
    iou: float
    protocol: str
    num_frames: int
    score_threshold: float
    empty_frames: str
    roi: str
    label_version: str | None
    is_simulated: bool
    condition: str
    low: float | None = None
    high: float | None = None

    @property
    def key(self) -> tuple[str, str, str, str, float]:
        """Protocol, condition, class, space and IoU threshold."""
        return self.protocol, self.condition, self.cls, self.space, self.iou

    @property
    def has_interval(self) -> bool:
        """Whether there is a 95 % interval."""
        return self.low is not None and not np.isnan(self.low)

    @property
    def metric(self) -> str:
        """Name that states all settings of the AP except the class and the frames.

        For example ap_3d_iou30/kradar_r40/score>0/skip=frame/labels=v2.1/roi=narrow,
        followed by /simulated for simulated frames.
        """
        labels = f"/labels={self.label_version}" if self.label_version else ""
        return (
            f"ap_{self.space}_iou{100 * self.iou:.4g}/{self.protocol}"
            f"/score>{self.score_threshold:g}/skip={self.empty_frames}"
            f"{labels}/roi={self.roi}" + ("/simulated" if self.is_simulated else "")
        )


def mean_ap(results: Sequence[Curve]) -> float:
    """Computes the mean AP over the classes that occur, or NaN if none does.

    Examples:
        >>> mean_ap([])
        nan
    """
    present = [result.ap for result in results if result.is_defined]
    return float(np.mean(present)) if present else float("nan")


class EvaluationSet:
    """Ground truth and predictions that are checked, sorted and paired once.

    Attributes:
        classes: Class names.
        frame: `[F]` frame ids in the order of the frame table.
        gt: Objects of the classes inside the region, sorted by frame, class and input
            order. Their frame and cls are positions in `frame` and in `classes`.
        pred: Predictions of the classes inside the region, in the same form as `gt`.
        score: Scores of `pred`.
        ground_truth: All objects as given.
        predictions: All predictions as given.
        left_out: Numbers of boxes that are excluded, by reason.
        roi: Name of the region.
        label_version: Label revision, or None if it is not known.
        is_simulated: Whether any frame is simulated according to the frame table.
    """

    def __init__(
        self,
        ground_truth: AnyColumns | Boxes,
        predictions: AnyColumns | Boxes,
        *,
        classes: Sequence[str] = CLASSES,
        frames: AnyColumns | None = None,
        roi: Roi = None,
        label_version: str | None = None,
    ) -> None:
        """Creates an evaluation set; see `evaluate` for the arguments."""
        self.classes = tuple(classes)
        is_repeated = len(set(self.classes)) < len(self.classes)
        if isinstance(classes, str) or not self.classes or is_repeated:
            raise UserError(f"classes is {classes!r}, expected different class names")
        self.roi = boxes.roi_name(roi)
        self.label_version = label_version
        truth = boxes.read_boxes(ground_truth, "ground truth", scored=False)
        found = boxes.read_boxes(predictions, "predictions", scored=True)
        self.ground_truth, self.predictions = truth, found
        if frames is None:
            frames = {"frame": np.union1d(truth.frame, found.frame)}
        self.frame = boxes.frame_ids(frames)
        self.is_simulated = bool(np.any(frames.get("simulated", False)))
        self._roi = roi
        self.left_out: dict[str, int] = {}
        self.gt, self._gt_row = self._select(truth, "ground truth")
        self.pred, self._pred_row = self._select(found, "predictions")
        assert self.pred.score is not None  # read_boxes requires it
        self.score = self.pred.score
        self.gt_group = self.gt.frame * len(self.classes) + self.gt.cls
        self.pred_group = self.pred.frame * len(self.classes) + self.pred.cls
        self.gt_count = self._count(self.gt_group)
        pairs = self.gt_count * self._count(self.pred_group)
        if pairs.max(initial=0) > MAX_PAIRS:
            frame, cls = np.unravel_index(pairs.argmax(), pairs.shape)
            raise DataError(
                f"frame {self.frame[frame]}: predictions and ground truths of "
                f"{self.classes[cls]} are {pairs[frame, cls]:,} pairs, expected at most "
                f"{MAX_PAIRS:,}: keep those with the highest scores"
            )
        self.pair_pred, self.pair_gt = matching.candidate_pairs(
            self.pred_group, self.gt_group, self.pred.box, self.gt.box
        )
        # Cache of `_once`, which all protocols, thresholds and frame weights share.
        self._shared: dict[tuple[Any, ...], Any] = {}

    def _select(self, table: Boxes, name: str) -> tuple[Boxes, Int[np.ndarray, " N"]]:
        """Returns the sorted boxes of the classes in the region, and their rows.

        The other boxes are counted in `left_out`.
        """
        position = boxes.frame_positions(table.frame, self.frame, name)
        cls = boxes.class_indices(table, self.classes, name)
        is_class, is_inside = cls >= 0, boxes.in_roi(table.box, self._roi)
        num_outside = int((is_class & ~is_inside).sum())
        self.left_out[f"{name}: class not evaluated"] = int((~is_class).sum())
        self.left_out[f"{name}: center outside the region of interest"] = num_outside
        row = np.flatnonzero(is_class & is_inside)
        row = row[np.lexsort((row, cls[row], position[row]))]
        score = None if table.score is None else table.score[row]
        return Boxes(position[row], table.box[row], cls[row], score), row

    def _count(self, group: Int[np.ndarray, " N"]) -> Int[np.ndarray, "F C"]:
        """Returns the number of boxes of every class in every frame."""
        shape = self.frame.size, len(self.classes)
        return np.bincount(group, minlength=shape[0] * shape[1]).reshape(shape)

    def evaluated(self, gt: Rows = ALL, pred: Rows = ALL) -> tuple[Boxes, Boxes]:
        """Returns rows of `gt` and `pred` as they were given, in the order of the input."""
        truth, found = np.sort(self._gt_row[gt]), np.sort(self._pred_row[pred])
        return self.ground_truth.take(truth), self.predictions.take(found)

    def of_frames(self, is_chosen: Bool[np.ndarray, " F"]) -> EvaluationSet:
        """Returns the evaluation set of some frames, such as those of one condition."""
        chosen = is_chosen[self.gt.frame], is_chosen[self.pred.frame]
        return self.of_boxes(*chosen, self.frame[is_chosen])

    def of_boxes(self, gt: Rows, pred: Rows, frame: np.ndarray) -> EvaluationSet:
        """Returns the evaluation set of rows of `gt` and `pred` in the frames of these ids."""
        is_simulated = np.full(frame.size, self.is_simulated)
        return EvaluationSet(
            *self.evaluated(gt, pred),
            classes=self.classes,
            frames={"frame": frame, "simulated": is_simulated},
            roi=self._roi,
            label_version=self.label_version,
        )

    # Shared work ---------------------------------------------------------------------

    def _once(self, function: Callable[..., T], *arguments: Any) -> T:
        """Returns the result of a method, which is cached for equal arguments."""
        key = (function.__name__, *arguments)
        if key not in self._shared:
            self._shared[key] = function(*arguments)
        return self._shared[key]

    def overlap(self, geometry: str, space: str) -> Float[np.ndarray, " P"]:
        """Returns the IoU of the candidate pairs in the geometry of a protocol."""
        return self._once(self._overlap, geometry)[SPACES.index(space)]

    def _overlap(self, geometry: str) -> Float[np.ndarray, "2 P"]:
        """Computes BEV and 3D IoU of the candidate pairs from the same intersections."""
        truth, found = self.gt.box, self.pred.box
        if geometry != "plain":
            truth = np.round(truth, 2)
        if geometry.startswith("swapped_lw"):
            swap = [0, 1, 2, 4, 3, 5, 6]
            truth, found = truth[:, swap], found[:, swap]
        z_center = 1.0 if geometry == "swapped_lw_z_top" else 0.5
        values = np.zeros((2, self.pair_gt.size))
        # The IoU of a pair needs about 32 temporary values.
        for rows in matching.chunks(np.full(self.pair_gt.size, 32)):
            a, b = found[self.pair_pred[rows]], truth[self.pair_gt[rows]]
            area = bev_intersection(a, b)
            volume = area * shared_height(a, b, z_center)
            area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
            volumes = area_a * a[:, 5] + area_b * b[:, 5]
            values[0, rows] = area / (area_a + area_b - area)
            values[1, rows] = volume / (volumes - volume)
        if geometry == "plain":
            return values
        # K-Radar's code stores IoUs in single precision and compares them in double.
        return values.astype(np.float32).astype(np.float64)

    def match(self, geometry: str, rule: str, space: str, iou: float) -> Matches:
        """Returns the matches of all frames and classes.

        They are `KradarMatches` for the rule "kradar"; otherwise the matched object of
        every prediction, or -1.
        """
        if geometry == "swapped_lw_z_top" and space == "bev":
            geometry = "swapped_lw"  # z has no effect
        return self._once(self._match, geometry, rule, space, iou)

    def _match(self, geometry: str, rule: str, space: str, iou: float) -> Matches:
        values = self.overlap(geometry, space)
        pairs = matching.Pairs(self.pair_pred, self.pair_gt, values)
        if rule == "kradar":
            return matching.match_kradar(pairs, self.score, self.gt_group, iou)
        if rule == "best":
            return matching.match_best(pairs, self.score, iou)
        num_gt = len(self.gt)
        return matching.match_free(pairs, self.score, self.pred_group, num_gt, iou)

    @functools.cached_property
    def by_score(self) -> list[Int[np.ndarray, " _"]]:
        """Predictions of every class by descending score; ties are in input order."""
        order = np.lexsort((self._pred_row, -self.score))
        return [order[self.pred.cls[order] == c] for c in range(len(self.classes))]

    # Results -------------------------------------------------------------------------

    def results(
        self,
        protocol: str = "kradar_r40",
        *,
        iou_thresholds: Sequence[float] | float = (0.3,),
        empty_frames: str = "protocol",
        score_threshold: float = 0.0,
        spaces: Sequence[str] = SPACES,
        weights: Shaped[np.ndarray, " F"] | None = None,
        curves: bool = True,
        condition: str = "all",
    ) -> list[Result]:
        """Computes the results of one protocol over all frames or over weighted frames.

        Args:
            protocol: Name of the protocol.
            iou_thresholds: See `evaluate`.
            empty_frames: See `evaluate`.
            score_threshold: See `evaluate`.
            spaces: See `evaluate`.
            weights: bool or int weight of every frame, such as the mask of a condition.
                None counts every frame once.
            curves: Whether to keep the precision, recall and score arrays.
            condition: Name of the condition that the weights select.

        Raises:
            UserError: The protocol, a space, an IoU threshold or the empty-frame rule is
                invalid.
        """
        chosen = protocols.get_protocol(protocol)
        empty_frames = chosen.resolve_empty_frames(empty_frames)
        spaces = (spaces,) if isinstance(spaces, str) else tuple(spaces)
        if not set(spaces) <= set(SPACES):
            raise UserError(f"spaces is {spaces}, expected some of {SPACES}")
        ious = np.atleast_1d(np.asarray(iou_thresholds, np.float64)).tolist()
        if not ious or not all(0 <= iou < 1 for iou in ious):
            raise UserError(
                f"iou_thresholds is {iou_thresholds}, expected numbers in [0, 1)"
            )
        frame_weights = self._frame_weights(empty_frames, weights)
        points = () if curves else ("precision", "recall", "score")
        dropped = dict.fromkeys(points, np.zeros(0))
        num_frames = (frame_weights > 0).sum(axis=0).tolist()
        score_threshold, results = float(score_threshold), []
        cases = itertools.product(spaces, ious, enumerate(self.classes))
        for space, iou, (index, name) in cases:
            # Protocols with the same geometry and matching share their rankings.
            matched_by = chosen.geometry, chosen.matching, space, iou
            ranked = self._once(self._ranking, matched_by, score_threshold, index)
            weight = frame_weights[:, index]
            num_gt = int(weight @ self.gt_count[:, index])
            if chosen.matching == "kradar":
                matched, events, detections = (
                    (score, count * weight[frame]) for score, frame, count in ranked
                )
                curve = protocols.kradar_curve(
                    matched, events, detections, num_gt, chosen.curve
                )
            else:
                ((score, frame, is_tp),) = ranked
                curve = protocols.pooled_curve(
                    score, is_tp, weight[frame], num_gt, chosen.curve
                )
            result = Result(
                cls=name,
                space=space,
                iou=iou,
                protocol=chosen.name,
                num_frames=num_frames[index],
                score_threshold=score_threshold,
                empty_frames=empty_frames,
                roi=self.roi,
                label_version=self.label_version,
                is_simulated=self.is_simulated,
                condition=condition,
                **(vars(curve) | dropped),
            )
            results.append(result)
        return results

    def _frame_weights(
        self, empty_frames: str, weights: Shaped[np.ndarray, " F"] | None
    ) -> Int[np.ndarray, "F C"]:
        """Returns the weights of the frames for every class; ignored frames have 0."""
        counts = np.ones(self.frame.size) if weights is None else np.asarray(weights)
        counts = counts.astype(np.int64)[:, None]
        if empty_frames == "class":
            return counts * (self.gt_count > 0)
        if empty_frames == "frame":
            counts = counts * (self.gt_count.sum(axis=1, keepdims=True) > 0)
        return np.broadcast_to(counts, self.gt_count.shape)

    def _ranking(
        self, matched_by: tuple[str, str, str, float], threshold: float, cls: int
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Returns the inputs of a curve of one class that do not depend on frame weights.

        They are the scores in descending order, their frames, and whether the predictions
        match. For K-Radar's protocols, there are three such lists with counts in place of
        matches: for the matches of the first pass, the changes of the true positives of
        the second pass, and the predictions.
        """
        match = self.match(*matched_by)
        mine = self.by_score[cls]
        if isinstance(match, matching.KradarMatches):
            counted = [
                (match.first_pred, np.ones_like(match.first_pred)),
                (match.event_pred, match.event_delta),
                (mine, np.ones_like(mine)),
            ]
        else:
            counted = [(mine, match[mine] >= 0)]
            threshold = threshold or -1.0  # a threshold of 0 also keeps scores of 0
        ranked = []
        for pred, count in counted:
            keep = (self.pred.cls[pred] == cls) & (self.score[pred] > threshold)
            pred, count = pred[keep], count[keep]
            if np.any(np.diff(self.score[pred]) > 0):
                order = np.argsort(-self.score[pred], kind="stable")
                pred, count = pred[order], count[order]
            ranked.append((self.score[pred], self.pred.frame[pred], count))
        return ranked
