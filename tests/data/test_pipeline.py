import dataclasses
import functools
import itertools
import types

import chex
import numpy as np
import pytest
from PIL import Image

from radejax.core.errors import UserError
from radejax.core.structures import CLASSES, Batch
from radejax.data import pipeline
from radejax.data.augment import Augmentation
from radejax.data.cameras import CameraOptions, camera_inputs
from radejax.data.kradar import KRadar
from radejax.data.pipeline import LoaderOptions, make_loader, make_table
from radejax.data.projection import stack_frames
from radejax.data.records import Records, open_projections, preprocess

from .. import small_models as small

OPTIONS = LoaderOptions(3, seed=1, process_index=0, process_count=1)


@pytest.fixture(scope="module")
def data(kradar_root):
    return KRadar(kradar_root, visibility=None)


@pytest.fixture(scope="module")
def records(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("records")
    preprocess(data, path, num_workers=0, progress=False)
    return open_projections(path)


@pytest.fixture
def loader(records, data):
    table = make_table(records, data, max_objects=5)

    def make(augment=None, **options):
        options = dataclasses.replace(OPTIONS, **options)
        return make_loader(table, options, augment=augment)

    return make


def frames_of(loader):
    return [batch.frame.tolist() for batch in loader]


# Content -----------------------------------------------------------------------------


def test_batches_are_the_records_and_labels(loader, records, data):
    for batch in loader(num_epochs=1):
        assert isinstance(batch, Batch)
        chex.assert_shape(batch.projection, (3, 16, 12, 11))
        chex.assert_type(
            [batch.projection, batch.boxes, batch.classes, batch.is_valid, batch.frame],
            [np.float16, np.float32, np.int32, bool, np.int32],
        )
        for row, index in enumerate(batch.frame):
            frame = data[index]
            np.testing.assert_array_equal(batch.projection[row], records[frame.key])
            count = int(batch.is_valid[row].sum())
            assert count == len(frame.boxes)
            found = batch.boxes[row, :count]
            np.testing.assert_allclose(found[:, :6], frame.boxes[:, :6], rtol=1e-6)
            yaw = np.arctan2(found[:, 6], found[:, 7])
            wanted = np.arctan2(np.sin(frame.boxes[:, 6]), np.cos(frame.boxes[:, 6]))
            np.testing.assert_allclose(yaw, wanted, atol=1e-6)
            classes = [CLASSES[i] for i in batch.classes[row, :count]]
            assert classes == frame.classes.tolist()
            assert not batch.boxes[row, count:].any()
            assert (batch.classes[row, count:] == -1).all()
    assert batch.image is None
    assert batch.camera is None


# Order --------------------------------------------------------------------------------


def test_every_epoch_has_every_frame_in_another_order(loader):
    frames = frames_of(loader(num_epochs=3))
    assert len(frames) == 12
    epochs = [list(itertools.chain(*frames[i : i + 4])) for i in (0, 4, 8)]
    assert all(sorted(epoch) == list(range(12)) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2] != epochs[0]
    in_order = frames_of(loader(num_epochs=2, shuffle=False))
    assert list(itertools.chain(*in_order)) == [*range(12), *range(12)]


def test_order_depends_only_on_the_seed(loader):
    wanted = frames_of(loader(num_epochs=2))
    for options in ({"num_threads": 0}, {"num_threads": 5}):
        assert frames_of(loader(num_epochs=2, **options)) == wanted
    # grain shuffles epoch e of seed s as epoch e - 1 of seed s + 1; we must not.
    others = [frames_of(loader(num_epochs=2, seed=s)) for s in (0, 2, 3)]
    orders = [run[4 * e : 4 * e + 4] for run in [wanted, *others] for e in (0, 1)]
    assert all(a != b for a, b in itertools.combinations(orders, 2))


def frames_of_processes(loader, count, **options):
    """Frames of the batches of every process."""
    make = functools.partial(loader, process_count=count, **options)
    return [frames_of(make(process_index=i)) for i in range(count)]


def test_batches_do_not_depend_on_the_number_of_processes(loader):
    whole = frames_of(loader(batch_size=6, num_epochs=2))
    for count in (2, 3):
        shares = frames_of_processes(loader, count, batch_size=6 // count, num_epochs=2)
        for rows, batch in zip(zip(*shares, strict=True), whole, strict=True):
            assert list(itertools.chain(*rows)) == batch


def test_processes_take_as_many_steps_when_frames_do_not_divide(loader):
    for batch_size, steps in ((1, 2), (2, 1)):
        shares = frames_of_processes(loader, 5, batch_size=batch_size, num_epochs=1)
        assert {len(share) for share in shares} == {steps}
    options = {"pad_remainder": True, "shuffle": False, "num_epochs": 1}
    padded = frames_of_processes(loader, 5, batch_size=2, **options)
    assert {len(share) for share in padded} == {2}
    drawn = sorted(frame for share in padded for batch in share for frame in batch)
    assert drawn == [-1] * 8 + list(range(12))


@pytest.mark.parametrize("batch_size", [5, 12])
def test_remainders(loader, batch_size):
    options = {"batch_size": batch_size, "num_epochs": 1, "shuffle": False}
    dropped = frames_of(loader(**options))
    padded = list(loader(pad_remainder=True, **options))
    assert len(dropped) == 12 // batch_size
    frames = np.concatenate([batch.frame for batch in padded]).tolist()
    assert frames == [*range(12), *[-1] * (-12 % batch_size)]
    empty = padded[-1].frame == -1
    assert int(empty.sum()) == -12 % batch_size
    assert not padded[-1].projection[empty].any()
    assert not padded[-1].is_valid[empty].any()


# Samples of several frames -----------------------------------------------------------


def test_preceding_frames_by_hand():
    keys = ["1/00001_00004", "1/00002_00005", "1/00004_00007", "2/00003_00001"]
    keys += ["10/00002_00001", "1/00003b"]
    a, b, d, other, ten, c = keys
    pairs = pipeline.frame_histories(reversed(keys), 2)
    of_one = {other: (other, other), ten: (ten, ten)}
    assert pairs == of_one | {a: (a, a), b: (a, b), c: (b, c), d: (c, d)}
    # A history ends where a frame is missing.
    three = pipeline.frame_histories([a, b, d, "1/00005_00008"], 3)
    assert three[b] == (a, a, b)
    assert three[d] == (d, d, d)
    assert three["1/00005_00008"] == (d, d, "1/00005_00008")
    # Two names of one radar frame, as two label revisions may give it.
    twice = pipeline.frame_histories([a, b, "1/00002_00006"], 2)
    assert twice[b] == (a, b)
    assert twice["1/00002_00006"] == (a, "1/00002_00006")
    with pytest.raises(UserError, match=r"frame 1/x7: .*num_frames=2 needs names that"):
        pipeline.frame_histories(["1/x7"], 2)


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_samples_are_the_records_of_a_frame_and_the_preceding_ones(
    records, kradar_root, probability, caplog
):
    """Also those of another split; all frames of a sample are mirrored."""
    test = KRadar(kradar_root, split="test", visibility=None)
    every = KRadar(kradar_root, visibility=None)
    with caplog.at_level("INFO", "radejax"):
        table = make_table(records, test, max_objects=5, num_frames=2)
    augment = Augmentation(records.grid, probability)
    options = dataclasses.replace(
        OPTIONS, batch_size=4, num_epochs=1, shuffle=False, pad_remainder=True
    )
    keys, doppler = [frame.key for frame in every], records.grid.num_doppler
    seen, repeated = 0, 0
    for batch in make_loader(table, options, augment=augment):
        chex.assert_shape(batch.projection, (4, 16, 12, 22))
        assert batch.projection.dtype == np.float16
        for sample, index in zip(batch.projection, batch.frame, strict=True):
            if index < 0:
                assert not sample.any()
                continue
            frame, seen = test[index], seen + 1
            position = keys.index(frame.key)
            before = every[max(0, position - 1)]
            if before.sequence != frame.sequence:
                before = frame
            repeated += before is frame or position == 0
            pair = [records[before.key], records[frame.key]]
            channels = stack_frames(pair, doppler)
            wanted = channels[:, ::-1] if probability else channels
            np.testing.assert_array_equal(sample, wanted)
    assert seen == len(test) < len(every)
    text = f"{repeated} of {seen} samples of 2 frames repeat one"
    assert text in caplog.text
    train = {frame.key for frame in KRadar(kradar_root, split="train")}
    assert any(before in train for before, _ in table.keys)


# State --------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0, 6, 7])
def test_restored_in_mid_epoch_continues_with_the_next_batch(loader, data, step):
    augment = Augmentation(data.grid, 0.5)
    options = {"num_epochs": 3, "augment": augment}
    first = loader(**options)
    for _ in range(step):
        next(first)
    state = first.get_state()
    wanted = list(first)
    for changes in ({}, {"num_threads": 0}, {"num_threads": 7}):
        second = loader(**options, **changes)
        next(second)
        second.set_state(state)
        found = list(second)
        assert len(found) == len(wanted) == 12 - step
        for a, b in zip(found, wanted, strict=True):
            chex.assert_trees_all_equal(a, b)


# Options ------------------------------------------------------------------------------


def test_augmentation_changes_per_epoch_and_stays_in_register(loader, data, records):
    augment = Augmentation(data.grid, mirror_probability=0.5)
    mirrored = {index: set() for index in range(12)}
    for batch in loader(num_epochs=6, augment=augment):
        for row, index in enumerate(batch.frame):
            plain = records[data[index].key]
            is_mirrored = not np.array_equal(batch.projection[row], plain)
            if is_mirrored:
                np.testing.assert_array_equal(batch.projection[row], plain[:, ::-1])
            mirrored[int(index)].add(is_mirrored)
            count = len(data[index].boxes)
            sign = -1 if is_mirrored else 1
            y_m, expected = batch.boxes[row, :count, 1], sign * data[index].boxes[:, 1]
            np.testing.assert_allclose(y_m, expected, rtol=1e-6)
    assert sum(len(seen) == 2 for seen in mirrored.values()) >= 9


def test_images_and_cameras(records, data, tmp_path):
    paths = [tmp_path / f"{10 + i}.png" for i in range(len(data))]
    for i, path in enumerate(paths):
        Image.fromarray(np.full((2, 4, 3), 10 + i, np.uint8)).save(path)
    calibration = small.calibration(intrinsics=(2, 2, 2, 1), width=4, height=2)
    (tmp_path / "cam_1.yml").write_text(calibration.to_kradar_text())
    fields = {"camera_calibration_path": tmp_path / "cam_1.yml"}
    shown = [*paths[:2], None, *paths[3:]]
    frames = [
        dataclasses.replace(frame, camera_path=path, **fields)
        for frame, path in zip(data, shown, strict=True)
    ]
    images = camera_inputs(frames, (2, 4), CameraOptions())
    table = make_table(records, frames, max_objects=5, images=images)

    def batches(**options):
        options = dataclasses.replace(OPTIONS, shuffle=False, **options)
        return make_loader(table, options)

    *_, batch = batches(batch_size=5, pad_remainder=True, num_epochs=1)
    assert batch.frame.tolist() == [10, 11, -1, -1, -1]
    assert batch.image[:, 0, 0, 0].tolist() == [20, 21, 0, 0, 0]
    assert batch.camera.is_valid.tolist() == [True, True, False, False, False]
    batch = next(batches(batch_size=4))
    assert batch.image.dtype == np.uint8
    assert batch.image[:, 0, 0, 0].tolist() == [10, 11, 0, 13]
    assert batch.camera.is_valid.tolist() == [True, True, False, True]
    chex.assert_shape(batch.camera.cam_from_ego, (4, 3, 4))
    assert batch.camera.intrinsics.dtype == np.float32


# Tables ------------------------------------------------------------------------------

BOX = [10.0, -2.0, 0.5, 4.0, 2.0, 1.5, np.pi / 6]


def frame_of(key, boxes=(), classes=(), **columns):
    """What of a frame the table reads."""
    boxes = np.array(boxes, np.float64).reshape(-1, 7)
    classes = np.array(classes, str)
    columns = {name: np.array(column) for name, column in columns.items()}
    return types.SimpleNamespace(key=key, boxes=boxes, classes=classes, columns=columns)


@pytest.fixture
def written(tmp_path):
    """Records of frames 1/a, 1/b and 1/c."""
    written = Records.create(tmp_path / "written", (2, 3, 4), "float16", {})
    for key in ("1/a", "1/b", "1/c"):
        written.write(key, np.zeros((2, 3, 4), np.float16))
    return written


@pytest.mark.wrong_types
def test_table_by_hand(written):
    frames = [frame_of("1/b", [BOX, BOX], ["Bicycle", "Sedan"]), frame_of("1/a")]
    frames.append(frame_of("1/c", [BOX], ["Pedestrian"]))
    table = make_table(written, frames, max_objects=2, classes=("Sedan", "Bicycle"))
    assert table.keys == (("1/b",), ("1/a",), ("1/c",))
    assert table.classes.tolist() == [[1, 0], [-1, -1], [-1, -1]]
    wanted = [10.0, -2.0, 0.5, 4.0, 2.0, 1.5, 0.5, np.sqrt(3) / 2]
    np.testing.assert_allclose(table.boxes[0, 1], wanted, rtol=1e-6)
    assert table.boxes.dtype == np.float32
    assert not table.boxes[1:].any()


@pytest.mark.wrong_types
def test_targets_are_columns_of_the_kept_objects(written):
    frames = [
        frame_of(
            *("1/b", [BOX, BOX], ["Bicycle", "Sedan"]),
            v=[[1.0, 2], [3, np.nan]],
            w=["R", "L"],  # texts are no targets
        ),
        frame_of("1/a", [BOX], ["Sedan"]),
    ]
    options = {"max_objects": 2, "classes": ("Sedan",)}
    table = make_table(written, frames, targets=("v",), **options)
    nan = np.nan
    expected = [[[3, nan], [nan, nan]], [[nan, nan], [nan, nan]]]
    np.testing.assert_array_equal(table.targets["v"], expected)
    with pytest.raises(UserError, match=r"targets is 'w', expected a column .*: v$"):
        make_table(written, frames, targets=("w",), **options)


def test_targets_and_augmented_samples_come_with_the_batch(records, data):
    frames = [dataclasses.replace(x, columns={"x": x.boxes[:, 0]}) for x in data]

    def shifted(sample, rng):
        projection = sample.projection + np.float16(rng.uniform())
        x = sample.targets["x"] + 1
        return dataclasses.replace(sample, projection=projection, targets={"x": x})

    table = make_table(records, frames, max_objects=5, targets=("x",))
    options = dataclasses.replace(OPTIONS, num_epochs=1)
    augment = Augmentation(records.grid, others=[shifted])
    for batch in make_loader(table, options, augment=augment):
        is_valid = batch.is_valid
        expected = batch.boxes[is_valid][:, 0] + 1
        np.testing.assert_array_equal(batch.targets["x"][is_valid], expected)
        assert batch.targets["x"].dtype == np.float32
        for row, index in enumerate(batch.frame):
            change = batch.projection[row] - records[data[index].key]
            np.testing.assert_allclose(change, change.mean(), atol=2e-3)
            assert change.mean() > 0


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x[1:], r"\(15, 12, 11\) float16, expected \(16, 12, 11\) float16,"),
        (lambda x: x.astype(complex), "complex128, expected"),
    ],
)
def test_own_augmentations_keep_the_shape(loader, records, change, message):
    def own(sample, rng):
        return dataclasses.replace(sample, projection=change(sample.projection))

    batches = loader(Augmentation(records.grid, others=[own]), num_threads=0)
    with pytest.raises(UserError, match=message):
        next(batches)


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda table, _: table([TWO, FIVE]), r"1/b has 5 objects.* is 3; 5 would do"),
        (lambda table, _: table([TWO, frame_of("1/x")]), r"1 of 2 frames have no .* 1/x"),
        (lambda table, _: table([]), "no frames"),
        (lambda table, _: table([TWO], images=NO_IMAGES), "0 cameras for 1 frames"),
        (lambda _, loader: loader(batch_size=13), "12 frames are fewer than one batch"),
        (lambda _, loader: loader(process_count=5), r"of 15 \(3 on each of 5 .*--config"),
    ],
)  # fmt: skip
def test_wrong_sizes(written, loader, call, message):
    table = functools.partial(make_table, written, max_objects=3)
    with pytest.raises(UserError, match=message):
        call(table, loader)
    table([TWO, FIVE], classes=("Bicycle",))  # objects of other classes take no rows


NO_IMAGES = types.SimpleNamespace(cameras=())
TWO = frame_of("1/a", [BOX] * 2, ["Sedan"] * 2)
FIVE = frame_of("1/b", [BOX] * 5, ["Sedan"] * 5)
