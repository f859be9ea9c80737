"""Figures of radar frames: bird's-eye view, polar view, one frame, scenes and slices.

The layout follows Figure 4 of RADE-Net and Figure 3 of DinoRADE: the radar map with a
dashed region of interest, ground truth with its class, predictions with class and score,
and the camera image. If the scene has matches, colors distinguish objects that are found and
missed, and true and false positives. In the bird's-eye view, x points up and y to the left, in
meters, and every range-azimuth bin covers the ground that it measures. In the figure of several
scenes, x points to the right and y up.

A projection `[R, A, D+E]` consists of two 3D maps: range-azimuth-Doppler (maximum over
elevation) and range-azimuth-elevation (maximum over Doppler). The Doppler axis wraps
around at a few meters per second, so it shows the aliased radial velocity and is labeled
as such.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from radejax.core.errors import UserError
from radejax.core.structures import ROIS
from radejax.geometry.boxes import bev_corners, corners
from radejax.geometry.radar_grid import RadarGrid, values_at
from radejax.visualize import style
from radejax.visualize.camera import draw_camera
from radejax.visualize.style import Scene

Extent = tuple[float, float, float, float]
"""x_min, x_max, y_min, y_max in meters."""

POWER_LABEL = "normalized log power, max over Doppler and elevation"

_OUTSIDE_COLOR = "0.90"
_BEHIND_M = 2.0  # shown behind the sensor, so that its mark is whole
_POINTS_PER_EDGE = 8  # straight edges bend in the polar view
_SCENE_PERCENTILES = (20.0, 99.5)
_FOOT_IN = 1.3  # axis labels, legend and color bar below scenes
_IMAGE_IN = 3.2  # width of the image to the left of a map
_MAP_IN = 5.5  # width of a map
_ROW_IN = 2.4  # height of a row
_SCENE_LABEL_PT = (
    8.5  # legible when a page shows the figure at three quarters of its size
)


def draw_map(
    values: ArrayLike,
    grid: RadarGrid,
    *,
    ax: Axes | None = None,
    extent: Extent | None = None,
    color_limits: tuple[float, float] | None = None,
    label: str = "",
    is_sideways: bool = False,
) -> Axes:
    """Draws a range-azimuth map, such as a heatmap or attention, on the ground plane.

    Args:
        values: Map `[R, A]`.
        grid: Grid of the map; padded maps need the padded grid.
        ax: Axes to draw on; a new figure by default.
        extent: Extent of the ground to show; the field of view by default.
        color_limits: Limits of the color scale; computed from the shown values by default.
        label: Label of the color bar, which is only drawn if this is not empty.
        is_sideways: Whether x points to the right and y up, instead of up and to the left.

    Raises:
        UserError: Map and grid differ in shape.
    """
    values = np.asarray(values, np.float32)
    if values.shape != (grid.num_range, grid.num_azimuth):
        raise UserError(
            f"map has shape {values.shape}, the grid expects (range, azimuth) = "
            f"{(grid.num_range, grid.num_azimuth)}"
        )
    x0, x1, y0, y1 = extent = extent or _extent_m(grid, None)
    ax = _axes_for_extent(extent) if ax is None else ax
    # Range bins outside the figure are slow to draw and would affect its color limits.
    x, y = np.moveaxis(grid.bin_centers_ego(), -1, 0)
    is_shown = ((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)).any(1)
    rows = np.flatnonzero(is_shown) if is_shown.any() else np.arange(grid.num_range)
    first = max(rows[0] - 2, 0)
    last = min(rows[-1] + 3, grid.num_range)
    # Edges are half a bin outside the centers; negative ranges are clipped to zero.
    range_bin = np.arange(first, last + 1) - 0.5
    range_bin = np.maximum(range_bin, grid.ego_to_bin(0.0, 0.0)[0])
    azimuth_bin = np.arange(grid.num_azimuth + 1) - 0.5
    edges = grid.bin_to_ego(range_bin[:, None], azimuth_bin[None])  # [R'+1, A+1, 2]
    ax.set_facecolor(_OUTSIDE_COLOR)
    shown = values[first:last]
    ahead, left = np.moveaxis(edges, -1, 0)
    horizontal, vertical = (ahead, left) if is_sideways else (left, ahead)
    mesh = style.draw_tiles(ax, horizontal, vertical, shown, color_limits)
    names = "x, ahead [m]", "y, left [m]"
    if is_sideways:
        ax.set(xlim=(x0, x1), ylim=(y0, y1), xlabel=names[0], ylabel=names[1])
    else:
        # The y axis increases to the left, as in a view from above with x pointing up.
        ax.set(xlim=(y1, y0), ylim=(x0, x1), xlabel=names[1], ylabel=names[0])
    ax.set_aspect("equal")
    if label:
        # An inset has the height of the axes even if the equal aspect shrinks them.
        cax = ax.inset_axes((1.02, 0.0, 0.035, 1.0))
        ax.figure.colorbar(mesh, cax=cax, label=label)
    return ax


def draw_comparison(
    maps: Mapping[str, Float[np.ndarray, "R A"]], grid: RadarGrid
) -> Figure:
    """Draws range-azimuth maps of several recordings, their profiles and strongest echoes.

    Args:
        maps: Mean power in dB by title.
        grid: Sensor axes of all maps.
    """
    figure = style.new_figure(5.0 * len(maps) + 4.0, 5.2, layout="constrained")
    layout = figure.add_gridspec(2, len(maps) + 1)
    profile, beams = (figure.add_subplot(layout[row, -1]) for row in range(2))
    limits = style.color_limits_of(np.stack(list(maps.values())))
    azimuth_deg = np.rad2deg(grid.azimuth_rad)
    for column, (title, level) in enumerate(maps.items()):
        ax = figure.add_subplot(layout[:, column])
        draw_map(level, grid, ax=ax, color_limits=limits, label="mean power [dB]")
        ax.set_title(title)
        profile.plot(grid.range_m, np.median(level, axis=1), lw=1.0, label=title)
        is_far = grid.range_m > min(10.0, grid.range_m[-1] / 2.0)
        above = np.where(is_far[:, None], level - np.median(level, 1)[:, None], -np.inf)
        row = level[np.unravel_index(above.argmax(), above.shape)[0]]
        beams.plot(azimuth_deg, row - row.max(), lw=1.0, label=title)
    profile.set(xlabel="range [m]", ylabel="median over azimuth [dB]")
    beams.set(xlabel="azimuth [degrees]", ylabel="row of the strongest echo [dB]")
    profile.legend(fontsize=7)
    return figure


def draw_bev(scene: Scene, *, color_limits: tuple[float, float] | None = None) -> Axes:
    """Draws a figure of one frame on the ground plane.

    It shows the region of interest and its surroundings, or the field of view if the
    scene has no region of interest.

    Args:
        scene: The frame.
        color_limits: Limits of the color scale; computed from the shown values by default.

    Returns:
        The axes; `.figure` is the figure.
    """
    ax = _draw_ground(scene, color_limits=color_limits, label=POWER_LABEL)
    _add_legend(ax, scene, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    ax.set_title(scene.title, pad=24)
    return ax


def _draw_ground(scene: Scene, is_sideways: bool = False, **options: Any) -> Axes:
    """Draws map, region, boxes and sensor; `options` are passed to `draw_map`."""
    extent = _extent_m(scene.grid, scene.roi, 0.2 if is_sideways else 0.37)
    ax = draw_map(
        scene.power, scene.grid, extent=extent, is_sideways=is_sideways, **options
    )
    order = slice(None) if is_sideways else slice(None, None, -1)
    if scene.lidar_m is not None:
        style.draw_points(ax, scene.lidar_m[:, :2][:, order])
    label_pt = _SCENE_LABEL_PT if is_sideways else style.LABEL_PT
    _draw_over(ax, scene, lambda points: points[..., order], label_pt=label_pt)
    # The sensor is drawn as a triangle that points ahead.
    marker = ">" if is_sideways else "^"
    ax.plot([0.0], [0.0], marker, color="black", mec="white", ms=8, zorder=7)
    return ax


def bin_edges(centers: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n+1"]:
    """Returns the edges of bins; a single bin is drawn with a width of 1."""
    if centers.size == 1:
        return np.array([centers[0] - 0.5, centers[0] + 0.5])
    edges: np.ndarray = values_at(centers, np.arange(centers.size + 1) - 0.5)
    return edges


def to_polar(points: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points 2"]:
    """Converts ground positions to azimuth in degrees, positive to the right, and range."""
    x, y = np.moveaxis(points, -1, 0)
    polar: np.ndarray = np.stack([np.rad2deg(-np.arctan2(y, x)), np.hypot(x, y)], -1)
    return polar


def _draw_polar(
    ax: Axes, scene: Scene, color_limits: tuple[float, float], *, show_labels: bool
) -> None:
    """Draws one frame in the network's coordinates, range over azimuth, one tile per bin.

    The straight edges of boxes are curves in these coordinates.
    """
    horizontal = bin_edges(np.rad2deg(scene.grid.azimuth_rad))
    vertical = bin_edges(scene.grid.range_m)
    style.draw_tiles(ax, horizontal, vertical, scene.power, color_limits)
    ax.set_xlim(horizontal.min(), horizontal.max())
    ax.set_ylim(max(vertical[0], 0.0), vertical[-1])
    ax.set(xlabel="azimuth, right positive [deg]", ylabel="range [m]")
    _draw_over(ax, scene, _outlines_in_polar, show_labels=show_labels)


def _outlines_in_polar(
    points: Float[np.ndarray, "*lines points 2"],
) -> Float[np.ndarray, "*lines points 2"]:
    """Converts outlines, which continue beyond 180 degrees instead of crossing the map."""
    polar = to_polar(points)
    polar[..., 0] = np.unwrap(polar[..., 0], period=360.0)
    return polar


def draw_frame(scene: Scene) -> Figure:
    """Draws one frame: bird's-eye view, polar view and, if given, camera image.

    Args:
        scene: Frame to draw; `frame_scene` creates that of a dataset's frame.

    Returns:
        A figure of 12 by 6.4 inches; write it with `save_figure`.

    Examples:
        >>> grid = RadarGrid.kradar()
        >>> draw_frame(Scene(np.zeros(grid.projection_shape), grid)).get_size_inches()
        array([12. ,  6.4])
    """
    figure = style.new_figure(12.0, 6.4)
    bev_ax = figure.add_axes((0.06, 0.085, 0.38, 0.835))
    _draw_ground(scene, ax=bev_ax, label=POWER_LABEL)
    # The color bar of the bird's-eye view holds for both maps.
    limits = bev_ax.collections[0].get_clim()
    has_image = scene.image is not None
    height = 0.26 if has_image else 0.77
    polar_ax = figure.add_axes((0.57, 0.085, 0.41, height))
    _draw_polar(polar_ax, scene, limits, show_labels=not has_image)
    if has_image:
        _draw_view(figure.add_axes((0.53, 0.43, 0.45, 0.49)), scene)
    place = (0.75, 0.095 + height)
    _add_legend(figure, scene, loc="lower center", bbox_to_anchor=place, ncols=4)
    figure.suptitle(scene.title)
    return figure


def draw_scenes(
    scenes: Sequence[Scene], *, color_limits: tuple[float, float] | None = None
) -> Figure:
    """Draws scenes, one per row, each with its camera image to the left of its map.

    Args:
        scenes: One or more scenes. The legend is that of the scene with most kinds of boxes.
        color_limits: Limits of the color scale that all scenes share; computed from the scenes
            by default.
    """
    has_image = any(scene.image is not None for scene in scenes)
    start_in = _IMAGE_IN if has_image else 0.0
    width = start_in + _MAP_IN + 0.9
    # The legend is above the color bar if both do not fit next to each other.
    foot_in = _FOOT_IN if has_image else _FOOT_IN + 0.6
    height = _ROW_IN * len(scenes) + foot_in
    figure = style.new_figure(width, height)
    # All scenes share one color scale. The few strongest echoes are beyond its limits.
    values = np.concatenate([scene.power.ravel() for scene in scenes])
    low, high = color_limits or np.nanpercentile(values, _SCENE_PERCENTILES)
    limits = (float(low), float(max(high, low + 1e-3)))
    tall = (_ROW_IN - 0.3) / height
    for row, scene in enumerate(scenes, 1):
        base = (height - _ROW_IN * row) / height
        if scene.image is not None:
            place = (0.1 / width, base, (_IMAGE_IN - 0.1) / width, tall)
            # Labels are only drawn on the map, as they would hide the small image.
            _draw_view(figure.add_axes(place), scene, show_labels=False)
        place = ((start_in + 0.75) / width, base, _MAP_IN / width, tall)
        ax = figure.add_axes(place)
        _draw_ground(scene, ax=ax, color_limits=limits, is_sideways=True)
        ax.set_title(scene.title, fontsize=11)
        if row < len(scenes):
            ax.set_xlabel("")
            ax.tick_params(labelbottom=False)
    place = (1 - 3.45 / width, 0.5 / height, 2.8 / width, 0.12 / height)
    cax = figure.add_axes(place)
    colors = ScalarMappable(Normalize(*limits), style.COLOR_MAP)
    bar = figure.colorbar(colors, cax=cax, orientation="horizontal", extend="both")
    bar.set_label(POWER_LABEL, fontsize=8.5)
    bar.ax.tick_params(labelsize=8.5)
    _add_legend(
        figure,
        max(scenes, key=lambda scene: len(scene.sets)),
        show_counts=False,
        loc="lower left",
        bbox_to_anchor=(0.1 / width, (foot_in - _FOOT_IN + 0.1) / height),
        ncols=3,
        fontsize=_SCENE_LABEL_PT,
    )
    return figure


def draw_samples(
    samples: Sequence[tuple[Scene, Scene, Float[np.ndarray, "R A"]]], grid: RadarGrid
) -> Figure:
    """Draws samples of a training, one per row, as the network gets them.

    Args:
        samples: For each sample the frame as it was recorded, the input with its boxes after
            augmentation, and the target heatmap.
        grid: Grid of the target heatmaps, padded if they are.
    """
    has_image = any(scene.image is not None for _, scene, _ in samples)
    figure = style.new_figure(13.5 + 5.5 * has_image, 5.0 * len(samples))
    right = 0.97 if has_image else 0.93  # a color bar is on the right of the last map
    layout = {"wspace": 0.35, "left": 0.06, "right": right, "bottom": 0.04, "top": 0.95}
    ratios = [1, 1, 1, 1.5][: 3 + has_image]
    axes = figure.subplots(
        len(samples),
        len(ratios),
        squeeze=False,
        width_ratios=ratios,
        gridspec_kw=layout,
    )
    for row, (frame, scene, target) in zip(axes, samples, strict=True):
        for ax, shown in zip(row, (frame, scene), strict=False):
            _draw_ground(shown, ax=ax, label="normalized log power")
        extent = _extent_m(scene.grid, scene.roi)
        draw_map(target, grid, ax=row[2], extent=extent, label="target")
        titles = [frame.title, scene.title, "target heatmap, max over classes"]
        if scene.image is not None:
            _draw_view(row[3], scene)
            titles.append("image that the network gets")
        for ax, title in zip(row, titles, strict=False):
            ax.set_title(title, fontsize=9)
        for ax in row[len(titles) :]:
            ax.set_axis_off()
    return figure


def _draw_view(ax: Axes, scene: Scene, *, show_labels: bool = True) -> None:
    """Draws the camera image, and the boxes on it if a calibration is given."""
    assert scene.image is not None
    if scene.camera is None:
        ax.imshow(np.asarray(scene.image))
        ax.set_axis_off()
        return
    draw_camera(
        scene.image,
        scene.camera,
        ground_truth=scene.ground_truth,
        predictions=scene.predictions,
        ax=ax,
        show_labels=show_labels,
        matches=scene.matches,
    )
    if scene.lidar_m is not None:
        pixels, depth_m = scene.camera.project_ego(scene.lidar_m)
        # Pixel centers are integers in imshow and half-integers in the calibration.
        style.draw_points(ax, pixels[scene.camera.in_image(pixels, depth_m)] - 0.5)


def _extent_m(
    grid: RadarGrid, roi: Sequence[float] | None, narrowest: float = 0.37
) -> Extent:
    """Returns the extent of the region and its surroundings, or of the field of view.

    Narrow regions are widened: half of their width is at least `narrowest` of their length.
    """
    far = bin_edges(grid.range_m)[-1]
    side = far * np.sin(min(grid.fov_azimuth_rad, np.pi / 2))
    behind = min(far * np.cos(grid.fov_azimuth_rad), -_BEHIND_M)
    if roi is None:
        return behind, far, -side, side
    _, x1, y0, y1 = roi[:4]
    far = min(far, 1.08 * x1)
    half = max(min(max(-y0, y1, 0.0) * 1.25, side), narrowest * far)
    return -_BEHIND_M, far, -half, half


def _axes_for_extent(extent: Extent) -> Axes:
    """Creates axes in a new figure for an extent, with space for color bar and legend."""
    x0, x1, y0, y1 = extent
    scale = min(5.5 / (x1 - x0), 6.0 / (y1 - y0))
    width, height = scale * (y1 - y0), scale * (x1 - x0)
    total = width + 1.75, height + 1.2
    place = (0.65 / total[0], 0.55 / total[1], width / total[0], height / total[1])
    return style.new_figure(*total).add_axes(place)


def _draw_over(
    ax: Axes,
    scene: Scene,
    to_axes: Callable[[np.ndarray], np.ndarray],
    show_labels: bool = True,
    label_pt: float = style.LABEL_PT,
) -> None:
    """Draws the region of interest, the boxes with their headings, and labels.

    Args:
        ax: Axes of a map, whose limits and aspect must be final.
        scene: The frame.
        to_axes: Function that converts ground positions `[..., 2]` to data coordinates.
        show_labels: Whether to write class and score next to the boxes.
        label_pt: Font size of the labels.
    """
    ax.apply_aspect()
    if scene.roi is not None:
        x0, x1, y0, y1 = scene.roi[:4]
        region = np.array([[(x0 + x1) / 2, (y0 + y1) / 2, 0, x1 - x0, y1 - y0, 0, 0]])
        # The dashes have a white outline to be visible on dark and on bright maps.
        ax.plot(
            *to_axes(style.footprints(region, 200)[0]).T,
            color=style.ROI_COLOR,
            linewidth=1.4,
            linestyle=(0, (5, 3)),
            path_effects=style.halo(2.6, "white"),
            zorder=3,
        )
    labels = []
    for order, (look, boxes) in enumerate(scene.sets):
        edges = to_axes(style.footprints(boxes.box, _POINTS_PER_EDGE))
        marks = to_axes(_heading_marks(boxes.box))
        widths = look.width * np.tile(style.line_scales(ax, edges, 8.0), 2)
        zorder = 4 + 0.2 * order  # below the texts
        style.draw_lines(ax, [*edges, *marks], look.color, widths, zorder)
        if not look.side:
            continue
        outlines = np.concatenate([edges, marks], 1)
        labels += [
            style.Label(outline, text, look.color, look.side)
            for outline, text in zip(outlines, style.label_texts(boxes), strict=True)
        ]
    if show_labels:
        style.draw_labels(ax, labels, label_pt)


def _heading_marks(boxes: Float[np.ndarray, "N 7"]) -> Float[np.ndarray, "N 2 2"]:
    """Returns line segments that show the heading of each box.

    They start at the middle of the front edge and point outwards, so that the echo inside
    the box remains visible.
    """
    front = bev_corners(boxes)[:, [0, 3]].mean(1)
    return np.stack([front, front + 0.7 * (front - boxes[:, :2])], 1)


def _add_legend(
    owner: Axes | Figure, scene: Scene, *, show_counts: bool = True, **place: Any
) -> None:
    """Adds a legend with one handle per kind of line to axes or a figure."""
    counts: dict[style.Style, int] = {}
    for look, boxes in scene.sets:
        counts[look] = counts.get(look, 0) + len(boxes)
    handles = []
    for look, count in counts.items():
        label = f"{look.name} ({count})" if show_counts else look.name
        line = Line2D([], [], color=look.color, lw=look.width, label=label)
        line.set_path_effects(style.halo(look.width + 1.4))
        handles.append(line)
    if scene.lidar_m is not None:
        color = style.LIDAR_COLOR
        handles.append(Line2D([], [], marker=".", ls="", color=color, label="LiDAR"))
    if scene.roi is not None:
        named = [name for name, roi in ROIS.items() if roi == tuple(scene.roi)]
        label = f"{named[0]} region" if named else "region of interest"
        line = Line2D([], [], color=style.ROI_COLOR, lw=1.4, ls="--", label=label)
        handles.append(line)
    terms = []
    if scene.score_threshold is not None and scene.predictions is not None:
        scores = scene.predictions.score
        lowest = 1.0 if scores is None else float(scores.min(initial=1.0))
        least = np.unique(scene.score_threshold)  # ascending
        ends = [min(least[0], round(lowest, 4)), *least[1:][-1:]]
        terms.append(f"score ≥ {' to '.join(f'{x:g}' for x in ends)}")
    if scene.matches is not None:
        terms.append(f"IoU > {scene.matches.iou:g}")
    if terms:
        handles.append(Line2D([], [], ls="", label=", ".join(terms)))
    # Counts, threshold and region fit in these sizes.
    sizes = {"fontsize": style.LABEL_PT, "handlelength": 1.6, "columnspacing": 1.2}
    owner.legend(handles=handles, frameon=False, **sizes | place)


# Slices -------------------------------------------------------------------------------


def draw_slices(scene: Scene, *, range_idx: int | None = None) -> Figure:
    """Draws range-azimuth, range-Doppler and azimuth-elevation maps on one color scale.

    There is no map of an axis that the radar does not measure.

    Ground truth is outlined in the range-azimuth and azimuth-elevation maps. Labels
    contain no Doppler, so the range-Doppler map shows the range interval of each box as a
    bar at the left edge.

    Args:
        scene: The frame; predictions, region and image are not drawn.
        range_idx: Range bin of the azimuth-elevation slice, or None for the maximum over
            range.
    """
    grid = scene.grid
    values = np.asarray(scene.projection, np.float32)
    doppler, elevation = np.split(values, [grid.num_doppler], -1)
    at_range = "max over range"
    if range_idx is not None:
        elevation = elevation[[range_idx]]
        at_range = f"at {grid.range_m[range_idx]:.1f} m"
    azimuth = (np.rad2deg(grid.azimuth_rad), "azimuth, right positive [deg]")
    distance = (grid.range_m, "range [m]")
    speed = (grid.doppler_mps, "Doppler (aliased) [m/s]")
    height = (np.rad2deg(grid.elevation_rad), "elevation bin value [deg]")
    axes_of = {
        "Range–azimuth, max over Doppler and elevation": (azimuth, distance),
        "Range–Doppler (aliased), max over azimuth": (speed, distance),
        f"Azimuth–elevation, {at_range}": (azimuth, height),
    }
    planes = values.max(-1), doppler.max(1), elevation.max(0).T
    truth = scene.ground_truth
    outlines = _outlines(np.zeros((0, 7)) if truth is None else truth.box)
    panels = list(zip(axes_of, planes, outlines, strict=True))
    panels = [panel for panel in panels if panel[1].size]
    figure = style.new_figure(14.0, 4.2, layout="constrained")
    axes = figure.subplots(1, len(panels))
    limits = style.color_limits_of(values)
    for ax, (title, plane, lines) in zip(axes, panels, strict=True):
        (x, x_label), (y, y_label) = axes_of[title]
        mesh = style.draw_tiles(ax, bin_edges(x), bin_edges(y), plane, limits)
        ax.set(xlabel=x_label, ylabel=y_label, title=title)
        figure.colorbar(mesh, ax=ax, label="normalized log power")
        if x is grid.doppler_mps:
            left, right = ax.get_xlim()
            lines = [np.add(bar, [left + 0.02 * (right - left), 0.0]) for bar in lines]
        # Lines are thinner here, as most boxes only cover a few bins.
        look = style.GROUND_TRUTH
        style.draw_lines(ax, lines, look.color, 0.7 * look.width)
    figure.suptitle(scene.title)
    return figure


def _outlines(
    boxes: Float[np.ndarray, "N 7"],
) -> tuple[list[Float[np.ndarray, "_ 2"]], ...]:
    """Returns the lines of boxes in the three slices, with bars at a Doppler of 0."""
    azimuth_range = [to_polar(outline) for outline in style.footprints(boxes, 8)]
    bars = []
    azimuth_elevation = []
    for outline, points in zip(azimuth_range, corners(boxes), strict=True):
        ground = to_polar(points[:, :2])
        height = np.rad2deg(np.arctan2(points[:, 2], ground[:, 1]))
        x0, x1 = ground[:, 0].min(), ground[:, 0].max()
        y0, y1 = height.min(), height.max()
        rectangle = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        azimuth_elevation.append(rectangle)
        ranges = outline[:, 1]
        bars.append(np.array([[0.0, ranges.min()], [0.0, ranges.max()]]))
    return azimuth_range, bars, azimuth_elevation
