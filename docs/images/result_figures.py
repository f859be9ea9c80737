"""Draws the figures of `docs/results.md` from the stored results in `docs/reports/ablations`."""

from __future__ import annotations

import dataclasses
import functools
import json
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from radejax.simulation.config import CONDITIONS, SimulationOptions
from radejax.visualize.draw import bin_edges
from radejax.visualize.style import new_figure

RESULTS = pathlib.Path(__file__).resolve().parents[1] / "reports" / "ablations"
SUPPORTED, NOT_REPRODUCED, INCONCLUSIVE = "#0072B2", "#D55E00", "#6b6b6b"
VERDICTS = {
    "supported in simulation": SUPPORTED,
    "not reproduced in simulation": NOT_REPRODUCED,
    "inconclusive": INCONCLUSIVE,
    "not tested with the paper's model": INCONCLUSIVE,
}
LINEAR_POINTS = 5.0  # differences beyond are drawn on a logarithmic axis
WEATHERS = ("normal", "overcast", "fog", "rain", "sleet", "lightsnow", "heavysnow")


@dataclasses.dataclass(frozen=True)
class Claim:
    """A claim of the table of `docs/results.md` whose difference is stored.

    Attributes:
        text: What is claimed.
        table: Name of the stored table.
        better: Variant that is claimed to be better.
        other: Variant that it is compared with.
        cls: Class, or "mean".
        paper: Difference in the paper in points, or None if it has no number.
        names_size: Whether the claim is of that size and not only of the sign.
        condition: Scenes to which the claim is restricted.
        is_tested: Whether the variants have what the claim is about.
    """

    text: str
    table: str
    better: str
    other: str
    cls: str = "Sedan"
    paper: float | None = None
    names_size: bool = False
    condition: str = "all"
    is_tested: bool = True


_CAMERA = ("camera", "R+C+W long", "R long")
_SHORT = ("4_realistic", "R+C+W", "R")
CLAIMS = (
    Claim("full network better than the plain one", "3_realistic", "model", "base", paper=4.73),
    Claim("attention alone does not help", "3", "base", "cbam", paper=1.1),
    Claim("larger heads help", "3", "cbam_heads", "cbam", paper=1.8),
    Claim("dilated neck helps", "3", "model", "cbam_heads", paper=4.0),
    Claim("attention helps with neck and heads", "3_realistic", "model", "no_cbam", paper=2.39),
    Claim("one stem better than two", "3_realistic", "model", "stem", paper=-0.34),
    Claim("narrow decoder is better", "3", "model", "expand", paper=0.79),
    Claim("heatmap sigma 0.75 better than 3", "sigma_realistic", "sigma 0.75", "sigma 3", "mean"),
    Claim("heatmap sigma 0.75 better than 1", "sigma", "sigma 0.75", "model", "mean"),
    Claim("camera gains 8 points", *_CAMERA, paper=8.64, names_size=True),
    Claim("camera helps", *_CAMERA, "mean"),
    Claim("camera helps", *_CAMERA, "Pedestrian"),
    Claim("camera helps", *_CAMERA, "Motorcycle"),
    Claim("camera helps", *_CAMERA, "Bicycle"),
    Claim("camera helps, short schedule", *_SHORT, paper=8.64),
    Claim("camera helps, short schedule", *_SHORT, "mean"),
    Claim("camera helps, short schedule", *_SHORT, "Pedestrian"),
    Claim("camera helps, short schedule", *_SHORT, "Motorcycle"),
    Claim("camera helps, short schedule", *_SHORT, "Bicycle"),
    Claim("camera with a covered lens, short", *_SHORT, condition="lens heavily or fully covered"),
    Claim("elevation weights help, short", "4_realistic", "R+C+W", "R+C", paper=0.4),
    Claim(
        "foundation model, short schedule", "4", "R+C+W", "R+C+W ResNet", paper=3.0,
        is_tested=False,
    ),
)  # fmt: skip


@functools.cache
def _table(name: str) -> Mapping[str, Any]:
    path = RESULTS / f"table_{name}.json"
    return json.loads(path.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def _stored(claim: Claim) -> tuple[float, float, float]:
    """Difference and its interval; of a claim or, for other classes, of a row."""
    table = _table(claim.table)
    if claim.condition == "all":
        for row in table["claims"]:
            if (row["a"], row["b"], row["cls"]) == (
                claim.better,
                claim.other,
                claim.cls,
            ):
                return row["difference"], row["low"], row["high"]
    for row in table["rows"]:
        place = row["cell"], row["cls"], row["condition"]
        if place == (claim.better, claim.cls, claim.condition):
            return row["difference"], row["low"], row["high"]
    raise LookupError(f"table {claim.table} has no {claim}")


def _against_cfar() -> tuple[float, float, float]:
    path = RESULTS / "quickstart_realistic.json"
    stored = json.loads(path.read_text(encoding="utf-8"))["cfar"]["difference"]
    row = stored["all_point Sedan"]
    return row["difference"], row["low"], row["high"]


def verdict(claim: Claim, difference: float, low: float, high: float) -> str:
    """Returns the verdict by the rule of the page."""
    supported, not_reproduced, inconclusive, not_tested = VERDICTS
    if not claim.is_tested:
        return not_tested
    size = claim.paper if claim.names_size and claim.paper is not None else 0.0
    if high < max(size, 0.0):
        return not_reproduced
    return supported if low > 0 and difference >= size else inconclusive


def label(claim: Claim) -> str:
    """Returns the text of a claim with class and, unless it is `ideal`, radar."""
    radar = ", realistic" if claim.table.endswith("_realistic") else ""
    return f"{claim.text} ({claim.cls}{radar})"


def draw_claims(path: pathlib.Path) -> None:
    """Draws a forest plot: one row per claim with its interval, and the paper's size."""
    cfar = Claim("RADE-Net beats CFAR", "cfar_realistic", "", "")
    found = [(cfar, *_against_cfar())] + [(c, *_stored(c)) for c in CLAIMS]
    figure = new_figure(9.0, 8.6, dpi=140)
    axes = figure.add_axes((0.42, 0.15, 0.405, 0.80))
    axes.set_xscale("symlog", linthresh=LINEAR_POINTS, linscale=0.8)
    axes.set_title("AP difference on simulated data (BEV, IoU 0.3)", fontsize=11)
    for row, (claim, difference, low, high) in enumerate(found):
        color = VERDICTS[verdict(claim, difference, low, high)]
        axes.plot([low, high], [row, row], color=color, lw=2.2, zorder=3)
        inside = color if claim.is_tested else "white"
        axes.plot(difference, row, "o", color=color, mfc=inside, ms=6, zorder=4)
        if claim.paper is not None:
            axes.plot(claim.paper, row, "D", mfc="none", mec="black", ms=7, zorder=5)
        text = f"{difference:+.1f} ({low:.1f} to {high:.1f})"
        place = {"transform": axes.get_yaxis_transform(), "va": "center", "fontsize": 9}
        axes.text(1.02, row, text, color=color, **place)
        axes.axhline(row, color="0.92", lw=0.6, zorder=0)
    axes.set_yticks(range(len(found)), [label(claim) for claim, *_ in found])
    axes.tick_params(axis="y", length=0, labelsize=9)
    axes.set_ylim(len(found) - 0.4, -0.6)
    axes.axvline(0, color="black", lw=0.9)
    ticks = (-5, -2, 0, 2, 5, 10, 20, 50)
    axes.set_xticks(ticks, [f"{tick:+d}" if tick else "0" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlim(-8, 62)
    axes.set_xlabel("points of AP: linear up to 5, logarithmic beyond")
    handles = [
        Line2D([], [], color=color, marker="o", lw=2.2, label=name)
        for name, color in VERDICTS.items()
    ]
    handles[-1].set_markerfacecolor("white")
    paper = {"marker": "D", "mfc": "none", "mec": "black", "ls": ""}
    handles.append(Line2D([], [], label="difference in the paper, on K-Radar", **paper))
    figure.legend(
        handles=handles, loc="lower center", ncols=2, fontsize=9, frameon=False
    )
    figure.savefig(path)


def draw_weather(path: pathlib.Path) -> None:
    """Draws AP by weather with and without the camera, and the difference."""
    rows = {(r["cell"], r["cls"], r["condition"]): r for r in _table("camera")["rows"]}
    (_, fusion, radar), count = _CAMERA, len(WEATHERS)
    figure = new_figure(8.0, 6.4, dpi=140, layout="constrained")
    axes = figure.subplots(2, 2, sharey=True, sharex="col", width_ratios=(1.5, 1))
    place = np.arange(count)
    for (left, right), cls in zip(axes, ("Sedan", "mean"), strict=True):
        name = "mean of five classes" if cls == "mean" else cls
        both = [
            [rows[cell, cls, w]["ap"] for w in WEATHERS] for cell in (radar, fusion)
        ]
        left.hlines(place, *np.sort(both, axis=0), color="0.75", lw=2, zorder=1)
        left.plot(both[0], place, "o", color=INCONCLUSIVE, label="radar only")
        left.plot(both[1], place, "D", color=SUPPORTED, label="radar and camera")
        left.set_title(f"AP BEV at IoU 0.3: {name}", fontsize=10)
        for y, weather in enumerate(WEATHERS):
            row = rows[fusion, cls, weather]
            is_clear = row["low"] > 0 or row["high"] < 0
            color = SUPPORTED if is_clear else INCONCLUSIVE
            right.plot([row["low"], row["high"]], [y, y], color=color, lw=2.2)
            right.plot(row["difference"], y, "o", color=color, ms=6)
        right.axvline(0, color="black", lw=0.9)
        right.set_title("difference, 95 %", fontsize=10)
        for axis in (left, right):
            axis.grid(axis="x", color="0.9", lw=0.6)
            axis.set_axisbelow(True)
    axes[0, 0].set_yticks(place, [_with_roads(name) for name in WEATHERS], fontsize=9)
    axes[0, 0].invert_yaxis()
    axes[0, 0].legend(fontsize=9)
    axes[1, 0].set(xlabel="AP [points]", xlim=(0, 100))
    axes[1, 1].set_xlabel("gain by the camera [points]")
    figure.savefig(path)


def _with_roads(weather: str) -> str:
    """Name of a weather and, below it, of the roads on which it is simulated."""
    roads = dict.fromkeys(road for road, _, name in CONDITIONS if name == weather)
    names = [road.replace("parkinglots", "parking lots") for road in roads]
    text = ", ".join(names[:2]) + (",\n" + ", ".join(names[2:]) if names[2:] else "")
    return f"{weather}:\n{text}"


def draw_camera_share(path: pathlib.Path) -> None:
    """Draws the camera's weight over the grid, and how it differs by what covers the lens."""
    stored = json.loads((RESULTS.parent / "camera_share.json").read_text("utf-8"))
    grid = SimulationOptions().make_grid()
    edges = bin_edges(np.rad2deg(grid.azimuth_rad)), bin_edges(grid.range_m)
    maps = {
        name: np.ma.masked_invalid(np.array(rows, float) / 1e4)
        for name, rows in stored["weight"].items()
    }
    names = [name for name in maps if name != "all"]
    figure = new_figure(9.6, 6.2, layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.7))
    ax = left.subplots()
    drawn = ax.pcolormesh(*edges, maps["all"], cmap="cividis", rasterized=True)
    left.colorbar(drawn, ax=ax, location="bottom", label="weight of the camera")
    axes = [ax, *right.subplots(2, 2, sharex=True, sharey=True).flat]
    for axis, name in zip(axes, ("all", *names), strict=True):
        title = f"{name}: {maps[name].mean():.3f}, {stored['frames'][name]} frames"
        axis.set_title(
            title.replace(": ", ":\n") if name != "all" else title, fontsize=9
        )
        axis.set_facecolor("0.8")
        axis.set(xlabel="azimuth, right positive [deg]", ylabel="range [m]")
        axis.label_outer()
    colors = {"cmap": "RdBu_r", "vmin": -0.015, "vmax": 0.015, "rasterized": True}
    for axis, name in zip(axes[1:], names, strict=True):
        drawn = axis.pcolormesh(*edges, maps[name] - maps["all"], **colors)
    label = "difference to the weight in all frames"
    right.colorbar(drawn, ax=axes[1:], location="bottom", label=label, extend="both")
    figure.savefig(path)
