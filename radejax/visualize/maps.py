"""Range-azimuth maps on the ground plane, and what is drawn over radar maps.

Every bin covers the ground that it measures. Over it: the region of interest, boxes with
headings and labels, the legend.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Real
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from radejax.core.errors import UserError
from radejax.core.structures import ROIS
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.canvas import (
    COLOR_MAP,
    ROI_COLOR,
    Objects,
    Scene,
    Style,
    add_colorbar,
    draw_tiles,
    footprints,
    halo,
    heading_marks,
    label_texts,
    new_figure,
)
from radejax.visualize.label_placement import Label, draw_labels

Extent = Literal["roi", "fov"] | Sequence[float]
_OUTSIDE_COLOR = "0.90"
_BEHIND_M = 2.0  # shown behind the sensor, so that its mark is whole
_POINTS_PER_EDGE = 8  # straight edges bend in the polar view


def draw_map(
    values: Any,
    grid: RadarGrid,
    *,
    ax: Axes | None = None,
    extent: Extent = "fov",
    color_limits: tuple[float, float] | None = None,
    cmap: Any = COLOR_MAP,
    label: str = "",
    show_colorbar: bool = True,
) -> Axes:
    """Draws any range-azimuth map on the ground plane: heatmaps, gates, attention.

    Args:
        values: `[R, A]`.
        grid: The grid of the map; padded maps come with the padded grid.
        ax: Where to draw; a new figure by default.
        extent: "fov" or x_min, x_max, y_min, y_max in metres.
        color_limits: Ends of the colour bar; by default from the values shown.
        cmap: Colour map.
        label: Text of the colour bar.
        show_colorbar: Give the map's scale.
    """
    values = np.asarray(values, np.float32)
    if values.shape != (grid.num_range, grid.num_azimuth):
        raise UserError(
            f"map has shape {values.shape}, the grid expects (range, azimuth) = "
            f"{(grid.num_range, grid.num_azimuth)}"
        )
    x0, x1, y0, y1 = extent_m(grid, None, extent)
    ax = axes_for_extent((x0, x1, y0, y1)) if ax is None else ax
    rows, columns = _bins_shown(grid, (x0, x1, y0, y1))
    shown = values[rows, columns]
    # Edges half a bin outside the centers; the range edge before zero is zero.
    range_cell = np.arange(grid.num_range + 1) - 0.5
    range_cell = np.maximum(range_cell, -grid.range_m[0] / grid.range_step_m)
    edges = grid.bin_to_ego(
        range_cell[rows.start : rows.stop + 1, None],
        np.arange(columns.start, columns.stop + 1)[None, :] - 0.5,
    )  # [R' + 1, A' + 1, 2]
    ax.set_facecolor(_OUTSIDE_COLOR)
    mesh = draw_tiles(ax, edges[..., 1], edges[..., 0], shown, color_limits, cmap)
    # Seen from above with x ahead, left is left: y grows to the left.
    ax.set(xlim=(y1, y0), ylim=(x0, x1), xlabel="y, left [m]", ylabel="x, ahead [m]")
    ax.set_aspect("equal")
    if show_colorbar:
        add_colorbar(mesh, ax, label)
    return ax


def extent_m(
    grid: RadarGrid, roi: Sequence[float] | None, extent: Extent
) -> tuple[float, float, float, float]:
    """x_min, x_max, y_min, y_max of the picture."""
    if not isinstance(extent, str):
        if len(extent) != 4 or extent[0] >= extent[1] or extent[2] >= extent[3]:
            raise UserError(
                f"extent must be x_min, x_max, y_min, y_max in metres, got {extent}"
            )
        x0, x1, y0, y1 = map(float, extent)
        return x0, x1, y0, y1
    if extent not in ("roi", "fov"):
        raise UserError(f"extent must be 'roi', 'fov' or 4 numbers, got {extent!r}")
    far = grid.range_m[-1] + grid.range_step_m / 2
    side = far * np.sin(min(grid.fov_azimuth_rad, np.pi / 2))
    if extent == "fov" or roi is None:
        return -_BEHIND_M, far, -side, side
    _, x1, y0, y1 = roi_m(roi)
    far = min(far, 1.08 * x1)
    # Narrow regions would be unreadable slivers: show at least 3:4.
    half = min(max(-y0, y1, 0.0) * 1.25, side)
    half = max(half, 0.37 * far)
    return -_BEHIND_M, far, -half, half


def roi_m(roi: Sequence[float]) -> tuple[float, float, float, float]:
    """x_min, x_max, y_min, y_max of a region of interest."""
    values = [float(v) for v in np.asarray(roi, np.float64).ravel()]
    if len(values) not in (4, 6) or values[0] >= values[1] or values[2] >= values[3]:
        raise UserError(
            "roi must be x_min, x_max, y_min, y_max (, z_min, z_max) in metres, "
            f"got {values}"
        )
    return values[0], values[1], values[2], values[3]


def axes_for_extent(extent: Sequence[float]) -> Axes:
    """Axes of a new figure that fit an extent, with room for scale and legend."""
    x0, x1, y0, y1 = extent
    scale = min(5.5 / (x1 - x0), 6.0 / (y1 - y0))
    width, height = scale * (y1 - y0), scale * (x1 - x0)
    total = width + 1.75, height + 1.2
    figure = new_figure(*total)
    return figure.add_axes(
        (0.65 / total[0], 0.55 / total[1], width / total[0], height / total[1])
    )


def _bins_shown(grid: RadarGrid, extent: Sequence[float]) -> tuple[slice, slice]:
    """Range and azimuth bins that touch a rectangle that lies ahead (a superset).

    Bins outside the picture cost time to draw and would set its colours.
    """
    x0, x1, y0, y1 = extent
    corners = np.array([[x, y] for x in (max(x0, 0.0), x1) for y in (y0, y1)])
    nearest_y = np.clip(0.0, y0, y1)
    low = (np.hypot(max(x0, 0.0), nearest_y) - grid.range_m[0]) / grid.range_step_m
    high = (np.hypot(*corners.T).max() - grid.range_m[0]) / grid.range_step_m
    first = int(np.clip(np.floor(low) - 1, 0, grid.num_range - 1))
    last = int(np.clip(np.ceil(high) + 2, first + 1, grid.num_range))
    return slice(first, last), slice(0, grid.num_azimuth)


# Over maps ---------------------------------------------------------------------------


def draw_roi(ax: Axes, outline: Real[np.ndarray, "P 2"]) -> None:
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
    sets: Sequence[tuple[Style, Objects]],
    to_axes: Callable[[np.ndarray], np.ndarray],
    *,
    show_labels: bool,
) -> None:
    """Boxes with heading marks, then their labels: ground truth left, found right.

    Args:
        ax: Where to draw; limits and aspect are final.
        sets: Of a `Scene`.
        to_axes: Ground positions `[..., 2]` to data coordinates.
        show_labels: Write class and score beside the boxes.
    """
    ax.apply_aspect()
    sets = [(style, objects) for style, objects in sets if len(objects.boxes)]
    if not sets:
        return
    labels = []
    thickness = _thickness(ax, np.concatenate([o.boxes for _, o in sets]), to_axes)
    for order, (style, objects) in enumerate(sets):
        edges = to_axes(footprints(objects.boxes, _POINTS_PER_EDGE))
        marks = to_axes(heading_marks(objects.boxes))
        width = style.map_width * thickness
        ax.add_collection(
            LineCollection(
                [*edges, *marks],
                colors=style.color,
                linewidths=width,
                path_effects=halo(width + 1.2 * thickness),
                capstyle="round",
                zorder=4 + order,
            ),
            autolim=False,
        )
        outlines = np.concatenate([edges, marks], 1)
        labels += [
            Label(outline, text, style.text_color, style.side)
            for outline, text in zip(outlines, label_texts(objects), strict=True)
        ]
    if show_labels:
        draw_labels(ax, labels)


def _thickness(ax: Axes, boxes: Float[np.ndarray, "N 7"], to_axes: Callable) -> float:
    """Factor on line widths, so that outlines of small boxes do not become blobs."""
    points = ax.transData.transform(to_axes(footprints(boxes)).reshape(-1, 2))
    edges = np.diff(points.reshape(-1, 5, 2), axis=1)
    short_side_pt = np.hypot(*np.moveaxis(edges, -1, 0)).min(-1) * 72 / ax.figure.dpi
    return float(np.clip(np.median(short_side_pt) / 8.0, 0.5, 1.0))


def legend_handles(scene: Scene, *, show_counts: bool = True) -> list[Line2D]:
    """One handle per kind of line in the picture."""
    handles = []
    for style, objects in scene.sets:
        count = f" ({len(objects.boxes)})" if show_counts else ""
        if objects.scores is not None and scene.score_threshold is not None:
            count += f", score from {scene.score_threshold:g}"
        width, label = style.map_width, style.name + count
        line = Line2D([], [], color=style.color, lw=width, label=label)
        line.set_path_effects(halo(width + 1.4))
        handles.append(line)
    if scene.roi is not None:
        named = [name for name, roi in ROIS.items() if roi == tuple(scene.roi)]
        label = f"{named[0]} region" if named else "region of interest"
        handles.append(Line2D([], [], color=ROI_COLOR, lw=1.4, ls="--", label=label))
    return handles


def draw_legend(ax: Axes, scene: Scene) -> None:
    """Legend above the axes, where it hides nothing."""
    handles = legend_handles(scene)
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
