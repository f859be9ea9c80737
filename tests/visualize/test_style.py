import dataclasses

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import style
from radejax.visualize.style import Scene

GRID = RadarGrid.reduced(num_doppler=4, num_range=6, num_elevation=3, num_azimuth=5)


def test_scenes_hold_boxes_of_one_frame_on_their_grid():
    projection = np.zeros(GRID.projection_shape, np.float32)
    boxes = Boxes.one_frame(np.ones((2, 7)), ["Sedan", "Bicycle"], [0.5, 0.25])
    scene = Scene(projection, GRID, predictions=boxes)
    assert scene.sets == [(style.PREDICTION, boxes)]
    assert style.label_texts(boxes) == ["Sedan 0.50", "Bicycle 0.25"]
    two = dataclasses.replace(boxes, frame=np.arange(2))
    with pytest.raises(UserError, match="boxes of 2 frames"):
        Scene(projection, GRID, ground_truth=two)
    with pytest.raises(UserError, match="one frame, without a batch axis"):
        Scene(projection[None], GRID)


def test_color_limits_ignore_what_is_not_finite():
    values = np.linspace(0.0, 1.0, 1001)
    low, high = style.color_limits_of(np.append(values, [np.nan, np.inf]))
    assert (low, high) == pytest.approx((0.2, 0.999))
    assert style.color_limits_of(np.eye(100)[0]) == (0.0, pytest.approx(0.901, 1e-3))
    assert style.color_limits_of(np.eye(2000)[0]) == (0.0, 1.0)
    assert style.color_limits_of(np.full(5, 3.0)) == (3.0, 4.0)
    assert style.color_limits_of(np.array([np.nan])) == (0.0, 1.0)


def test_save_makes_folders_and_leaves_no_parts(tmp_path):
    figure = style.new_figure(2, 2)
    path = style.save_figure(figure, tmp_path / "a" / "b.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    style.save_figure(figure, tmp_path / "a" / "b.pdf")
    assert {p.name for p in path.parent.iterdir()} == {"b.png", "b.pdf"}


def test_failed_save_keeps_the_old_figure(tmp_path, monkeypatch):
    figure = style.new_figure(2, 2)
    path = style.save_figure(figure, tmp_path / "b.png")
    before = path.read_bytes()

    def fail(target, **_):
        target.write_bytes(b"half")
        raise RuntimeError("interrupted")

    monkeypatch.setattr(figure, "savefig", fail)
    with pytest.raises(RuntimeError, match="interrupted"):
        style.save_figure(figure, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["b.png"]


def test_unknown_suffix_is_rejected(tmp_path):
    with pytest.raises(UserError, match="png"):
        style.save_figure(style.new_figure(2, 2), tmp_path / "a.xyz")


def test_radar_colors_keep_white_and_red_visible():
    """WCAG contrast of at least 1.5 between white and the strongest echo."""

    def luminance(rgb):
        rgb = np.asarray(rgb[:3])
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    brightest = luminance(style.COLOR_MAP(1.0))
    assert 1.05 / (brightest + 0.05) > 1.5
    # Monotone in brightness: readable in gray and under color blindness.
    steps = [luminance(style.COLOR_MAP(v)) for v in np.linspace(0, 1, 20)]
    assert (np.diff(steps) > 0).all()
