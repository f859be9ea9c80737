import jax
import jax.numpy as jnp
import numpy as np
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
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, K),
    st.floats(0.05, 0.9),
    st.sampled_from([0.0, np.nan, np.inf]),
)
def test_equals_the_python_loop_whatever_padding_rows_hold(
    seed, num_valid, threshold, bad
):
    boxes = random_boxes(np.random.default_rng(seed))
    is_valid = np.arange(K) < num_valid
    expected = python_greedy(overlap_matrix(boxes, threshold), is_valid)
    boxes[num_valid:] = bad
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


# Matching --------------------------------------------------------------------------


def test_every_prediction_has_the_object_that_a_loop_finds():
    rng = np.random.default_rng(0)
    low, high = [-19, -19, -1, 2, 2, 2, -3], [19, 19, 1, 8, 8, 4, 3]
    boxes = rng.uniform(low, high, (50, 7)).astype(np.float32)
    predicted, objects = boxes[:30], boxes[30:]
    are_predicted, are_objects = np.arange(30) < 25, np.arange(20) != 7
    overlap = bev_iou(predicted, objects) * are_objects
    expected = overlap.argmax(1)
    has_object = (overlap.max(1) > 0) & are_predicted
    assert 5 < has_object.sum() < 20
    assert (bev_iou(predicted, objects).argmax(1) == 7).any()
    object_idx, is_matched = match(predicted, are_predicted, objects, are_objects)
    np.testing.assert_array_equal(is_matched, has_object)
    np.testing.assert_array_equal(object_idx[has_object], expected[has_object])
