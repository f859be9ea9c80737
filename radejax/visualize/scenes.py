"""Several frames in one figure, as in the papers: camera image above, radar map below.

References:
    RADE-Net, Figure 4 (one scene per weather); DinoRADE, Figure 3 (with magnified views).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from radejax.errors import UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import bev
from radejax.visualize.canvas import new_figure
from radejax.visualize.overlays import both_sets, legend_handles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ZOOM_COLOR = "#E69F00"
"""Orange of Okabe and Ito's colour-blind safe set, as the papers' magnified views."""


class Scene(NamedTuple):
    """One frame to show.

    Attributes:
        projection: `[R, A, D+E]` normalised log power.
        ground_truth: As in `bev.draw_bev`.
        predictions: As in `bev.draw_bev`.
        image: `[H, W, 3]` left front image, or None.
        camera: `CameraCalibration` of the image, or None.
        title: Such as the weather.
        zoom: x and y in metres of the place to magnify, or None.
    """

    projection: Any
    ground_truth: Any = None
    predictions: Any = None
    image: Any = None
    camera: Any = None
    title: str = ""
    zoom: tuple[float, float] | None = None


def draw_scenes(
    scenes: Sequence[Scene],
    grid: RadarGrid,
    *,
    roi: Sequence[float] | None = None,
    columns: int = 4,
    class_names: Sequence[str] | None = None,
    zoom_m: float = 10.0,
) -> Figure:
    """Figure of scenes side by side: ground truth, predictions and region in each.

    Args:
        scenes: At least one.
        grid: The grid of the projections.
        roi: Region of interest, dashed; as in `bev.draw_bev`.
        columns: Scenes in a row.
        class_names: Names of class indices; see `canvas.as_objects`.
        zoom_m: Width and height of what is magnified, metres.

    Raises:
        UserError: No scenes, or one that does not fit the grid.
    """
    if not scenes:
        raise UserError("no scenes to draw")
    columns = min(columns, len(scenes))
    rows = -(-len(scenes) // columns)
    width, height = 3.9 * columns, 6.4 * rows + 0.5
    figure = new_figure(width, height)
    limits = _common_limits(scenes, grid)
    for index, scene in enumerate(scenes):
        row, column = divmod(index, columns)
        left = (column + 0.14) / columns
        bottom = 1.0 - (6.4 * (row + 1) + 0.05) / height

        def place(y: float, h: float, x: float = left, base: float = bottom) -> tuple:
            return x, base + y / height, 0.83 / columns, h / height

        shown = {
            "ground_truth": scene.ground_truth,
            "predictions": scene.predictions,
            "class_names": class_names,
        }
        above = None
        if scene.image is not None:
            above = figure.add_axes(place(4.25, 1.85))
            truth, found = both_sets(*list(shown.values())[:2], class_names)
            # Labels are readable on the map; here they would hide the image.
            bev.draw_view(
                above, scene.image, scene.camera, truth, found, show_labels=False
            )
        below = figure.add_axes(place(0.55, 3.6))
        bev.draw_bev(
            scene.projection,
            grid,
            ax=below,
            roi=roi,
            color_limits=limits,
            show_legend=False,
            show_colorbar=False,
            **shown,
        )
        if column:
            below.set_ylabel("")
        (above or below).set_title(scene.title, fontsize=11)
        if scene.zoom is not None:
            _magnify(below, scene, grid, limits, zoom_m, class_names)
    first = both_sets(scenes[0].ground_truth, scenes[0].predictions, class_names)
    handles = legend_handles(*first, roi)
    for handle in handles:  # numbers of one scene would mislead
        handle.set_label(handle.get_label().split(" (")[0])
    figure.legend(handles=handles, loc="lower center", ncols=3, frameon=False)
    return figure


def _common_limits(scenes: Sequence[Scene], grid: RadarGrid) -> tuple[float, float]:
    """One colour scale for all scenes."""
    from radejax.visualize.canvas import color_limits_of
    from radejax.visualize.projections import range_azimuth

    limits = [color_limits_of(range_azimuth(s.projection, grid)) for s in scenes]
    return min(low for low, _ in limits), max(high for _, high in limits)


def _magnify(
    ax: Axes,
    scene: Scene,
    grid: RadarGrid,
    limits: tuple[float, float],
    size_m: float,
    class_names: Sequence[str] | None,
) -> None:
    """An orange square on the map and what is in it, larger, in a corner."""
    from matplotlib.patches import Rectangle

    x, y = scene.zoom
    half = size_m / 2
    # The axes show y to the left and x up.
    ax.add_patch(
        Rectangle(
            (y - half, x - half), size_m, size_m, fill=False, ec=ZOOM_COLOR, lw=1.5
        )
    )
    inset = ax.inset_axes((0.60, 0.02, 0.38, 0.38 * _aspect(ax)))
    bev.draw_bev(
        scene.projection,
        grid,
        ax=inset,
        extent=(x - half, x + half, y - half, y + half),
        ground_truth=scene.ground_truth,
        predictions=scene.predictions,
        class_names=class_names,
        color_limits=limits,
        show_labels=False,
        show_legend=False,
        show_colorbar=False,
    )
    inset.set(xticks=[], yticks=[], xlabel="", ylabel="")
    for spine in inset.spines.values():
        spine.set(color=ZOOM_COLOR, lw=1.5)


def _aspect(ax: Axes) -> float:
    """Width over height of the axes on paper, so that an inset becomes a square."""
    box = ax.get_position()
    width, height = ax.figure.get_size_inches()
    return float(np.clip(box.width * width / (box.height * height), 0.2, 5.0))
