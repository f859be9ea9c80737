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
    touching = np.array([[14.0, 2, 2, 4, 2, 2, 0]])
    np.testing.assert_allclose(bev(car, ahead), [[4 / 12]], rtol=1e-6)
    np.testing.assert_allclose(volume(car, above), [[4 / 28]], rtol=1e-6)
    np.testing.assert_allclose(R.bev_intersection(car, ahead), [4.0])
    assert bev(car, touching) == volume(car, touching) == 0


def test_agrees_with_polygon_clipping_on_every_kind(pairs):
    a, b = pairs["box_a"], pairs["box_b"]
    np.testing.assert_allclose(bev_host(a, b), pairs["iou_bev_exact"], atol=1e-12)
    np.testing.assert_allclose(bev_pairs(a, b), pairs["iou_bev_exact"], atol=5e-7)
    np.testing.assert_allclose(volume_host(a, b), pairs["iou_3d_exact"], atol=1e-12)
    np.testing.assert_allclose(volume_pairs(a, b), pairs["iou_3d_exact"], atol=5e-7)


def test_agrees_with_the_released_code_where_that_is_right(pairs):
    usable = pairs["reference_reliable"]
    a, b = pairs["box_a"][usable], pairs["box_b"][usable]
    assert usable.sum() > 560
    np.testing.assert_allclose(bev_pairs(a, b), pairs["iou_bev"][usable], atol=5e-4)
    np.testing.assert_allclose(volume_pairs(a, b), pairs["iou_3d"][usable], atol=5e-4)


def test_every_box_is_compared_with_every_other_of_its_frame():
    """In float32 on a device, also of bfloat16, and in float64 on the host."""
    boxes = random_boxes(np.random.default_rng(1), 70).reshape(2, 35, 7)
    a, b = boxes[:, :20], boxes[:, 20:]
    area_a, area_b = a[..., 3] * a[..., 4], b[..., 3] * b[..., 4]
    shared = shapely.intersection(polygons(a)[:, :, None], polygons(b)[:, None])
    shared = shapely.area(shared)
    expected = shared / (area_a[:, :, None] + area_b[:, None] - shared)
    on_device, on_host = (bev, np.float32, 5e-7), (R.bev_iou, np.float64, 1e-7)
    for function, dtype, atol in (on_device, on_host):
        found = function(a, b)
        assert found.dtype == dtype
        np.testing.assert_allclose(found, expected, atol=atol)
    assert bev(a[0], b[0, :0]).shape == (20, 0)
    narrow = jnp.asarray(a[0]).astype(jnp.bfloat16)
    np.testing.assert_allclose(bev(narrow, narrow).diagonal(), 1, atol=1e-6)


def nearly(rng, a, scale):
    """Boxes that differ from `a` by about `scale` in everything but z and height."""
    b = a.astype(np.float64)
    b[:, [0, 1, 3, 4, 6]] += rng.normal(0, scale, (len(a), 5))
    return b.astype(np.float32)


@pytest.mark.parametrize("scale", [1e-7, 1e-4])
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
@given(box_numbers, box_numbers, st.floats(-3, 3), st.floats(-30, 30))
@example((1, 0, 0, 1, 2, 1, -1.2), (1, 0, 0, 4, 2, 1, -1.2), 1.0, 10.0)
def test_any_two_boxes(a, b, yaw, shift):
    """As shapely says, in [0, 1], symmetric, and unchanged by a common rigid motion."""
    a, b = as_box(a), as_box(b)
    expected = shapely_intersection(a, b)
    np.testing.assert_allclose(R.bev_intersection(a, b), expected, atol=1e-7)
    sin, cos = np.sin(yaw), np.cos(yaw)
    turn = np.eye(7)
    turn[:2, :2] = [[cos, -sin], [sin, cos]]
    motion = np.array([shift, 2 * shift, 1.0, 0, 0, 0, yaw])
    moved = [box.astype(np.float64) @ turn.T + motion for box in (a, b)]
    for on_host, on_device in ((bev_host, bev_pairs), (volume_host, volume_pairs)):
        iou = on_host(a, b)
        assert 0 <= iou[0] <= 1
        np.testing.assert_allclose(on_host(b, a), iou, atol=1e-9)
        np.testing.assert_allclose(on_host(*moved), iou, atol=1e-9)
        np.testing.assert_allclose(on_device(a, b), iou, atol=5e-6)


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
