"""How much a fusion model takes from the camera, over the field of view."""

from __future__ import annotations

import math
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from radejax.core.files import write_json
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.canvas import new_figure, save_figure


def average_by_group(
    shares: Iterable[tuple[str, Float[np.ndarray, "R A"]]],
) -> tuple[dict[str, Float[np.ndarray, "R A"]], dict[str, int]]:
    """Mean maps of groups, "all" first, over what the camera sees.

    A bin that no query sees in the image has share 0, which says nothing of the gate:
    every bin is averaged over the frames that have it in view.

    Args:
        shares: Group and share of every frame.

    Returns:
        Means by group, 0 in bins that no frame has in view, and the numbers of
        frames with anything in view, that is, with an image.
    """
    sums: dict[str, Any] = {}
    seen: dict[str, Any] = {}
    counts: dict[str, int] = {}
    for group, share in shares:
        is_seen = share > 0
        for name in ("all", group):
            sums[name] = sums.get(name, 0.0) + share
            seen[name] = seen.get(name, 0) + is_seen
            counts[name] = counts.get(name, 0) + int(is_seen.any())
    return {name: sums[name] / np.maximum(seen[name], 1) for name in sums}, counts


def mean_share(share: Float[np.ndarray, "R A"], grid: RadarGrid) -> float:
    """Mean of a map over the bins in view, those above 0; NaN without any.

    Bins beyond the grid are padding and do not count.
    """
    share = np.asarray(share)[: grid.num_range, : grid.num_azimuth]
    return float(share[share > 0].mean()) if (share > 0).any() else float("nan")


def draw_camera_share(
    maps: Mapping[str, Float[np.ndarray, "R A"]],
    grid: RadarGrid,
    *,
    counts: Mapping[str, int] | None = None,
    columns: int = 4,
) -> Figure:
    """One range-azimuth panel per condition, all on one scale.

    Args:
        maps: Mean share of the camera by condition, 0 (radar alone) to 1.
        grid: Axes of the maps; more bins than the grid has are padding and cut.
        counts: Frames with an image per condition, for the titles.
        columns: Panels side by side.
    """
    columns = min(columns, len(maps))
    rows = -(-len(maps) // columns)
    figure = new_figure(2.6 * columns + 1.2, 2.9 * rows + 0.4, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    maps = {
        k: np.asarray(m)[: grid.num_range, : grid.num_azimuth] for k, m in maps.items()
    }
    # Bins that no query sees in the image have share 0: they say nothing of the gate.
    seen = np.concatenate([m[m > 0] for m in maps.values()] or [np.zeros(0)])
    low, high = (seen.min(), seen.max()) if seen.size else (0.0, 1.0)
    colors = matplotlib.colormaps["cividis"].with_extremes(bad="0.85")
    azimuth = np.rad2deg(grid.azimuth_rad)
    extent = (azimuth[0], azimuth[-1], grid.range_m[0], grid.range_m[-1])
    for ax, (name, share) in zip(axes.flat, maps.items(), strict=False):
        picture = ax.imshow(
            np.ma.masked_equal(share, 0.0),
            origin="lower",
            aspect="auto",
            extent=extent,
            vmin=low,
            vmax=max(high, low + 1e-3),
            cmap=colors,
            interpolation="nearest",
        )
        number = "" if counts is None else f", {counts[name]} frames"
        mean = f"mean {mean_share(share, grid):.3f}" if share.any() else "not in view"
        ax.set_title(f"{name}\n{mean}{number}", fontsize=8)
        ax.tick_params(labelbottom=True, labelsize=8)
    for ax in axes.flat[len(maps) :]:
        ax.set_visible(False)
    figure.supxlabel("azimuth (degrees, positive to the right)", fontsize=9)
    figure.supylabel("range (m)", fontsize=9)
    bar = figure.colorbar(picture, ax=axes.ravel().tolist(), shrink=0.8)
    bar.set_label("share of the camera in the fused map (grey: not in view)")
    return figure


def write_camera_share(
    out: pathlib.Path,
    maps: Mapping[str, np.ndarray],
    counts: Mapping[str, int],
    grid: RadarGrid,
    title: str = "",
) -> None:
    """Writes `camera_share.json` (means and counts) and `camera_share.png`.

    Means are over the bins in view; null without any.
    """
    means = {name: mean_share(share, grid) for name, share in maps.items()}
    summary = {
        name: {"mean": None if math.isnan(m) else m, "frames": counts[name]}
        for name, m in means.items()
    }
    write_json(out / "camera_share.json", summary)
    figure = draw_camera_share(maps, grid, counts=counts)
    if title:
        figure.suptitle(title)
    save_figure(figure, out / "camera_share.png")
