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
    two = dataclasses.replace(boxes, frame=np.arange(2))
    with pytest.raises(UserError, match="boxes of 2 frames"):
        Scene(projection, GRID, ground_truth=two)
    with pytest.raises(UserError, match="one frame, without a batch axis"):
        Scene(projection[None], GRID)


def test_figures_are_saved_whole_or_not_at_all(tmp_path, monkeypatch):
    figure = style.new_figure(2, 2)
    path = style.save_figure(figure, tmp_path / "a" / "b.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    figure.suptitle("title")
    style.save_figure(figure, path.with_suffix(".pdf"))
    embedded = path.with_suffix(".pdf").read_bytes()
    assert b"/FontFile2" in embedded  # TrueType
    assert b"/Type3" not in embedded
    with pytest.raises(UserError, match="png"):
        style.save_figure(figure, path.with_suffix(".xyz"))
    before = path.read_bytes()

    def fail(target, **_):
        target.write_bytes(b"half")
        raise RuntimeError("interrupted")

    monkeypatch.setattr(figure, "savefig", fail)
    with pytest.raises(RuntimeError, match="interrupted"):
        style.save_figure(figure, path)
    assert path.read_bytes() == before
    assert {p.name for p in path.parent.iterdir()} == {"b.png", "b.pdf"}
