"""Bird's-eye view and polar view of a radar frame with its boxes.

The layout follows Figure 4 of RADE-Net and Figure 3 of DinoRADE: the radar map with
the region of interest dashed, ground truth white with its class, predictions red with
class and score, and the camera image beside it. Here x points up and y to the left, in
metres, and every range-azimuth bin covers the ground that it measures.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from radejax.visualize.camera import draw_camera
from radejax.visualize.canvas import (
    Scene,
    add_colorbar,
    draw_tiles,
    footprints,
    new_figure,
    save_figure,
)
from radejax.visualize.maps import (
    Extent,
    draw_legend,
    draw_map,
    draw_objects,
    draw_roi,
    extent_m,
    legend_handles,
    roi_m,
)
from radejax.visualize.projections import (
    bin_edges,
    color_label,
    range_azimuth,
    to_polar,
)

__all__ = [
    "Scene",
    "draw_bev",
    "draw_frame",
    "draw_map",
    "draw_polar",
    "draw_view",
    "save_figure",
]


def draw_bev(
    scene: Scene,
    *,
    ax: Axes | None = None,
    extent: Extent = "roi",
    color_limits: tuple[float, float] | None = None,
    show_labels: bool = True,
    show_legend: bool = True,
    show_colorbar: bool = True,
    **values: Any,
) -> Axes:
    """Draws one frame on the ground plane.

    Args:
        scene: The frame.
        ax: Where to draw; a new figure by default. Its limits and aspect are set.
        extent: "roi" shows the region of interest and its surroundings (all of the
            field of view without one), "fov" the field of view, or x_min, x_max,
            y_min, y_max in metres.
        color_limits: Ends of the colour bar; by default from the values shown.
        show_labels: Write class and score beside the boxes.
        show_legend: Explain the lines.
        show_colorbar: Give the map's scale.
        **values: What a bin shows: `channels`, `reduce` and `units` of
            `projections.range_azimuth`.

    Returns:
        The axes; `.figure` is the figure.

    Raises:
        UserError: Projection, grid, boxes or region of interest do not fit together.
    """
    ax = draw_map(
        range_azimuth(scene.projection, scene.grid, **values),
        scene.grid,
        ax=ax,
        extent=extent_m(scene.grid, scene.roi, extent),
        color_limits=color_limits,
        label=color_label(**values),
        show_colorbar=show_colorbar,
    )
    if scene.roi is not None:
        x0, x1, y0, y1 = roi_m(scene.roi)
        outline = np.array([[x0, y0], [x0, y1], [x1, y1], [x1, y0], [x0, y0]])
        draw_roi(ax, outline[:, ::-1])
    draw_objects(
        ax, scene.sets, lambda points: points[..., ::-1], show_labels=show_labels
    )
    # The sensor, pointing ahead.
    ax.plot([0.0], [0.0], "^", color="black", mec="white", ms=8, zorder=7)
    _explain(ax, scene, show_legend)
    return ax


def draw_polar(
    scene: Scene,
    *,
    ax: Axes | None = None,
    color_limits: tuple[float, float] | None = None,
    show_labels: bool = True,
    show_legend: bool = True,
    show_colorbar: bool = True,
    **values: Any,
) -> Axes:
    """Draws one frame as the network sees it: range over azimuth, one tile a bin.

    Straight box edges bend here; they are drawn bent. Arguments as in `draw_bev`.
    """
    power = range_azimuth(scene.projection, scene.grid, **values)
    ax = new_figure(6.0, 5.0).add_axes((0.11, 0.1, 0.74, 0.82)) if ax is None else ax
    horizontal = bin_edges(np.rad2deg(scene.grid.azimuth_rad))
    vertical = bin_edges(scene.grid.range_m)
    mesh = draw_tiles(ax, horizontal, vertical, power, color_limits)
    ax.set_xlim(horizontal[0], horizontal[-1])
    ax.set_ylim(max(vertical[0], 0.0), vertical[-1])
    ax.set(xlabel="azimuth, right positive [deg]", ylabel="range [m]")
    if show_colorbar:
        add_colorbar(mesh, ax, color_label(**values))
    if scene.roi is not None:
        x0, x1, y0, y1 = roi_m(scene.roi)
        box = np.array([[(x0 + x1) / 2, (y0 + y1) / 2, 0, x1 - x0, y1 - y0, 0, 0]])
        draw_roi(ax, to_polar(footprints(box, 200)[0]))
    draw_objects(ax, scene.sets, to_polar, show_labels=show_labels)
    _explain(ax, scene, show_legend)
    return ax


def _explain(ax: Axes, scene: Scene, show_legend: bool) -> None:
    """Legend and title."""
    if show_legend:
        draw_legend(ax, scene)
    if scene.title:
        ax.set_title(scene.title, pad=24 if show_legend else 6)


def draw_frame(
    scene: Scene,
    *,
    extent: Extent = "roi",
    color_limits: tuple[float, float] | None = None,
    show_labels: bool = True,
    **values: Any,
) -> Figure:
    """Figure of one frame: bird's-eye view, camera image (if any) and polar view.

    Args:
        scene: The frame.
        extent: Of the bird's-eye view, as in `draw_bev`.
        color_limits: As in `draw_bev`.
        show_labels: Of the bird's-eye view, as in `draw_bev`.
        **values: As in `draw_bev`.

    Returns:
        A figure of about 12 by 6.4 inches; write it with `save_figure`.
    """
    figure = new_figure(12.0, 6.4)
    untitled = dataclasses.replace(scene, title="")
    common = {"color_limits": color_limits, "show_legend": False, **values}
    bev_ax = figure.add_axes((0.05, 0.085, 0.40, 0.835))
    draw_bev(untitled, ax=bev_ax, extent=extent, show_labels=show_labels, **common)
    has_image = scene.image is not None
    polar_place = (0.57, 0.085, 0.41, 0.26 if has_image else 0.77)
    polar_ax = figure.add_axes(polar_place)
    common |= {"show_labels": not has_image, "show_colorbar": False}
    draw_polar(untitled, ax=polar_ax, **common)
    if has_image:
        draw_view(figure.add_axes((0.53, 0.40, 0.45, 0.52)), scene)
    figure.legend(
        handles=legend_handles(scene),
        loc="lower center",
        bbox_to_anchor=(0.765, polar_place[1] + polar_place[3] + 0.01),
        ncols=3,
        fontsize=8,  # counts, threshold and the region's name fit
        frameon=False,
    )
    if scene.title:
        figure.suptitle(scene.title)
    return figure


def draw_view(ax: Axes, scene: Scene, *, show_labels: bool = True) -> None:
    """Camera image, with the boxes where a calibration is given."""
    if scene.camera is None:
        ax.imshow(np.asarray(scene.image))
        ax.set_axis_off()
        return
    draw_camera(
        scene.image,
        scene.camera,
        ground_truth=scene.ground_truth,
        predictions=scene.predictions,
        class_names=scene.class_names,
        ax=ax,
        show_labels=show_labels,
    )
