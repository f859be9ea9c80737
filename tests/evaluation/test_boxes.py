import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.core.structures import Boxes
from radejax.evaluation import boxes


def test_roi_names_and_bounds():
    assert boxes.roi_bounds("narrow") == (0, 72, -6.4, 6.4, -2, 6)
    assert boxes.roi_bounds(None) is None
    assert boxes.roi_name((0, 72, -16, 16, -2, 7.6)) == "wide"
    assert boxes.roi_name((0, 10, -1, 1, -2, 2)) == "0,10,-1,1,-2,2"
    assert boxes.roi_name(None) == "none"
    with pytest.raises(UserError, match="increasing bounds"):
        boxes.roi_bounds((0, 0, 1, 2, 3, 4))


def test_frame_positions_of_any_order():
    position = boxes.frame_positions(np.array([5, 3, 5]), np.array([3, 9, 5]), "x")
    assert position.tolist() == [2, 0, 2]
    none = np.zeros(0, int)
    with pytest.raises(DataError, match="x: frame 3, row 0: no such frame among the 0"):
        boxes.frame_positions(np.array([3]), none, "x")
    assert boxes.frame_positions(none, none, "x").size == 0


def test_a_class_that_k_radar_does_not_have_may_be_asked_for():
    tram = Boxes(np.zeros(1, int), np.ones((1, 7)), np.array(["Tram"]))
    assert boxes.class_indices(tram, ("Tram",), "x").tolist() == [0]


def test_read_boxes_takes_lists_and_empty_tables():
    found = boxes.read_boxes(
        {"frame": [1], "box": [[0, 0, 0, 1, 1, 1, 0]], "cls": ["Sedan"], "score": [1]},
        "predictions",
        scored=True,
    )
    assert (found.frame.dtype, found.box.shape) == (np.int64, (1, 7))
    assert (found.cls[0], found.score[0]) == ("Sedan", 1)
    empty = {"frame": [], "box": [], "cls": []}
    assert boxes.read_boxes(empty, "x", scored=False).box.shape == (0, 7)
