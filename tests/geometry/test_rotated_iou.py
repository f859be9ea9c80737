import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from radejax.geometry import rotated_iou as R
from radejax.geometry.boxes import bev_corners, boxes8_from_7

bev = jax.jit(R.bev_iou)
volume = jax.jit(R.iou_3d)


def of_pairs(function):
    """IoU of corresponding boxes `[P, 7]` by a function of all pairs."""
    return lambda a, b: function(a[..., None, :], b[..., None, :])[..., 0, 0]


bev_pairs = of_pairs(bev)
volume_pairs = of_pairs(volume)
bev_host, volume_host = of_pairs(R.bev_iou), of_pairs(R.iou_3d)


@pytest.fixture(scope="module")
def pairs(golden):
    return np.load(golden / "geometry_iou.npz")


def polygons(boxes):
    return shapely.polygons(bev_corners(np.asarray(boxes, np.float64)))


def shapely_intersection(a, b):
    # Without a grid GEOS finds nothing in common of some boxes with collinear edges.
    return shapely.area(shapely.intersection(polygons(a), polygons(b), grid_size=1e-12))


def random_boxes(rng, count, spread=3.0):
    center = rng.normal(0, spread, (count, 3)) + np.array([40, 5, 0])
    size = rng.uniform(0.3, 9, (count, 3))
    yaw = rng.uniform(-np.pi, np.pi, (count, 1))
    return np.concatenate([center, size, yaw], 1).astype(np.float32)


def test_half_overlap_by_hand():
    car = np.array([[10.0, 0, 0, 4, 2, 2, 0]])
    ahead = np.array([[12.0, 0, 0, 4, 2, 2, np.pi]])
    above = np.array([[12.0, 0, 1, 4, 2, 2, 0]])
    np.testing.assert_allclose(bev(car, ahead), [[4 / 12]], rtol=1e-6)
    np.testing.assert_allclose(volume(car, above), [[4 / 28]], rtol=1e-6)
    np.testing.assert_allclose(R.bev_intersection(car, ahead), [4.0])


def test_square_turned_by_45_degrees_is_an_octagon():
    square = np.array([[0.0, 0, 0, 2, 2, 1, 0]])
    turned = np.array([[0.0, 0, 0, 2, 2, 1, np.pi / 4]])
    octagon = 8 * (np.sqrt(2) - 1)
    np.testing.assert_allclose(R.bev_intersection(square, turned), [octagon])
    np.testing.assert_allclose(
        bev(square, turned), [[octagon / (8 - octagon)]], rtol=1e-6
    )


@pytest.mark.parametrize(
    ("exact", "double", "single"),
    [
        ("iou_bev_exact", bev_host, bev_pairs),
        ("iou_3d_exact", volume_host, volume_pairs),
    ],
)
def test_agrees_with_polygon_clipping_on_every_kind(pairs, exact, double, single):
    a, b = pairs["box_a"], pairs["box_b"]
    np.testing.assert_allclose(double(a, b), pairs[exact], atol=1e-12)
    np.testing.assert_allclose(single(a, b), pairs[exact], atol=5e-7)


def test_agrees_with_the_released_code_where_that_is_right(pairs):
    usable = pairs["reference_reliable"]
    a, b = pairs["box_a"][usable], pairs["box_b"][usable]
    assert usable.sum() > 560
    np.testing.assert_allclose(bev_pairs(a, b), pairs["iou_bev"][usable], atol=5e-4)
    np.testing.assert_allclose(volume_pairs(a, b), pairs["iou_3d"][usable], atol=5e-4)


def test_matrix_agrees_with_shapely():
    rng = np.random.default_rng(1)
    a, b = random_boxes(rng, 60), random_boxes(rng, 40)
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    shared = shapely.area(shapely.intersection(polygons(a)[:, None], polygons(b)))
    expected = shared / (area_a[:, None] + area_b - shared)
    assert (expected > 0.1).sum() > 100
    np.testing.assert_allclose(bev(a, b), expected, atol=5e-7)


def nearly(rng, a, scale):
    """Boxes that differ from `a` by about `scale` in everything but z and height."""
    b = a.astype(np.float64)
    b[:, [0, 1, 3, 4, 6]] += rng.normal(0, scale, (len(a), 5))
    return b.astype(np.float32)


@pytest.mark.parametrize("scale", [1e-7, 1e-5, 1e-4, 1e-2])
def test_nearly_identical_boxes_against_shapely(scale):
    rng = np.random.default_rng(2)
    a = random_boxes(rng, 2000)
    b = nearly(rng, a, scale)
    expected = shapely_intersection(a, b)
    union = a[:, 3] * a[:, 4] + b[:, 3].astype(np.float64) * b[:, 4] - expected
    np.testing.assert_allclose(R.bev_intersection(a, b), expected, rtol=1e-9)
    np.testing.assert_allclose(bev_pairs(a, b), expected / union, atol=1e-6)


@pytest.mark.parametrize("along", [True, False])
def test_boxes_slid_along_an_edge_share_collinear_edges(along):
    rng = np.random.default_rng(3)
    a = random_boxes(rng, 500).astype(np.float64)
    slide = rng.uniform(0, 1.5, 500) * a[:, 3 if along else 4]
    direction = a[:, 6] + (0 if along else np.pi / 2)
    b = a.copy()
    b[:, 0] += slide * np.cos(direction)
    b[:, 1] += slide * np.sin(direction)
    size, other = (a[:, 3], a[:, 4]) if along else (a[:, 4], a[:, 3])
    expected = np.maximum(size - slide, 0) * other
    area = a[:, 3] * a[:, 4]
    found = R.bev_intersection(a, b)
    np.testing.assert_allclose(found / area, expected / area, atol=1e-12)
    a, b = a.astype(np.float32), b.astype(np.float32)  # not quite collinear any more
    np.testing.assert_allclose(bev_pairs(a, b), bev_host(a, b), atol=1e-6)


def test_touching_boxes_do_not_overlap():
    a = np.array([[0.0, 0, 0, 4, 2, 1, 0]] * 4, np.float32)
    b = a.copy()
    b[:, :2] = [[4, 0], [-4, 0], [0, 2], [4, 2]]
    np.testing.assert_array_equal(bev_pairs(a, b), 0)
    b[:, :2] = 0
    b[:, 2] = 1  # on top of each other
    np.testing.assert_array_equal(volume_pairs(a, b), 0)


box_numbers = st.tuples(
    st.floats(-6, 6, width=32),
    st.floats(-6, 6, width=32),
    st.floats(-2, 2, width=32),
    st.floats(0.25, 10, width=32),
    st.floats(0.25, 4, width=32),
    st.floats(0.25, 3, width=32),
    st.sampled_from([0.0, np.pi / 2, 0.3, -1.2, 3.0]) | st.floats(-3, 3, width=32),
)


def as_box(numbers):
    return np.asarray([numbers], np.float32)


@settings(deadline=None, max_examples=100)
@given(box_numbers, box_numbers)
def test_symmetric_bounded_and_bev_at_least_volume(a, b):
    a, b = as_box(a), as_box(b)
    ground, space = float(bev_pairs(a, b)[0]), float(volume_pairs(a, b)[0])
    assert 0 <= space <= 1
    assert 0 <= ground <= 1
    np.testing.assert_allclose(ground, bev_pairs(b, a), atol=1e-6)
    np.testing.assert_allclose(space, volume_pairs(b, a), atol=1e-6)
    np.testing.assert_allclose(ground, bev_host(a, b), atol=2e-6)


@settings(deadline=None, max_examples=50)
@given(box_numbers)
@example((0.0, 0.0, 1.9424906969070435, 1.0, 1.5, 0.25, 1.0))
def test_identical_boxes_have_iou_1(a):
    a = as_box(a)
    np.testing.assert_allclose(bev_pairs(a, a), 1, atol=5e-7)
    # Top and bottom are rounded to float32, which the IoU doubles.
    z, height = np.abs(a[0, [2, 5]])
    rounding = 2 * np.finfo(np.float32).eps * (z + height / 2) / height
    np.testing.assert_allclose(volume_pairs(a, a), 1, atol=5e-7 + rounding)
    half_turn = a + np.array([0, 0, 0, 0, 0, 0, np.pi], np.float32)
    # Adding pi rounds the angle by 1e-7, which long boxes feel most.
    np.testing.assert_allclose(bev_pairs(a, half_turn), 1, atol=1e-5)


@settings(deadline=None, max_examples=100)
@given(box_numbers, box_numbers, st.floats(-3, 3), st.floats(-30, 30))
def test_unchanged_by_a_common_rigid_motion(a, b, yaw, shift):
    a, b = as_box(a).astype(np.float64), as_box(b).astype(np.float64)
    translation = np.array([shift, 2 * shift, 1.0])
    sin, cos = np.sin(yaw), np.cos(yaw)
    turn = np.eye(7)
    turn[:2, :2] = [[cos, -sin], [sin, cos]]
    motion = np.array([*translation, 0, 0, 0, yaw])
    moved = [box @ turn.T + motion for box in (a, b)]
    np.testing.assert_allclose(bev_host(*moved), bev_host(a, b), atol=1e-9)
    np.testing.assert_allclose(volume_host(*moved), volume_host(a, b), atol=1e-9)


@settings(deadline=None, max_examples=100)
@given(box_numbers, box_numbers)
@example((1, 0, 0, 1, 2, 1, -1.2), (1, 0, 0, 4, 2, 1, -1.2))
def test_against_shapely(a, b):
    a, b = as_box(a), as_box(b)
    expected = shapely_intersection(a, b)
    np.testing.assert_allclose(R.bev_intersection(a, b), expected, atol=1e-7)


def test_degenerate_and_huge_boxes_are_finite():
    boxes = np.array(
        [
            [0, 0, 0, 0, 0, 0, 0],
            [0, 0, 0, 4, 0, 1, 0.3],
            [0, 0, 0, -4, 2, 1, 0],
            [0, 0, 0, 4, 2, 1, 0.3],
            [1e5, -1e5, 0, 4, 2, 1, 1],
            [0, 0, 0, 1e4, 1e4, 10, 0.2],
            [0, 0, 0, 1e-6, 1e-6, 1e-6, 0.2],
        ],
        np.float32,
    )
    for function in (bev, volume):
        matrix = np.asarray(function(boxes, boxes))
        assert np.isfinite(matrix).all()
        assert (matrix >= 0).all()
        assert (matrix <= 1).all()
        assert (matrix[:3] == 0).all()
        np.testing.assert_allclose(matrix.diagonal()[3:], 1, atol=1e-6)


def test_yaw_vector_of_8_scales_the_box():
    box = np.array([[10.0, 2, 0, 4, 2, 1, 0.4]], np.float32)
    eight = boxes8_from_7(box)
    np.testing.assert_allclose(bev(eight, box), [[1.0]], atol=1e-6)
    eight[:, 6:] *= 0.5
    np.testing.assert_allclose(bev(eight, box), [[0.25]], rtol=1e-6)
    eight[:, 6:] = 0
    np.testing.assert_array_equal(bev(eight, box), [[0.0]])


def test_shapes_batch_and_vmap():
    boxes = random_boxes(np.random.default_rng(6), 24).reshape(2, 3, 4, 7)
    nested = bev(boxes, boxes)
    assert nested.shape == (2, 3, 4, 4)
    mapped = jax.vmap(jax.vmap(bev))(boxes, boxes)
    np.testing.assert_allclose(nested, mapped, atol=1e-7)
    assert bev(boxes[0, 0], boxes[0, 1, :0]).shape == (4, 0)


def test_boxes_are_compared_in_float32_on_devices_and_float64_on_the_host():
    boxes = random_boxes(np.random.default_rng(7), 5)
    matrix = bev(*[jnp.asarray(boxes).astype(jnp.bfloat16)] * 2)
    assert matrix.dtype == jnp.float32
    np.testing.assert_allclose(matrix.diagonal(), 1, atol=1e-6)
    for function in (R.bev_intersection, R.bev_iou, R.iou_3d):
        assert function(boxes, boxes).dtype == np.float64


@pytest.mark.wrong_types
def test_bad_shapes_are_rejected():
    with pytest.raises(ValueError, match=r"must be \[..., 7\] or \[..., 8\], got"):
        bev(np.zeros((2, 5)), np.zeros((2, 7)))
