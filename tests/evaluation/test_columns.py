import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.evaluation import columns


def test_roi_names_and_bounds():
    assert columns.roi_bounds("narrow") == (0, 72, -6.4, 6.4, -2, 6)
    assert columns.roi_bounds(None) is None
    assert columns.roi_name((0, 72, -16, 16, -2, 7.6)) == "wide"
    assert columns.roi_name((0, 10, -1, 1, -2, 2)) == "0,10,-1,1,-2,2"
    assert columns.roi_name(None) == "none"
    with pytest.raises(UserError, match="increasing bounds"):
        columns.roi_bounds((0, 0, 1, 2, 3, 4))


def test_in_roi_looks_at_centers_only_and_includes_bounds():
    box = np.zeros((4, 7))
    box[:, 0] = [0, 72, 72.0001, -1e-9]
    box[:, 3:6] = 100
    assert columns.in_roi(box, "narrow").tolist() == [True, True, False, False]
    assert columns.in_roi(box, None).all()


def test_frame_ids():
    np.testing.assert_array_equal(columns.frame_ids({"frame": [3, 1]}), [3, 1])
    np.testing.assert_array_equal(columns.frame_ids({"frame": np.array([3.0])}), [3])
    with pytest.raises(UserError, match="need a column 'frame', found \\['name'\\]"):
        columns.frame_ids({"name": ["a"]})
    with pytest.raises(DataError, match="frame 5 occurs twice, in rows \\[0, 2\\]"):
        columns.frame_ids({"frame": [5, 1, 5]})
    with pytest.raises(UserError, match="column 'weather' has"):
        columns.frame_ids({"frame": [1, 2], "weather": ["fog"]})


def test_dense_frames_of_any_order():
    position = columns.dense_frames(np.array([5, 3, 5]), np.array([3, 9, 5]), name="x")
    assert position.tolist() == [2, 0, 2]
    with pytest.raises(DataError, match="x: frame 4, row 1: no such frame among the 2"):
        columns.dense_frames(np.array([3, 4]), np.array([3, 5]), name="x")
    with pytest.raises(DataError, match="among the 0 frames"):
        columns.dense_frames(np.array([3]), np.zeros(0, int), name="x")
    assert columns.dense_frames(np.zeros(0, int), np.zeros(0, int), name="x").size == 0


def test_class_indices():
    cls = np.array(["Bicycle", "Sedan", "Bicycle Group"])
    index = columns.class_indices(cls, np.arange(3), ("Sedan", "Bicycle"), name="x")
    assert index.tolist() == [1, 0, -1]
    own = columns.class_indices(
        np.array(["Tram"]), np.zeros(1, int), ("Tram",), name="x"
    )
    assert own.tolist() == [0]
    with pytest.raises(DataError, match="frame 4, row 0: unknown class 'sedan'"):
        columns.class_indices(np.array(["sedan"]), np.array([4]), ("Sedan",), name="x")


def test_read_columns_takes_lists_and_empty_tables():
    frame, box, cls, score = columns.read_columns(
        {"frame": [1], "box": [[0, 0, 0, 1, 1, 1, 0]], "cls": ["Sedan"], "score": [1]},
        name="predictions",
        scored=True,
    )
    assert (frame.dtype, box.shape, cls[0], score[0]) == (np.int64, (1, 7), "Sedan", 1)
    empty = {"frame": [], "box": [], "cls": []}
    assert columns.read_columns(empty, name="x", scored=False)[1].shape == (0, 7)
