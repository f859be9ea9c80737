"""Bird's-eye view and polar view of a radar frame with its boxes.

The layout follows Figure 4 of RADE-Net and Figure 3 of DinoRADE: the radar map with
the region of interest dashed, ground truth white with its class, predictions red with
class and score, and the camera image beside it. Here x points up and y to the left, in
metres, and every range-azimuth bin covers the ground that it measures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.canvas import (
    COLOR_MAP,
    Objects,
    add_colorbar,
    color_limits_of,
    footprints,
    new_figure,
    save_figure,
)
from radejax.visualize.maps import Extent, draw_map, extent_m, roi_m
from radejax.visualize.overlays import (
    both_sets,
    draw_legend,
    draw_objects,
    draw_roi,
    legend_handles,
)
from radejax.visualize.projections import (
    Channels,
    Reduce,
    Units,
    bin_edges,
    color_label,
    range_azimuth,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "draw_bev",
    "draw_frame",
    "draw_map",
    "draw_polar",
    "draw_view",
    "save_figure",
]

_POLAR_OPTIONS = ("channels", "reduce", "units", "color_limits")


def draw_bev(
    projection: Any,
    grid: RadarGrid,
    *,
    roi: Sequence[float] | None = None,
    ground_truth: Any = None,
    predictions: Any = None,
    class_names: Sequence[str] | None = None,
    ax: Axes | None = None,
    extent: Extent = "roi",
    channels: Channels = "all",
    reduce: Reduce = "max",
    units: Units = "normalized",
    color_limits: tuple[float, float] | None = None,
    show_labels: bool = True,
    show_legend: bool = True,
    show_colorbar: bool = True,
    title: str | None = None,
) -> Axes:
    """Draws one frame on the ground plane.

    Args:
        projection: `[R, A, D+E]` normalised log power of one frame.
        grid: The grid of the projection.
        roi: x_min, x_max, y_min, y_max, z_min, z_max in metres (z may be left out):
            the dashed rectangle where detections count.
        ground_truth: Boxes with classes; anything that `canvas.as_objects` takes, such
            as `(boxes [N, 7], classes)` or a frame.
        predictions: Boxes with scores and classes, such as `(boxes, scores, classes)`
            or one frame of `Detections`.
        class_names: Names of class indices; see `canvas.as_objects`.
        ax: Where to draw; a new figure by default. Its limits and aspect are set.
        extent: "roi" shows the region of interest and its surroundings (all of the
            field of view without one), "fov" the field of view, or x_min, x_max,
            y_min, y_max in metres.
        channels: Channels that the map is reduced over.
        reduce: "max" or "mean".
        units: "normalized" or "db".
        color_limits: Ends of the colour bar; by default from the values shown.
        show_labels: Write class and score beside the boxes.
        show_legend: Explain the lines.
        show_colorbar: Give the map's scale.
        title: Title of the axes.

    Returns:
        The axes; `.figure` is the figure.

    Raises:
        UserError: Projection, grid, boxes or region of interest do not fit together.
    """
    values = range_azimuth(
        projection, grid, channels=channels, reduce=reduce, units=units
    )
    truth, found = both_sets(ground_truth, predictions, class_names)
    limits = extent_m(grid, roi, extent)
    ax = draw_map(
        values,
        grid,
        ax=ax,
        extent=limits,
        color_limits=color_limits,
        label=color_label(channels=channels, reduce=reduce, units=units),
        show_colorbar=show_colorbar,
    )
    if roi is not None:
        x0, x1, y0, y1 = roi_m(roi)
        outline = np.array([[x0, y0], [x0, y1], [x1, y1], [x1, y0], [x0, y0]])
        draw_roi(ax, outline[:, ::-1])
    draw_objects(
        ax, truth, found, lambda points: points[..., ::-1], show_labels=show_labels
    )
    # The sensor, pointing ahead.
    ax.plot([0.0], [0.0], "^", color="black", mec="white", ms=8, zorder=7)
    if show_legend:
        draw_legend(ax, truth, found, roi)
    if title:
        ax.set_title(title, pad=24 if show_legend else 6)
    return ax


def draw_polar(
    projection: Any,
    grid: RadarGrid,
    *,
    roi: Sequence[float] | None = None,
    ground_truth: Any = None,
    predictions: Any = None,
    class_names: Sequence[str] | None = None,
    ax: Axes | None = None,
    channels: Channels = "all",
    reduce: Reduce = "max",
    units: Units = "normalized",
    color_limits: tuple[float, float] | None = None,
    show_labels: bool = True,
    show_legend: bool = True,
    show_colorbar: bool = True,
    title: str | None = None,
) -> Axes:
    """Draws one frame as the network sees it: range over azimuth, one tile a bin.

    Straight box edges bend here; they are drawn bent. Arguments as in `draw_bev`.
    """
    values = range_azimuth(
        projection, grid, channels=channels, reduce=reduce, units=units
    )
    truth, found = both_sets(ground_truth, predictions, class_names)
    ax = new_figure(6.0, 5.0).add_axes((0.11, 0.1, 0.74, 0.82)) if ax is None else ax
    low, high = color_limits or color_limits_of(values)
    horizontal = bin_edges(np.rad2deg(grid.azimuth_rad))
    vertical = bin_edges(grid.range_m)
    mesh = ax.pcolormesh(
        horizontal,
        vertical,
        values,
        cmap=COLOR_MAP,
        vmin=low,
        vmax=high,
        rasterized=True,
    )
    ax.set_xlim(horizontal[0], horizontal[-1])
    ax.set_ylim(max(vertical[0], 0.0), vertical[-1])
    ax.set(xlabel="azimuth, right positive [deg]", ylabel="range [m]")
    if show_colorbar:
        label = color_label(channels=channels, reduce=reduce, units=units)
        add_colorbar(mesh, ax, label)
    if roi is not None:
        x0, x1, y0, y1 = roi_m(roi)
        box = np.array([[(x0 + x1) / 2, (y0 + y1) / 2, 0, x1 - x0, y1 - y0, 0, 0]])
        draw_roi(ax, _to_polar(footprints(box, 200)[0]))
    draw_objects(ax, truth, found, _to_polar, show_labels=show_labels)
    if show_legend:
        draw_legend(ax, truth, found, roi)
    if title:
        ax.set_title(title, pad=24 if show_legend else 6)
    return ax


def draw_frame(
    projection: Any,
    grid: RadarGrid,
    *,
    ground_truth: Any = None,
    predictions: Any = None,
    roi: Sequence[float] | None = None,
    image: Any = None,
    camera: Any = None,
    class_names: Sequence[str] | None = None,
    title: str | None = None,
    **bev_options: Any,
) -> Figure:
    """Figure of one frame: bird's-eye view, camera image (if any) and polar view.

    Args:
        projection: `[R, A, D+E]` normalised log power of one frame.
        grid: The grid of the projection.
        ground_truth: As in `draw_bev`.
        predictions: As in `draw_bev`.
        roi: As in `draw_bev`.
        image: `[H, W, 3]` left front camera image, uint8 or float in [0, 1], or None.
        camera: `CameraCalibration` of the image: draws the boxes on it, or None.
        class_names: Names of class indices; see `canvas.as_objects`.
        title: Title of the figure, such as sequence, frame and weather.
        **bev_options: Further arguments of `draw_bev`.

    Returns:
        A figure of about 12 by 6.4 inches; write it with `save_figure`.
    """
    figure = new_figure(12.0, 6.4)
    truth, found = both_sets(ground_truth, predictions, class_names)
    shared = {"roi": roi, "ground_truth": truth, "predictions": found}
    options = {"show_legend": False, **bev_options}
    bev_ax = figure.add_axes((0.05, 0.085, 0.40, 0.835))
    draw_bev(projection, grid, ax=bev_ax, **shared, **options)
    has_image = image is not None
    polar_place = (0.57, 0.085, 0.41, 0.26 if has_image else 0.77)
    draw_polar(
        projection,
        grid,
        ax=figure.add_axes(polar_place),
        **shared,
        **{k: v for k, v in options.items() if k in _POLAR_OPTIONS},
        show_labels=not has_image,
        show_legend=False,
        show_colorbar=False,
    )
    if has_image:
        view_ax = figure.add_axes((0.53, 0.40, 0.45, 0.52))
        draw_view(view_ax, image, camera, truth, found)
    figure.legend(
        handles=legend_handles(truth, found, roi),
        loc="lower center",
        bbox_to_anchor=(0.765, polar_place[1] + polar_place[3] + 0.01),
        ncols=3,
        frameon=False,
    )
    if title:
        figure.suptitle(title)
    return figure


def _to_polar(points: np.ndarray) -> np.ndarray:
    """Azimuth in degrees and range of ground positions `[..., 2]`."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([np.rad2deg(-np.arctan2(y, x)), np.hypot(x, y)], -1)


def draw_view(
    ax: Axes,
    image: Any,
    camera: Any,
    truth: Objects | None,
    found: Objects | None,
    *,
    show_labels: bool = True,
) -> None:
    """Camera image, with the boxes where a calibration is given."""
    if camera is None:
        ax.imshow(np.asarray(image))
        ax.set_axis_off()
        return
    from radejax.visualize.camera import draw_camera

    draw_camera(
        image,
        camera,
        ground_truth=truth,
        predictions=found,
        ax=ax,
        show_labels=show_labels,
    )
