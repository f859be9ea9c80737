import dataclasses
import types

import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.evaluation.files import load, predictions
from radejax.evaluation.files.load import Source


def test_ground_truth_has_to_come_from_somewhere(stored):
    folder, source = stored
    with pytest.raises(UserError, match="say where the ground truth is"):
        load.load(folder / "found.json", Source(), ("Sedan",))
    with pytest.raises(FileNotFoundError, match=r"none\.json"):
        load.load(folder / "none.json", source, ("Sedan",))
    (folder / "frames.json").write_text("[]")
    with pytest.raises(
        DataError, match=r"frames\.json: it is \[\], expected an object"
    ):
        load.load(folder / "found.json", source, ("Sedan",))
    (folder / "frames.json").write_text('{"frame": [1, 2], "name": ["a"]}')
    with pytest.raises(DataError, match="column 'name' has 1 entries for 2 frames"):
        load.load(folder / "found.json", source, ("Sedan",))


def test_ground_truth_by_id_without_a_frame_table(random_scene, tmp_path):
    truth, found, _ = random_scene(8)
    predictions.write_table(tmp_path / "found.npz", found)
    predictions.write_table(tmp_path / "truth.npz", truth)
    source = Source(ground_truth=str(tmp_path / "truth.npz"))
    _, _, frames, _ = load.load(tmp_path / "found.npz", source, ("Sedan",))
    both = np.union1d(truth["frame"], found["frame"])
    np.testing.assert_array_equal(frames["frame"], both)


def test_ground_truth_of_a_report(stored):
    folder, source = stored
    expected = load.load(folder / "found.json", source, ("Sedan",))
    beside = dataclasses.replace(source, frames=None)
    truth = predictions.read_table(folder / "truth.csv", expected[2], scored=False)
    report = folder / "run" / "evaluation"
    report.mkdir(parents=True)
    predictions.write_table(report / "ground_truth.npz", truth, expected[2])
    (report / "frames.json").write_bytes((folder / "frames.json").read_bytes())
    for place in (folder / "truth.csv", report, report.parent):
        other = dataclasses.replace(beside, ground_truth=str(place))
        found = load.load(folder / "found.json", other, ("Sedan",))
        for a, b in zip(found[:3], expected[:3], strict=True):
            assert a.keys() == b.keys()
            for name in a:
                np.testing.assert_array_equal(a[name], b[name])


def test_a_part_of_the_frames(stored, random_scene):
    folder, source = stored
    _, _, whole, _ = load.load(folder / "found.json", source, ("Sedan",))
    part = dataclasses.replace(source, weather=("fog", "rain"))
    truth, found, frames, _ = load.load(folder / "found.json", part, ("Sedan",))
    chosen = whole["frame"][np.isin(whole["weather"], ("fog", "rain"))]
    assert 0 < chosen.size < whole["frame"].size
    np.testing.assert_array_equal(frames["frame"], chosen)
    for table in (truth, found):
        assert set(table["frame"]) <= set(chosen.tolist())
        assert len(table["box"]) == len(table["frame"]) > 0
    none = dataclasses.replace(source, sequences=(77,))
    with pytest.raises(UserError, match="no frames of sequence 77; there are "):
        load.load(folder / "found.json", none, ("Sedan",))


def test_labels_of_kradar(shared, tmp_path):
    folder = shared / "data" / "kradar"
    source = Source(labels=str(folder / "labels_v2_1.zip"), split="test")
    first = (folder / "split" / "test.txt").read_text().splitlines()[0]
    header = "frame,cls,x,y,z,l,w,h,yaw,score\n"
    line = f"{first.replace(',', '/')},Sedan,20,0,0,4,2,1.5,0,0.5\n"
    (tmp_path / "p.csv").write_text(header + line)
    truth, found, frames, left_out = load.load(tmp_path / "p.csv", source, ("Sedan",))
    assert frames["frame"].size == 17536
    assert found["frame"].tolist() == [0]
    assert truth["frame"].size > 10000
    assert any(name.startswith("labels: ") for name in left_out)


def test_tables_from_frames():
    frame = types.SimpleNamespace(
        sequence=3,
        name="00001_00001",
        weather="fog",
        environment="urban",
        time="day",
        boxes=np.ones((2, 7)),
        classes=["Sedan", "Bicycle"],
        is_simulated=False,
    )
    empty = types.SimpleNamespace(
        **{**vars(frame), "boxes": np.zeros((0, 7)), "classes": [], "weather": "rain"}
    )
    truth, table = load.tables_from_frames([empty, frame])
    assert truth["frame"].tolist() == [1, 1]
    assert truth["cls"].tolist() == ["Sedan", "Bicycle"]
    assert table["weather"].tolist() == ["rain", "fog"]
    none, _ = load.tables_from_frames([])
    assert none["box"].shape == (0, 7)
