import json

import numpy as np
import pytest

from radejax.core.errors import DataError
from radejax.visualize import curves
from radejax.visualize.style import SERIES_COLORS


def test_interpolated_precision_in_order_of_recall():
    curve = np.array([0.5, 0.1, 0.2]), np.array([0.8, 0.6, 0.5])
    panels = {"AP": {"all": curve, "fog": None, "rain": curve}, "B": {"all": curve}}
    figure = curves.draw_precision_recall(panels | {"C": {"all": ([0, 0], [0, 0])}})
    one, two, three = figure.axes
    assert [ax.get_title() for ax in figure.axes] == ["AP", "B", "C"]
    x, y = one.lines[0].get_data()
    np.testing.assert_array_equal(x, [0, 0.1, 0.2, 0.5, 0.5])
    np.testing.assert_array_equal(y, [0.8, 0.8, 0.8, 0.8, 0])
    assert one.lines[0].get_drawstyle() == "steps-pre"  # the area is the AP
    assert [line.get_label() for line in one.lines] == ["all", "rain"]
    # Fog has a color of its own where it is not drawn: rain's is the third.
    assert one.lines[1].get_color() == SERIES_COLORS[2]
    assert not two.texts
    assert [text.get_text() for text in three.texts] == ["none found"]


def test_series_of_a_run_are_read_and_drawn(tmp_path):
    path = tmp_path / "metrics.jsonl"
    rows = [{"step": s, "focal": 1 / s, "gwd": 0.5} for s in (1, 2, 4)]
    rows[1]["gwd"] = None  # not finite
    lines = map(json.dumps, rows)
    text = "\n".join(lines) + "\n"
    path.write_text(text + '{"step": 5, "foc')
    series = curves.read_metrics(path)
    np.testing.assert_array_equal(series["focal"], [[1, 2, 4], [1, 0.5, 0.25]])
    np.testing.assert_array_equal(series["gwd"], [[1, 2, 4], [0.5, np.nan, 0.5]])
    figure = curves.draw_training(series, ["focal", "gwd"], "run")
    assert [ax.get_title() for ax in figure.axes] == ["focal", "gwd"]
    held_out = {"validation/focal": ([2, 4], [0.7, 0.6])}
    figure = curves.draw_training(series | held_out, ["focal", "gwd"])
    line = figure.axes[0].lines[-1]
    assert line.get_label() == "validation"
    np.testing.assert_array_equal(line.get_xydata(), [[2, 0.7], [4, 0.6]])
    assert len(figure.axes[1].lines) == 2
    path.write_text(text + "oops\n")
    with pytest.raises(DataError, match=r"metrics\.jsonl, line 4"):
        curves.read_metrics(path)
    with pytest.raises(FileNotFoundError, match=r"none\.jsonl"):
        curves.read_metrics(tmp_path / "none.jsonl")
