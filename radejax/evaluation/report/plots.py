"""Curves of a report: precision and recall, calibration."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping

import numpy as np

from radejax.core import files
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import RECOMMENDED
from radejax.evaluation.report import breakdown
from radejax.visualize.canvas import new_figure
from radejax.visualize.curves import draw_calibration, draw_precision_recall


def precision_recall(
    data: EvaluationSet,
    masks: Mapping[str, np.ndarray],
    path: pathlib.Path,
    *,
    iou: float,
    space: str = "3d",
    score_threshold: float = 0.0,
) -> None:
    """One panel per class, one curve per condition, in the recommended protocol.

    Args:
        data: The evaluation set.
        masks: `[F]` frame masks by condition; "all" is drawn too.
        path: Picture to write.
        iou: IoU threshold.
        space: "bev" or "3d".
        score_threshold: Score cut.
    """
    curves: dict[str, dict[str, tuple]] = {name: {} for name in data.classes}
    for name, mask in {"all": np.ones(data.frame.size, bool), **masks}.items():
        results = data.results(
            RECOMMENDED,
            iou_thresholds=iou,
            spaces=space,
            score_threshold=score_threshold,
            weights=mask,
        )
        for result in results:
            if result.is_defined:
                label = f"{name}, AP {result.ap:.1f}"
                curves[result.cls][label] = (result.recall, result.precision)
    columns = min(len(curves), 3)
    rows = -(-len(curves) // columns)
    figure = new_figure(4.6 * columns, 4.0 * rows, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axis in axes[len(curves) :]:
        axis.set_axis_off()
    for axis, (cls, lines) in zip(axes, curves.items(), strict=False):
        draw_precision_recall(lines, ax=axis, title=f"{cls}, {space}, IoU {iou:g}")
    _save(figure, path)


def calibration(
    data: EvaluationSet, path: pathlib.Path, *, iou: float, space: str = "3d"
) -> None:
    """How often predictions of a score are right, all classes together."""
    match = breakdown.matched_objects(data, space, iou)
    axis = draw_calibration(data.pred.score, match >= 0, title=f"{space}, IoU {iou:g}")
    _save(axis.figure, path)


def _save(figure: object, path: pathlib.Path) -> None:
    with files.atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:], dpi=110)
