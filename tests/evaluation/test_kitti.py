import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.evaluation import evaluate, kitti

from .scenes import random_scene

TRUTH, FOUND, FRAMES = random_scene(4)


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
    texts = {
        "gts/000001.txt": "sed 0.00 0 0 50 50 150 150 1.6 1.9 4.2 -2.3 0.5 30.13 -3.14\n"
        "bus 0.00 0 0 50 50 150 150 1.6 1.9 4.2 -2.3 0.5 30.13 -3.14\n",
        "preds/000001.txt": "bic -1 -1 0 50 50 150 150 1.5 2.0 4.0 -2.25 0.125 30.5 0.1 "
        "0.75\n",
        "desc/000001.txt": "night\nhighway\nrain",
        "val.txt": "000001\n",
    }
    for condition in ("all", "rain", "highway", "night"):
        for name, text in texts.items():
            assert (tmp_path / "0.0" / condition / name).read_text() == text
    assert not (tmp_path / "0.0" / "fog").exists()


def test_round_trip_gives_the_same_results(tmp_path):
    written = kitti.write_kitti(tmp_path, TRUTH, FOUND, FRAMES)
    truth, found, frames = kitti.read_kitti(tmp_path)
    assert written == np.unique(TRUTH["frame"]).size == frames["frame"].size
    for name in ("weather", "environment", "time"):
        np.testing.assert_array_equal(frames[name], FRAMES[name][frames["frame"]])
    np.testing.assert_array_equal(truth.box, np.round(TRUTH["box"], 2))
    for protocol in ("kradar_r40", "kradar_r11", "kradar_r40_corrected"):
        terms = {"protocol": protocol, "iou_thresholds": (0.3, 0.5)}
        one = evaluate(TRUTH, FOUND, frames=FRAMES, **terms)
        other = evaluate(truth, found, frames=frames, **terms)
        assert [r.ap for r in one] == [r.ap for r in other]
    part, _, _ = kitti.read_kitti(tmp_path / "0.0" / "fog")
    assert len(part) == (FRAMES["weather"][TRUTH["frame"]] == "fog").sum()


def test_a_frame_with_equal_tags_is_listed_once(tmp_path):
    unknown = dict.fromkeys(kitti.DESCRIPTION, np.full(12, "unknown"))
    kitti.write_kitti(tmp_path, TRUTH, FOUND, {**FRAMES, **unknown})
    parts = (tmp_path / "0.0" / part for part in ("all", "unknown"))
    listed, again = ((part / "val.txt").read_text() for part in parts)
    assert listed == again


def test_score_threshold_and_dummy_lines(tmp_path):
    kitti.write_kitti(tmp_path, TRUTH, FOUND, FRAMES, score_threshold=0.5)
    assert [p.name for p in tmp_path.iterdir()] == ["0.5"]
    _, read, _ = kitti.read_kitti(tmp_path / "0.5")
    with_truth = np.isin(FOUND["frame"], TRUTH["frame"])
    assert len(read) == ((FOUND["score"] > 0.5) & with_truth).sum()
    kitti.write_kitti(tmp_path, TRUTH, FOUND, FRAMES, score_threshold=0.95)
    lines = {p.read_text().strip() for p in (tmp_path / "0.95/all/preds").iterdir()}
    assert lines == {kitti.DUMMY}
    assert len(kitti.read_kitti(tmp_path / "0.95" / "all")[1]) == 0


def test_files_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(UserError, match="has no folder 'preds'"):
        kitti.read_kitti(tmp_path)
    for threshold in (0.0, 0.3):
        kitti.write_kitti(tmp_path, TRUTH, FOUND, FRAMES, score_threshold=threshold)
    with pytest.raises(UserError, match=r"several score thresholds \(0.0, 0.3\)"):
        kitti.read_kitti(tmp_path)
    path = next((tmp_path / "0.0/all/preds").iterdir())
    start = "sed -1 -1 0 50 50 150 150 1 1"
    for text, message in (
        (f"{start} 1 0 0 0 0", "line 1: 15 fields, expected 16"),
        (f"{'s' * 20000}{start[3:]} 1 0 0 0 0 0.5", "line 1: unknown class 's{79}"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=f"{path.name}: {message}"):
            kitti.read_kitti(tmp_path / "0.0")
    path.rename(path.with_name("first.txt"))
    with pytest.raises(DataError, match="named by its number"):
        kitti.read_kitti(tmp_path / "0.0")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cls": np.full(30, "Tram")}, "no key for class 'Tram'"),
        ({k: v[:0] for k, v in TRUTH.items()}, "no frame has ground truth"),
    ],
)  # fmt: skip
def test_ground_truth_that_cannot_be_written_is_named(tmp_path, change, message):
    with pytest.raises((DataError, UserError), match=message):
        kitti.write_kitti(tmp_path, {**TRUTH, **change}, FOUND, FRAMES)
