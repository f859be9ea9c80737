"""Average precision of 3D detections, in every protocol that K-Radar papers use.

`evaluate` answers one question on plain column arrays; `EvaluationSet` keeps what
protocols, conditions and resamples share (pairs, overlaps, matches), so that all of them
together cost little more than one.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from radejax.errors import UserError
from radejax.evaluation import matching, overlap, protocols, tables
from radejax.structures import CLASSES

SPACES = ("bev", "3d")
PROTOCOL_DEFAULT = "protocol"


@dataclasses.dataclass(frozen=True)
class Result:
    """One average precision and what it means.

    Attributes:
        cls: Class name.
        space: "bev" or "3d".
        iou: IoU threshold; a match needs more.
        ap: Average precision, 0 to 100. Without any object of the class it is NaN, except
            in K-Radar's protocols, which define it as 0; test `num_gt`.
        num_gt: Objects of the class in the frames that take part.
        num_det: Predictions of the class in those frames, after the score cut.
        protocol: Name of the protocol.
        num_frames: Frames that take part.
        score_threshold: Predictions need a score above this.
        skip_empty: Frame rule that was used.
        roi: Name of the region of interest.
        label_version: Label revision of the ground truth, if known.
        precision: `[K]` precision along the curve (K-Radar: after making it monotone).
        recall: `[K]` recall along the curve.
        score: `[K]` score threshold along the curve, falling.
    """

    cls: str
    space: str
    iou: float
    ap: float
    num_gt: int
    num_det: int
    protocol: str
    num_frames: int
    score_threshold: float
    skip_empty: str | None
    roi: str
    label_version: str | None
    precision: np.ndarray = dataclasses.field(repr=False)
    recall: np.ndarray = dataclasses.field(repr=False)
    score: np.ndarray = dataclasses.field(repr=False)

    @property
    def is_defined(self) -> bool:
        """Whether the class occurs at all; reports show `-` where it does not."""
        return self.num_gt > 0

    @property
    def metric(self) -> str:
        """Name with everything the number depends on but the class and the frames."""
        return metric_name(
            self.space,
            self.iou,
            self.protocol,
            self.score_threshold,
            self.skip_empty,
            self.label_version,
            self.roi,
        )


def metric_name(
    space: str,
    iou: float,
    protocol: str,
    score_threshold: float,
    skip_empty: str | None,
    label_version: str | None,
    roi: str,
) -> str:
    """A metric's full name.

    Examples:
        >>> metric_name("3d", 0.3, "kradar_r40", 0.0, "frame", "v2.1", "narrow")
        'ap_3d_iou30/kradar_r40/score>0/skip=frame/labels=v2.1/roi=narrow'
    """
    return (
        f"ap_{space}_iou{100 * iou:.4g}/{protocol}/score>{score_threshold:g}"
        f"/skip={skip_empty or 'none'}/labels={label_version or 'unknown'}/roi={roi}"
    )


def evaluate(
    ground_truth: Mapping[str, np.ndarray],
    predictions: Mapping[str, np.ndarray],
    *,
    classes: Sequence[str] = CLASSES,
    iou_thresholds: Sequence[float] | float = (0.3,),
    protocol: str = "kradar_r40",
    frames: Mapping[str, np.ndarray] | None = None,
    skip_empty: str | None = PROTOCOL_DEFAULT,
    score_threshold: float = 0.0,
    roi: str | Sequence[float] | None = None,
    spaces: Sequence[str] = SPACES,
    label_version: str | None = None,
) -> list[Result]:
    """Average precision per class, space and IoU threshold in one protocol.

    Args:
        ground_truth: Columns frame `[N]` int, box `[N, 7]` x, y, z, l, w, h, yaw (metres,
            radians, ego frame, full extents, z at mid-height) and cls `[N]` names. The
            order of boxes within a frame matters to K-Radar's protocols.
        predictions: The same columns and score `[M]` in [0, 1].
        classes: Classes to evaluate. The frame rules look at these only.
        iou_thresholds: A match needs an IoU above the threshold.
        protocol: One of `protocols.PROTOCOLS`.
        frames: Columns of the frame table, at least frame `[F]`; None takes the frames
            that occur. Boxes of other frames are an error.
        skip_empty: Frames left out: "class" without an object of the class, "frame"
            without an object of any class, None none; default: the protocol's rule.
        score_threshold: Predictions need a score above this. 0 keeps all (in K-Radar's
            protocols all above 0).
        roi: Keep only boxes with their center in this region: "narrow", "wide", six
            bounds, or None.
        spaces: "bev" and "3d", or one of them.
        label_version: Label revision, only to be carried into the results' names.

    Returns:
        One `Result` per space, IoU threshold and class, in that nesting.

    Raises:
        UserError: Unknown protocol, space, region or frame rule; missing columns.
        DataError: A bad row, named by table, frame and row.

    References:
        K-Radar evaluation: Paek et al., arXiv:2206.08171, and its issues 28, 36, 81.

    Examples:
        >>> box = np.array([[20.0, 0, 0, 4, 2, 1.5, 0]])
        >>> truth = {"frame": [0], "box": box, "cls": ["Sedan"]}
        >>> found = {**truth, "score": [0.9]}
        >>> [r.ap for r in evaluate(truth, found, classes=["Sedan"], protocol="exact")]
        [100.0, 100.0]
    """
    data = EvaluationSet(
        ground_truth,
        predictions,
        classes=classes,
        frames=frames,
        roi=roi,
        label_version=label_version,
    )
    return data.results(
        protocol,
        iou_thresholds=iou_thresholds,
        skip_empty=skip_empty,
        score_threshold=score_threshold,
        spaces=spaces,
    )


def mean_ap(results: Sequence[Result]) -> float:
    """Mean AP over the classes that occur; NaN if none does."""
    present = [result.ap for result in results if result.is_defined]
    return float(np.mean(present)) if present else float("nan")


class EvaluationSet:
    """Ground truth and predictions, checked, sorted and paired once.

    Attributes:
        classes: Class names.
        frame: `[F]` frame ids, in the order of the frame table.
        gt: Objects of the classes inside the region.
        pred: Predictions of the classes inside the region.
        left_out: Counts of what does not take part and why.
        roi: Name of the region.
        label_version: Label revision or None.
    """

    def __init__(
        self,
        ground_truth: Mapping[str, np.ndarray],
        predictions: Mapping[str, np.ndarray],
        *,
        classes: Sequence[str] = CLASSES,
        frames: Mapping[str, np.ndarray] | None = None,
        roi: str | Sequence[float] | None = None,
        label_version: str | None = None,
    ) -> None:
        """See `evaluate` for the arguments."""
        self.classes = _check_classes(classes)
        self.roi = tables.roi_name(roi)
        self.label_version = label_version
        truth = tables.read_columns(ground_truth, name="ground truth", scored=False)
        found = tables.read_columns(predictions, name="predictions", scored=True)
        if frames is None:
            self.frame = np.unique(np.concatenate([truth[0], found[0]]))
        else:
            self.frame = tables.frame_ids(frames)
        self.left_out: dict[str, int] = {}
        self.gt = self._select(truth, "ground truth", roi)
        self.pred = self._select(found, "predictions", roi)
        num_classes = len(self.classes)
        self.gt_group = self.gt.frame * num_classes + self.gt.cls
        self.pred_group = self.pred.frame * num_classes + self.pred.cls
        self.pair_pred, self.pair_gt = overlap.candidate_pairs(
            self.pred_group, self.gt_group, self.pred.box, self.gt.box
        )
        self.gt_count = np.bincount(
            self.gt_group, minlength=self.frame.size * num_classes
        ).reshape(self.frame.size, num_classes)
        self._overlaps: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._matches: dict[tuple, object] = {}

    def _select(self, columns: tuple, name: str, roi: object) -> tables.Objects:
        """Boxes of the evaluated classes in the region, sorted; counts the others."""
        frame, box, cls_name, score = columns
        dense = tables.dense_frames(frame, self.frame, name=name)
        cls = tables.class_indices(cls_name, frame, self.classes, name=name)
        wanted = cls >= 0
        inside = tables.in_roi(box, roi)
        self.left_out[f"{name}: class not evaluated"] = int((~wanted).sum())
        self.left_out[f"{name}: center outside the region of interest"] = int(
            (wanted & ~inside).sum()
        )
        row = np.flatnonzero(wanted & inside)
        row = row[np.lexsort((row, cls[row], dense[row]))]
        return tables.Objects(dense[row], box[row], cls[row], score[row], row)

    # Shared work ---------------------------------------------------------------------

    def overlaps(self, geometry: str) -> tuple[np.ndarray, np.ndarray]:
        """BEV and 3D IoU of the candidate pairs under a protocol's geometry."""
        if geometry not in self._overlaps:
            self._overlaps[geometry] = self._overlap(geometry)
        return self._overlaps[geometry]

    def _overlap(self, geometry: str) -> tuple[np.ndarray, np.ndarray]:
        truth, found = self.gt.box, self.pred.box
        if geometry == "plain":
            return overlap.pair_iou(found[self.pair_pred], truth[self.pair_gt])
        truth = np.round(truth, 2)
        if geometry.startswith("exchanged"):
            exchange = [0, 1, 2, 4, 3, 5, 6]
            truth, found = truth[:, exchange], found[:, exchange]
        bev, iou_3d = overlap.pair_iou(
            found[self.pair_pred],
            truth[self.pair_gt],
            z_center=1.0 if geometry == "exchanged_top" else 0.5,
        )
        # The original stores overlaps in single and compares them in double precision.
        return tuple(iou.astype(np.float32).astype(np.float64) for iou in (bev, iou_3d))

    def match(self, protocol: protocols.Protocol, space: str, iou: float) -> object:
        """Matches of all frames and classes: `KradarMatches` or `[M]` object or -1."""
        geometry = protocol.geometry
        if geometry == "exchanged_top" and space == "bev":
            geometry = "exchanged"  # z plays no part
        key = (geometry, protocol.matching, space, iou)
        if key not in self._matches:
            values = self.overlaps(geometry)[SPACES.index(space)]
            pairs = (self.pair_pred, self.pair_gt, values, self.pred.score)
            if protocol.matching == "kradar":
                match = matching.match_kradar(*pairs, self.gt_group, iou)
            elif protocol.matching == "best":
                match = matching.match_best(*pairs, iou)
            else:
                match = matching.match_free(*pairs, self.pred_group, len(self.gt), iou)
            self._matches[key] = match
        return self._matches[key]

    @functools.cached_property
    def _by_score(self) -> list[np.ndarray]:
        """Predictions of every class by falling score, ties by the caller's row."""
        order = np.lexsort((self.pred.row, -self.pred.score))
        return [order[self.pred.cls[order] == c] for c in range(len(self.classes))]

    # Results -------------------------------------------------------------------------

    def frame_weights(
        self, skip_empty: str | None, weights: np.ndarray | None = None
    ) -> np.ndarray:
        """`[F, C]` integer weights of the frames after the frame rule."""
        if weights is None:
            weights = np.ones(self.frame.size, np.int64)
        weights = np.asarray(weights).astype(np.int64)[:, None]
        if skip_empty == "class":
            return weights * (self.gt_count > 0)
        if skip_empty == "frame":
            weights = weights * (self.gt_count.sum(axis=1, keepdims=True) > 0)
        elif skip_empty is not None:
            raise UserError(
                f'skip_empty must be "class", "frame" or None, got {skip_empty!r}'
            )
        return np.broadcast_to(weights, self.gt_count.shape)

    def results(
        self,
        protocol: str = "kradar_r40",
        *,
        iou_thresholds: Sequence[float] | float = (0.3,),
        skip_empty: str | None = PROTOCOL_DEFAULT,
        score_threshold: float = 0.0,
        spaces: Sequence[str] = SPACES,
        weights: np.ndarray | None = None,
        curves: bool = True,
    ) -> list[Result]:
        """Results in one protocol, over all frames or over weighted ones.

        Args:
            protocol: Name of the protocol.
            iou_thresholds: As in `evaluate`.
            skip_empty: As in `evaluate`.
            score_threshold: As in `evaluate`.
            spaces: As in `evaluate`.
            weights: `[F]` bool or int weight of every frame; a condition is a mask.
            curves: Keep the precision, recall and score arrays.
        """
        chosen = protocols.get_protocol(protocol)
        skip = chosen.skip_empty if skip_empty == PROTOCOL_DEFAULT else skip_empty
        spaces = (spaces,) if isinstance(spaces, str) else tuple(spaces)
        if not set(spaces) <= set(SPACES):
            raise UserError(f"spaces must be among {SPACES}, got {spaces}")
        frame_weights = self.frame_weights(skip, weights)
        empty = np.zeros(0)
        results = []
        for space in spaces:
            for iou in _check_ious(iou_thresholds):
                for index, name in enumerate(self.classes):
                    weight = frame_weights[:, index]
                    curve = self.curve(
                        chosen, space, iou, index, weight, score_threshold
                    )
                    kept = (curve.precision, curve.recall, curve.score)
                    results.append(
                        Result(
                            name,
                            space,
                            iou,
                            curve.ap,
                            curve.num_gt,
                            curve.num_det,
                            chosen.name,
                            int((weight > 0).sum()),
                            float(score_threshold),
                            skip,
                            self.roi,
                            self.label_version,
                            *(kept if curves else (empty, empty, empty)),
                        )
                    )
        return results

    def curve(
        self,
        protocol: protocols.Protocol,
        space: str,
        iou: float,
        cls: int,
        weight: np.ndarray,
        score_threshold: float = 0.0,
    ) -> protocols.Curve:
        """Curve and AP of one class over frames with integer weights `[F]`."""
        order = self._by_score[cls]
        score = self.pred.score[order]
        if protocol.matching == "kradar" or score_threshold != 0:
            order = order[score > score_threshold]
            score = self.pred.score[order]
        det_weight = weight[self.pred.frame[order]]
        num_gt = int(weight @ self.gt_count[:, cls])
        match = self.match(protocol, space, iou)
        if protocol.matching != "kradar":
            return protocols.pooled_curve(
                score=score,
                is_tp=match[order] >= 0,
                weight=det_weight,
                num_gt=num_gt,
                curve=protocol.curve,
            )
        first = self._falling(match.first_pred, cls, score_threshold)[0]
        event, which = self._falling(match.event_pred, cls, score_threshold)
        return protocols.kradar_curve(
            matched_score=self.pred.score[first],
            matched_weight=weight[self.pred.frame[first]],
            event_score=self.pred.score[event],
            event_delta=match.event_delta[which] * weight[self.pred.frame[event]],
            det_score=score,
            det_weight=det_weight,
            num_gt=num_gt,
            samples=protocol.curve,
        )

    def _falling(
        self, pred: np.ndarray, cls: int, score_threshold: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Entries of a class above the score cut by falling score, and where they were."""
        which = np.flatnonzero(
            (self.pred.cls[pred] == cls) & (self.pred.score[pred] > score_threshold)
        )
        which = which[np.argsort(-self.pred.score[pred[which]], kind="stable")]
        return pred[which], which


def _check_classes(classes: Sequence[str]) -> tuple[str, ...]:
    """Class names as a tuple; raises for none, one twice or a plain string."""
    if isinstance(classes, str) or not len(classes):
        raise UserError(f"classes must be a sequence of class names, got {classes!r}")
    names = tuple(str(name) for name in classes)
    if len(set(names)) != len(names):
        raise UserError(f"a class is named twice in {names}")
    return names


def _check_ious(iou_thresholds: Sequence[float] | float) -> tuple[float, ...]:
    """IoU thresholds as a tuple of floats in [0, 1)."""
    values = tuple(float(v) for v in np.atleast_1d(np.asarray(iou_thresholds, float)))
    if not values or not all(0 <= value < 1 for value in values):
        raise UserError(f"iou_thresholds must lie in [0, 1), got {iou_thresholds}")
    return values
