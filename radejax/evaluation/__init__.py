"""Average precision of 3D detections, in every protocol that K-Radar papers use.

`evaluate` computes the APs of one protocol from column arrays. For several evaluations of
the same predictions (protocols, weathers, resamples), build an `EvaluationSet`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from radejax.core.structures import CLASSES
from radejax.evaluation.boxes import (
    AnyBoxes,
    AnyColumns,
    Roi,
    columns_of_boxes,
    with_ids,
)
from radejax.evaluation.evaluation_set import SPACES, EvaluationSet, Result, mean_ap
from radejax.evaluation.protocols import PROTOCOLS

__all__ = ["PROTOCOLS", "SPACES", "EvaluationSet", "Result", "evaluate", "mean_ap"]


def evaluate(
    ground_truth: AnyBoxes,
    predictions: AnyBoxes,
    *,
    classes: Sequence[str] = CLASSES,
    iou_thresholds: Sequence[float] | float = (0.3,),
    protocol: str = "kradar_r40",
    frames: AnyColumns | None = None,
    empty_frames: str = "protocol",
    score_threshold: float = 0.0,
    roi: Roi = None,
    spaces: Sequence[str] = SPACES,
    label_version: str | None = None,
) -> list[Result]:
    """Computes the average precision per class, space and IoU threshold in one protocol.

    Args:
        ground_truth: `Boxes`, or columns frame `[N]` (ids, or keys such as
            "1/00033_00001" as in the files of a report), box `[N, 7]` x, y, z, l, w, h,
            yaw (meters, radians, radar frame, full extents, z at mid-height) and cls
            `[N]` names. The results of K-Radar's protocols depend on the order of boxes
            within each frame.
        predictions: The same columns and score `[M]` in [0, 1].
        classes: Classes to evaluate. `empty_frames` considers only these.
        iou_thresholds: A match needs an IoU above the threshold.
        protocol: One of `protocols.PROTOCOLS`.
        frames: Columns of the frame table, at least frame `[F]`. None uses the frames
            that occur in the other tables. Boxes of other frames are an error.
        empty_frames: Frames to ignore: "class" for frames without an object of the
            class, "frame" for frames without an object of any class, "none" for no
            frames, "protocol" for the default of the protocol.
        score_threshold: Predictions need a score above this threshold. 0 keeps all
            predictions (in K-Radar's protocols, all with a score above 0).
        roi: Region of interest; only boxes with their center in it are kept.
        spaces: "bev" and "3d", or one of them.
        label_version: Label revision, which is part of the names of the results.

    Returns:
        One `Result` per space, IoU threshold and class, in that nesting.

    Raises:
        UserError: A protocol, space, region or empty-frame rule is unknown, or a column
            is missing.
        DataError: A row is invalid; the message names the table, frame and row.

    References:
        K-Radar evaluation: Paek et al., arXiv:2206.08171, and its issues 28, 36, 81.

    Examples:
        >>> import numpy as np
        >>> box = np.array([[20.0, 0, 0, 4, 2, 1.5, 0]])
        >>> truth = {"frame": [0], "box": box, "cls": ["Sedan"]}
        >>> found = {**truth, "score": [0.9]}
        >>> [r.ap for r in evaluate(truth, found, classes=["Sedan"], protocol="all_point")]
        [100.0, 100.0]
    """
    truth, found = map(columns_of_boxes, (ground_truth, predictions))
    named = [
        x["frame"]
        for x in (truth, found)
        if x.get("frame", np.zeros(0)).dtype.kind == "U"
    ]
    if named and frames is None:
        keys = np.unique(np.concatenate(named))
        frames = {"frame": np.arange(len(keys)), "name": keys}
    if named:
        truth = with_ids(truth, frames, "ground truth")
        found = with_ids(found, frames, "predictions")
    data = EvaluationSet(
        truth,
        found,
        classes=classes,
        frames=frames,
        roi=roi,
        label_version=label_version,
    )
    return data.results(
        protocol,
        iou_thresholds=iou_thresholds,
        empty_frames=empty_frames,
        score_threshold=score_threshold,
        spaces=spaces,
    )
