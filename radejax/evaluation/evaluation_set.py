"""Ground truth and predictions, paired once and asked many times."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from radejax.core.errors import DataError, UserError
from radejax.core.structures import CLASSES
from radejax.evaluation import columns, matching, overlap, protocols
from radejax.evaluation.columns import AnyColumns
from radejax.evaluation.protocols import PROTOCOL_DEFAULT, Curve, Protocol
from radejax.evaluation.result import SPACES, Result

MOST_PAIRS = 1_000_000
"""Of predictions and ground truths of a class in a frame; 100 and 20 are many."""

Matches = matching.KradarMatches | Int[np.ndarray, " M"]

# Scores, falling; frames; how many true positives (or matches) each adds.
Falling = tuple[
    Float[np.ndarray, " K"],
    Int[np.ndarray, " K"],
    Int[np.ndarray, " K"] | Bool[np.ndarray, " K"],
]


class Terms(NamedTuple):
    """What one AP of a class is asked in: protocol, "bev" or "3d", IoU, score cut."""

    protocol: Protocol
    space: str
    iou: float
    score_threshold: float = 0.0


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
        is_simulated: The frame table says that frames are simulated.
    """

    def __init__(
        self,
        ground_truth: AnyColumns,
        predictions: AnyColumns,
        *,
        classes: Sequence[str] = CLASSES,
        frames: AnyColumns | None = None,
        roi: str | Sequence[float] | None = None,
        label_version: str | None = None,
    ) -> None:
        """See `evaluate` for the arguments."""
        self.classes = _check_classes(classes)
        self.roi = columns.roi_name(roi)
        self.label_version = label_version
        self.is_simulated = columns.are_simulated(frames)
        truth = columns.read_columns(ground_truth, name="ground truth", scored=False)
        found = columns.read_columns(predictions, name="predictions", scored=True)
        if frames is None:
            self.frame = np.unique(np.concatenate([truth[0], found[0]]))
        else:
            self.frame = columns.frame_ids(frames)
        self.left_out: dict[str, int] = {}
        self.gt = self._select(truth, "ground truth", roi)
        self.pred = self._select(found, "predictions", roi)
        num_classes = len(self.classes)
        self.gt_group = self.gt.frame * num_classes + self.gt.cls
        self.pred_group = self.pred.frame * num_classes + self.pred.cls
        self._check_number()
        self.pair_pred, self.pair_gt = overlap.candidate_pairs(
            self.pred_group, self.gt_group, self.pred.box, self.gt.box
        )
        self.gt_count = np.bincount(
            self.gt_group, minlength=self.frame.size * num_classes
        ).reshape(self.frame.size, num_classes)
        self._overlaps: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._matches: dict[tuple, Matches] = {}
        self._parts: dict[tuple, list[Falling]] = {}

    def _select(
        self, table: tuple, name: str, roi: str | Sequence[float] | None
    ) -> columns.Objects:
        """Boxes of the evaluated classes in the region, sorted; counts the others."""
        frame, box, cls_name, score = table
        dense = columns.dense_frames(frame, self.frame, name=name)
        cls = columns.class_indices(cls_name, frame, self.classes, name=name)
        wanted = cls >= 0
        inside = columns.in_roi(box, roi)
        self.left_out[f"{name}: class not evaluated"] = int((~wanted).sum())
        self.left_out[f"{name}: center outside the region of interest"] = int(
            (wanted & ~inside).sum()
        )
        row = np.flatnonzero(wanted & inside)
        row = row[np.lexsort((row, cls[row], dense[row]))]
        return columns.Objects(dense[row], box[row], cls[row], score[row], row)

    def _check_number(self) -> None:
        """`DataError` for more boxes of a class in a frame than can be compared."""
        groups = self.frame.size * len(self.classes)
        counts = [
            np.bincount(group, minlength=groups)
            for group in (self.gt_group, self.pred_group)
        ]
        pairs = counts[0] * counts[1]
        if pairs.max(initial=0) > MOST_PAIRS:
            group = int(pairs.argmax())
            frame, cls = divmod(group, len(self.classes))
            raise DataError(
                f"frame {self.frame[frame]}: {counts[1][group]} predictions and "
                f"{counts[0][group]} ground truths of {self.classes[cls]} are "
                f"{pairs[group]:,} pairs, expected at most {MOST_PAIRS:,}: keep those "
                "with the highest scores"
            )

    # Shared work ---------------------------------------------------------------------

    def overlaps(
        self, geometry: str
    ) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
        """BEV and 3D IoU of the candidate pairs under a protocol's geometry."""
        if geometry not in self._overlaps:
            self._overlaps[geometry] = self._overlap(geometry)
        return self._overlaps[geometry]

    def _overlap(
        self, geometry: str
    ) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
        truth, found = self.gt.box, self.pred.box
        if geometry == "plain":
            return overlap.pair_iou(found[self.pair_pred], truth[self.pair_gt])
        truth = np.round(truth, 2)
        if geometry.startswith("swapped_lw"):
            exchange = [0, 1, 2, 4, 3, 5, 6]
            truth, found = truth[:, exchange], found[:, exchange]
        bev, iou_3d = overlap.pair_iou(
            found[self.pair_pred],
            truth[self.pair_gt],
            z_center=1.0 if geometry == "swapped_lw_z_top" else 0.5,
        )
        # The original stores overlaps in single and compares them in double precision.
        bev, iou_3d = (i.astype(np.float32).astype(np.float64) for i in (bev, iou_3d))
        return bev, iou_3d

    def match(self, protocol: Protocol, space: str, iou: float) -> Matches:
        """Matches of all frames and classes: `KradarMatches` or each one's object or -1."""
        geometry = protocol.geometry
        if geometry == "swapped_lw_z_top" and space == "bev":
            geometry = "swapped_lw"  # z plays no part
        key = (geometry, protocol.matching, space, iou)
        if key not in self._matches:
            values = self.overlaps(geometry)[SPACES.index(space)]
            pairs = matching.Pairs(self.pair_pred, self.pair_gt, values)
            score = self.pred.score
            match: Matches
            if protocol.matching == "kradar":
                match = matching.match_kradar(pairs, score, self.gt_group, iou)
            elif protocol.matching == "best":
                match = matching.match_best(pairs, score, iou)
            else:
                match = matching.match_free(
                    pairs, score, self.pred_group, len(self.gt), iou
                )
            self._matches[key] = match
        return self._matches[key]

    @functools.cached_property
    def by_score(self) -> list[Int[np.ndarray, " _"]]:
        """Predictions of every class by falling score, ties by the caller's row."""
        order = np.lexsort((self.pred.row, -self.pred.score))
        return [order[self.pred.cls[order] == c] for c in range(len(self.classes))]

    # Results -------------------------------------------------------------------------

    def frame_weights(
        self, empty_frames: str | None, weights: Shaped[np.ndarray, " F"] | None = None
    ) -> Int[np.ndarray, "F C"]:
        """Weights of the frames for every class, after the frame rule."""
        if weights is None:
            weights = np.ones(self.frame.size, np.int64)
        weights = np.asarray(weights).astype(np.int64)[:, None]
        if empty_frames == "class":
            return weights * (self.gt_count > 0)
        if empty_frames == "frame":
            weights = weights * (self.gt_count.sum(axis=1, keepdims=True) > 0)
        elif empty_frames is not None:
            raise UserError(
                f'empty_frames must be "class", "frame" or None, got {empty_frames!r}'
            )
        return np.broadcast_to(weights, self.gt_count.shape)

    def results(
        self,
        protocol: str = "kradar_r40",
        *,
        iou_thresholds: Sequence[float] | float = (0.3,),
        empty_frames: str | None = PROTOCOL_DEFAULT,
        score_threshold: float = 0.0,
        spaces: Sequence[str] = SPACES,
        weights: Shaped[np.ndarray, " F"] | None = None,
        curves: bool = True,
    ) -> list[Result]:
        """Results in one protocol, over all frames or over weighted ones.

        Args:
            protocol: Name of the protocol.
            iou_thresholds: As in `evaluate`.
            empty_frames: As in `evaluate`.
            score_threshold: As in `evaluate`.
            spaces: As in `evaluate`.
            weights: bool or int weight of every frame; a condition is a mask.
            curves: Keep the precision, recall and score arrays.
        """
        chosen = protocols.get_protocol(protocol)
        skip = chosen.frame_rule(empty_frames)
        spaces = (spaces,) if isinstance(spaces, str) else tuple(spaces)
        if not set(spaces) <= set(SPACES):
            raise UserError(f"spaces must be among {SPACES}, got {spaces}")
        frame_weights = self.frame_weights(skip, weights)
        points = () if curves else ("precision", "recall", "score")
        dropped = dict.fromkeys(points, np.zeros(0))
        results = []
        for space, iou, (index, name) in itertools.product(
            spaces, _check_ious(iou_thresholds), enumerate(self.classes)
        ):
            weight = frame_weights[:, index]
            terms = Terms(chosen, space, iou, float(score_threshold))
            curve = self.curve(terms, index, weight)
            result = Result(
                cls=name,
                space=space,
                iou=iou,
                protocol=chosen.name,
                num_frames=int((weight > 0).sum()),
                score_threshold=terms.score_threshold,
                empty_frames=skip,
                roi=self.roi,
                label_version=self.label_version,
                is_simulated=self.is_simulated,
                **(vars(curve) | dropped),
            )
            results.append(result)
        return results

    def curve(
        self,
        terms: Terms,
        cls: int,
        weight: Int[np.ndarray, " F"],
        among: Bool[np.ndarray, " F"] | None = None,
    ) -> Curve:
        """Curve and AP of one class over weighted frames.

        `among` is a mask of frames outside which all weights are zero: many questions about
        few frames (resamples of a condition) are answered faster with it.
        """
        (score, frame, is_tp), *steps = self._falling(terms, cls, among)
        num_gt, curve = int(weight @ self.gt_count[:, cls]), terms.protocol.curve
        det_weight = weight[frame]
        if terms.protocol.matching == "kradar":
            matched, events = ((s, count * weight[f]) for s, f, count in steps)
            made = (score, det_weight)
            return protocols.kradar_curve(matched, events, made, num_gt, curve)
        return protocols.pooled_curve(
            score=score, is_tp=is_tp, weight=det_weight, num_gt=num_gt, curve=curve
        )

    def _falling(
        self, terms: Terms, cls: int, among: Bool[np.ndarray, " F"] | None
    ) -> list[Falling]:
        """What a curve of one class needs by falling score, for any weights.

        Predictions with what they found; in K-Radar's protocols then the matches of the
        first pass and the steps of the second.
        """
        protocol, *others = terms
        where = None if among is None else among.tobytes()
        key = (protocol.geometry, protocol.matching, *others, cls, where)
        if key in self._parts:
            return self._parts[key]
        if among is not None:
            whole = self._falling(terms, cls, None)
            parts = [tuple(v[among[part[1]]] for v in part) for part in whole]
        else:
            match, mine = self.match(*terms[:3]), self.by_score[cls]
            if isinstance(match, matching.KradarMatches):
                first, event = match.first_pred, match.event_pred
                counts = [(pred, np.ones_like(pred)) for pred in (mine, first)]
                counts.append((event, match.event_delta))
                cut = terms.score_threshold
            else:  # a cut of 0 keeps all, scores of 0 too
                counts = [(mine, match[mine] >= 0)]
                cut = terms.score_threshold or -1.0
            parts = [self._sorted(pred, count, cls, cut) for pred, count in counts]
        self._parts[key] = parts
        return parts

    def _sorted(
        self,
        pred: Int[np.ndarray, " P"],
        count: Shaped[np.ndarray, " P"],
        cls: int,
        cut: float,
    ) -> Falling:
        """Counts at predictions of a class above the score cut, by falling score."""
        keep = (self.pred.cls[pred] == cls) & (self.pred.score[pred] > cut)
        pred, count = pred[keep], count[keep]
        order = np.argsort(-self.pred.score[pred], kind="stable")
        pred = pred[order]
        return self.pred.score[pred], self.pred.frame[pred], count[order]


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
