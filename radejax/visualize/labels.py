"""Places the texts beside boxes so that they cover neither boxes nor each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from radejax.visualize.canvas import halo

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Sizes of DejaVu Sans, in units of the font size: near enough to reserve room.
_CHARACTER_WIDTH = 0.60
_LINE_HEIGHT = 1.25


def place_labels(
    obstacles: np.ndarray,
    anchors: np.ndarray,
    sizes: np.ndarray,
    prefer_left: np.ndarray,
    frame: np.ndarray,
    *,
    gap: float,
) -> np.ndarray:
    """Lower left corners of labels beside their boxes, clear of what is there already.

    Greedy: labels are placed in the given order, each at the nearest of a fan of
    places (left or right of its box, shifted up or down by half lines) where it
    overlaps the least.

    Args:
        obstacles: `[M, 4]` rectangles x0, y0, x1, y1 to keep clear.
        anchors: `[N, 4]` rectangle of the box that each label belongs to.
        sizes: `[N, 2]` width and height of each label.
        prefer_left: `[N]` bool, True where the label should stand left of its box.
        frame: `[4]` rectangle that labels should not leave.
        gap: Distance between box and label.

    Returns:
        `[N, 2]` corners, in the unit of the input (pixels).
    """
    taken = [np.asarray(r, float) for r in obstacles]
    corners = np.zeros((len(anchors), 2))
    for i, (box, (width, height)) in enumerate(zip(anchors, sizes, strict=True)):
        shifts = 0.5 * height * np.array([0, 1, -1, 2, -2, 3, -3, 4, -4, 6, -6, 8, -8])
        left, right = box[0] - gap - width, box[2] + gap
        sides = (left, right) if prefer_left[i] else (right, left)
        x0 = np.tile(sides, len(shifts))
        y0 = np.repeat((box[1] + box[3]) / 2 - height / 2 + shifts, 2)
        places = np.stack([x0, y0, x0 + width, y0 + height], -1)
        area = width * height
        outside = area - _overlap(places, np.asarray(frame, float)[None]).sum(-1)
        covered = _overlap(places, np.array(taken).reshape(-1, 4)).sum(-1)
        # A small price on distance decides among places that are equally clear.
        cost = (2 * outside + covered) / area + 0.02 * np.arange(len(places))
        best = int(np.argmin(cost))
        corners[i] = places[best, :2]
        taken.append(places[best])
    return corners


def _overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`[N, M]` areas shared by rectangles `[N, 4]` and `[M, 4]`."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.clip(high - low, 0, None).prod(-1)


def draw_labels(
    ax: Axes,
    outlines: list[np.ndarray],
    texts: list[str],
    colors: list[str],
    prefer_left: list[bool],
    *,
    font_size: float = 7.5,
) -> None:
    """Writes a text beside each outline; a thin line leads to a text that moved away.

    Axes limits and aspect must be final: room is reserved in pixels.

    Args:
        ax: Where to draw.
        outlines: N arrays `[P, 2]` of points in data coordinates.
        texts: N texts.
        colors: N colours.
        prefer_left: Which texts should stand left of their outline.
        font_size: Points.
    """
    frame = ax.get_window_extent().extents
    rectangles = np.zeros((len(outlines), 4))
    for i, outline in enumerate(outlines):
        pixels = ax.transData.transform(outline)
        rectangles[i] = [*pixels.min(0), *pixels.max(0)]
    centers = (rectangles[:, :2] + rectangles[:, 2:]) / 2
    shown = np.flatnonzero(
        ((centers >= frame[:2]) & (centers <= frame[2:])).all(-1)
        if len(outlines)
        else []
    )
    pixel_per_point = ax.figure.dpi / 72
    line = font_size * pixel_per_point
    sizes = np.array(
        [[_CHARACTER_WIDTH * line * len(texts[i]), _LINE_HEIGHT * line] for i in shown]
    ).reshape(-1, 2)
    corners = place_labels(
        rectangles[shown],
        rectangles[shown],
        sizes,
        np.array(prefer_left, bool)[shown],
        frame,
        gap=3 * pixel_per_point,
    )
    for i, corner, size in zip(shown, corners, sizes, strict=True):
        _draw_label(
            ax, texts[i], colors[i], rectangles[i], corner, size, font_size=font_size
        )


def _draw_label(
    ax: Axes,
    text: str,
    color: str,
    rectangle: np.ndarray,
    corner: np.ndarray,
    size: np.ndarray,
    *,
    font_size: float,
) -> None:
    """One text, right-aligned on the left of its box, with its leader if it moved."""
    pixel_per_point = ax.figure.dpi / 72
    is_left = corner[0] < rectangle[0]
    edge = np.array(
        [rectangle[0] if is_left else rectangle[2], rectangle[[1, 3]].mean()]
    )
    target = corner + size * (1.0 if is_left else 0.0, 0.5)
    has_moved = abs(target[1] - edge[1]) > 0.75 * size[1]
    leader = {"arrowstyle": "-", "color": color, "lw": 0.6, "shrinkA": 0, "shrinkB": 0}
    ax.annotate(
        text,
        xy=ax.transData.inverted().transform(edge),
        xytext=(target - edge) / pixel_per_point,
        textcoords="offset points",
        ha="right" if is_left else "left",
        va="center",
        color=color,
        fontsize=font_size,
        path_effects=halo(1.6),
        arrowprops=leader if has_moved else None,
        annotation_clip=True,
        zorder=6,
    )
