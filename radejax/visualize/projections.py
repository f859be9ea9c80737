"""Planes of a projection: what to reduce, in which unit, and pictures of the slices.

A projection `[R, A, D+E]` is two 3D maps side by side: range-azimuth-Doppler (maximum
over elevation) and range-azimuth-elevation (maximum over Doppler). The Doppler axis
wraps around at a few metres per second, so a position on it is an aliased radial
velocity, never the velocity: pictures say so.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from radejax.core.errors import UserError
from radejax.geometry.boxes import corners
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.canvas import (
    GROUND_TRUTH,
    as_objects,
    color_limits_of,
    draw_tiles,
    footprints,
    halo,
    new_figure,
)

Channels = Literal["all", "doppler", "elevation"]
Plane = Literal["range_azimuth", "range_doppler", "azimuth_elevation"]
Reduce = Literal["max", "mean"]
Units = Literal["normalized", "db"]

DB_PER_UNIT = 184.3
"""Decibels per unit of a normalised projection, `p = (dB + 1.2) / 184.3`."""
DB_OFFSET = 1.2

_UNIT_LABELS = {"normalized": "normalised log power", "db": "power [dB]"}
_CHANNEL_LABELS = {
    "all": "Doppler and elevation",
    "doppler": "Doppler",
    "elevation": "elevation",
}


def check_projection(projection: Any, grid: RadarGrid) -> np.ndarray:
    """The projection as a float32 array, or a `UserError` that names both shapes."""
    values = np.asarray(projection, np.float32)
    if values.shape != grid.projection_shape:
        raise UserError(
            f"projection has shape {values.shape}, the grid expects (range, azimuth, "
            f"Doppler + elevation) = {grid.projection_shape}; pass one frame, without "
            "a batch axis, and the grid that it was recorded on"
        )
    return values


def to_units(
    values: Float[np.ndarray, "*bins"], units: Units
) -> Float[np.ndarray, "*bins"]:
    """Normalised log power as it is, or in decibels."""
    _check_choice("units", units, _UNIT_LABELS)
    return values if units == "normalized" else values * DB_PER_UNIT - DB_OFFSET


def range_azimuth(
    projection: Any,
    grid: RadarGrid,
    *,
    channels: Channels = "all",
    reduce: Reduce = "max",
    units: Units = "normalized",
) -> Float[np.ndarray, "R A"]:
    """One value per range-azimuth bin.

    Args:
        projection: `[R, A, D+E]` normalised log power.
        grid: The grid of the projection.
        channels: Which channels enter: "doppler", "elevation" or "all".
        reduce: "max" or "mean" over them. The maximum over either group is the
            maximum over the whole tensor; the mean shows extended targets more calmly.
        units: "normalized" or "db".
    """
    values = check_projection(projection, grid)
    _check_choice("channels", channels, _CHANNEL_LABELS)
    _check_choice("reduce", reduce, ("max", "mean"))
    first, last = {
        "all": (0, None),
        "doppler": (0, grid.num_doppler),
        "elevation": (grid.num_doppler, None),
    }[channels]
    return to_units(getattr(values[..., first:last], reduce)(-1), units)


def range_doppler(
    projection: Any,
    grid: RadarGrid,
    *,
    azimuth_idx: int | None = None,
    units: Units = "normalized",
) -> Float[np.ndarray, "R D"]:
    """Values at one azimuth bin, or the maximum over all of them (None)."""
    values = check_projection(projection, grid)[..., : grid.num_doppler]
    return to_units(_slice_or_max(values, azimuth_idx, 1, "azimuth_idx"), units)


def azimuth_elevation(
    projection: Any,
    grid: RadarGrid,
    *,
    range_idx: int | None = None,
    units: Units = "normalized",
) -> Float[np.ndarray, "A E"]:
    """Values at one range bin, or the maximum over all of them (None)."""
    values = check_projection(projection, grid)[..., grid.num_doppler :]
    return to_units(_slice_or_max(values, range_idx, 0, "range_idx"), units)


def color_label(
    *, channels: Channels = "all", reduce: Reduce = "max", units: Units = "normalized"
) -> str:
    """Text of a colour bar: quantity, unit and what was reduced."""
    return f"{_UNIT_LABELS[units]}, {reduce} over {_CHANNEL_LABELS[channels]}"


def bin_edges(centers: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n+1"]:
    """Edges of a uniform axis of `n` bin centers, half a step outside."""
    step = (centers[-1] - centers[0]) / (centers.size - 1)
    return centers[0] + step * (np.arange(centers.size + 1) - 0.5)


def draw_slice(
    plane: Plane,
    projection: Any,
    grid: RadarGrid,
    *,
    index: int | None = None,
    units: Units = "normalized",
    color_limits: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws one slice of a projection with axes in metres, degrees and m/s.

    Args:
        plane: Which two axes are shown.
        projection: `[R, A, D+E]` normalised log power.
        grid: The grid of the projection.
        index: Bin of the third axis (azimuth for "range_doppler", range for
            "azimuth_elevation"); None takes the maximum over it.
        units: "normalized" or "db".
        color_limits: Ends of the colour bar; by default from the values.
        ax: Where to draw; a new figure by default.

    Returns:
        The axes.
    """
    _check_choice(
        "plane", plane, ("range_azimuth", "range_doppler", "azimuth_elevation")
    )
    azimuth_deg = np.rad2deg(grid.azimuth_rad)
    if plane == "range_azimuth":
        values = range_azimuth(projection, grid, units=units)
        horizontal, vertical = azimuth_deg, grid.range_m
        labels = ("azimuth, right positive [deg]", "range [m]")
        title = "Range–azimuth, max over Doppler and elevation"
    elif plane == "range_doppler":
        values = range_doppler(projection, grid, azimuth_idx=index, units=units)
        horizontal, vertical = grid.doppler_mps, grid.range_m
        labels = ("Doppler (aliased) [m/s]", "range [m]")
        where = "max over azimuth" if index is None else _at(azimuth_deg, index, "°")
        title = f"Range–Doppler (aliased), {where}"
    else:
        values = azimuth_elevation(projection, grid, range_idx=index, units=units).T
        horizontal, vertical = azimuth_deg, np.rad2deg(grid.elevation_rad)
        labels = ("azimuth, right positive [deg]", "elevation bin value [deg]")
        where = "max over range" if index is None else _at(grid.range_m, index, " m")
        title = f"Azimuth–elevation, {where}"
    ax = new_figure(5.0, 4.2).add_subplot() if ax is None else ax
    edges = bin_edges(horizontal), bin_edges(vertical)
    mesh = draw_tiles(ax, *edges, values, color_limits)
    ax.set(xlabel=labels[0], ylabel=labels[1], title=title)
    ax.figure.colorbar(mesh, ax=ax, label=_UNIT_LABELS[units])
    return ax


def draw_slices(
    projection: Any,
    grid: RadarGrid,
    *,
    range_idx: int | None = None,
    azimuth_idx: int | None = None,
    units: Units = "normalized",
    ground_truth: Any = None,
) -> Figure:
    """Figure of the three slices side by side, on one colour scale.

    Boxes are outlined where both axes are known. Labels have no Doppler: there a bar at
    the left edge spans the ranges of each box.

    Args:
        projection: `[R, A, D+E]` normalised log power.
        grid: The grid of the projection.
        range_idx: Range bin of the azimuth-elevation slice; None: maximum.
        azimuth_idx: Azimuth bin of the range-Doppler slice; None: maximum.
        units: "normalized" or "db".
        ground_truth: Boxes to draw, anything that `canvas.as_objects` takes, or None.
    """
    figure = new_figure(14.0, 4.2, layout="constrained")
    axes = figure.subplots(1, 3)
    limits = color_limits_of(to_units(check_projection(projection, grid), units))
    indices = (None, azimuth_idx, range_idx)
    for ax, plane, index in zip(axes, get_args(Plane), indices, strict=True):
        draw_slice(
            plane,
            projection,
            grid,
            index=index,
            units=units,
            color_limits=limits,
            ax=ax,
        )
    boxes = as_objects(ground_truth, what="ground_truth").boxes
    left, right = axes[1].get_xlim()
    left += 0.02 * (right - left)
    width = 0.7 * GROUND_TRUTH.map_width  # most boxes are a few bins
    for ax, lines in zip(axes, _outlines(boxes, left), strict=True):
        ax.add_collection(
            LineCollection(
                lines,
                colors=GROUND_TRUTH.color,
                linewidths=width,
                path_effects=halo(width + 1.2),
            ),
            autolim=False,
        )
    return figure


def _outlines(
    boxes: Float[np.ndarray, "N 7"], left: float
) -> tuple[list[Float[np.ndarray, "_ 2"]], ...]:
    """Lines of boxes in the three slices.

    Args:
        boxes: In the ego frame.
        left: Doppler at which a box's bar stands.
    """
    azimuth_range = [to_polar(outline) for outline in footprints(boxes, 8)]
    bars, azimuth_elevation = [], []
    for outline, points in zip(azimuth_range, corners(boxes), strict=True):
        ground = to_polar(points[:, :2])
        height = np.rad2deg(np.arctan2(points[:, 2], ground[:, 1]))
        seen = np.stack([ground[:, 0], height], -1)
        (x0, y0), (x1, y1) = seen.min(0), seen.max(0)
        azimuth_elevation.append(
            np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        )
        ranges = outline[:, 1]
        bars.append(np.array([[left, ranges.min()], [left, ranges.max()]]))
    return azimuth_range, bars, azimuth_elevation


def to_polar(points: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points 2"]:
    """Azimuth in degrees, right positive, and range of ground positions."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([np.rad2deg(-np.arctan2(y, x)), np.hypot(x, y)], -1)


def _slice_or_max(
    values: Float[np.ndarray, "_ _ _"], index: int | None, axis: int, name: str
) -> Float[np.ndarray, "_ _"]:
    """One bin of an axis, or the maximum over it."""
    if index is None:
        return values.max(axis)
    if not 0 <= index < values.shape[axis]:
        raise UserError(f"{name} {index} is outside 0..{values.shape[axis] - 1}")
    return values.take(index, axis)


def _at(axis: Float[np.ndarray, " n"], index: int, unit: str) -> str:
    """ "at 23.1 m" for a title."""
    return f"at {axis[index]:.1f}{unit}"


def _check_choice(name: str, value: Any, choices: Any) -> None:
    """Raises a `UserError` that lists the choices."""
    if value not in choices:
        raise UserError(f"{name} must be one of {', '.join(choices)}; got {value!r}")
