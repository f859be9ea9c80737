"""Several frames in one figure, as in the papers: camera image above, radar map below.

References:
    RADE-Net, Figure 4 (one scene per weather); DinoRADE, Figure 3 (with magnified views).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from radejax.core.errors import UserError
from radejax.visualize import bev
from radejax.visualize.canvas import COLOR_MAP, Scene, new_figure
from radejax.visualize.maps import legend_handles
from radejax.visualize.projections import color_label, range_azimuth

ZOOM_COLOR = "#E69F00"
"""Orange of Okabe and Ito's colour-blind safe set, as the papers' magnified views."""

_COLOR_PERCENTILES = (20.0, 99.5)
_FOOT_IN = 0.8  # legend and colour bar
_COLUMN_IN, _ROW_IN = 4.9, 8.0  # large enough for scores of crowded scenes


def draw_scenes(
    scenes: Sequence[Scene], *, columns: int = 4, zoom_m: float = 10.0
) -> Figure:
    """Figure of scenes side by side: ground truth, predictions and region in each.

    Args:
        scenes: At least one; the legend is the first one's.
        columns: Scenes in a row.
        zoom_m: Width and height of what is magnified, metres.

    Raises:
        UserError: No scenes, or one that does not fit its grid.
    """
    if not scenes:
        raise UserError("no scenes to draw")
    columns = min(columns, len(scenes))
    rows = -(-len(scenes) // columns)
    width, height = _COLUMN_IN * columns, _ROW_IN * rows + _FOOT_IN
    figure = new_figure(width, height)
    limits = _common_limits(scenes)
    draw = functools.partial(
        bev.draw_bev, color_limits=limits, show_legend=False, show_colorbar=False
    )
    for index, scene in enumerate(scenes):
        row, column = divmod(index, columns)
        left = (column + 0.14) / columns
        bottom = 1.0 - (_ROW_IN * (row + 1) + 0.05) / height

        def place(y: float, h: float, x: float = left, base: float = bottom) -> tuple:
            return x, base + y / height, 0.83 / columns, h / height

        above = None
        if scene.image is not None:
            above = figure.add_axes(place(5.55, 2.15))
            # Labels are readable on the map; here they would hide the image.
            bev.draw_view(above, scene, show_labels=False)
        below = figure.add_axes(place(0.55, 4.9))
        draw(dataclasses.replace(scene, title=""), ax=below)
        if column:
            below.set_ylabel("")
        (above or below).set_title(scene.title, fontsize=11)
        if scene.zoom is not None:
            _magnify(below, scene, zoom_m, draw)
    _draw_colorbar(figure, limits)
    figure.legend(
        handles=legend_handles(scenes[0], show_counts=False),  # of one scene alone
        loc="lower left",
        bbox_to_anchor=(0.3 / width, 0.2 / height),
        ncols=3 if columns > 1 else 1,
        frameon=False,
    )
    return figure


def _common_limits(scenes: Sequence[Scene]) -> tuple[float, float]:
    """One colour scale for all scenes, which the few strongest echoes exceed."""
    values = [range_azimuth(scene.projection, scene.grid).ravel() for scene in scenes]
    low, high = np.nanpercentile(np.concatenate(values), _COLOR_PERCENTILES)
    return float(low), float(high) if high > low else float(low) + 1.0


def _draw_colorbar(figure: Figure, limits: tuple[float, float]) -> None:
    """The scale of all maps, below them, beside the legend."""
    width, height = figure.get_size_inches()
    cax = figure.add_axes(
        (1.0 - 3.3 / width, 0.42 / height, 2.7 / width, 0.11 / height)
    )
    mappable = ScalarMappable(Normalize(*limits), COLOR_MAP)
    bar = figure.colorbar(mappable, cax=cax, orientation="horizontal", extend="both")
    bar.set_label(color_label(), fontsize=8)
    bar.ax.tick_params(labelsize=8)


def _magnify(ax: Axes, scene: Scene, size_m: float, draw: Callable[..., Axes]) -> None:
    """An orange square on the map and what is in it, larger, in a corner."""
    assert scene.zoom is not None
    x, y = scene.zoom
    half = size_m / 2
    # The axes show y to the left and x up.
    ax.add_patch(
        Rectangle(
            (y - half, x - half), size_m, size_m, fill=False, ec=ZOOM_COLOR, lw=1.5
        )
    )
    inset = ax.inset_axes((0.60, 0.02, 0.38, 0.38 * _aspect(ax)))
    draw(
        dataclasses.replace(scene, title="", roi=None),
        ax=inset,
        extent=(x - half, x + half, y - half, y + half),
        show_labels=False,
    )
    inset.set(xticks=[], yticks=[], xlabel="", ylabel="")
    for spine in inset.spines.values():
        spine.set(color=ZOOM_COLOR, lw=1.5)


def _aspect(ax: Axes) -> float:
    """Width over height of the axes on paper, so that an inset becomes a square."""
    box = ax.get_position()
    width, height = ax.figure.figure.get_size_inches()
    return float(np.clip(box.width * width / (box.height * height), 0.2, 5.0))
