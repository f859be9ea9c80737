"""Places the texts beside boxes so that they cover neither boxes nor each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes

from radejax.visualize.canvas import Side, halo

# Sizes of DejaVu Sans, in units of the font size: near enough to reserve room.
_CHARACTER_WIDTH = 0.60
_LINE_HEIGHT = 1.25
_MOST_COVERED = 0.1  # of a label by others, to stay readable


class Label(NamedTuple):
    """A text beside an outline.

    Attributes:
        outline: Points in data coordinates.
        text: One line.
        color: Of text and leader.
        side: Where the text should stand.
    """

    outline: Float[np.ndarray, "P 2"]
    text: str
    color: str
    side: Side


def place_labels(
    obstacles: Float[np.ndarray, "M 4"],
    anchors: Float[np.ndarray, "N 4"],
    sizes: Float[np.ndarray, "N 2"],
    prefer: Sequence[Side],
    frame: Float[np.ndarray, "4"],
    *,
    gap: float,
) -> Float[np.ndarray, "N 2"]:
    """Lower left corners of labels beside their boxes, clear of what is there already.

    Greedy: labels are placed in the given order, each at the nearest of a fan of
    places (left or right of its box, or above it, shifted by half lines) where it
    overlaps the least.

    Args:
        obstacles: Rectangles x0, y0, x1, y1 to keep clear.
        anchors: Rectangle of the box that each label belongs to.
        sizes: Width and height of each label.
        prefer: N sides where the labels should stand.
        frame: Rectangle that labels should not leave.
        gap: Distance between box and label.

    Returns:
        Corners, in the unit of the input (pixels, y up).
    """
    taken = [np.asarray(r, float) for r in obstacles]
    corners = np.zeros((len(anchors), 2))
    for i, (box, size) in enumerate(zip(anchors, sizes, strict=True)):
        lower_left = _candidates(box, size, prefer[i], gap)
        places = np.concatenate([lower_left, lower_left + size], -1)
        area = size.prod()
        outside = area - _overlap(places, np.asarray(frame, float)[None]).sum(-1)
        covered = _overlap(places, np.array(taken).reshape(-1, 4)).sum(-1)
        # A small price on distance decides among places that are equally clear.
        cost = (2 * outside + covered) / area + 0.004 * np.arange(len(places))
        best = int(np.argmin(cost))
        corners[i] = places[best, :2]
        taken.append(places[best])
    return corners


def _candidates(
    box: Float[np.ndarray, "4"], size: Float[np.ndarray, "2"], prefer: Side, gap: float
) -> Float[np.ndarray, "P 2"]:
    """Lower left corners around a box, the most wanted first."""
    width, height = size
    if prefer == "above":
        shifts = 0.5 * height * np.arange(20)
        middle = (box[0] + box[2] - width) / 2
        columns = (middle, box[0], box[2] - width)
        x = np.tile(columns, len(shifts))
        y = np.repeat(box[3] + gap + shifts, 3)
        inside = [[middle, box[3] - gap - height], [middle, box[1] + gap]]
        return np.concatenate([np.stack([x, y], -1), inside])
    shifts = 0.5 * height * np.array([0, 1, -1, 2, -2, 3, -3, 4, -4, 6, -6, 8, -8])
    left, right = box[0] - gap - width, box[2] + gap
    x = np.tile((left, right) if prefer == "left" else (right, left), len(shifts))
    y = np.repeat((box[1] + box[3]) / 2 - height / 2 + shifts, 2)
    return np.stack([x, y], -1)


def _overlap(
    a: Float[np.ndarray, "N 4"], b: Float[np.ndarray, "M 4"]
) -> Float[np.ndarray, "N M"]:
    """Areas shared by rectangles."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.clip(high - low, 0, None).prod(-1)


def draw_labels(
    ax: Axes,
    labels: Sequence[Label],
    *,
    font_size: float = 7.5,
    keep_boxes_clear: bool = True,
) -> None:
    """Writes a text beside each outline; a thin line leads to a text that moved away.

    Axes limits and aspect must be final: room is reserved in pixels. Outlines whose
    center is out of sight get no text, nor do those for whose text no room is left: of
    texts that cover each other the first is drawn.

    Args:
        ax: Where to draw.
        labels: The most important first.
        font_size: Points.
        keep_boxes_clear: Texts avoid all outlines, not only other texts.
    """
    frame = np.asarray(ax.get_window_extent().extents)
    low, high = frame[:2], frame[2:]
    shown, rectangles = [], []
    for label in labels:
        pixels = ax.transData.transform(label.outline)
        first, last = pixels.min(0), pixels.max(0)
        center = (first + last) / 2
        if ((center >= low) & (center <= high)).all():
            shown.append(label)
            rectangles.append([*np.clip(first, low, high), *np.clip(last, low, high)])
    if not shown:
        return
    anchors = np.array(rectangles)
    pixel_per_point = ax.figure.dpi / 72
    line = font_size * pixel_per_point
    sizes = np.array(
        [[_CHARACTER_WIDTH * line * len(s.text), _LINE_HEIGHT * line] for s in shown]
    )
    corners = place_labels(
        anchors if keep_boxes_clear else np.zeros((0, 4)),
        anchors,
        sizes,
        [label.side for label in shown],
        frame,
        gap=3 * pixel_per_point,
    )
    for i in np.flatnonzero(_is_free(np.concatenate([corners, corners + sizes], -1))):
        _draw_label(ax, shown[i], anchors[i], corners[i], sizes[i], font_size)


def _is_free(places: Float[np.ndarray, "N 4"]) -> Bool[np.ndarray, " N"]:
    """True for rectangles that those before them do not cover."""
    areas = (places[:, 2:] - places[:, :2]).prod(-1)
    covered = _overlap(places, places)
    is_free = np.ones(len(places), bool)
    for i in range(len(places)):
        is_free[i] = covered[i, :i] @ is_free[:i] <= _MOST_COVERED * areas[i]
    return is_free


def _draw_label(
    ax: Axes,
    label: Label,
    anchor: Float[np.ndarray, "4"],
    corner: Float[np.ndarray, "2"],
    size: Float[np.ndarray, "2"],
    font_size: float,
) -> None:
    """One text, aligned with the nearest point of its box, with a leader if it moved."""
    center = corner + size / 2
    edge = np.clip(center, anchor[:2], anchor[2:])
    if corner[0] >= anchor[2]:
        align, target = "left", corner + size * (0.0, 0.5)
    elif corner[0] + size[0] <= anchor[0]:
        align, target = "right", corner + size * (1.0, 0.5)
    else:
        align, target = "center", center
    # The point of the text that is nearest to the box.
    near = np.clip(edge, corner, corner + size)
    has_moved = np.hypot(*(near - edge)) > 0.75 * size[1]
    leader = {"arrowstyle": "-", "color": label.color, "lw": 0.6}
    leader |= {"shrinkA": 0, "shrinkB": 0}
    x, y = ax.transData.inverted().transform(edge)
    right, up = (target - edge) * 72 / ax.figure.dpi
    ax.annotate(
        label.text,
        xy=(x, y),
        xytext=(right, up),
        textcoords="offset points",
        ha=align,
        va="center",
        color=label.color,
        fontsize=font_size,
        path_effects=halo(1.6),
        arrowprops=leader if has_moved else None,
        annotation_clip=False,
        zorder=6,
    )
