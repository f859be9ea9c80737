"""Precision-recall curves of a report."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from radejax.evaluation.boxes import Columns
from radejax.evaluation.evaluation_set import SPACES, EvaluationSet, Result
from radejax.evaluation.protocols import RECOMMENDED
from radejax.evaluation.results import EvaluationOptions, condition_masks


def draw(
    data: EvaluationSet,
    frames: Columns,
    options: EvaluationOptions,
    out_dir: pathlib.Path,
) -> None:
    """Draw precision over recall at the first IoU threshold, a curve per weather."""
    # Imported here, as matplotlib takes a second to load and may not be needed.
    from radejax.visualize.style import save_figure

    iou = options.iou_thresholds[0]
    suffix = ", simulated data" if data.is_simulated else ""
    everything = {"all": np.ones(data.frame.size, bool)}
    for space in SPACES:
        results = {
            name: data.results(
                RECOMMENDED,
                iou_thresholds=iou,
                spaces=space,
                weights=mask,
                **options.settings_of(RECOMMENDED),
            )
            for name, mask in (everything | condition_masks(frames, "weather")).items()
        }
        figure = _precision_recall(
            results, f"{RECOMMENDED}, {space}, IoU {iou:g}{suffix}"
        )
        path = out_dir / f"precision_recall_{space}_iou{100 * iou:.4g}.png"
        save_figure(figure, path, dpi=110)


def _precision_recall(results: Mapping[str, Sequence[Result]], settings: str) -> Any:
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
        draw_precision_recall(lines, ax=axis, title=f"{panel[0].cls}, {settings}")
        if not any(np.any(result.recall) for result in panel if result.is_defined):
            axis.text(0.5, 0.5, "none found", transform=axis.transAxes, ha="center")
    return figure
