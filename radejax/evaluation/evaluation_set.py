"""Ground truth and predictions that are paired once and evaluated many times."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import ArrayLike

from radejax.core.errors import DataError, require
from radejax.core.structures import CLASSES, Boxes
from radejax.evaluation import boxes, matching, protocols
from radejax.evaluation.boxes import AnyBoxes, AnyColumns, Roi
from radejax.evaluation.protocols import Curve, Protocol
from radejax.geometry.rotated_iou import bev_intersection, shared_height

T = TypeVar("T")

SPACES = ("bev", "3d")

MAX_PAIRS = 1_000_000
"""Largest number of pairs of predictions and objects per class and frame.

A frame rarely has more than 100 predictions and 20 objects of a class."""

Rows = Bool[np.ndarray, " _"] | slice
ALL = slice(None)


class Ranking(NamedTuple):
    """Predictions of one class above a score threshold, by descending score.

    Attributes:
        score: `[K]` scores.
        frame: `[K]` positions of the frames.
        value: `[K]` what each prediction adds to a sum over the predictions, such as
            whether it is a true positive.
    """

    score: Float[np.ndarray, " K"]
    frame: Int[np.ndarray, " K"]
    value: Shaped[np.ndarray, " K"]

    def weighted(
        self, weight: Int[np.ndarray, " F"]
    ) -> tuple[Float[np.ndarray, " K"], Int[np.ndarray, " K"]]:
        """Returns the scores, and the values times the weights of their frames."""
        return self.score, self.value * weight[self.frame]


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
    condition: str = "all"
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

    Args:
        results: Results of the classes; those with a NaN AP do not occur.

    Examples:
        >>> mean_ap([])
        nan
    """
    present = [result.ap for result in results if result.is_defined]
    return float(np.mean(present)) if present else float("nan")


def _cached(method: Callable[..., T]) -> Callable[..., T]:
    """Makes a method of `EvaluationSet` compute its result once for equal arguments."""

    @functools.wraps(method)
    def cached(self: EvaluationSet, *args: str | float) -> T:
        key = (method, *args)
        if key not in self._cache:
            self._cache[key] = method(self, *args)
        result: T = self._cache[key]
        return result

    return cached


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
        ground_truth: AnyBoxes,
        predictions: AnyBoxes,
        *,
        classes: Sequence[str] = CLASSES,
        frames: AnyColumns | None = None,
        roi: Roi = None,
        label_version: str | None = None,
        known: Sequence[str] = (),
    ) -> None:
        """Creates an evaluation set; see `evaluate` for the arguments.

        `known` are further classes of the boxes, which are not evaluated.
        """
        self.classes = tuple(classes)
        is_unique = len(set(self.classes)) == len(self.classes) > 0
        is_valid = is_unique and not isinstance(classes, str)
        require(is_valid, "classes", classes, "different class names")
        self.roi = boxes.roi_name(roi)
        self.label_version = label_version
        truth = boxes.read_boxes(ground_truth, "ground truth", scored=False)
        found = boxes.read_boxes(predictions, "predictions", scored=True)
        self.ground_truth = truth
        self.predictions = found
        if frames is None:
            frames = {"frame": np.union1d(truth.frame, found.frame)}
        self.frame = boxes.frame_ids(frames)
        self.is_simulated = bool(np.any(frames.get("simulated", False)))
        self._roi = roi
        self._known = known
        self.left_out: dict[str, int] = {}
        self.gt, self._gt_row = self._select(truth, "ground truth")
        self.pred, self._pred_row = self._select(found, "predictions")
        assert self.pred.score is not None  # read_boxes requires it
        self.score = self.pred.score
        self.gt_group = self.gt.frame * len(self.classes) + self.gt.cls
        self.pred_group = self.pred.frame * len(self.classes) + self.pred.cls
        self.gt_count = self.count_groups(self.gt_group)
        pairs = self.gt_count * self.count_groups(self.pred_group)
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
        # All protocols, thresholds and frame weights share the results of `_cached` methods.
        self._cache: dict[tuple[object, ...], Any] = {}

    def _select(self, table: Boxes, name: str) -> tuple[Boxes, Int[np.ndarray, " N"]]:
        """Returns the checked and sorted boxes of the classes in the region, and their rows.

        The other boxes are counted in `left_out`.
        """
        boxes.require_sizes(table, name)
        position = boxes.frame_positions(table.frame, self.frame, name)
        cls = boxes.class_indices(table, self.classes, name, self._known)
        is_class = cls >= 0
        is_inside = boxes.in_roi(table.box, self._roi)
        num_outside = int((is_class & ~is_inside).sum())
        self.left_out[f"{name}: class not evaluated"] = int((~is_class).sum())
        self.left_out[f"{name}: center outside the region of interest"] = num_outside
        row = np.flatnonzero(is_class & is_inside)
        row = row[np.lexsort((row, cls[row], position[row]))]
        found = table.take(row)
        return dataclasses.replace(found, frame=position[row], cls=cls[row]), row

    def count_groups(self, group: Int[np.ndarray, " N"]) -> Int[np.ndarray, "F C"]:
        """Counts boxes by frame and class from rows of `gt_group` or `pred_group`."""
        shape = self.frame.size, len(self.classes)
        return np.bincount(group, minlength=shape[0] * shape[1]).reshape(shape)

    def evaluated(self, gt: Rows = ALL, pred: Rows = ALL) -> tuple[Boxes, Boxes]:
        """Returns rows of `gt` and `pred` as they were given, in the order of the input."""
        truth = self.ground_truth.take(np.sort(self._gt_row[gt]))
        return truth, self.predictions.take(np.sort(self._pred_row[pred]))

    def matched_pairs(
        self, pred: Int[np.ndarray, " K"], gt: Int[np.ndarray, " K"]
    ) -> tuple[Boxes, Boxes]:
        """Returns predictions and their objects as they were given, with all columns.

        Args:
            pred: Positions in `pred`.
            gt: Positions of their objects in `gt`.
        """
        found = self.predictions.take(self._pred_row[pred])
        return found, self.ground_truth.take(self._gt_row[gt])

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

    def outcomes(
        self, iou: float
    ) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " M"]]:
        """Returns whether the boxes match in `all_point` and 3D, in the order of the input.

        Returns:
            For all objects and all predictions as given: 1 if it is matched, 0 if not, and
            -1 if it is not evaluated.
        """
        match = self.matched_objects("plain", "free", "3d", iou)
        truth = np.full(len(self.ground_truth), -1)
        found = np.full(len(self.predictions), -1)
        truth[self._gt_row] = np.isin(np.arange(len(self.gt)), match)
        found[self._pred_row] = match >= 0
        return truth, found

    # Shared work ---------------------------------------------------------------------

    @_cached
    def overlaps(self, geometry: str) -> dict[str, Float[np.ndarray, " P"]]:
        """Returns the IoU of the candidate pairs in the geometry of a protocol, by space."""
        truth = self.gt.box
        found = self.pred.box
        if geometry != "plain":
            truth = np.round(truth, 2)
        if geometry.startswith("swapped_lw"):
            swap = [0, 1, 2, 4, 3, 5, 6]
            truth = truth[:, swap]
            found = found[:, swap]
        z_center = 1.0 if geometry == "swapped_lw_z_top" else 0.5
        bev, volumetric = np.zeros((2, self.pair_gt.size))
        # The IoU of a pair needs about 32 temporary values.
        for rows in matching.chunks(np.full(self.pair_gt.size, 32)):
            a, b = found[self.pair_pred[rows]], truth[self.pair_gt[rows]]
            area = bev_intersection(a, b)
            volume = area * shared_height(a, b, z_center)
            area_a = a[:, 3] * a[:, 4]
            area_b = b[:, 3] * b[:, 4]
            volumes = area_a * a[:, 5] + area_b * b[:, 5]
            bev[rows] = area / (area_a + area_b - area)
            volumetric[rows] = volume / (volumes - volume)
        if geometry != "plain":
            # K-Radar's code stores IoUs in single precision and compares them in double.
            bev[:] = bev.astype(np.float32)
            volumetric[:] = volumetric.astype(np.float32)
        return {"bev": bev, "3d": volumetric}

    def _pairs(self, geometry: str, space: str) -> matching.Pairs:
        iou = self.overlaps(geometry)[space]
        return matching.Pairs(self.pair_pred, self.pair_gt, iou)

    @_cached
    def matched_objects(
        self, geometry: str, rule: str, space: str, iou: float
    ) -> Int[np.ndarray, " M"]:
        """Returns the object that each prediction matches by the rule "best" or "free", or -1."""
        pairs = self._pairs(geometry, space)
        if rule == "best":
            return matching.match_best(pairs, self.score, iou)
        num_gt = len(self.gt)
        return matching.match_free(pairs, self.score, self.pred_group, num_gt, iou)

    def confidences(self) -> dict[str, Float[np.ndarray, " M"]]:
        """Returns the scores and, of a calibrated model, the probabilities by name."""
        extras = self.pred.extras.items()
        return {"score": self.score} | {n: x for n, x in extras if n == "probability"}

    @functools.cached_property
    def by_score(self) -> Int[np.ndarray, " M"]:
        """Predictions by descending score; ties are in input order."""
        return np.lexsort((self._pred_row, -self.score))

    @_cached
    def _by_class(self, threshold: float) -> list[Int[np.ndarray, " _"]]:
        """Returns the predictions of each class above a threshold, by descending score."""
        pred = self.by_score[self.score[self.by_score] > threshold]
        cls = self.pred.cls[pred]
        return [pred[cls == index] for index in range(len(self.classes))]

    @_cached
    def _pooled_rankings(
        self, geometry: str, rule: str, space: str, iou: float, threshold: float
    ) -> list[Ranking]:
        """Returns the predictions of each class, which count if they match an object."""
        is_tp = self.matched_objects(geometry, rule, space, iou) >= 0
        # A threshold of 0 also keeps scores of 0.
        by_class = self._by_class(threshold or -1.0)
        return [self._ranking(pred, is_tp[pred]) for pred in by_class]

    @_cached
    def _kradar_rankings(
        self, geometry: str, space: str, iou: float, threshold: float
    ) -> list[tuple[Ranking, Ranking, Ranking]]:
        """Returns matches, changes of the true positives and predictions of each class."""
        if geometry == "swapped_lw_z_top" and space == "bev":  # z has no effect
            return self._kradar_rankings("swapped_lw", space, iou, threshold)
        pairs = self._pairs(geometry, space)
        found = matching.match_kradar(pairs, self.score, self.gt_group, iou)
        matched = self._ranked(found.first_pred, 1, threshold)
        events = self._ranked(found.event_pred, found.event_delta, threshold)
        every = [self._ranking(pred, 1) for pred in self._by_class(threshold)]
        return list(zip(matched, events, every, strict=True))

    def _ranked(
        self, pred: Int[np.ndarray, " K"], value: ArrayLike, threshold: float
    ) -> list[Ranking]:
        """Returns the values of some predictions for each class, by descending score."""
        order = np.argsort(-self.score[pred], kind="stable")
        value = np.broadcast_to(value, pred.shape)[order]
        pred = pred[order]
        is_kept = self.score[pred] > threshold
        rankings = []
        for cls in range(len(self.classes)):
            rows = is_kept & (self.pred.cls[pred] == cls)
            rankings.append(self._ranking(pred[rows], value[rows]))
        return rankings

    def _ranking(self, pred: Int[np.ndarray, " K"], value: ArrayLike) -> Ranking:
        value = np.broadcast_to(value, pred.shape)
        return Ranking(self.score[pred], self.pred.frame[pred], value)

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
            curves: Whether to keep the precision, recall and score arrays, which take
                much memory in many results.

        Raises:
            UserError: The protocol, a space, an IoU threshold or the empty-frame rule is
                invalid.
        """
        chosen = protocols.get_protocol(protocol)
        empty_frames = chosen.resolve_empty_frames(empty_frames)
        spaces = (spaces,) if isinstance(spaces, str) else tuple(spaces)
        require(set(spaces) <= set(SPACES), "spaces", spaces, f"some of {SPACES}")
        ious = np.atleast_1d(np.asarray(iou_thresholds, np.float64)).tolist()
        is_valid = bool(ious) and all(0 <= iou < 1 for iou in ious)
        require(is_valid, "iou_thresholds", iou_thresholds, "numbers in [0, 1)")
        score_threshold = float(score_threshold)
        frame_weights = self._frame_weights(empty_frames, weights)
        num_frames = (frame_weights > 0).sum(axis=0).tolist()
        num_gt = (frame_weights * self.gt_count).sum(axis=0).tolist()
        points = () if curves else ("precision", "recall", "score")
        dropped = dict.fromkeys(points, np.zeros(0))
        results = []
        for space, iou in itertools.product(spaces, ious):
            of_classes = self._curves(
                chosen, space, iou, score_threshold, frame_weights, num_gt
            )
            for index, curve in enumerate(of_classes):
                result = Result(
                    cls=self.classes[index],
                    space=space,
                    iou=iou,
                    protocol=chosen.name,
                    num_frames=num_frames[index],
                    score_threshold=score_threshold,
                    empty_frames=empty_frames,
                    roi=self.roi,
                    label_version=self.label_version,
                    is_simulated=self.is_simulated,
                    **(vars(curve) | dropped),
                )
                results.append(result)
        return results

    def _curves(
        self,
        protocol: Protocol,
        space: str,
        iou: float,
        threshold: float,
        weights: Int[np.ndarray, "F C"],
        num_gt: Sequence[int],
    ) -> Iterator[Curve]:
        """Yields the curve of each class over weighted frames, with `num_gt` objects."""
        geometry = protocol.geometry
        kind = protocol.curve
        if protocol.matching == "kradar":
            triples = self._kradar_rankings(geometry, space, iou, threshold)
            for cls, triple in enumerate(triples):
                matched, events, every = (x.weighted(weights[:, cls]) for x in triple)
                yield protocols.kradar_curve(matched, events, every, num_gt[cls], kind)
            return
        rule = protocol.matching
        rankings = self._pooled_rankings(geometry, rule, space, iou, threshold)
        for cls, (score, frame, is_tp) in enumerate(rankings):
            weight = weights[:, cls][frame]
            yield protocols.pooled_curve(score, is_tp, weight, num_gt[cls], kind)

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
