"""Curves of a report: precision and recall, calibration. Matplotlib, no display needed."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from radejax import files
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import RECOMMENDED

COLORS = (
    "#1b6ca8",
    "#d1495b",
    "#2e933c",
    "#b5838d",
    "#edae49",
    "#6a4c93",
    "#30638e",
    "#444444",
)


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
    figure, axes = _panels(len(data.classes))
    everything = np.ones(data.frame.size, bool)
    for position, (name, mask) in enumerate({"all": everything, **masks}.items()):
        results = data.results(
            RECOMMENDED,
            iou_thresholds=iou,
            spaces=space,
            score_threshold=score_threshold,
            weights=mask,
        )
        for axis, result in zip(axes, results, strict=True):
            if not result.is_defined:
                continue
            height = np.maximum.accumulate(result.precision[::-1])[::-1]
            axis.step(
                np.concatenate([[0.0], result.recall]),
                np.concatenate([height[:1], height]),
                color="black" if name == "all" else COLORS[position % len(COLORS)],
                linewidth=1.8 if name == "all" else 1.0,
                label=f"{name} {result.ap:.1f}",
            )
    for axis, cls in zip(axes, data.classes, strict=True):
        axis.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="recall", ylabel="precision")
        axis.set_title(cls, fontsize=10)
        axis.grid(alpha=0.3)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=7, title="AP", title_fontsize=7)
    figure.suptitle(f"{RECOMMENDED}, {space}, IoU {iou:g}, roi {data.roi}", fontsize=10)
    _save(figure, path)


def calibration(numbers: Mapping[str, Mapping[str, Any]], path: pathlib.Path) -> None:
    """Precision over score, one curve per class, from `breakdown.calibration`."""
    figure, axes = _panels(1)
    axis = axes[0]
    axis.plot([0, 1], [0, 1], color="#999999", linewidth=1, linestyle="--")
    for position, (name, bins) in enumerate(numbers.items()):
        points = [
            (score, precision)
            for score, precision in zip(bins["score"], bins["precision"], strict=True)
            if score is not None
        ]
        if points:
            axis.plot(
                *zip(*points, strict=True),
                marker="o",
                markersize=3,
                color="black" if name == "all" else COLORS[position % len(COLORS)],
                label=f"{name} (error {bins['error']:.3f})",
            )
    axis.set(xlim=(0, 1), ylim=(0, 1), xlabel="score", ylabel="precision")
    axis.grid(alpha=0.3)
    if len(axis.get_legend_handles_labels()[0]):
        axis.legend(fontsize=7)
    _save(figure, path)


def _panels(count: int) -> tuple[Figure, Sequence[Any]]:
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(4.2 * columns, 3.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axis in axes[count:]:
        axis.set_axis_off()
    return figure, axes[:count]


def _save(figure: Figure, path: pathlib.Path) -> None:
    FigureCanvasAgg(figure)
    with files.atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:], dpi=110)
