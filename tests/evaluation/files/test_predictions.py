import json

import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.evaluation.files import predictions


@pytest.fixture
def scene(random_scene):
    return random_scene(2)


def assert_same(one, other):
    for column, values in other.items():
        np.testing.assert_array_equal(one[column], values)


@pytest.mark.parametrize("suffix", ["npz", "json", "csv"])
@pytest.mark.parametrize("by_key", [True, False])
def test_round_trip_is_exact(tmp_path, scene, suffix, by_key):
    truth, found, frames = scene
    for name, table, scored in (("p", found, True), ("t", truth, False)):
        path = tmp_path / f"{name}.{suffix}"
        predictions.write_table(path, table, frames if by_key else None)
        read = predictions.read_table(path, frames, scored=scored)
        assert_same(read, table)
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"p.{suffix}", f"t.{suffix}"]


@pytest.mark.parametrize("suffix", ["npz", "json", "csv"])
def test_empty_tables(tmp_path, scene, suffix):
    nothing = {k: v[:0] for k, v in scene[1].items()}
    path = tmp_path / f"p.{suffix}"
    predictions.write_table(path, nothing, scene[2])
    read = predictions.read_table(path, scene[2])
    assert read["box"].shape == (0, 7)
    assert read["frame"].dtype == np.int64


def test_keys_survive_another_selection_of_frames(tmp_path, scene):
    _, found, frames = scene
    predictions.write_table(tmp_path / "p.csv", found, frames)
    shifted = {**frames, "frame": frames["frame"] + 1000}
    read = predictions.read_table(tmp_path / "p.csv", shifted)
    np.testing.assert_array_equal(read["frame"], found["frame"] + 1000)


def test_frame_keys():
    ids = {"frame": np.array([4, 5])}
    assert predictions.frame_keys(ids) == ["4", "5"]
    named = {**ids, "name": np.array(["00033_00001.txt", "00034_00002"])}
    assert predictions.frame_keys(named) == ["00033_00001", "00034_00002"]
    named["sequence"] = np.array([1, 12])
    assert predictions.frame_keys(named) == ["1/00033_00001", "12/00034_00002"]
    named["name"] = np.array(["1/00033_00001", "12/00034_00002"])
    assert predictions.frame_keys(named) == ["1/00033_00001", "12/00034_00002"]


def test_json_in_its_three_forms(tmp_path):
    frames = {"frame": np.array([10, 11]), "name": np.array(["1/a", "1/b"])}
    box = [1, 2, 3, 4, 5, 6, 0.5]
    record = {"cls": "Sedan", "box": box, "score": 0.5}
    spelled = {"cls": "Sedan", "score": 0.5, **dict(zip("xyzlwh", box, strict=False))}
    forms = (
        [{"frame": "1/b", **record}],
        {"1/a": [], "1/b.txt": [record]},
        {"frame": [11], "cls": ["Sedan"], "box": [box], "score": [0.5]},
        [{"frame": 11, **spelled, "yaw": 0.5}],
    )
    for form in forms:
        path = tmp_path / "p.json"
        path.write_text(json.dumps(form))
        read = predictions.read_table(path, frames)
        assert_same(
            read,
            {"frame": [11], "cls": ["Sedan"], "box": [box], "score": [0.5]},
        )


def test_npz_with_class_indices(tmp_path):
    np.savez(
        tmp_path / "p.npz",
        frame=[0],
        box=np.ones((1, 7)),
        cls=[1],
        class_names=["Sedan", "Bicycle"],
        score=[0.5],
    )
    assert predictions.read_table(tmp_path / "p.npz")["cls"].tolist() == ["Bicycle"]


def test_wrong_files_are_named(tmp_path):
    frames = {"frame": np.array([0]), "name": np.array(["1/a"])}

    def raises(name, content, match, error=DataError):
        path = tmp_path / name
        path.write_bytes(content.encode())
        with pytest.raises(error, match=match):
            predictions.read_table(path, frames)

    header = "frame,cls,x,y,z,l,w,h,yaw,score\n"
    with pytest.raises(FileNotFoundError, match="no such file"):
        predictions.read_table(tmp_path / "none.csv")
    raises("a.txt", "", "cannot read '.txt'; known: .npz", UserError)
    raises("a.npz", "nonsense", "a.npz: corrupted, not a NumPy archive")
    raises("a.json", "{", "a.json is not valid JSON")
    raises("a.json", "[1]", "expected a list of objects")
    raises("a.json", '{"1/a": 3}', "frame '1/a': expected a list")
    raises("a.json", '[{"frame": 0, "cls": "Sedan"}]', "row 0, frame 0: box is")
    raises("a.json", '[{"frame": 0, "box": [1,2,3,4,5,6,7]}]', "row 0: lacks 'cls'")
    one = '{"frame": 0, "cls": "Sedan", "box": [1,2,3,4,5,6,7]'
    raises("a.json", f'[{one}, "score": 1}}, {one}}}]', "row 1: lacks 'score'")
    raises("a.json", f"[{one}}}]", r"lacks \['score'\]")
    raises(
        "a.json",
        f'[{one}, "score": "high"}}]',
        r"score\[0\] is 'high', expected a finite",
    )
    raises("a.csv", "frame,cls,x\n", "line 1: lacks columns \\['y', 'z'")
    raises("a.csv", header + "0,Sedan,1,2,3,4,5,6,x,1\n", "line 2: yaw is 'x'")
    raises("a.csv", header + "0,Sedan,1,2\n", "line 2: z is None")
    long = f"0,{'S' * 999},1,2,3,4,5,6,7,1\n"
    raises("a.csv", header + long, "line 2: 'SSS.* is no name: 999 characters")
    raises(
        "a.csv",
        header + "1/b,Sedan,1,2,3,4,5,6,7,1\n",
        "row 0: no frame '1/b' among the 1 frames",
    )
    with pytest.raises(UserError, match=r"cannot write '\.txt'"):
        predictions.write_table(tmp_path / "b.txt", {"frame": [], "box": [], "cls": []})
    (tmp_path / "a.csv").write_text(header + "1/b,Sedan,1,2,3,4,5,6,7,1\n")
    with pytest.raises(DataError, match="frames are named"):
        predictions.read_table(tmp_path / "a.csv")
