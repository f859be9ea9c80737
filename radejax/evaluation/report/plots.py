"""Curves of a report: precision and recall, calibration."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from radejax.evaluation.columns import Columns
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import RECOMMENDED
from radejax.evaluation.report import breakdown
from radejax.evaluation.report.measure import Options, condition_masks
from radejax.evaluation.result import SPACES, Result


def draw(
    data: EvaluationSet, frames: Columns, options: Options, out_dir: pathlib.Path
) -> list[pathlib.Path]:
    """Draws precision and recall in both spaces, and calibration in 3D.

    Args:
        data: The evaluation set.
        frames: Frame table; a curve per weather is drawn where it says them.
        options: The first IoU threshold and the score cut count.
        out_dir: Folder of the pictures.

    Returns:
        The pictures.
    """
    # Here, as matplotlib takes a second to load and not every report has pictures.
    from radejax.visualize.curves import draw_calibration
    from radejax.visualize.style import save_figure

    iou = options.iou_thresholds[0]
    kind = ", simulated data" if data.is_simulated else ""
    masks = {
        "all": np.ones(data.frame.size, bool),
        **condition_masks(frames, "weather"),
    }
    written = []
    for space in SPACES:
        results = {
            name: data.results(
                RECOMMENDED,
                iou_thresholds=iou,
                spaces=space,
                score_threshold=options.cut(RECOMMENDED),
                weights=mask,
            )
            for name, mask in masks.items()
        }
        terms = f"{RECOMMENDED}, {space}, IoU {iou:g}{kind}"
        figure = _precision_recall(results, terms)
        path = out_dir / f"precision_recall_{space}_iou{100 * iou:.4g}.png"
        written.append(save_figure(figure, path, dpi=110))
    match = breakdown.matched_objects(data, "3d", iou)
    axis = draw_calibration(data.pred.score, match >= 0, title=f"3d, IoU {iou:g}{kind}")
    figure = axis.figure.figure
    return [*written, save_figure(figure, out_dir / "calibration.png", dpi=110)]


def _precision_recall(results: Mapping[str, Sequence[Result]], terms: str) -> Any:
    """Figure with one panel per class that has objects, one curve per condition."""
    from radejax.visualize.curves import draw_precision_recall
    from radejax.visualize.style import new_figure

    classes = list(zip(*results.values(), strict=True))  # results of a class each
    seen = [panel for panel in classes if any(result.is_defined for result in panel)]
    panels = seen or classes[:1]
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    figure = new_figure(4.6 * columns, 4.8 * rows, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    for axis, panel in zip(axes, panels, strict=False):
        lines = {
            f"{name}, AP {result.ap:.1f}": (result.recall, result.precision)
            if result.is_defined
            else None
            for name, result in zip(results, panel, strict=True)
        }
        draw_precision_recall(lines, ax=axis, title=f"{panel[0].cls}, {terms}")
        if not any(np.any(result.recall) for result in panel if result.is_defined):
            axis.text(0.5, 0.5, "none found", transform=axis.transAxes, ha="center")
    return figure
