import numpy as np

from radejax.core import files
from radejax.data.dataset import LabeledFrame, LabeledFrames
from radejax.data.kradar import KRadar, motion, write
from radejax.data.kradar.labels import Label

from ..conftest import GRID

NAMES = [f"{i + 4:05d}_{i + 1:05d}" for i in range(4)]


def sedan(x, y, track_id, visibility="R"):
    return Label("Sedan", (x, y, 0.5, 4.0, 2.0, 1.5, 0.25), visibility, track_id)


def write_labels(root, *frames, clock_s=(0.0, 0.1, 0.2, 0.3), sequence=1):
    for i, labels in enumerate(frames):
        path = root / f"{sequence}/info_label/{NAMES[i]}.txt"
        write.write_labels(path, (i + 4, i + 1, 2, 1, 3), clock_s[i], labels)


def velocities(root, **options):
    return {f.name: f.columns["velocity_mps"] for f in KRadar(root, **options)}


def test_velocities_are_smoothed_differences_of_a_track(tmp_path):
    x_m = (10.0, 11.0, 13.0, 16.0)
    write_labels(tmp_path, *([sedan(x, 0.5 * x, 7)] for x in x_m))
    # Differences of 10, (10 + 20) / 2, (20 + 30) / 2 and 30 m/s, then means of three.
    expected = [12.5, 50 / 3, 70 / 3, 27.5]
    found = velocities(tmp_path)
    for name, v in zip(NAMES, expected, strict=True):
        np.testing.assert_allclose(found[name], [[v, v / 2]], rtol=1e-9)


def test_velocities_are_nan_where_no_track_gives_them(tmp_path):
    cyclist = Label("Bicycle", (30.0, 3.0, 0.5, 2.0, 1.0, 1.5, 0.0), "R", 7)
    first = [sedan(10, 0, 7), sedan(15, 0, -1), cyclist, sedan(40, 0, 8)]
    second = [sedan(11, 0, 7), sedan(15, 0, -1), sedan(60, 0, 7), sedan(60, 9, 8)]
    write_labels(tmp_path, first, second, [sedan(11, 0, 7)], clock_s=(0.0, 0.1, 0.9))
    found = velocities(tmp_path)
    nan = [np.nan, np.nan]
    # No id, another class, and 8 moves by 22 m in 0.1 s.
    np.testing.assert_allclose(found[NAMES[0]], [[10, 0], nan, nan, nan])
    # No id, the id of an earlier label, and the same jump.
    np.testing.assert_allclose(found[NAMES[1]], [[10, 0], nan, nan, nan])
    np.testing.assert_allclose(found[NAMES[2]], [nan])  # 0.8 s later


def test_velocities_at_the_ends_of_a_split_use_the_other_split(tmp_path):
    write_labels(tmp_path, *([sedan(10 + i * i, 0, 7)] for i in range(4)))
    write.write_splits(tmp_path / "split", [(1, NAMES[1])], [(1, NAMES[3])])
    every = velocities(tmp_path)
    for split, name in (("train", NAMES[1]), ("test", NAMES[3])):
        found = velocities(tmp_path, split=split)
        assert list(found) == [name]
        np.testing.assert_array_equal(found[name], every[name])


def test_velocities_of_the_file_are_used_instead(tmp_path):
    write_labels(tmp_path, [sedan(10, 0, 7), sedan(20, 0, 8)], [sedan(11, 0, 7)])
    write_labels(tmp_path, [sedan(10, 0, 7)], [sedan(11, 0, 7)], sequence=2)
    path = tmp_path / "1/info_motion/objects.csv"
    text = f"{motion.OBJECT_HEADER}\n{NAMES[0]},Sedan,7,1.25,-0.5,3.0\n"
    files.write_text(path, text)
    assert motion.read_motion(path) == {(NAMES[0], "Sedan", 7): (1.25, -0.5, 3.0)}
    speeds = [frame.columns["speed_mps"].tolist() for frame in KRadar(tmp_path)]
    assert str(speeds) == "[[3.0, nan], [nan], [nan], [nan]]"
    found = [frame.columns["velocity_mps"] for frame in KRadar(tmp_path)]
    np.testing.assert_allclose(found[0], [[1.25, -0.5], [np.nan, np.nan]])
    np.testing.assert_allclose(found[1], [[np.nan, np.nan]])
    np.testing.assert_allclose(found[2], [[10.0, 0.0]])  # sequence 2 has no file


def test_a_malformed_file_is_reported(tmp_path):
    write_labels(tmp_path, [sedan(10, 0, 7)], [sedan(11, 0, 7)])
    path = tmp_path / "1/info_motion/objects.csv"
    files.write_text(path, motion.OBJECT_HEADER + "\na,b,1,x,0,0\n")
    data = KRadar(tmp_path)
    (problem,) = (text for kind, text in data.summary().problems if kind == "motion")
    assert problem.startswith(str(path))
    assert "convert string to float" in problem
    np.testing.assert_allclose(data[0].columns["velocity_mps"], [[10.0, 0.0]])


def test_columns_are_those_of_the_kept_boxes(tmp_path):
    labels = [sedan(10, 0, 3, "L"), sedan(20, 0, 4), sedan(500, 0, 5), sedan(30, 0, 6)]
    moved = [sedan(x.box[0] + x.track_id, 0, x.track_id) for x in labels]
    write_labels(tmp_path, labels, moved)
    frame = KRadar(tmp_path)[0]
    assert frame.columns["track_id"].tolist() == [4, 6]
    np.testing.assert_allclose(frame.columns["velocity_mps"], [[40, 0], [60, 0]])
    assert frame.columns["visibility"].tolist() == ["R", "R"]


def test_columns_of_own_readers_are_kept_with_their_boxes():
    boxes = [[20.0, 0, 0, 4, 2, 1.5, 0], [-20.0, 0, 0, 4, 2, 1.5, 0]]
    fields = {"sequence": 1, "name": "a", "boxes": np.array(boxes)}
    fields["classes"] = np.array(["car", "car"])
    frame = LabeledFrame(**fields, columns={"weight_kg": np.array([900, 800])})
    (kept,) = LabeledFrames([frame], GRID).with_valid_boxes(["car"])
    assert kept.columns["weight_kg"].tolist() == [900]
