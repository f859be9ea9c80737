"""Curves over data: precision and recall, training, score calibration."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from radejax.core import files
from radejax.core.errors import UserError
from radejax.visualize.style import SERIES_COLORS, new_figure

_LINE_STYLES = ("-", "--", "-.", ":")


def draw_precision_recall(
    curves: Mapping[str, tuple[Any, Any] | None],
    *,
    ax: Axes | None = None,
    title: str = "",
) -> Axes:
    """Draw precision over recall, one line per class or model.

    Lines differ in color and in dash pattern.

    Args:
        curves: Name to `(recall [K], precision [K])`, both in [0, 1]; None keeps the
            looks of the others the same from panel to panel.
        ax: Where to draw; a new figure by default.
        title: Title of the axes.
    """
    ax = new_figure(5.2, 4.6, layout="constrained").add_subplot() if ax is None else ax
    for i, (label, curve) in enumerate(curves.items()):
        if curve is not None:
            recall, precision = (np.asarray(values, float) for values in curve)
            order = np.argsort(recall, kind="stable")
            ax.plot(recall[order], precision[order], label=label, **_line(i))
    limits = (0, 1.02)
    ax.set(xlim=limits, ylim=limits, xlabel="recall", ylabel="precision")
    ax.set_title(title, fontsize=9)
    ax.grid(alpha=0.3)
    if curves:
        ax.legend(  # below the axes, where it covers no curve
            fontsize=7,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.16),
            ncols=1 if len(curves) < 4 else 2,
            frameon=False,
        )
    return ax


def read_metrics(path: str | os.PathLike) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Series of a run's `metrics.jsonl`: name to `(step [N], value [N])`.

    An unfinished last line, as an interrupted run leaves it, is ignored.

    Raises:
        FileNotFoundError: The file does not exist.
        DataError: A line is not a JSON object with a step; names file and line.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no metrics of a run at {path}")
    series: dict[str, list[tuple[float, float]]] = {}
    *lines, _ = files.read_text(path).split("\n")
    for number, line in enumerate(lines, 1):
        record = files.parse_json(line, {"step": float}, f"{path}, line {number}")
        step = float(record.pop("step"))
        for name, value in record.items():
            if isinstance(value, int | float):
                series.setdefault(name, []).append((step, float(value)))
    return {name: tuple(np.array(rows).T) for name, rows in series.items()}


def draw_training(
    series: Mapping[str, tuple[Any, Any]], keys: Sequence[str], title: str = ""
) -> Figure:
    """Figure of a run's losses over steps, one panel per key.

    Args:
        series: Name to `(step [N], value [N])`, such as those of `read_metrics`.
        keys: Names of the series to show.
        title: Title of the figure.
    """
    figure = new_figure(4.0 * len(keys), 3.4, layout="constrained")
    axes = figure.subplots(1, len(keys), squeeze=False)[0]
    for key, ax, color in zip(keys, axes, SERIES_COLORS, strict=False):
        step, value = (np.asarray(v, float) for v in series[key])
        smooth = moving_mean(value, max(1, round(0.05 * value.size)))
        ax.plot(step, value, color=color, alpha=0.3, lw=0.8, label="logged")
        ax.plot(step, smooth, color=color, lw=1.8, label="moving mean")
        ax.set(xlabel="step", title=key)
        finite = value[np.isfinite(value)]
        if finite.size and finite.min() > 0 and finite.max() > 20 * finite.min():
            ax.set_yscale("log")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    figure.suptitle(title)
    return figure


def moving_mean(values: Float[np.ndarray, " N"], width: int) -> Float[np.ndarray, " N"]:
    """Mean over the last `width` finite values, fewer at the start."""
    is_finite = np.isfinite(values)
    total = np.cumsum(np.where(is_finite, values, 0.0))
    count = np.cumsum(is_finite)
    total[width:], count[width:] = (
        total[width:] - total[:-width],
        count[width:] - count[:-width],
    )
    return np.divide(total, count, out=np.full(values.shape, np.nan), where=count > 0)


def calibration_bins(
    scores: Any, is_match: Any, num_bins: int = 10
) -> tuple[
    Float[np.ndarray, " {num_bins}"],
    Float[np.ndarray, " {num_bins}"],
    Int[np.ndarray, " {num_bins}"],
]:
    """Mean score, share of matches and number of detections in equal score bins.

    Args:
        scores: `[N]` in [0, 1].
        is_match: `[N]` bool, True where the detection matches an object.
        num_bins: Of equal width over [0, 1].

    Returns:
        Of each bin; mean score and share are NaN in empty ones.
    """
    scores, is_match = np.asarray(scores, float), np.asarray(is_match, bool)
    if scores.shape != is_match.shape or scores.ndim != 1:
        raise UserError(
            f"scores {scores.shape} and matches {is_match.shape} must be vectors of "
            "one length"
        )
    if scores.size and not (0 <= scores.min() <= scores.max() <= 1):
        raise UserError(f"scores must lie in [0, 1], got up to {scores.max()}")
    idx = np.minimum((scores * num_bins).astype(int), num_bins - 1)
    count = np.bincount(idx, minlength=num_bins)
    sums = np.bincount(idx, scores, num_bins), np.bincount(idx, is_match, num_bins)
    mean, share = (
        np.divide(s, count, out=np.full(num_bins, np.nan), where=count > 0)
        for s in sums
    )
    return mean, share, count


def draw_calibration(
    scores: Any,
    is_match: Any,
    *,
    num_bins: int = 10,
    ax: Axes | None = None,
    title: str | None = None,
) -> Axes:
    """Draws what share of detections with a score really are objects.

    On the diagonal a score is a probability; below it the detector is too sure. The
    text gives the expected calibration error, the mean distance to the diagonal weighted
    by the number of detections.

    Args:
        scores: `[N]` in [0, 1].
        is_match: `[N]` bool, True where the detection matches an object.
        num_bins: Of equal width over [0, 1].
        ax: Where to draw; a new figure by default.
        title: Title of the axes.
    """
    mean, share, count = calibration_bins(scores, is_match, num_bins)
    ax = new_figure(5.0, 4.4, layout="constrained").add_subplot() if ax is None else ax
    ax.plot([0, 1], [0, 1], color="0.4", lw=1, ls="--", label="calibrated")
    ax.plot(mean, share, "o-", color=SERIES_COLORS[0], label="detections")
    histogram = ax.twinx()
    edges = np.linspace(0, 1, num_bins + 1)
    histogram.bar(
        edges[:-1], count, 1 / num_bins, align="edge", color=SERIES_COLORS[5], alpha=0.3
    )
    histogram.set(ylabel="detections in the bin", ylim=(0, 3 * max(count.max(), 1)))
    error = np.nansum(np.abs(mean - share) * count) / max(count.sum(), 1)
    ax.set(
        xlim=(0, 1),
        ylim=(0, 1.02),
        xlabel="score",
        ylabel="share that matches an object",
    )
    text = f"expected calibration error {error:.3f}, {count.sum()} detections"
    ax.set_title("\n".join(filter(None, (title, text))), fontsize=9)
    ax.legend(fontsize=8, loc="upper left")
    return ax


def _line(i: int) -> dict[str, Any]:
    """Colour and dash pattern of the i-th line; no two alike among the first 24."""
    return {
        "color": SERIES_COLORS[i % len(SERIES_COLORS)],
        "linestyle": _LINE_STYLES[(i + i // len(SERIES_COLORS)) % len(_LINE_STYLES)],
        "linewidth": 1.8,
    }
