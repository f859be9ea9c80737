import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.evaluation import overlap


def boxes(rng, num):
    return np.column_stack(
        [
            rng.normal(0, 3, (num, 2)),
            rng.normal(0, 0.5, num),
            rng.uniform(0.3, 6, (num, 3)),
            rng.uniform(-7, 7, num),
        ]
    )


def polygons(box):
    unit = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    local = unit[None] * box[:, None, 3:5]
    cos, sin = np.cos(box[:, 6])[:, None], np.sin(box[:, 6])[:, None]
    x = box[:, :1] + cos * local[..., 0] - sin * local[..., 1]
    y = box[:, 1:2] + sin * local[..., 0] + cos * local[..., 1]
    return shapely.polygons(np.stack([x, y], -1))


def test_axis_aligned_by_hand():
    a = np.array([[0, 0, 0, 4, 2, 2, 0.0]] * 4)
    b = np.array(
        [
            [2, 0, 0, 4, 2, 2, 0.0],  # half over: 4 / 12
            [0, 0, 1, 4, 2, 2, 0.0],  # half above: 1 and 8 / 24
            [0, 0, 0, 2, 4, 2, np.pi / 2],  # the same box, described otherwise
            [4, 0, 0, 4, 2, 2, 0.0],  # touching
        ]
    )
    bev, iou_3d = overlap.pair_iou(a, b)
    np.testing.assert_allclose(bev, [1 / 3, 1, 1, 0], atol=1e-12)
    np.testing.assert_allclose(iou_3d, [1 / 3, 1 / 3, 1, 0], atol=1e-12)


def test_against_polygons():
    rng = np.random.default_rng(0)
    a, b = boxes(rng, 2000), boxes(rng, 2000)
    shared = shapely.area(shapely.intersection(polygons(a), polygons(b)))
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    bev, iou_3d = overlap.pair_iou(a, b)
    np.testing.assert_allclose(bev, shared / (area_a + area_b - shared), atol=1e-12)
    top = np.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
    bottom = np.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
    volume = shared * np.clip(top - bottom, 0, None)
    union = area_a * a[:, 5] + area_b * b[:, 5] - volume
    np.testing.assert_allclose(iou_3d, volume / union, atol=1e-12)


@pytest.mark.parametrize("scale", [0, 1e-15, 1e-12, 1e-9, 1e-6])
def test_identical_and_nearly_identical_boxes(scale):
    rng = np.random.default_rng(1)
    a = boxes(rng, 3000)
    b = a + scale * rng.normal(size=a.shape)
    bev, iou_3d = overlap.pair_iou(a, b)
    np.testing.assert_allclose(bev, 1, atol=1e-12 + 200 * scale)
    np.testing.assert_allclose(iou_3d, 1, atol=1e-12 + 200 * scale)


@settings(deadline=None, max_examples=30, derandomize=True)
@given(seed=st.integers(0, 10**6), turn=st.floats(-7, 7), shift=st.floats(-100, 100))
def test_symmetric_bounded_and_unmoved_by_rigid_motion(seed, turn, shift):
    rng = np.random.default_rng(seed)
    a, b = boxes(rng, 50), boxes(rng, 50)

    def move(box):
        cos, sin = np.cos(turn), np.sin(turn)
        moved = box.copy()
        moved[:, :2] = box[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + shift
        moved[:, 6] += turn
        return moved

    for one, other, again in zip(
        overlap.pair_iou(a, b),
        overlap.pair_iou(b, a),
        overlap.pair_iou(move(a), move(b)),
        strict=True,
    ):
        assert (one >= 0).all()
        assert (one <= 1 + 1e-12).all()
        np.testing.assert_allclose(one, other, atol=1e-12)
        np.testing.assert_allclose(one, again, atol=1e-10)


def test_chunks_give_the_same(monkeypatch):
    rng = np.random.default_rng(2)
    a, b = boxes(rng, 100), boxes(rng, 100)
    whole = overlap.pair_iou(a, b)
    groups = np.sort(rng.integers(0, 5, 100))
    all_pairs = overlap.candidate_pairs(groups, groups, a, b)
    monkeypatch.setattr(overlap, "PAIRS_PER_CHUNK", 64)
    for one, other in zip(whole, overlap.pair_iou(a, b), strict=True):
        np.testing.assert_array_equal(one, other)
    again = overlap.candidate_pairs(groups, groups, a, b)
    for one, other in zip(all_pairs, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_candidates_are_all_overlapping_pairs_of_a_group():
    rng = np.random.default_rng(3)
    a, b = boxes(rng, 80), boxes(rng, 90)
    group_a, group_b = rng.integers(0, 6, 80), np.sort(rng.integers(0, 6, 90))
    first, second = overlap.candidate_pairs(group_a, group_b, a, b)
    found = set(zip(first.tolist(), second.tolist(), strict=True))
    assert len(found) == first.size
    assert (group_a[first] == group_b[second]).all()
    grid = np.stack(np.meshgrid(np.arange(80), np.arange(90), indexing="ij"))
    i, j = grid.reshape(2, -1)
    bev, _ = overlap.pair_iou(a[i], b[j])
    touching = (bev > 0) & (group_a[i] == group_b[j])
    assert found >= set(zip(i[touching].tolist(), j[touching].tolist(), strict=True))
    assert len(found) < ((group_a[i] == group_b[j]).sum())


def test_no_boxes():
    none, group = np.zeros((0, 7)), np.zeros(1, int)
    one = np.array([[0, 0, 0, 1, 1, 1, 0.0]])
    for a, b in ((none, none), (none, one), (one, none)):
        first, second = overlap.candidate_pairs(group[: len(a)], group[: len(b)], a, b)
        assert first.size == second.size == 0


def test_kradar_pair_fixture(shared):
    folder = shared / "fixtures" / "kradar_eval"
    pairs = np.load(folder / "pair_iou.npz")
    truth = np.load(folder / "ground_truth.npz")["box_rounded"][pairs["gt_index"]]
    found = np.load(folder / "predictions.npz")["box"][pairs["pred_index"]]
    bev, iou_3d = overlap.pair_iou(found, truth)
    np.testing.assert_allclose(bev, pairs["bev_geometric"], atol=1e-12)
    np.testing.assert_allclose(iou_3d, pairs["iou3d_geometric"], atol=1e-12)
    exchange = [0, 1, 2, 4, 3, 5, 6]
    truth, found = truth[:, exchange], found[:, exchange]
    bev, iou_3d = overlap.pair_iou(found, truth)
    np.testing.assert_allclose(bev, pairs["bev_official"], atol=1e-12)
    np.testing.assert_allclose(iou_3d, pairs["iou3d_official"], atol=1e-12)
    _, top = overlap.pair_iou(found, truth, z_center=1.0)
    np.testing.assert_allclose(top, pairs["iou3d_official_legacy"], atol=1e-12)
