"""Slices of a projection through its range, azimuth, Doppler and elevation axes.

A projection `[R, A, D+E]` is two 3D maps side by side: range-azimuth-Doppler (maximum
over elevation) and range-azimuth-elevation (maximum over Doppler). The Doppler axis
wraps around at a few meters per second, so a position on it is an aliased radial
velocity, never the velocity: figures say so.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from radejax.geometry.boxes import corners
from radejax.visualize.style import (
    GROUND_TRUTH,
    Scene,
    color_limits_of,
    draw_lines,
    draw_tiles,
    footprints,
    new_figure,
)


def bin_edges(centers: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n+1"]:
    """Edges of a uniform axis of `n` bin centers, half a step outside."""
    step = (centers[-1] - centers[0]) / (centers.size - 1)
    return centers[0] + step * (np.arange(centers.size + 1) - 0.5)


def to_polar(points: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points 2"]:
    """Azimuth in degrees, right positive, and range of ground positions."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([np.rad2deg(-np.arctan2(y, x)), np.hypot(x, y)], -1)


def draw_slices(scene: Scene, *, range_idx: int | None = None) -> Figure:
    """Figure of three slices on one color scale: azimuth, Doppler, elevation.

    Ground truth is outlined where both axes are known. Labels have no Doppler: there a
    bar at the left edge spans the ranges of each box.

    Args:
        scene: The frame; predictions, region and image are not drawn.
        range_idx: Range bin of the azimuth-elevation slice; None: maximum.
    """
    grid, values = scene.grid, np.asarray(scene.projection, np.float32)
    doppler, elevation = np.split(values, [grid.num_doppler], -1)
    azimuth_deg, range_m = np.rad2deg(grid.azimuth_rad), grid.range_m
    at_range = "max over range"
    if range_idx is not None:
        elevation = elevation[[range_idx]]
        at_range = f"at {range_m[range_idx]:.1f} m"
    azimuth = (azimuth_deg, "azimuth, right positive [deg]")
    distance = (range_m, "range [m]")
    slices = (
        (
            values.max(-1),
            azimuth,
            distance,
            "Range–azimuth, max over Doppler and elevation",
        ),
        (
            doppler.max(1),
            (grid.doppler_mps, "Doppler (aliased) [m/s]"),
            distance,
            "Range–Doppler (aliased), max over azimuth",
        ),
        (
            elevation.max(0).T,
            azimuth,
            (np.rad2deg(grid.elevation_rad), "elevation bin value [deg]"),
            f"Azimuth–elevation, {at_range}",
        ),
    )
    figure = new_figure(14.0, 4.2, layout="constrained")
    axes = figure.subplots(1, 3)
    limits = color_limits_of(values)
    for ax, (plane, horizontal, vertical, title) in zip(axes, slices, strict=True):
        edges = bin_edges(horizontal[0]), bin_edges(vertical[0])
        mesh = draw_tiles(ax, *edges, plane, limits)
        ax.set(xlabel=horizontal[1], ylabel=vertical[1], title=title)
        figure.colorbar(mesh, ax=ax, label="normalized log power")
    figure.suptitle(scene.title)
    if scene.ground_truth is not None:
        left, right = axes[1].get_xlim()
        outlines = _outlines(scene.ground_truth.box, left + 0.02 * (right - left))
        for ax, lines in zip(axes, outlines, strict=True):
            # Most boxes are a few bins.
            draw_lines(ax, lines, GROUND_TRUTH.color, 0.7 * GROUND_TRUTH.width)
    return figure


def _outlines(
    boxes: Float[np.ndarray, "N 7"], left: float
) -> tuple[list[Float[np.ndarray, "_ 2"]], ...]:
    """Lines of boxes in the three slices, bars at a Doppler of `left`."""
    azimuth_range = [to_polar(outline) for outline in footprints(boxes, 8)]
    bars, azimuth_elevation = [], []
    for outline, points in zip(azimuth_range, corners(boxes), strict=True):
        ground = to_polar(points[:, :2])
        height = np.rad2deg(np.arctan2(points[:, 2], ground[:, 1]))
        x0, x1 = ground[:, 0].min(), ground[:, 0].max()
        y0, y1 = height.min(), height.max()
        azimuth_elevation.append(
            np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        )
        ranges = outline[:, 1]
        bars.append(np.array([[left, ranges.min()], [left, ranges.max()]]))
    return azimuth_range, bars, azimuth_elevation
