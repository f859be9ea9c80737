import json
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.structures import Batch, DetectionMaps
from radejax.detection.decode import DecodeOptions
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.detection import LossOptions, detection_loss
from radejax.losses.focal import gaussian_heatmap

STRETCHED = RadarGrid.kradar().padded(8, "stretched")
CASES = ("batch4_sigma0p75", "one_object_sigma3", "no_objects")
CASES += ("batch2_adaptive", "batch2_anisotropic")
PARTS = ("focal", "gwd", "smooth_l1")
GRID = RadarGrid.reduced(num_doppler=4, num_range=24, num_elevation=4, num_azimuth=16)


# The authors' code ----------------------------------------------------------------


def reference_maps(stream, batch):
    """Full-size maps that the reference was computed on, channels last."""
    rng = np.random.default_rng([1234, stream])
    logits = 1.5 * rng.standard_normal((batch, 5, 256, 112)) - 2
    heatmap = (1 / (1 + np.exp(-logits))).astype(np.float32)
    params = np.empty((batch, 8, 256, 112))
    params[:, :3] = 0.5 * rng.standard_normal((batch, 3, 256, 112))
    for channel, low, width in ((3, 3.0, 2.0), (4, 1.5, 1.0), (5, 1.2, 1.0)):
        params[:, channel] = low + width * rng.random((batch, 256, 112))
    params[:, 6:] = 0.7 * rng.standard_normal((batch, 2, 256, 112))
    p = heatmap.astype(np.float64)
    logits = np.moveaxis(np.log(p) - np.log1p(-p), 1, -1)
    maps = DetectionMaps(
        jnp.asarray(logits, jnp.float32),
        jnp.asarray(np.moveaxis(params, 1, -1), jnp.float32),
    )
    return maps, heatmap


def batch_of(boxes, classes, is_valid):
    arrays = (jnp.asarray(x) for x in (boxes, classes, is_valid))
    return Batch(None, *arrays, frame=None)


@pytest.fixture(scope="module")
def cases(golden):
    return np.load(golden / "losses_cases.npz")


@pytest.fixture(scope="module", params=CASES)
def case(request, cases):
    """Everything the reference says about a case, and what we compute for it."""
    name = request.param
    want = {k.split("/")[1]: v for k, v in cases.items() if k.startswith(f"{name}/")}
    batch = batch_of(want["boxes"], want["classes"], want["is_valid"])
    maps, heatmap = reference_maps(int(want["stream"]), len(want["boxes"]))
    sigma = {"sigma_mode": str(want["sigma_mode"])}
    sigma["sigma_bins"] = float(want["sigma_cells"])
    changes = {f"heatmap_{name}": value for name, value in sigma.items()}
    options = LossOptions(gwd_transform="none", **changes)

    def loss(maps):
        return detection_loss(maps, batch, STRETCHED, options)

    (total, parts), grads = jax.jit(jax.value_and_grad(loss, has_aux=True))(maps)
    objects = batch.boxes, batch.classes, batch.is_valid
    target = gaussian_heatmap(*objects, STRETCHED, num_classes=5, **sigma)
    # The reference differentiates with respect to probabilities.
    slope = np.moveaxis(heatmap.astype(np.float64) * (1 - heatmap), 1, -1)
    return {
        "want": want,
        "total": float(total),
        "parts": {k: float(v) for k, v in parts.items()},
        "target": np.moveaxis(np.asarray(target), -1, 1),
        "grad_heatmap": np.moveaxis(np.asarray(grads.heatmap_logits) / slope, -1, 1),
        "grad_params": np.asarray(grads.box_params),
    }


def windows(maps, case, fill):
    """13 x 13 bins around each object in its class: `[P, 13, 13]`."""
    want = case["want"]
    margins = [(0, 0), (0, 0), (6, 6), (6, 6)]
    padded = np.pad(maps, margins, constant_values=fill)
    found = []
    for frame, row in want["patch_frame_object"].astype(int):
        x, y = want["boxes"][frame, row, :2].astype(np.float64)
        i, j = STRETCHED.nearest_bin(x, y)
        cls = want["classes"][frame, row]
        found.append(padded[frame, cls, i : i + 13, j : j + 13])
    return np.stack(found)


def relative(found, wanted):
    return np.abs(found - wanted).max() / np.abs(wanted).max()


def test_losses_of_the_released_code(case):
    for part in PARTS:
        np.testing.assert_allclose(case["parts"][part], case["want"][part], rtol=2e-6)
    has_objects = case["want"]["is_valid"].any()
    assert case["total"] == pytest.approx(4.0 if has_objects else 2.0)
    assert case["parts"]["num_objects"] == case["want"]["is_valid"].sum()


def test_targets_of_the_released_code(case):
    want, target = case["want"], case["target"]
    ones = (target == 1).sum((2, 3))
    np.testing.assert_array_equal(ones, want["target_num_ones"])
    assert case["parts"]["num_positive"] == ones.sum()
    sums = target.sum((2, 3), dtype=np.float64)
    np.testing.assert_allclose(sums, want["target_channel_sum"], rtol=1e-6, atol=1e-6)
    if len(want["patch_frame_object"]):
        found = windows(target, case, -1)
        np.testing.assert_allclose(found, want["target_patches"], atol=1e-6)


def test_gradients_of_the_released_code(case):
    want = case["want"]
    stats = want["grad_total_heatmap_channel_stats"]  # mean, std, min, max
    for column, function in enumerate((np.mean, np.std, np.min, np.max)):
        found = function(case["grad_heatmap"].astype(np.float64), (2, 3))
        atol = 1e-5 * np.abs(stats).max()
        np.testing.assert_allclose(found, stats[..., column], rtol=1e-4, atol=atol)
    if not len(want["patch_frame_object"]):
        np.testing.assert_array_equal(case["grad_params"], 0)
        return
    # Total = 2 focal / constant + ...
    found = windows(case["grad_heatmap"], case, 0) * case["parts"]["focal"] / 2
    assert relative(found, want["grad_focal_heatmap_patches"]) < 2e-6
    at = tuple(want["grad_cells"].T)
    found = case["grad_params"][at]
    assert relative(found, want["grad_total_regression_at_cells"]) < 5e-6
    elsewhere = case["grad_params"].copy()
    elsewhere[at] = 0
    np.testing.assert_array_equal(elsewhere, 0)


# Small scenes ---------------------------------------------------------------------


def small_scene(rng, counts=(0, 1, 3), rows=4):
    """Random maps and objects in the field of view of the small grid."""
    b = len(counts)
    maps = DetectionMaps(
        jnp.asarray(rng.normal(-2, 1, (b, 24, 16, 2)), jnp.float32),
        jnp.asarray(rng.normal(1, 0.5, (b, 24, 16, 8)), jnp.float32),
    )
    boxes = np.full((b, rows, 8), np.nan, np.float32)
    classes = np.full((b, rows), -1, np.int32)
    is_valid = np.arange(rows) < np.array(counts)[:, None]
    cells = rng.uniform([2, 0], [23, 15], (b, rows, 2))
    boxes[..., :2] = GRID.bin_to_ego(cells[..., 0], cells[..., 1])
    boxes[..., 2:6] = rng.uniform(0.5, 5, (b, rows, 4))
    yaw = rng.uniform(-3, 3, (b, rows))
    boxes[..., 6], boxes[..., 7] = np.sin(yaw), np.cos(yaw)
    boxes[~is_valid] = np.nan
    classes[is_valid] = rng.integers(0, 2, is_valid.sum())
    return maps, batch_of(boxes, classes, is_valid)


@partial(jax.jit, static_argnames=("options", "decoding"))
def _loss_and_grad(maps, batch, options, decoding):
    chosen = LossOptions(**json.loads(options))

    def loss(maps):
        return detection_loss(maps, batch, GRID, chosen, decoding)

    return jax.value_and_grad(loss, has_aux=True)(maps)


def loss_and_grad(maps, batch, decoding=None, **options):
    """Compiled once per shape and set of options, not once per test."""
    return _loss_and_grad(maps, batch, json.dumps(options), decoding)


def test_parts_weigh_as_asked_whatever_their_size():
    maps, batch = small_scene(np.random.default_rng(1))
    (total, parts), grad = loss_and_grad(maps, batch)
    assert float(total) == pytest.approx(4)
    sizes = [float(parts[p]) for p in PARTS]
    weights = {p: w / s for p, w, s in zip(PARTS, (2, 1, 1), sizes, strict=True)}
    options = {"weights": weights, "normalize": False}
    (plain, parts), plain_grad = loss_and_grad(maps, batch, **options)
    assert float(plain) == pytest.approx(4)
    assert float(parts["weighted_sum"]) == pytest.approx(4)
    chex.assert_trees_all_close(grad, plain_grad, atol=1e-6)
    options = {"weights": {"focal": 3.0}, "normalize": False}
    (total, terms), _ = loss_and_grad(maps, batch, **options)
    assert not {"gwd", "smooth_l1"} & set(terms)
    np.testing.assert_allclose(total, 3 * parts["focal"], 1e-5)


def test_perfect_boxes_give_finite_gradients():
    maps, batch = small_scene(np.random.default_rng(3), counts=(3, 0, 0))
    params = np.array(maps.box_params)
    for box in np.asarray(batch.boxes[0, :3]):
        i, j = GRID.nearest_bin(*box[:2])
        params[0, i, j] = box
        params[0, i, j, :2] -= GRID.bin_to_ego(i, j)
    maps = maps.replace(box_params=jnp.asarray(params))
    (_, parts), grad = loss_and_grad(maps, batch)
    assert float(parts["gwd"]) * 3 == pytest.approx(1 - 1 / 1.65, abs=1e-5)
    assert float(parts["smooth_l1"]) == pytest.approx(0, abs=1e-10)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(grad))


def test_bfloat16_maps_are_compared_in_float32():
    maps, batch = small_scene(np.random.default_rng(5))
    low = jax.tree.map(lambda x: x.astype(jnp.bfloat16), maps)
    same = jax.tree.map(lambda x: x.astype(jnp.float32), low)
    (_, parts), grad = loss_and_grad(low, batch)
    (_, wanted), _ = loss_and_grad(same, batch)
    for name in wanted:
        np.testing.assert_allclose(parts[name], wanted[name], rtol=1e-6)
        assert parts[name].dtype != jnp.bfloat16
    assert grad.box_params.dtype == jnp.bfloat16


def test_normalized_yaw_ignores_the_length_of_the_vector():
    maps, batch = small_scene(np.random.default_rng(6))
    longer = maps.replace(box_params=maps.box_params.at[..., 6:].multiply(2.5))

    def gwd_of(**options):
        found = (loss_and_grad(m, batch, **options) for m in (maps, longer))
        return [float(parts["gwd"]) for (_, parts), _ in found]

    gwd, raw = gwd_of(normalize_yaw=True), gwd_of()
    assert gwd[0] == pytest.approx(gwd[1], rel=1e-5)
    assert abs(raw[0] - raw[1]) > 1e-3
    zero = maps.replace(box_params=maps.box_params.at[..., 6:].set(0))
    _, grad = loss_and_grad(zero, batch, normalize_yaw=True)
    assert np.isfinite(grad.box_params).all()


def scene(peaks, objects, num_frames=1):
    """Peaks (logits by bin and class) and objects (x, y, class) in the first frame.

    All boxes are squares of 8 m; bins are 5.1 m and 7 degrees apart.
    """
    logits = np.full((num_frames, 24, 16, 2), -9.0, np.float32)
    for place, logit in peaks.items():
        logits[0][place] = logit
    params = np.zeros((num_frames, 24, 16, 8), np.float32)
    boxes = np.zeros((num_frames, 4, 8), np.float32)
    for array in (params, boxes):
        array[..., 3:6], array[..., 7] = (8.0, 8.0, 2.0), 1
    classes = np.zeros((num_frames, 4), np.int32)
    for row, (x, y, cls) in enumerate(objects):
        boxes[0, row, :2], classes[0, row] = (x, y), cls
    is_valid = np.zeros((num_frames, 4), bool)
    is_valid[0, : len(objects)] = True
    maps = DetectionMaps(jnp.asarray(logits), jnp.asarray(params))
    return maps, batch_of(boxes, classes, is_valid)


def scene_with_peaks():
    """Two objects in the first of three frames; peaks on one, behind it, and far off."""
    x, y = GRID.bin_to_ego(10, 8) + np.array([1.0, 0.5])
    objects = [(x, y, 0), (*GRID.bin_to_ego(5, 2), 0)]
    return scene({(10, 8, 0): 3.0, (12, 8, 0): 2.0, (18, 3, 0): 1.0}, objects, 3)


def test_nms_matching_by_hand():
    # (12, 8) is 10 m behind (10, 8): it overlaps neither it nor the object.
    maps, batch = scene_with_peaks()
    (_, parts), grad = loss_and_grad(maps, batch, assignment="nms")
    assert int(parts["num_matched"]) == 1
    assert int(parts["num_objects"]) == 2
    # Off by (1, 0.5) in 2 of 8 numbers, sqrt(1.25) m apart, in one of three frames.
    np.testing.assert_allclose(parts["smooth_l1"], (0.5 + 0.125) / 8 / 3, rtol=1e-5)
    gwd = 1 - 1 / (1.65 + np.sqrt(1.25))
    np.testing.assert_allclose(parts["gwd"], gwd / 3, rtol=1e-5)
    touched = np.argwhere(np.abs(grad.box_params).sum(-1) > 0)
    assert touched.tolist() == [[0, 10, 8]]


@pytest.mark.parametrize(
    ("changes", "num_matched"),
    [
        ({"threshold_inclusive": False}, 0),
        ({}, 2),
        ({"nms_iou": 0.05}, 1),
        ({"nms_iou": 0.05, "per_class_nms": True}, 2),
    ],
)
def test_nms_matching_chooses_boxes_as_decoding_does(changes, num_matched):
    # Two boxes 8 m long and 5.1 m apart, of other classes and with a score of 0.5.
    objects = [(*GRID.bin_to_ego(10, 8), 0), (*GRID.bin_to_ego(11, 8), 1)]
    maps, batch = scene({(10, 8, 0): 0.0, (11, 8, 1): 0.0}, objects)
    decoding = DecodeOptions(score_threshold=0.5, **changes)
    options = LossOptions(assignment="nms")

    @jax.jit  # of all that it returns, only this is compiled
    def count(maps):
        _, parts = detection_loss(maps, batch, GRID, options, decoding)
        return parts["num_matched"]

    assert count(maps) == num_matched


@pytest.mark.wrong_types
def test_wrong_arguments_are_named():
    maps, batch = small_scene(np.random.default_rng(9))
    narrow = batch.replace(boxes=batch.boxes[..., :7])
    with pytest.raises(ValueError, match="on the grid's 256 x 112 bins"):
        detection_loss(maps, batch, STRETCHED)
    with pytest.raises(ValueError, match=r"must be \[3, N, 8\] .* got \(3, 4, 7\)"):
        detection_loss(maps, narrow, GRID)


# Own outputs and targets --------------------------------------------------------------


@pytest.mark.parametrize("assignment", ["center", "nms"])
def test_own_terms_see_outputs_and_targets_of_the_matched_objects(
    assignment, tmp_path, monkeypatch
):
    """The velocity of the second object is unknown: no error, and no gradient of NaN."""
    (tmp_path / "own_loss.py").write_text(
        "import jax.numpy as jnp\n"
        "def velocity(pairs, options):\n"
        "    assert pairs.maps.outputs['v'].shape == (3, 24, 16, 2)\n"
        "    assert pairs.batch.targets['v_mps'].shape == (3, 4, 2)\n"
        "    error = pairs.outputs['v'] - pairs.targets['v_mps']\n"
        "    return pairs.mean(jnp.abs(error).sum(-1), where=pairs.is_known['v_mps'])\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    maps, batch = scene_with_peaks()
    outputs = jnp.zeros((3, 24, 16, 2)).at[0, 10, 8].set(jnp.array([2.0, 1.5]))
    targets = jnp.zeros((3, 4, 2)).at[0, :2].set(jnp.array([[1.0, 2.0], [3, jnp.nan]]))
    (_, terms), grad = loss_and_grad(
        maps.replace(outputs={"v": outputs}),
        batch.replace(targets={"v_mps": targets}),
        assignment=assignment,
        own_terms=("own_loss:velocity",),
        weights={"velocity": 2.0},
        normalize=False,
    )
    assert float(terms["velocity"]) == pytest.approx((1.0 + 0.5) / 3)
    touched = np.argwhere(np.abs(grad.outputs["v"]).sum(-1) > 0)
    assert touched.tolist() == [[0, 10, 8]]
