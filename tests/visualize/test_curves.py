import json

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from radejax.core.errors import DataError
from radejax.visualize import curves
from radejax.visualize.style import SERIES_COLORS


def test_precision_over_recall_in_order_of_recall():
    curve = np.array([0.5, 0.1]), np.array([0.8, 1.0])
    panels = {"AP": {"all": curve, "fog": None, "rain": curve}, "B": {"all": curve}}
    figure = curves.draw_precision_recall(panels | {"C": {"all": ([0, 0], [0, 0])}})
    one, two, three = figure.axes
    assert [ax.get_title() for ax in figure.axes] == ["AP", "B", "C"]
    np.testing.assert_array_equal(one.lines[0].get_xydata(), [[0.1, 1.0], [0.5, 0.8]])
    assert [line.get_label() for line in one.lines] == ["all", "rain"]
    # Fog has a color of its own where it is not drawn: rain's is the third.
    assert one.lines[1].get_color() == SERIES_COLORS[2]
    assert not two.texts
    assert [text.get_text() for text in three.texts] == ["none found"]


def test_lines_differ_and_the_legend_covers_none():
    many = {str(i): ([0, 1], [1, 0]) for i in range(12)}
    (ax,) = curves.draw_precision_recall({"": many}).axes
    looks = {(line.get_color(), line.get_linestyle()) for line in ax.lines}
    assert len(looks) == 12
    assert len({line.get_linestyle() for line in ax.lines[:4]}) == 4
    canvas = FigureCanvasAgg(ax.figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    legend = ax.get_legend().get_window_extent(renderer)
    assert legend.y1 < ax.get_window_extent(renderer).y0
    assert legend.y0 > 0  # inside the figure


def write_metrics(path, extra=""):
    lines = [json.dumps({"step": s, "focal": 1 / s, "gwd": 0.5}) for s in (1, 2, 4)]
    path.write_text("\n".join(lines) + "\n" + extra)
    return path


def test_metrics_are_read_by_name(tmp_path):
    path = write_metrics(tmp_path / "metrics.jsonl", '{"step": 5, "foc')
    series = curves.read_metrics(path)
    np.testing.assert_array_equal(series["focal"], [[1, 2, 4], [1, 0.5, 0.25]])
    figure = curves.draw_training(series, ["focal", "gwd"], "run")
    assert [ax.get_title() for ax in figure.axes] == ["focal", "gwd"]


def test_damaged_metrics_are_named(tmp_path):
    path = write_metrics(tmp_path / "metrics.jsonl", "oops\n")
    with pytest.raises(DataError, match=r"metrics\.jsonl, line 4"):
        curves.read_metrics(path)
    with pytest.raises(FileNotFoundError, match=r"none\.jsonl"):
        curves.read_metrics(tmp_path / "none.jsonl")


def test_moving_mean_by_hand():
    values = np.array([1.0, 3.0, np.nan, 5.0, 7.0])
    mean = curves.moving_mean(values, 2)
    np.testing.assert_allclose(mean, [1.0, 2.0, 3.0, 5.0, 6.0])
    np.testing.assert_array_equal(curves.moving_mean(values[:1], 3), [1.0])
    assert values[0] == 1.0
