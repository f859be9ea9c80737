"""Ground truth and predictions, paired once and asked many times."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import numpy as np

from radejax.core.errors import UserError
from radejax.core.structures import CLASSES
from radejax.evaluation import columns as tables
from radejax.evaluation import matching, overlap, protocols
from radejax.evaluation.result import SPACES, Result

PROTOCOL_DEFAULT = "protocol"


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
        self._parts: dict[tuple, dict[str, np.ndarray]] = {}

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
        among: np.ndarray | None = None,
    ) -> protocols.Curve:
        """Curve and AP of one class over frames with integer weights `[F]`.

        `among` is a `[F]` mask outside which all weights are zero: many questions about
        few frames (resamples of a condition) are answered faster with it.
        """
        parts = self._sorted_parts(
            protocol, space, iou, cls, float(score_threshold), among
        )
        num_gt = int(weight @ self.gt_count[:, cls])
        det_weight = weight[parts["frame"]]
        if protocol.matching != "kradar":
            return protocols.pooled_curve(
                score=parts["score"],
                is_tp=parts["is_tp"],
                weight=det_weight,
                num_gt=num_gt,
                curve=protocol.curve,
            )
        return protocols.kradar_curve(
            matched_score=parts["first_score"],
            matched_weight=weight[parts["first_frame"]],
            event_score=parts["event_score"],
            event_delta=parts["event_delta"] * weight[parts["event_frame"]],
            det_score=parts["score"],
            det_weight=det_weight,
            num_gt=num_gt,
            samples=protocol.curve,
        )

    def _sorted_parts(
        self,
        protocol: protocols.Protocol,
        space: str,
        iou: float,
        cls: int,
        score_threshold: float,
        among: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """What a curve of one class needs, sorted by falling score, for any weights."""
        where = None if among is None else among.tobytes()
        key = (protocol.geometry, protocol.matching, space, iou, cls, score_threshold)
        if (key, where) in self._parts:
            return self._parts[key, where]
        if among is not None:
            parts = self._sorted_parts(protocol, space, iou, cls, score_threshold, None)
            self._parts[key, where] = _parts_among(parts, among)
            return self._parts[key, where]
        score, frame = self.pred.score, self.pred.frame
        order = self._by_score[cls]
        if protocol.matching == "kradar" or score_threshold != 0:
            order = order[score[order] > score_threshold]
        parts = {"score": score[order], "frame": frame[order]}
        match = self.match(protocol, space, iou)
        if protocol.matching != "kradar":
            parts["is_tp"] = match[order] >= 0
        else:
            first = self._falling(match.first_pred, cls, score_threshold)
            event = self._falling(match.event_pred, cls, score_threshold)
            for name, rows in (("first", first), ("event", event)):
                pred = getattr(match, f"{name}_pred")[rows]
                parts[f"{name}_score"], parts[f"{name}_frame"] = (
                    score[pred],
                    frame[pred],
                )
            parts["event_delta"] = match.event_delta[event]
        self._parts[key, where] = parts
        return parts

    def _falling(
        self, pred: np.ndarray, cls: int, score_threshold: float
    ) -> np.ndarray:
        """Positions of a class's predictions above the score cut, by falling score."""
        which = np.flatnonzero(
            (self.pred.cls[pred] == cls) & (self.pred.score[pred] > score_threshold)
        )
        return which[np.argsort(-self.pred.score[pred[which]], kind="stable")]


def _parts_among(
    parts: dict[str, np.ndarray], among: np.ndarray
) -> dict[str, np.ndarray]:
    """The entries of `_sorted_parts` that lie in the frames of a mask."""
    inside = {name: among[parts[name]] for name in parts if name.endswith("frame")}
    return {
        name: values[inside.get(f"{name.rpartition('_')[0]}_frame", inside["frame"])]
        for name, values in parts.items()
    }


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
