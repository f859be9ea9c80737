"""Figures of precision-recall curves and of training metrics."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from radejax.core import files
from radejax.core.errors import DataError
from radejax.visualize.style import SERIES_COLORS, new_figure

_LINE_STYLES = ("-", "--", "-.", ":")

Curve = tuple[ArrayLike, ArrayLike] | None
"""Recall `[K]` and precision `[K]`, both in [0, 1], of one line; None draws nothing."""


def draw_precision_recall(
    panels: Mapping[str, Mapping[str, Curve]],
    title: str = "",
    labels: tuple[str, str] | None = None,
) -> Figure:
    """Draws interpolated precision over recall, one line per class, condition or model.

    With `labels`, the curves are other values from 0 to 1, such as F1 over the score, and are
    drawn as they are.

    The interpolated precision at a recall is the highest precision at this or a higher
    recall. In the protocol `all_point`, AP is the area under the drawn steps. Lines differ
    in color and in dash pattern, which depend on the position of the curve in its panel.
    Use None for missing curves, so that a name has the same color and pattern in all
    panels.

    Args:
        panels: Curves by name for the title of each panel; at least one panel.
        title: Title of the figure.
        labels: Labels of the axes of curves that are not interpolated.
    """
    rows = -(-len(panels) // 4)
    columns = -(-len(panels) // rows)
    figure = new_figure(3.8 * columns, 4.4 * rows, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    for ax, (name, curves) in zip(axes, panels.items(), strict=False):
        _draw_panel(ax, curves, labels)
        ax.set_title(name, fontsize=10)
    figure.suptitle(title)
    return figure


def _draw_panel(
    ax: Axes, curves: Mapping[str, Curve], labels: tuple[str, str] | None
) -> None:
    is_empty = labels is None
    for i, (label, curve) in enumerate(curves.items()):
        if curve is not None and labels:
            ax.plot(*curve, label=label, **_line(i))
        elif curve is not None:
            recall, precision = (np.asarray(values, float) for values in curve)
            order = np.argsort(recall, kind="stable")
            highest = np.maximum.accumulate(precision[order][::-1])[::-1]
            # The precision of the first recall holds from 0 on, and 0 after the last one.
            x = np.concatenate([[0.0], recall[order], recall[order][-1:]])
            y = np.concatenate([highest[:1], highest, [0.0]])
            ax.plot(x, y, label=label, drawstyle="steps-pre", **_line(i))
            is_empty = is_empty and not recall.any()
    limits = (0, 1.02)
    xlabel, ylabel = labels or ("recall", "interpolated precision")
    ax.set(xlim=limits, ylim=limits, xlabel=xlabel, ylabel=ylabel)
    ax.grid(alpha=0.3)
    if is_empty:
        ax.text(0.5, 0.5, "none found", transform=ax.transAxes, ha="center")
    if ax.lines:  # the legend is below the axes, not to cover a curve
        ax.legend(
            fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16), frameon=False
        )


def read_metrics(path: files.PathLike) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Reads the series of a run's `metrics.jsonl` as `(step [N], value [N])` by name.

    An incomplete last line of an interrupted run is ignored.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: The file does not exist.
        DataError: A line is not a JSON object with a step; the message names file and
            line.
    """
    series: dict[str, list[tuple[float, float]]] = {}
    *lines, _ = files.read_text(path).split("\n")
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            step = float(record.pop("step"))
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise DataError(f"{path}, line {number} is corrupted: {error}") from None
        for name, value in record.items():
            if value is None or isinstance(value, int | float):
                finite = math.nan if value is None else float(value)
                series.setdefault(name, []).append((step, finite))
    return {name: tuple(np.array(rows).T) for name, rows in series.items()}


def draw_training(
    series: Mapping[str, tuple[ArrayLike, ArrayLike]],
    keys: Sequence[str],
    title: str = "",
) -> Figure:
    """Draws the losses of a run over steps, one panel per key.

    Args:
        series: `(step [N], value [N])` by name, as returned by `read_metrics`.
        keys: Names of the series to show. Those of a split, such as `validation/focal`,
            are drawn in the panel of `focal`.
        title: Title of the figure.
    """
    figure = new_figure(4.0 * len(keys), 3.4, layout="constrained")
    axes = figure.subplots(1, len(keys), squeeze=False)[0]
    for key, ax, color in zip(keys, axes, SERIES_COLORS, strict=False):
        step, value = (np.asarray(v, float) for v in series[key])
        smooth = moving_mean(value, max(1, round(0.05 * value.size)))
        ax.plot(step, value, color=color, alpha=0.3, lw=0.8, label="logged")
        ax.plot(step, smooth, color=color, lw=1.8, label="moving mean")
        for name in (name for name in series if name.endswith(f"/{key}")):
            split = name.removesuffix(f"/{key}")
            ax.plot(*series[name], color="black", marker=".", lw=1.2, label=split)
        ax.set(xlabel="step", title=key)
        finite = value[np.isfinite(value)]
        if finite.size and finite.min() > 0 and finite.max() > 20 * finite.min():
            ax.set_yscale("log")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    figure.suptitle(title)
    return figure


def moving_mean(values: Float[np.ndarray, " N"], width: int) -> Float[np.ndarray, " N"]:
    """Computes the mean of the finite values among the last `width` values.

    There are fewer values at the start. The mean is NaN if none is finite.
    """
    is_finite = np.isfinite(values)
    window = np.ones(width)
    total = np.convolve(np.where(is_finite, values, 0.0), window)[: values.size]
    count = np.convolve(is_finite, window)[: values.size]
    return total / np.where(count > 0, count, np.nan)


def _line(i: int) -> dict[str, Any]:
    """Returns color and dash pattern of the i-th line; the first 24 lines all differ."""
    return {
        "color": SERIES_COLORS[i % len(SERIES_COLORS)],
        "linestyle": _LINE_STYLES[(i + i // len(SERIES_COLORS)) % len(_LINE_STYLES)],
        "linewidth": 1.8,
    }
