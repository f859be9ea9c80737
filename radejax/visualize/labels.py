"""Texts next to boxes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from radejax.visualize.style import halo

# Sizes of DejaVu Sans, in units of the font size.
_CHARACTER_WIDTH, _LINE_HEIGHT = 0.60, 1.25
_ALIGN = {
    "left": ("right", -1, 0),
    "right": ("left", 1, 0),
    "above": ("center", 0, 1),
    "below": ("center", 0, -1),
}


class Label(NamedTuple):
    """A text next to an outline.

    Attributes:
        outline: Points in data coordinates.
        text: One line of text.
        color: Color of the text.
        side: "left", "right", "above" or "below".
    """

    outline: Float[np.ndarray, "P 2"]
    text: str
    color: str
    side: str


def draw_labels(ax: Axes, labels: Sequence[Label], font_size: float = 7.5) -> None:
    """Write each text next to its outline, if no earlier text is covered by it.

    The limits and the aspect of the axes must be final: space is computed in pixels.

    Args:
        ax: Where to draw.
        labels: The most important first.
        font_size: Font size in points.
    """
    point = ax.figure.dpi / 72  # pixels
    gap = 3 * point
    low, high = ax.get_window_extent().get_points()
    taken = np.zeros((0, 4))
    for label in labels:
        pixels = ax.transData.transform(label.outline)
        first, last = pixels.min(0), pixels.max(0)
        center = (first + last) / 2
        align, right, up = _ALIGN[label.side]
        size = np.array([_CHARACTER_WIDTH * len(label.text), _LINE_HEIGHT])
        size *= font_size * point
        offset = (last - first) / 2 + gap
        middle = center + (right, up) * (offset + size / 2)
        box = np.concatenate([middle - size / 2, middle + size / 2])
        is_outside = (center < low).any() or (center > high).any()
        is_covered = (taken[:, :2] < box[2:]).all(1) & (taken[:, 2:] > box[:2]).all(1)
        if is_outside or is_covered.any():
            continue
        taken = np.concatenate([taken, box[None]])
        x, y = ax.transData.inverted().transform(center + (right, up) * offset)
        ax.text(
            *(x, y, label.text),
            ha=align,
            va=("center", "bottom", "top")[up],
            color=label.color,
            fontsize=font_size,
            path_effects=halo(1.6),
            zorder=6,
        )
