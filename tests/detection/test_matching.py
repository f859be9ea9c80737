import jax
import numpy as np

from radejax.detection import matching
from radejax.geometry.rotated_iou import bev_iou

match_boxes = jax.jit(matching.match_boxes)


def squares(x, side=4.0, z=0.0):
    boxes = np.zeros((len(x), 7), np.float32)
    boxes[:, 0], boxes[:, 2], boxes[:, 3:6] = x, z, side
    return boxes


def valid(*flags):
    return np.array(flags, bool)


OBJECTS = squares([0.0, 10.0, 13.0])


def test_by_hand():
    predicted = squares([1.0, 12.0, 50.0, 0.5])
    found = match_boxes(predicted, valid(1, 1, 1, 0), OBJECTS, valid(1, 1, 1))
    assert found.object_idx.tolist() == [0, 2, 0, 0]
    assert found.is_matched.tolist() == [True, True, False, False]
    np.testing.assert_allclose(found.iou, [3 / 5, 3 / 5, 0, 0], rtol=1e-5)


def test_padding_objects_are_never_matched():
    found = match_boxes(squares([13.0]), valid(1), OBJECTS, valid(1, 1, 0))
    assert found.object_idx.tolist() == [1]
    np.testing.assert_allclose(found.iou, [1 / 7], rtol=1e-5)
    nothing = match_boxes(squares([13.0]), valid(1), OBJECTS, valid(0, 0, 0))
    assert not nothing.is_matched[0]


def test_threshold_is_exclusive():
    predicted = squares([0.0])
    for threshold, expected in ((0.99, True), (1.0, False)):
        found = match_boxes(
            predicted, valid(1), OBJECTS, valid(1, 1, 1), iou_threshold=threshold
        )
        assert bool(found.is_matched[0]) is expected


def test_every_prediction_has_the_object_that_a_loop_finds():
    rng = np.random.default_rng(0)

    def random_boxes(count):
        boxes = rng.uniform(
            [-9, -9, -1, 2, 2, 2, -3], [9, 9, 1, 8, 8, 4, 3], (count, 7)
        )
        return boxes.astype(np.float32)

    predicted, objects = random_boxes(30), random_boxes(20)
    iou = bev_iou(predicted, objects)
    iou = iou.reshape(30, 20)
    expected = [int(row.argmax()) if row.max() > 0.3 else None for row in iou]
    found = match_boxes(
        predicted, np.ones(30, bool), objects, np.ones(20, bool), iou_threshold=0.3
    )
    matched = [
        int(j) if ok else None
        for j, ok in zip(found.object_idx, found.is_matched, strict=True)
    ]
    assert matched == expected
    assert None in expected
    assert sum(j is not None for j in expected) > 5
