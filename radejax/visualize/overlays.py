"""Lines over radar maps: region of interest, boxes with headings, labels, legend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from radejax.visualize.canvas import (
    GROUND_TRUTH_COLOR,
    PREDICTION_COLOR,
    PREDICTION_TEXT_COLOR,
    ROI_COLOR,
    Objects,
    as_objects,
    footprints,
    halo,
    heading_marks,
    label_texts,
)
from radejax.visualize.label_placement import draw_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POINTS_PER_EDGE = 8  # straight edges bend in the polar view


def both_sets(
    ground_truth: Any, predictions: Any, class_names: Sequence[str] | None
) -> tuple[Objects | None, Objects | None]:
    """Both sets as `Objects`; what was not given stays None."""
    truth = found = None
    if ground_truth is not None:
        truth = as_objects(ground_truth, class_names, what="ground_truth")
        truth = truth._replace(scores=None)
    if predictions is not None:
        found = as_objects(predictions, class_names, what="predictions")
    return truth, found


def draw_roi(ax: Axes, outline: np.ndarray) -> None:
    """Dashed black line with a white rim: visible on dark and on bright ground."""
    ax.plot(
        *outline.T,
        color=ROI_COLOR,
        linewidth=1.4,
        linestyle=(0, (5, 3)),
        path_effects=halo(2.6, "white"),
        zorder=3,
    )


def draw_objects(
    ax: Axes,
    truth: Objects | None,
    found: Objects | None,
    to_axes: Callable[[np.ndarray], np.ndarray],
    *,
    show_labels: bool,
) -> None:
    """Boxes with heading marks, then their labels: ground truth left, found right."""
    ax.apply_aspect()
    outlines, texts, colors, prefer = [], [], [], []
    thickness = _thickness(ax, [o for o in (truth, found) if o is not None], to_axes)
    for objects, color, text_color, width, is_truth in (
        (truth, GROUND_TRUTH_COLOR, GROUND_TRUTH_COLOR, 1.9, True),
        (found, PREDICTION_COLOR, PREDICTION_TEXT_COLOR, 1.3, False),
    ):
        if objects is None or not len(objects.boxes):
            continue
        edges = to_axes(footprints(objects.boxes, _POINTS_PER_EDGE))
        marks = to_axes(heading_marks(objects.boxes))
        width *= thickness
        ax.add_collection(
            LineCollection(
                [*edges, *marks],
                colors=color,
                linewidths=width,
                path_effects=halo(width + 1.2 * thickness),
                capstyle="round",
                zorder=4 if is_truth else 5,
            ),
            autolim=False,
        )
        outlines += list(np.concatenate([edges, marks], 1))
        texts += label_texts(objects)
        colors += [text_color] * len(edges)
        prefer += ["left" if is_truth else "right"] * len(edges)
    if show_labels and outlines:
        draw_labels(ax, outlines, texts, colors, prefer)


def _thickness(ax: Axes, sets: list[Objects], to_axes: Callable) -> float:
    """Factor on line widths, so that outlines of small boxes do not become blobs."""
    boxes = [footprints(s.boxes) for s in sets if len(s.boxes)]
    if not boxes:
        return 1.0
    points = ax.transData.transform(to_axes(np.concatenate(boxes)).reshape(-1, 2))
    edges = np.diff(points.reshape(-1, 5, 2), axis=1)
    short_side_pt = np.hypot(*np.moveaxis(edges, -1, 0)).min(-1) * 72 / ax.figure.dpi
    return float(np.clip(np.median(short_side_pt) / 8.0, 0.5, 1.0))


def legend_handles(
    truth: Objects | None, found: Objects | None, roi: Any
) -> list[Line2D]:
    """One handle per kind of line in the picture."""
    handles = []
    for objects, color, width, name in (
        (truth, GROUND_TRUTH_COLOR, 1.9, "ground truth"),
        (found, PREDICTION_COLOR, 1.3, "prediction"),
    ):
        if objects is not None:
            label = f"{name} ({len(objects.boxes)})"
            line = Line2D([], [], color=color, lw=width, label=label)
            line.set_path_effects(halo(width + 1.4))
            handles.append(line)
    if roi is not None:
        handles.append(
            Line2D([], [], color=ROI_COLOR, lw=1.4, ls="--", label="region of interest")
        )
    return handles


def draw_legend(
    ax: Axes, truth: Objects | None, found: Objects | None, roi: Any
) -> None:
    """Legend above the axes, where it hides nothing."""
    handles = legend_handles(truth, found, roi)
    if handles:
        ax.legend(
            handles=handles,
            loc="lower center",
            bbox_to_anchor=(0.5, 1.0),
            ncols=len(handles),
            fontsize=8,
            frameon=False,
            handlelength=1.6,
        )
