import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.evaluation import evaluate, kitti

CLASSES = ("Sedan", "Bus or Truck")


@pytest.fixture
def scene(random_scene):
    return random_scene(4)


def test_lines_as_the_official_tools_write_them(tmp_path):
    truth = {
        "frame": np.array([12, 12]),
        "box": np.array([[30.126, -2.3, 0.5, 4.2, 1.9, 1.6, -3.14159]] * 2),
        "cls": np.array(["Sedan", "Bus or Truck"]),
    }
    found = {
        "frame": np.array([12, 13]),
        "box": np.array([[30.5, -2.25, 0.125, 4.0, 2.0, 1.5, 0.1]] * 2),
        "cls": np.array(["Bicycle", "Sedan"]),
        "score": np.array([0.75, 0.5]),
    }
    frames = {
        "frame": np.array([13, 12]),
        "weather": np.array(["fog", "rain"]),
        "environment": np.array(["urban", "highway"]),
        "time": np.array(["day", "night"]),
    }
    assert kitti.write_kitti(tmp_path, truth, found, frames) == 1
    root = tmp_path / "0.0" / "all"
    assert (root / "gts/000001.txt").read_text() == (
        "sed 0.00 0 0 50 50 150 150 1.6 1.9 4.2 -2.3 0.5 30.13 -3.14\n"
        "bus 0.00 0 0 50 50 150 150 1.6 1.9 4.2 -2.3 0.5 30.13 -3.14\n"
    )
    assert (root / "preds/000001.txt").read_text() == (
        "bic -1 -1 0 50 50 150 150 1.5 2.0 4.0 -2.25 0.125 30.5 0.1 0.75\n"
    )
    assert (root / "desc/000001.txt").read_text() == "night\nhighway\nrain"
    assert (root / "val.txt").read_text() == "000001\n"
    for condition in ("rain", "highway", "night"):
        part = tmp_path / "0.0" / condition
        assert (part / "preds/000001.txt").is_file()
        assert (part / "val.txt").read_text() == "000001\n"
    assert not (tmp_path / "0.0" / "fog").exists()


def test_round_trip_gives_the_same_results(tmp_path, scene):
    truth, found, frames = scene
    written = kitti.write_kitti(tmp_path, truth, found, frames)
    truth2, found2, frames2 = kitti.read_kitti(tmp_path)
    assert written == np.unique(truth["frame"]).size == frames2["frame"].size
    for name in ("weather", "environment", "time"):
        np.testing.assert_array_equal(frames2[name], frames[name][frames2["frame"]])
    np.testing.assert_array_equal(truth2["box"], np.round(truth["box"], 2))
    for protocol in ("kradar_r40", "kradar_r11", "kradar_r40_corrected"):
        terms = {"classes": CLASSES, "protocol": protocol, "iou_thresholds": (0.3, 0.5)}
        one = evaluate(truth, found, frames=frames, **terms)
        other = evaluate(truth2, found2, frames=frames2, **terms)
        assert [r.ap for r in one] == [r.ap for r in other]
    part, _, _ = kitti.read_kitti(tmp_path / "0.0" / "fog")
    in_fog = frames["weather"][truth["frame"]] == "fog"
    assert part["cls"].size == in_fog.sum()


def test_score_cut_and_dummy_lines(tmp_path, scene):
    truth, found, frames = scene
    kitti.write_kitti(tmp_path, truth, found, frames, score_threshold=0.5)
    assert [p.name for p in tmp_path.iterdir()] == ["0.5"]
    _, read, _ = kitti.read_kitti(tmp_path / "0.5")
    with_truth = np.isin(found["frame"], truth["frame"])
    assert read["score"].size == ((found["score"] > 0.5) & with_truth).sum()
    kitti.write_kitti(tmp_path, truth, found, frames, score_threshold=0.95)
    lines = {p.read_text().strip() for p in (tmp_path / "0.95/all/preds").iterdir()}
    assert lines == {kitti.DUMMY}
    _, nothing, _ = kitti.read_kitti(tmp_path / "0.95" / "all")
    assert nothing["box"].shape == (0, 7)


def test_errors(tmp_path, scene):
    truth, found, frames = scene
    with pytest.raises(UserError, match="has no folder 'preds'"):
        kitti.read_kitti(tmp_path)
    for cut in (0.0, 0.3):
        kitti.write_kitti(tmp_path, truth, found, frames, score_threshold=cut)
    with pytest.raises(UserError, match=r"several score thresholds \(0.0, 0.3\)"):
        kitti.read_kitti(tmp_path)
    strange = {**truth, "cls": np.full(len(truth["cls"]), "Tram")}
    with pytest.raises(UserError, match="no key for class 'Tram'"):
        kitti.write_kitti(tmp_path / "b", strange, found, frames)
    path = next((tmp_path / "0.0/all/preds").iterdir())
    start = "sed -1 -1 0 50 50 150 150 1 1"
    for text, message in (
        (f"{start} 1 0 0 0 0", "line 1: 15 fields, expected 16"),
        (f"\n{start} one 0 0 0 0 0.5", "line 2: could not convert"),
        (f"{'s' * 20000}{start[3:]} 1 0 0 0 0 0.5", "line 1: unknown class 's{79}"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=f"{path.name}: {message}"):
            kitti.read_kitti(tmp_path / "0.0")
    path.rename(path.with_name("first.txt"))
    with pytest.raises(DataError, match="named by its number"):
        kitti.read_kitti(tmp_path / "0.0")


def test_a_reports_own_files_are_written(tmp_path, scene, write_table):
    truth, found, frames = scene
    for name, table in (("truth", truth), ("found", found)):
        write_table(tmp_path / f"{name}.npz", table, frames)
    by_key = [dict(np.load(tmp_path / f"{name}.npz")) for name in ("truth", "found")]
    assert by_key[0]["frame"].dtype.kind == "U"
    count = kitti.write_kitti(tmp_path / "by_key", *by_key, frames)
    assert count == kitti.write_kitti(tmp_path / "by_id", truth, found, frames) > 1
    for path in (tmp_path / "by_id").rglob("*.txt"):
        other = tmp_path / "by_key" / path.relative_to(tmp_path / "by_id")
        assert path.read_text() == other.read_text()
    wrong = {**truth, "frame": truth["frame"] + 10**6}
    with pytest.raises(DataError, match=r"ground truth: frame 10000.*no such frame"):
        kitti.write_kitti(tmp_path / "wrong", wrong, found, frames)
    none = {name: column[:0] for name, column in truth.items()}
    with pytest.raises(UserError, match="no frame has ground truth"):
        kitti.write_kitti(tmp_path / "none", none, found, frames)
