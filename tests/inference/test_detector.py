"""`Detector`: inputs it takes, thresholds, batches without recompiling."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax import Detector, UserError
from radejax.core.structures import CLASSES, NARROW_ROI, Batch
from radejax.data.kradar import write
from radejax.data.projection import project_tensor

from .. import small_models as small


@pytest.fixture(scope="module")
def unused(projections):
    """Untrained: nearly every bin is a weak detection. Only copies of it are called."""
    usual = [float(projections.mean()), float(projections.std())]
    saved = dataclasses.replace(small.saved(), usual_input=usual)
    return Detector(saved, score_threshold=0.3, batch_sizes=(1, 4))


@pytest.fixture(scope="module")
def detector(unused):
    return unused.replace()


@pytest.fixture(scope="module")
def tesseracts():
    rng = np.random.default_rng(0)
    shape = (5, *small.small_grid().shape_drea)
    return (10 ** rng.uniform(5, 14, shape)).astype(np.float32)


@pytest.fixture(scope="module")
def projections(tesseracts):
    return np.stack([project_tensor(t) for t in tesseracts])


def _equal(a, b, atol=1e-4):
    assert a.is_valid.any()
    np.testing.assert_array_equal(a.is_valid, b.is_valid)
    np.testing.assert_array_equal(a.classes, b.classes)
    np.testing.assert_allclose(a.scores, b.scores, atol=atol)
    np.testing.assert_allclose(a.boxes, b.boxes, atol=10 * atol)


def test_tesseracts_projections_and_files_agree(
    detector, tesseracts, projections, tmp_path
):
    expected = detector(projections[0])
    assert expected.boxes.shape == (1, 100, 7)
    _equal(detector(tesseracts[0]), expected)
    path = tmp_path / "tesseract_00001.mat"
    write.write_tesseract(path, tesseracts[0])
    _equal(detector(path), expected)
    _equal(detector([path, path]), detector(projections[[0, 0]]))
    _equal(detector(list(projections[:2])), detector(projections[:2]))
    _equal(detector(tuple(tesseracts[:2])), detector(projections[:2]))


def test_any_batch_size_runs_in_the_compiled_sizes(detector, projections):
    whole = detector(projections)  # 5 frames: a batch of 4 and one of 1
    assert whole.boxes.shape[0] == 5
    for i in range(5):
        one = detector(projections[i])
        _equal(jax.tree.map(lambda x, i=i: x[i : i + 1], whole), one)
    before = detector._run._cache_size()
    detector(projections[:2])
    detector(projections[:3])
    assert detector._run._cache_size() == before


def test_thresholds_and_region_change_without_compiling(detector, projections):
    default = detector(projections[:1])
    before = detector._run._cache_size()
    scores = np.asarray(default.scores)[np.asarray(default.is_valid)]
    strict = detector(projections[:1], score_threshold=float(np.median(scores)))
    assert 0 < strict.is_valid.sum() < default.is_valid.sum()
    every = dict.fromkeys(detector.classes, float(np.median(scores)))
    for given in (every, tuple(every.values()), f"{np.median(scores)}"):
        _equal(detector(projections[:1], score_threshold=given), strict, atol=0)
    cls = detector.classes[int(default.classes[0, 0])]
    others = detector(projections[:1], score_threshold={cls: 1.0})  # 0.3 for the others
    assert cls not in others.to_boxes().cls
    assert others.is_valid.any()
    assert detector(projections[:1], nms_iou=1.0).is_valid.sum() >= scores.size
    region = detector(projections[:1], roi=(0, 15, -5, 5, -10, 10))
    boxes = np.asarray(region.boxes)[np.asarray(region.is_valid)]
    assert 0 < len(boxes) < scores.size
    assert (boxes[:, 0] <= 15).all()
    assert (np.abs(boxes[:, 1]) <= 5).all()
    everywhere = detector(projections[:1], roi=(-np.inf, np.inf) * 3)
    _equal(everywhere, default, atol=0)
    assert detector._run._cache_size() == before


def test_samples_of_two_frames_and_a_stream_with_a_history(
    detector, tesseracts, projections, tmp_path
):
    two = small.detector(num_frames=2, score_threshold=0.3, batch_sizes=(1, 4))
    pairs = np.stack([projections[[0, 0, 1, 2, 3]], projections], 1)
    expected = two(pairs)
    assert expected.boxes.shape == (5, 100, 7)
    # A sample is what the loader makes of its frames; their order matters.
    doppler = two.grid.num_doppler
    parts = [pairs[..., :doppler], pairs[..., doppler:]]
    stacked = np.concatenate([p[:, i] for p in parts for i in (0, 1)], -1)
    _equal(two(Batch(stacked, None, None, None, None)), expected)
    assert np.abs(two(pairs[:, ::-1]).scores - expected.scores).max() > 1e-3
    # Arrays and paths of one sample, tesseracts and projections.
    _equal(two(list(projections[:2])), two(pairs[1]))
    _equal(two(tesseracts[:2]), two(pairs[1]))
    paths = [tmp_path / f"tesseract_{i:05d}.mat" for i in (1, 2)]
    for path, tesseract in zip(paths, tesseracts, strict=False):
        write.write_tesseract(path, tesseract)
    _equal(two(paths), two(pairs[1]))
    # The stream takes single frames or batches of them.
    items = (projections[0], tesseracts[1:4], list(projections[4:]))
    streamed = list(two.stream(items))
    whole = jax.tree.map(lambda *x: np.concatenate(x), *streamed)
    _equal(whole, expected)
    assert two.warmup(2) is two
    message = r"\[16, 14, 5\]; expected .*\[B, 2, R, A, D\+E\].* of 2 consecutive "
    message += r"frames \(config.data.num_frames\), oldest first; Detector.stream takes"
    with pytest.raises(UserError, match=message):
        two(projections[0])


def test_memory_of_the_caller_may_be_refilled(detector, projections):
    """Aligned to 64 bytes, where `device_put` on CPU would share it."""
    for count in (1, 4):  # a compiled size: nothing else copies the frames
        shape = (count, *projections.shape[1:])
        memory = np.zeros(4 * np.prod(shape) + 64, np.uint8)
        start = -memory.ctypes.data % 64
        ring = memory[start : start + 4 * np.prod(shape)].view(np.float32)
        ring = ring.reshape(shape)

        def refilled(ring=ring, count=count):
            for i in range(5 - count):
                ring[:] = projections[i : i + count]
                yield ring
            ring[:] = 0.0

        for i, found in enumerate(detector.stream(refilled())):
            _equal(found, detector(projections[i : i + count]))
        ring[:] = projections[:count]
        taken = detector.put(ring)
        ring[:] = 0.0
        np.testing.assert_array_equal(taken, projections[:count])


def test_invalid_frames_are_counted_and_warned_of_once(
    detector, tesseracts, projections, caplog
):
    def count(*calls):
        made = detector.replace(batch_sizes=(1, 4))
        caplog.clear()
        for frames in calls:
            made(frames)
        return made.num_invalid_frames, caplog.text

    def spoiled(frames, value):
        frames = frames[:3].copy()
        frames[(1, 1, *[2] * (frames.ndim - 2))] = value
        return frames

    assert count(projections, tesseracts)[0] == 0
    for value in (np.nan, np.inf, 1e38):
        number, text = count(spoiled(projections, value), spoiled(projections, value))
        assert number == 2
        assert text.count("1 of 3 frames are not linear power or its projection") == 1
    for value in (np.nan, np.inf, -1.0):
        assert count(spoiled(tesseracts, value))[0] == 1
    decibels = np.concatenate([10 * np.log10(tesseracts[:2]), tesseracts[:1]])
    number, text = count(decibels)
    assert number == 2
    assert "2 of 3 frames" in text
    assert "as in decibels" in text
    levels = 184.3 * projections[:3] - 1.2
    assert count(levels)[0] == 3
    assert count(0 * tesseracts[:3], 0 * projections[:3])[0] == 6
    # The frames of a warm-up are not counted.
    assert count((255 * projections[:3]).astype(np.uint8))[0] == 0
    made = detector.replace(batch_sizes=(1,)).warmup()
    assert (made.num_invalid_frames, caplog.text) == (0, "")


def test_invalid_frames_of_arrays_on_a_device_are_counted_later(
    detector, projections, caplog
):
    made = detector.replace(batch_sizes=(1, 4))
    spoiled = projections[:3].copy()
    spoiled[1, 1, 2, 2] = np.nan
    device = jnp.asarray(spoiled)
    assert made(device).num_invalid.tolist() == [0, 1, 0]
    assert caplog.text == ""  # it is not awaited in the call
    assert made.num_invalid_frames == 1
    assert caplog.text.count("1 of 3 frames are not linear power") == 1
    for _ in range(10):
        made(device)
    assert made._num_invalid == 3  # that of the last eight calls is not awaited
    assert made.num_invalid_frames == 11
    assert made(projections[:3]).num_invalid.tolist() == [0, 0, 0]


def test_input_unlike_that_of_the_training_is_warned_of_once(
    unused, tesseracts, projections, tmp_path, caplog
):
    path = tmp_path / "tesseract_00001.mat"
    write.write_tesseract(path, 1e4 * tesseracts[0])
    for frames, is_near in (
        (projections, True),
        (tesseracts[:1], True),
        ((255 * projections).round().astype(np.uint8), True),
        (tesseracts[:1] * 1e4, False),
        (path, False),
        (projections * 0.3, False),
        (jnp.asarray(projections * 0.3), True),  # those on a device are not checked
    ):
        made = unused.replace()
        caplog.clear()
        for _ in range(2):
            made(frames)
        assert caplog.text.count("in the training: detections") == (not is_near)


def test_detections_as_boxes_and_lists(detector, projections):
    found = detector(projections[:2])
    table, rows = found.to_boxes(), found.to_list()
    counts = found.is_valid.sum(1).tolist()
    assert np.bincount(table.frame).tolist() == list(map(len, rows)) == counts
    # Frames that pad a batch are left out.
    second = found.to_boxes(np.array([-1, 7]))
    np.testing.assert_array_equal(second.box, table.box[table.frame == 1])
    assert set(second.frame) == {7}
    names = ("x", "y", "z", "l", "w", "h", "yaw")
    box, score = np.asarray(found.boxes[0, 0]), float(found.scores[0, 0])
    first = dict(zip(names, box, strict=True)) | {"score": score}
    first["cls"] = CLASSES[int(found.classes[0, 0])]
    assert rows[0][0] == pytest.approx(first)


def test_region_and_classes_are_those_of_the_model(projections):
    names = ("Bicycle", "Motorcycle", "Pedestrian", "Bus or Truck", "Sedan")
    region, other = (0, 15, -5, 5, -10, 10), (0, 9, -5, 5, -10, 10)
    saved = small.saved(decode__roi=region, classes=names)
    found = Detector(saved, score_threshold=0.3)(projections[:1])
    assert found.is_valid.any()
    assert (found.boxes[found.is_valid][:, 0] <= 15).all()
    index = int(found.classes[0, 0])
    assert found.to_list()[0][0]["cls"] == names[index]
    assert Detector(saved, roi=other).decode_options.roi == other
    assert Detector(saved, roi="narrow").decode_options.roi == NARROW_ROI


def test_wrong_arguments_are_named(detector, tesseracts):
    masked = np.ma.masked_less(tesseracts[:2], 0)
    masked[0, 0, 0, 0, 0] = np.ma.masked
    gap = (0, 72, None, None, -2, 6)
    for call, message in (
        (lambda: detector([]), "the list is empty"),
        (lambda: detector(np.zeros((0, 16, 14, 5))), r"\[0, 16, 14, 5\]; expected"),
        (lambda: detector(masked), "frames: 1 values are masked"),
        (lambda: detector(tesseracts > 0), "frames: array of bool, expected real"),
        (lambda: detector(tesseracts, roi="middle"), "roi is 'middle', expected"),
        (lambda: small.detector(roi=gap), r"roi is \(0, 72, None, None, -2, 6\), exp"),
        (lambda: small.detector(batch_sizes=(0,)), r"batch_sizes is \(0,\), expected"),
        (lambda: small.detector(nms_iou=1.5), "nms_iou is 1.5, expected a number"),
        (lambda: detector(tesseracts, [None], "x"), "the model is radar-only"),
    ):
        with pytest.raises(UserError, match=message):
            call()
