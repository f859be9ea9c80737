"""`Detector`: inputs it takes, thresholds, batches without recompiling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

from radejax import Detector, UserError
from radejax.core.structures import CLASSES, NARROW_ROI, Batch
from radejax.data.kradar import write
from radejax.data.projection import project_tensor
from radejax.evaluation.kitti import prediction_texts

from .. import small_models as small


@pytest.fixture(scope="module")
def detector():
    """Untrained: nearly every bin is a weak detection."""
    return small.detector(score_threshold=0.3, batch_sizes=(1, 4))


@pytest.fixture(scope="module")
def tesseracts(detector):
    rng = np.random.default_rng(0)
    shape = (5, *detector.grid.shape_drea)
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
    with pytest.raises(UserError, match="the list is empty"):
        detector([])
    with pytest.raises(ValueError, match="must have the same shape"):
        detector([projections[0], projections[0, :8]])


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
    assert detector(projections[:1], nms_iou=1.0).is_valid.sum() >= scores.size
    region = detector(projections[:1], roi=(0, 15, -5, 5, -10, 10))
    boxes = np.asarray(region.boxes)[np.asarray(region.is_valid)]
    assert 0 < len(boxes) < scores.size
    assert (boxes[:, 0] <= 15).all()
    assert (np.abs(boxes[:, 1]) <= 5).all()
    assert detector._run._cache_size() == before


def test_stream_gives_what_calls_give(detector, projections):
    streamed = list(detector.stream(iter(projections)))
    assert len(streamed) == 5
    for found, projection in zip(streamed, projections, strict=True):
        _equal(found, detector(projection))


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
    zeros = np.zeros((5, 0), np.int32)
    batch = Batch(
        *(stacked, np.zeros((5, 0, 8), np.float32), zeros, zeros > 0, zeros.sum(1))
    )
    _equal(two(batch), expected)
    assert np.abs(two(pairs[:, ::-1]).scores - expected.scores).max() > 1e-3
    # Arrays and paths of one sample, tesseracts and projections.
    _equal(two(list(projections[:2])), two(pairs[1]))
    _equal(two(tesseracts[:2]), two(pairs[1]))
    _equal(two(np.stack([tesseracts[:2]] * 2)), two(pairs[[1, 1]]))
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
    with pytest.raises(
        UserError,
        match=r"\[16, 14, 5\]; expected .*\[B, 2, R, A, D\+E\].* of 2 consecutive "
        r"frames \(config.data.num_frames\), oldest first; Detector.stream takes",
    ):
        two(projections[0])


def test_a_stream_of_samples_counts_every_invalid_frame_once():
    two = small.detector(num_frames=3, batch_sizes=(1, 4))
    frames = small.projections(4)
    frames[1, 0, 0, 0] = np.nan
    assert len(list(two.stream([frames[:2], frames[2:]]))) == 2
    assert two.num_invalid_frames == 1


def test_detections_as_columns_lists_and_text(detector, projections):
    found = detector(projections[:2])
    columns, rows = found.to_columns(), found.to_list()
    counts = found.is_valid.sum(1).tolist()
    assert np.bincount(columns["frame"]).tolist() == list(map(len, rows)) == counts
    names = ("x", "y", "z", "l", "w", "h", "yaw")
    box, score = np.asarray(found.boxes[0, 0]), float(found.scores[0, 0])
    first = dict(zip(names, box, strict=True)) | {"score": score}
    first["cls"] = detector.classes[int(found.classes[0, 0])]
    assert rows[0][0] == pytest.approx(first)
    texts = prediction_texts(found)
    assert [len(text.splitlines()) for text in texts] == counts
    words = texts[0].splitlines()[0].split(" ")
    assert words[0] in ("sed", "bus", "ped", "mot", "bic")
    numbers = [float(word) for word in words[8:]]  # h w l y z x yaw score
    assert numbers == pytest.approx([*box[[5, 4, 3, 1, 2, 0, 6]], score])
    nothing = detector(projections[:1], score_threshold=1.0)
    assert prediction_texts(nothing) == ["dummy -1 -1 0 0 0 0 0 0 0 0 0 0 0 0 0"]


def test_a_wrong_shape_names_what_was_expected(detector):
    with pytest.raises(
        UserError, match=r"\[3, 16, 14, 6\]; expected projections .*\[B, 16, 14, 5\]"
    ):
        detector(np.zeros((3, 16, 14, 6), np.float32))
    with pytest.raises(UserError, match=r"\[0, 16, 14, 5\]; expected"):
        detector(np.zeros((0, 16, 14, 5), np.float32))


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


def test_column_major_tensors_are_copied_and_give_the_same(detector, tesseracts):
    for frames in (tesseracts[:1], tesseracts[:4]):
        given = np.stack([np.asfortranarray(frame) for frame in frames])
        assert not given.flags.c_contiguous
        _equal(detector(given), detector(frames), atol=0)
        placed = detector.put(given)
        given[:] = 0
        np.testing.assert_array_equal(placed, frames)
    sharding = NamedSharding(jax.make_mesh((4,), ("data",)), PartitionSpec("data"))
    sharded = small.detector(batch_sizes=(4,), sharding=sharding)
    placed = sharded.put(np.stack([np.asfortranarray(x) for x in tesseracts[:4]]))
    assert placed.sharding.is_equivalent_to(sharding, 5)
    np.testing.assert_array_equal(placed, tesseracts[:4])


def test_region_of_decode_options_holds_where_none_is_given(detector, projections):
    region, other = (0, 15, -5, 5, -10, 10), (0, 9, -5, 5, -10, 10)
    saved = small.saved(decode__roi=region)
    made = Detector(saved, score_threshold=0.3)
    found = made(projections[:1])
    boxes = np.asarray(found.boxes)[np.asarray(found.is_valid)]
    assert len(boxes)
    assert (boxes[:, 0] <= 15).all()
    assert Detector(saved, roi=other).decode_options["roi"] == other


def test_detections_carry_the_names_of_their_detector(detector, projections):
    names = ("Bicycle", "Motorcycle", "Pedestrian", "Bus or Truck", "Sedan")
    turned = Detector(
        small.saved(classes=names), score_threshold=0.3, batch_sizes=(1, 4)
    )
    found = turned(projections)  # two chunks
    index = int(found.classes[0, 0])
    assert found.to_list()[0][0]["cls"] == names[index]
    assert found.replace(class_names=CLASSES).to_list()[0][0]["cls"] == CLASSES[index]
    assert detector(projections[0]).to_list()[0][0]["cls"] == CLASSES[index]


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38])
def test_invalid_frames_are_counted_and_warned_of_once(
    detector, projections, caplog, value
):
    detector = detector.replace(batch_sizes=(1, 4))
    frames = projections[:3].copy()
    detector(frames)
    assert detector.num_invalid_frames == 0
    frames[1, 2, 3, 1] = value
    for _ in range(2):
        detector(frames)
    assert detector.num_invalid_frames == 2
    warnings = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert len(warnings) == 1
    assert (
        "1 of 3 frames are not linear power or its projection: some values"
        in warnings[0]
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_one_invalid_cell_of_a_tesseract_is_found(detector, tesseracts, value):
    detector = detector.replace(batch_sizes=(4,))
    frames = tesseracts[:3].copy()
    frames[2, 1, 3, 2, 5] = value
    detector(frames)
    assert detector.num_invalid_frames == 1


def test_decibels_are_warned_of(detector, tesseracts, projections, caplog):
    detector = detector.replace(batch_sizes=(4,))
    decibels = 10.0 * np.log10(tesseracts[:2])
    detector(np.concatenate([decibels, tesseracts[:1]]))
    assert "2 of 3 frames are not linear power" in caplog.text
    assert "as in decibels" in caplog.text
    detector(184.3 * projections[:3] - 1.2)
    assert detector.num_invalid_frames == 5
    detector((255 * projections[:3]).astype(np.uint8))  # as of records
    detector(jnp.asarray(projections[:3]))
    assert detector.num_invalid_frames == 5


def test_arrays_of_other_kinds(detector, tesseracts):
    wanted = np.asarray(detector(tesseracts[:2]).boxes)
    masked = np.ma.masked_less(tesseracts[:2], 0)  # nothing is masked
    for kind in (
        tesseracts[:2].astype(">f4"),
        masked,
        list(tesseracts[:2].astype("O")),
    ):
        np.testing.assert_array_equal(detector(kind).boxes, wanted)
    masked[0, 0, 0, 0, 0] = np.ma.masked
    for wrong, message in (
        (masked, "frames: 1 values are masked"),
        (tesseracts[:2] > 0, "frames: array of bool, expected real numbers"),
        (tesseracts[:2] * 1j, "array of complex64"),
        (np.full(tesseracts.shape, "x", object), "array of object"),
    ):
        with pytest.raises(UserError, match=message):
            detector(wrong)


def test_warming_up_compiles_for_the_inputs_of_the_sample(tesseracts):
    detector = small.detector(batch_sizes=(2,))
    sizes = [detector._run._cache_size()]
    for call in (
        lambda: detector.warmup(),
        lambda: detector.warmup(2),
        lambda: detector.warmup(tesseracts[:1]),
        lambda: detector(tesseracts[:2]),
    ):
        call()
        sizes.append(detector._run._cache_size())
    assert sizes == [0, 1, 1, 2, 2]


def test_arguments_by_name_and_wrong_ones():
    detector = small.detector(roi="narrow")
    assert tuple(detector.decode_options["roi"]) == tuple(NARROW_ROI)
    for wrong, message in (
        (
            {"roi": "middle"},
            "roi is 'middle', expected narrow, wide or six numbers x0 < x1",
        ),
        ({"roi": (0, 1)}, r"roi is \(0, 1\), expected narrow"),
        (
            {"roi": (0, 72, None, None, -2, 6)},
            r"roi is \(0, 72, None, None, -2, 6\), exp",
        ),
        (
            {"roi": (72, 0, -6, 6, -2, 6)},
            r"roi is \(72, 0, -6, 6, -2, 6\), expected narrow",
        ),
        ({"batch_sizes": (0,)}, r"batch_sizes is \(0,\), expected integers of"),
        ({"batch_sizes": ()}, r"batch_sizes is \(\), expected"),
        ({"nms_iou": 1.5}, r"nms_iou is 1.5, expected a number"),
        ({"score_threshold": np.nan}, r"score_threshold is nan, expected a"),
    ):
        with pytest.raises(UserError, match=message):
            small.detector(**wrong)
