import types

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.data.cameras import CameraOptions, camera_inputs
from radejax.data.frame_table import make_table
from radejax.data.kradar import KRadar
from radejax.data.records.job import project_dataset
from radejax.data.records.projections import RecordSource


def frame(key, boxes=(), classes=(), camera_path=None):
    """What of a frame the table looks at."""
    boxes = np.array(boxes, np.float64).reshape(-1, 7)
    return types.SimpleNamespace(
        key=key, boxes=boxes, classes=np.array(classes, str), camera_path=camera_path
    )


def records(keys, skipped=()):
    manifest = types.SimpleNamespace(skipped=dict(skipped))
    index = {key: i for i, key in enumerate(keys)}
    return types.SimpleNamespace(
        index_of=lambda: index, manifest=manifest, folder="records"
    )


BOX = [10.0, -2.0, 0.5, 4.0, 2.0, 1.5, np.pi / 6]


@pytest.mark.wrong_types
def test_table_by_hand():
    frames = [
        frame("1/b", [BOX, BOX], ["Bicycle", "Sedan"]),
        frame("1/a"),
        frame("1/c", [BOX], ["Pedestrian"]),
    ]
    table = make_table(
        records(["1/a", "1/b", "1/c"]),
        frames,
        max_objects=2,
        classes=("Sedan", "Bicycle"),
    )
    assert table.record.tolist() == [1, 0, 2]
    assert table.classes.tolist() == [[1, 0], [-1, -1], [-1, -1]]
    assert table.is_valid.tolist() == [[True, True], [False, False], [False, False]]
    wanted = [10.0, -2.0, 0.5, 4.0, 2.0, 1.5, 0.5, np.sqrt(3) / 2]
    np.testing.assert_allclose(table.boxes[0, 1], wanted, rtol=1e-6)
    assert table.boxes.dtype == np.float32
    assert not table.boxes[1:].any()


@pytest.mark.wrong_types
def test_too_many_objects_says_how_many_would_do():
    frames = [
        frame("1/a", [BOX] * 2, ["Sedan"] * 2),
        frame("1/b", [BOX] * 5, ["Sedan"] * 5),
    ]
    with pytest.raises(UserError, match=r"frame 1/b has 5 objects.* is 3; 5 would do"):
        make_table(records(["1/a", "1/b"]), frames, max_objects=3)
    # Objects of other classes take no rows.
    make_table(records(["1/a", "1/b"]), frames, max_objects=0, classes=("Bicycle",))


@pytest.mark.wrong_types
def test_frames_without_records():
    frames = [frame("1/a"), frame("1/b")]
    source = records(["1/a"], {"1/b": "t.mat: truncated"})
    with pytest.raises(UserError, match=r"1 of 2 frames .* 1/b \(t\.mat: truncated\)"):
        make_table(source, frames, max_objects=1)
    with pytest.raises(UserError, match="no frames"):
        make_table(source, [], max_objects=1)


def test_labels_can_be_exchanged_between_frames(kradar_root, tmp_path):
    data = KRadar(kradar_root, visibility=None, field_of_view=False)
    project_dataset(data, tmp_path, num_workers=0, progress=False)
    source = RecordSource(tmp_path)
    plain = make_table(source, data, max_objects=9)
    mixed = make_table(source, data, max_objects=9, label_permutation_seed=3)
    np.testing.assert_array_equal(plain.record, mixed.record)
    assert (plain.boxes != mixed.boxes).any()
    plain_rows, mixed_rows = (
        sorted(bytes(b) + bytes(c) for b, c in zip(t.boxes, t.classes, strict=True))
        for t in (plain, mixed)
    )
    assert plain_rows == mixed_rows  # boxes and classes move together
    again = make_table(source, data, max_objects=9, label_permutation_seed=3)
    np.testing.assert_array_equal(again.boxes, mixed.boxes)
    assert ((mixed.classes >= 0) == mixed.is_valid).all()


@pytest.mark.wrong_types
def test_cameras_are_of_the_same_frames():
    frames = [frame("1/a"), frame("1/b")]
    for one in frames:
        one.camera_calibration_path = None
    images = camera_inputs(frames[:1], (2, 4), CameraOptions())
    with pytest.raises(UserError, match="1 cameras for 2 frames"):
        make_table(records(["1/a", "1/b"]), frames, max_objects=1, images=images)
