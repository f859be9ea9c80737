import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.detection.nms import greedy_suppression, match_boxes, rotated_nms
from radejax.geometry.rotated_iou import bev_iou

K = 24
nms = jax.jit(rotated_nms)
suppression = jax.jit(greedy_suppression)
match = jax.jit(match_boxes)


def python_greedy(overlaps, is_valid):
    keep = np.zeros(len(is_valid), bool)
    for j in range(len(is_valid)):
        keep[j] = is_valid[j] and not any(keep[i] and overlaps[i, j] for i in range(j))
    return keep


def random_boxes(rng, spread=6.0):
    boxes = np.zeros((K, 7), np.float32)
    boxes[:, :2] = rng.uniform(-spread, spread, (K, 2))
    boxes[:, 3:6] = rng.uniform(1, 6, (K, 3))
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, K)
    return boxes


def overlap_matrix(boxes, threshold):
    return bev_iou(boxes.astype(np.float64), boxes) >= threshold


def test_threshold_is_inclusive():
    boxes = np.zeros((2, 7), np.float32)
    boxes[:, 3:6] = [3.0, 2, 1]
    boxes[1, 0] = 1.5  # half of each: IoU 1/3, exact in these numbers up to rounding
    valid = jnp.ones(2, bool)
    assert nms(boxes, valid, 0.0).tolist() == [True, False]
    assert nms(boxes, valid, 1 / 3 - 1e-5).tolist() == [True, False]
    assert nms(boxes, valid, 1 / 3 + 1e-5).tolist() == [True, True]
    same = boxes.copy()
    same[1] = same[0]
    assert nms(same, valid, 1.0).tolist() == [True, False]


def test_only_boxes_of_one_class_where_classes_are_given():
    boxes = np.zeros((3, 7), np.float32)
    boxes[:, 3:6] = 4
    valid, classes = jnp.ones(3, bool), jnp.array([0, 1, 0])
    assert nms(boxes, valid, 0.3).tolist() == [True, False, False]
    keep = nms(boxes, valid, 0.3, classes=classes)
    assert keep.tolist() == [True, True, False]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(0, K), st.floats(0.05, 0.9))
def test_equals_the_python_loop(seed, num_valid, threshold):
    boxes = random_boxes(np.random.default_rng(seed))
    is_valid = np.arange(K) < num_valid
    expected = python_greedy(overlap_matrix(boxes, threshold), is_valid)
    np.testing.assert_array_equal(nms(boxes, is_valid, threshold), expected)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_any_overlap_relation(seed, density):
    rng = np.random.default_rng(seed)
    overlaps = rng.random((K, K)) < density
    overlaps |= overlaps.T
    is_valid = rng.random(K) < 0.8
    expected = python_greedy(overlaps, is_valid)
    np.testing.assert_array_equal(suppression(overlaps, is_valid), expected)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_boxes_in_padding_rows_disturb_nothing(bad):
    boxes = random_boxes(np.random.default_rng(1))
    is_valid = np.arange(K) < 12
    clean = nms(boxes, is_valid, 0.3)
    boxes[12:] = bad
    np.testing.assert_array_equal(nms(boxes, is_valid, 0.3), clean)


# Matching --------------------------------------------------------------------------


def squares(x, side=4.0, z=0.0):
    boxes = np.zeros((len(x), 7), np.float32)
    boxes[:, 0], boxes[:, 2], boxes[:, 3:6] = x, z, side
    return boxes


def valid(*flags):
    return np.array(flags, bool)


OBJECTS = squares([0.0, 10.0, 13.0])


def test_matches_by_hand():
    predicted = squares([1.0, 12.0, 50.0, 0.5])
    object_idx, is_matched = match(
        predicted, valid(1, 1, 1, 0), OBJECTS, valid(1, 1, 1)
    )
    assert object_idx.tolist() == [0, 2, 0, 0]
    assert is_matched.tolist() == [True, True, False, False]
    # Padding objects are never matched.
    object_idx, _ = match(squares([13.0]), valid(1), OBJECTS, valid(1, 1, 0))
    assert object_idx.tolist() == [1]


def test_every_prediction_has_the_object_that_a_loop_finds():
    rng = np.random.default_rng(0)

    def random_boxes(count):
        boxes = rng.uniform(
            [-19, -19, -1, 2, 2, 2, -3], [19, 19, 1, 8, 8, 4, 3], (count, 7)
        )
        return boxes.astype(np.float32)

    predicted, objects = random_boxes(30), random_boxes(20)
    expected = [
        int(row.argmax()) if row.max() > 0 else None
        for row in bev_iou(predicted, objects)
    ]
    object_idx, is_matched = match(
        predicted, np.ones(30, bool), objects, np.ones(20, bool)
    )
    matched = [
        int(j) if ok else None for j, ok in zip(object_idx, is_matched, strict=True)
    ]
    assert matched == expected
    assert None in expected
    assert sum(j is not None for j in expected) > 5
