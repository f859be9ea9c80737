from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit

from radejax.config import load_config
from radejax.core.structures import WIDE_ROI, DetectionMaps
from radejax.detection import decode as D
from radejax.geometry.boxes import boxes7_from_8
from radejax.geometry.radar_grid import RadarGrid

KRADAR = RadarGrid.kradar()
OFFICIAL = {112: KRADAR.padded(8, "stretched"), 107: KRADAR.padded(1, "stretched")}
CASES = ("padded_wide_roi", "unpadded_no_roi")
GRID = RadarGrid.reduced(num_doppler=4, num_range=20, num_elevation=4, num_azimuth=12)
C = 3
RELEASED = D.DecodeOptions(max_detections=16, threshold_inclusive=False)

_decode = jax.jit(D.decode, static_argnames=("grid", "options", "pre_nms"))
_STATIC = ("grid", "max_peaks", "threshold_inclusive")
_find_peaks = jax.jit(D.find_peaks, static_argnames=_STATIC)


def decode(maps, grid, *, roi=None, pre_nms=None, **options):
    """Results in NumPy: JAX compiles every slice of another size."""
    options = RELEASED.replace(**options)
    return jax.device_get(_decode(maps, grid, options, roi=roi, pre_nms=pre_nms))


def find_peaks(*args, **options):
    options = {"threshold_inclusive": False, "score_threshold": 0.3} | options
    return jax.device_get(_find_peaks(*args, **options))


def logit(p):
    with np.errstate(divide="ignore"):
        p = np.asarray(p, np.float64)
        return (np.log(p) - np.log1p(-p)).astype(np.float32)


def make_maps(heatmap, params):
    """Maps from probabilities and box parameters, channels first as the reference."""
    return DetectionMaps(
        jnp.asarray(np.moveaxis(logit(heatmap), 1, -1)),
        jnp.asarray(np.moveaxis(params, 1, -1), jnp.float32),
    )


# The authors' code ----------------------------------------------------------------


def reference_maps(stream, blobs, width):
    """Full-size maps that the reference was computed on."""
    rng = np.random.default_rng([1234, stream])
    shape = (3, 256, width)
    heatmap = 0.05 * rng.random((3, 5, 256, width))
    rows, columns = np.arange(256)[:, None], np.arange(width)
    for frame, cls, i, j, peak, sigma in blobs:
        distance = (rows - i) ** 2 + (columns - j) ** 2
        one = heatmap[int(frame), int(cls)]
        np.maximum(one, peak * np.exp(-distance / (2 * sigma**2)), out=one)
    params = np.empty((3, 8, 256, width))
    params[:, :2] = 0.3 * rng.standard_normal((3, 2, 256, width))
    params[:, 2] = 0.5 * rng.standard_normal(shape)
    for channel, low, spread in ((3, 4.0, 1.5), (4, 1.8, 0.6), (5, 1.3, 0.8)):
        params[:, channel] = low + spread * rng.random(shape)
    yaw = 0.3 * np.arange(3)[:, None, None] + 0.2 * rng.standard_normal(shape)
    norm = 0.9 + 0.2 * rng.random(shape)
    params[:, 6], params[:, 7] = norm * np.sin(yaw), norm * np.cos(yaw)
    return make_maps(heatmap.astype(np.float32), params)


@pytest.fixture(scope="module", params=CASES)
def case(request, golden):
    arrays = np.load(golden / "detection_postproc.npz")
    prefix = f"{request.param}/"
    want = {k.removeprefix(prefix): arrays[k] for k in arrays if k.startswith(prefix)}
    maps = reference_maps(int(want["stream"]), want["blobs"], int(want["width"]))
    return want, maps, OFFICIAL[int(want["width"])]


def roi_of(want):
    whole = np.array([-1e9, 1e9] * 3)
    return WIDE_ROI if want["wide_roi"] else whole


def test_boxes_before_nms_of_the_released_code(case):
    want, maps, grid = case
    peaks = find_peaks(maps, grid, max_peaks=96, roi=roi_of(want))
    for frame in range(3):
        boxes = want[f"boxes_before_nms_{frame}"]
        boxes = boxes[np.argsort(-boxes[:, 8])]
        count = len(boxes)
        assert peaks.num_found[frame] == count
        assert peaks.is_valid[frame].tolist() == [True] * count + [False] * (96 - count)
        np.testing.assert_allclose(peaks.boxes[frame, :count], boxes[:, :8], atol=2e-5)
        np.testing.assert_allclose(peaks.scores[frame, :count], boxes[:, 8], atol=1e-6)
        np.testing.assert_array_equal(peaks.classes[frame, :count], boxes[:, 9])
        np.testing.assert_array_equal(peaks.bins[frame, :count], boxes[:, [11, 10]])


def test_ties_of_the_released_code(golden):
    want = np.load(golden / "detection_ties.npz")
    heatmap = np.zeros((1, 5, 256, 112), np.float32)
    heatmap[tuple(want["heat_index"].T)] = want["heat_value"]
    params = np.zeros((1, 8, 256, 112))
    params[:, 3:5], params[:, [5, 7]] = 0.2, 1
    maps = make_maps(heatmap, params)
    peaks = find_peaks(maps, OFFICIAL[112], max_peaks=8)
    boxes = want["boxes_before_nms"]
    order = np.lexsort((boxes[:, 10], boxes[:, 11], -boxes[:, 8]))
    np.testing.assert_allclose(peaks.boxes[0, :4], boxes[order, :8], atol=2e-5)
    np.testing.assert_array_equal(peaks.classes[0, :4], boxes[order, 9])
    assert int(peaks.num_found[0]) == 4


# Against the definition -----------------------------------------------------------


def naive_peaks(scores, threshold, inclusive=False):
    """(score, class, range, azimuth) of one frame `[R, A, C]`, by loops."""
    found = []
    for i in range(scores.shape[0]):
        for j in range(scores.shape[1]):
            best = None
            for cls in range(scores.shape[2]):
                value = scores[i, j, cls]
                around = scores[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2, cls]
                above = value >= threshold if inclusive else value > threshold
                if above and value >= around.max() and (not best or value > best[0]):
                    best = (value, cls, i, j)
            found += [best] if best else []
    return sorted(found, key=lambda p: (-p[0], p[2], p[3]))


def sigmoid(x):
    return np.asarray(jax.nn.sigmoid(x))


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_peaks_equal_the_definition(seed, inclusive):
    rng = np.random.default_rng(seed)
    # Few levels: many equal neighbors, equal classes and scores on the threshold.
    logits = rng.integers(-3, 2, (1, 20, 12, C)).astype(np.float32)
    maps = DetectionMaps(jnp.asarray(logits), jnp.zeros((1, 20, 12, 8)))
    threshold = sigmoid(np.float32(0))
    expected = naive_peaks(sigmoid(logits[0]), threshold, inclusive)
    options = {"score_threshold": threshold, "threshold_inclusive": inclusive}
    peaks = find_peaks(maps, GRID, max_peaks=240, **options)
    count = int(peaks.num_found[0])
    assert count == len(expected)
    columns = peaks.scores[0], peaks.classes[0], *peaks.bins[0].T
    found = [column[:count].tolist() for column in columns]
    assert [*zip(*found, strict=True)] == expected
    assert not np.asarray(peaks.is_valid[0, count:]).any()


def test_every_class_has_its_threshold():
    """A class whose score is too low leaves its bin to another one."""
    rng = np.random.default_rng(0)
    logits = jnp.asarray(rng.normal(0, 2, (1, 20, 12, C)), jnp.float32)
    maps = DetectionMaps(logits, jnp.zeros((1, 20, 12, 8)))
    thresholds = np.array([0.9, 0.3, 0.6], np.float32)
    found = find_peaks(maps, GRID, max_peaks=240, score_threshold=thresholds)
    # Lower scores of the same class in the neighborhood do not matter.
    above = np.where(sigmoid(logits) >= thresholds, sigmoid(logits), 0)[0]
    expected = naive_peaks(above, 1e-6)
    count = int(found.num_found[0])
    rows = zip(found.scores[0].tolist(), found.classes[0].tolist(), strict=True)
    assert [*rows][:count] == [(float(score), cls) for score, cls, *_ in expected]
    assert {cls for _, cls, *_ in expected} == {0, 1, 2}
    peaks = partial(find_peaks, maps, GRID, max_peaks=240)
    same, one = peaks(score_threshold=thresholds * 0 + 0.4), peaks(score_threshold=0.4)
    jax.tree.map(np.testing.assert_array_equal, same, one)


def test_probabilities_are_a_further_output():
    logits, params, *_ = scattered(4)
    maps = DetectionMaps(jnp.asarray(logits), jnp.asarray(params))
    fits = ((0.5, -1.0), (2.0, 0.5), (1.0, 0.0))
    plain, found = decode(maps, GRID), decode(maps, GRID, calibration=fits)
    probability = found.outputs["probability"]
    for name in ("boxes", "scores", "classes", "is_valid", "num_truncated"):
        np.testing.assert_array_equal(getattr(found, name), getattr(plain, name))
    rows = plain.is_valid
    assert rows.sum() == 4
    assert not probability[~rows].any()
    for cls, (temperature, offset) in enumerate(fits):
        mine = rows & (plain.classes == cls)
        expected = expit(logit(plain.scores[mine]) / temperature + offset)
        np.testing.assert_allclose(probability[mine], expected, rtol=1e-5)
    sure = DetectionMaps(jnp.asarray(logits).at[0, 4, 0, 0].set(99), maps.box_params)
    certain = decode(sure, GRID, calibration=fits)
    assert (certain.scores[0, 0], certain.outputs["probability"][0, 0]) == (1, 1)


def scattered(num=6, spacing=3, seed=0):
    """Peaks of falling score, apart from each other, with 1 m boxes."""
    rng = np.random.default_rng(seed)
    logits = np.full((1, 20, 12, C), -8.0, np.float32)
    cells = [(i, j) for i in range(4, 20, spacing) for j in range(0, 12, spacing)]
    cells = [cells[k] for k in rng.permutation(len(cells))[:num]]
    classes = rng.integers(0, C, num)
    for rank, ((i, j), cls) in enumerate(zip(cells, classes, strict=True)):
        logits[0, i, j, cls] = 3 - 0.25 * rank
    params = np.zeros((1, 20, 12, 8), np.float32)
    params[..., 3:6], params[..., 7] = 1, 1
    return logits, params, np.array(cells), classes


def maps_of(logits, params):
    return DetectionMaps(jnp.asarray(logits), jnp.asarray(params))


def decode_scene(logits, params, **options):
    """Detections of a scene on the small grid."""
    return decode(maps_of(logits, params), GRID, **options)


def test_encoded_boxes_come_back_with_the_outputs_of_their_bins():
    logits, params, cells, classes = scattered(num=7)
    rng = np.random.default_rng(1)
    boxes = np.zeros((len(cells), 7))
    boxes[:, :2] = GRID.bin_to_ego(*cells.T) + rng.uniform(-1, 1, (len(cells), 2))
    boxes[:, 2:6] = rng.uniform(0.5, 3, (len(cells), 4))
    boxes[:, 6] = rng.uniform(-3, 3, len(cells))
    boxes[1] = boxes[0]  # which NMS removes
    kept = [0, 2, 3, 4, 5, 6]
    for (i, j), box in zip(cells, boxes, strict=True):
        offset = box[:2] - GRID.bin_to_ego(i, j)
        heading = [np.sin(box[6]), np.cos(box[6])]
        params[0, i, j] = [*offset, box[2], *box[3:6], *heading]
    rows, columns = np.indices(logits.shape[1:3])
    outputs = {"bin": jnp.asarray(np.stack([rows, columns], -1)[None])}
    outputs["sum"] = outputs["bin"].sum(-1)
    found = decode(maps_of(logits, params).replace(outputs=outputs), GRID)
    np.testing.assert_allclose(found.boxes[0, :6], boxes[kept], atol=2e-5)
    assert found.outputs["bin"][0, :6].tolist() == cells[kept].tolist()
    made = found.to_boxes()
    assert made.extras["sum"].tolist() == cells[kept].sum(1).tolist()
    assert made.to_list()[0]["bin"] == cells[0].tolist()
    np.testing.assert_array_equal(found.classes[0], [*classes[kept]] + [-1] * 10)
    np.testing.assert_array_equal(found.scores[0, 6:], 0)
    np.testing.assert_array_equal(found.boxes[0, 6:], 0)
    assert found.is_valid[0].tolist() == [True] * 6 + [False] * 10


@pytest.mark.parametrize(
    ("size_m", "max_detections", "pre_nms", "num_found", "num_truncated"),
    [
        (1, 16, None, 10, 0),
        (1, 6, None, 6, 4),
        (1, 6, 10, 6, 4),
        (500, 5, None, 1, 0),  # everything overlaps; what NMS drops is not truncated
        (500, 5, 7, 1, 3),
    ],
)
def test_what_k_cuts_off_is_counted(
    size_m, max_detections, pre_nms, num_found, num_truncated
):
    logits, params, _, _ = scattered(num=10)
    params[..., 3:5] = size_m
    options = {"max_detections": max_detections, "pre_nms": pre_nms}
    found = decode_scene(logits, params, **options)
    assert found.boxes.shape == (1, max_detections, 7)
    assert int(found.is_valid.sum()) == num_found
    assert int(found.num_truncated[0]) == num_truncated
    assert (np.diff(found.scores[0]) <= 0).all()


def test_region_bounds_are_inclusive_and_leave_room_for_others():
    logits, params, cells, _ = scattered(num=10)
    x, y = GRID.bin_to_ego(*cells.T).T
    inside = (np.abs(y) <= 30) & (x <= 90)
    assert 3 < inside.sum() < 10
    roi = np.array([0, 90, -30, 30, 0, 0.0])
    found = decode_scene(logits, params, roi=roi)
    np.testing.assert_allclose(found.boxes[0, : inside.sum(), 0], x[inside], rtol=1e-6)
    # Peaks outside do not take the place of peaks inside.
    count = int(inside.sum())
    tight = find_peaks(maps_of(logits, params), GRID, max_peaks=count, roi=roi)
    assert np.asarray(tight.is_valid).all()
    params[..., 2] = 0.1
    above = decode_scene(logits, params, roi=roi)
    assert not np.asarray(above.is_valid).any()


def overlapping_classes():
    """Two classes that overlap, in bins that are not neighbors."""
    logits = np.full((1, 20, 12, C), -8.0, np.float32)
    logits[0, 10, 5, 0], logits[0, 10, 7, 1] = 2, 1
    params = np.zeros((1, 20, 12, 8), np.float32)
    params[..., 3:5], params[..., 5], params[..., 7] = 60, 2, 1
    return logits, params


def test_nms_across_classes_or_per_class():
    run = partial(decode_scene, *overlapping_classes(), max_detections=4)
    assert run().is_valid[0].tolist() == [True, False, False, False]
    assert run(per_class_nms=True).classes[0].tolist() == [0, 1, -1, -1]


def test_length_of_the_yaw_vector_scales_boxes_in_nms_only_as_released():
    logits, params = overlapping_classes()
    params[..., 7] = 0.1
    run = partial(decode_scene, logits, params)
    released, plain = run(), run(raw_yaw="never")
    assert int(released.is_valid.sum()) == 2
    assert int(plain.is_valid.sum()) == 1
    np.testing.assert_allclose(released.boxes[0, 0, 3:5], 60)
    always = run(raw_yaw="always")
    np.testing.assert_array_equal(always.is_valid, released.is_valid)
    np.testing.assert_allclose(always.boxes[0, 0, 3:5], 6, rtol=1e-6)


def test_detections_of_the_released_code(case):
    """Region filter before NMS and boxes as the released evaluator takes them."""
    want, maps, grid = case
    options = load_config("configs/radenet.py:official").decode
    options = options.replace(max_detections=48)
    if not want["wide_roi"]:
        options = options.replace(roi=None)
    found = jax.device_get(_decode(maps, grid, options))
    for frame in range(3):
        kept = want[f"boxes_before_nms_{frame}"][want[f"kept_{frame}"]]
        count = len(kept)
        assert int(found.is_valid[frame].sum()) == count
        np.testing.assert_allclose(found.scores[frame, :count], kept[:, 8], atol=1e-6)
        np.testing.assert_array_equal(found.classes[frame, :count], kept[:, 9])
        expected = boxes7_from_8(kept[:, :8])
        expected[:, 3:5] *= np.hypot(kept[:, 6], kept[:, 7])[:, None]
        np.testing.assert_allclose(found.boxes[frame, :count], expected, atol=2e-5)
    np.testing.assert_array_equal(found.num_truncated, 0)


def test_bfloat16_maps_and_saturated_or_missing_numbers():
    logits, params, _, _ = scattered()
    low = jax.tree.map(lambda x: x.astype(jnp.bfloat16), maps_of(logits, params))
    found = decode(low, GRID)
    assert found.boxes.dtype == found.scores.dtype == jnp.float32
    assert int(found.is_valid.sum()) == 6
    for value in (np.inf, 100.0, np.nan, -np.inf):
        flat = decode_scene(np.full_like(logits, value), params)
        assert np.isfinite(flat.boxes).all()
        assert np.isfinite(flat.scores).all()
        assert np.asarray(flat.is_valid).any() == (value > 0)


@pytest.mark.wrong_types
def test_wrong_shapes_are_rejected():
    logits, params, _, _ = scattered()
    maps, few = maps_of(logits, params), maps_of(logits, params[..., :7])
    for call, message in (
        (lambda: D.decode(maps, KRADAR, RELEASED), "on the grid's 256 x 107 bins"),
        (lambda: D.decode(few, GRID, RELEASED), r"12, 7\), expected \[B, R, A, C\]"),
        (lambda: D.decode(maps, GRID, RELEASED, pre_nms=0), "1 peak must enter NMS"),
        (lambda: D.decode(maps, GRID, RELEASED, roi=np.zeros(4)), r"roi must be \[6\]"),
        (lambda: RELEASED.replace(roi=(0, 1)), "config.decode.roi is .* six numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize("raw_yaw", ["nms", "always"])
def test_a_size_is_never_negative(raw_yaw):
    logits = jnp.full((2, 20, 12, C), -9.0)
    logits = logits.at[0, [5, 15], [3, 9], 1].set(2.0).at[1, 5, 3, 0].set(2.0)
    shrunk = jnp.array([0, 0, 0, -0.2, 1.5, 0, 0, 0])
    params = jnp.ones((2, 20, 12, 8)).at[0, 5, 3].set(shrunk)
    run = partial(decode_scene, logits, params, raw_yaw=raw_yaw)
    found, released = run(), run(clip_sizes=False)
    least = np.float32(0.01)
    width = 1.5 if raw_yaw == "nms" else least  # the yaw vector's length is 0
    np.testing.assert_array_equal(found.boxes[0, 0, 3:6], [least, width, least])
    boxes = found.to_boxes()
    assert boxes.frame[boxes.is_clipped].tolist() == [0]
    np.testing.assert_array_equal(found.boxes[0, 1], released.boxes[0, 1])
    length = np.float32(-0.2) if raw_yaw == "nms" else 0.0
    assert released.boxes[0, 0, 3] == length
