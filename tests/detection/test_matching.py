import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.detection import matching
from radejax.geometry.rotated_iou import bev_iou_np, iou_3d_np

match_boxes = jax.jit(matching.match_boxes, static_argnames=("one_to_one", "space"))


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


def test_classes_must_agree_where_given():
    found = match_boxes(
        squares([11.0, 11.0]),
        valid(1, 1),
        OBJECTS,
        valid(1, 1, 1),
        predicted_classes=jnp.array([0, 1]),
        object_classes=jnp.array([0, 1, 0]),
    )
    assert found.object_idx.tolist() == [2, 1]


def test_one_to_one_gives_the_next_best_to_the_later():
    predicted = squares([11.0, 11.0, 11.0])
    many = match_boxes(predicted, valid(1, 1, 1), OBJECTS, valid(1, 1, 1))
    assert many.object_idx.tolist() == [1, 1, 1]
    single = match_boxes(
        predicted, valid(1, 1, 1), OBJECTS, valid(1, 1, 1), one_to_one=True
    )
    assert single.object_idx.tolist() == [1, 2, 0]
    assert single.is_matched.tolist() == [True, True, False]


def python_one_to_one(iou, threshold):
    taken, found = set(), []
    for row in iou:
        free = [j for j in range(len(row)) if j not in taken and row[j] > threshold]
        best = max(free, key=lambda j: row[j]) if free else None
        taken.add(best)
        found.append(best)
    return found


@pytest.mark.parametrize(("space", "oracle"), [("bev", bev_iou_np), ("3d", iou_3d_np)])
def test_one_to_one_equals_the_python_loop(space, oracle):
    rng = np.random.default_rng(0)

    def random_boxes(count):
        boxes = rng.uniform(
            [-9, -9, -1, 2, 2, 2, -3], [9, 9, 1, 8, 8, 4, 3], (count, 7)
        )
        return boxes.astype(np.float32)

    predicted, objects = random_boxes(30), random_boxes(20)
    iou = oracle(np.repeat(predicted, 20, 0), np.tile(objects, (30, 1)))
    expected = python_one_to_one(iou.reshape(30, 20), 0.1)
    found = match_boxes(
        predicted,
        np.ones(30, bool),
        objects,
        np.ones(20, bool),
        iou_threshold=0.1,
        one_to_one=True,
        space=space,
    )
    matched = [
        int(j) if ok else None
        for j, ok in zip(found.object_idx, found.is_matched, strict=True)
    ]
    assert matched == expected
    assert None in expected
    assert sum(j is not None for j in expected) > 5


def test_bad_arguments_are_refused():
    arguments = (OBJECTS, valid(1, 1, 1), OBJECTS, valid(1, 1, 1))
    with pytest.raises(ValueError, match="'bev' or '3d', got 'birdseye'"):
        match_boxes(*arguments, space="birdseye")
    with pytest.raises(ValueError, match="both predicted_classes and object_classes"):
        match_boxes(*arguments, predicted_classes=jnp.zeros(3, int))
