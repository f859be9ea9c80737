"""Range-azimuth maps on the ground plane: every bin covers the ground it measures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from radejax.core.errors import UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.canvas import (
    COLOR_MAP,
    add_colorbar,
    color_limits_of,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Extent = Literal["roi", "fov"] | Sequence[float]
_OUTSIDE_COLOR = "0.90"
_BEHIND_M = 2.0  # shown behind the sensor, so that its mark is whole


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
    low, high = color_limits or color_limits_of(shown)
    # Edges half a bin outside the centers; the range edge before zero is zero.
    range_cell = np.arange(grid.num_range + 1) - 0.5
    range_cell = np.maximum(range_cell, -grid.range_m[0] / grid.range_step_m)
    edges = grid.cell_to_ego(
        range_cell[rows.start : rows.stop + 1, None],
        np.arange(columns.start, columns.stop + 1)[None, :] - 0.5,
    )  # [R' + 1, A' + 1, 2]
    ax.set_facecolor(_OUTSIDE_COLOR)
    mesh = ax.pcolormesh(
        edges[..., 1],
        edges[..., 0],
        shown,
        cmap=cmap,
        vmin=low,
        vmax=high,
        rasterized=True,
    )
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
        return tuple(float(v) for v in extent)
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
