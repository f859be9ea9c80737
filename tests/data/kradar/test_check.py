import json
import math
import shutil

import numpy as np
import pytest
from PIL import Image

from radejax.core.errors import UserError
from radejax.data.kradar import KRadar, write
from radejax.data.kradar.check import check_dataset
from radejax.data.kradar.labels import Label

SEDAN = "expected about 4.61 x 2.18 x 1.91 m"


@pytest.fixture
def root(kradar_root, tmp_path):
    return shutil.copytree(kradar_root, tmp_path / "kradar")


def test_healthy_copy(root):
    report = check_dataset(root)
    assert report.num_problems == 0
    assert "no problems" in report.to_text()
    row = report.sequences[1]
    wanted = {"sequence": 2, "weather": "fog", "labels": 6, "train": 4, "test": 2}
    wanted |= {"tesseracts": 6, "radar_missing": 0, "radar_corrupted": 0}
    wanted |= {"calibration": "-2.5, 0.25"}
    assert {name: row[name] for name in wanted} == wanted
    rows = {(row["split"], row["weather"]): row for row in report.objects}
    counts = KRadar(root, split="train").class_counts()
    for cls, number in counts.items():
        assert rows["train", "fog"][cls] == rows["train", "all"][cls] == number
    plain = json.loads(json.dumps(report.to_dict()))
    assert plain["summary"]["num_problems"] == 0
    assert len(plain["sequences"]) == 2


def test_everything_that_is_wrong_is_named(root, caplog):
    tesseracts = root / "1/radar_tesseract"
    path = tesseracts / "tesseract_00005.mat"
    path.write_bytes(path.read_bytes()[:-5])
    (tesseracts / "tesseract_00006.mat").unlink()
    other = np.ones((2, 3, 4, 5), np.float32)
    write.write_tesseract(tesseracts / "tesseract_00007.mat", other)
    (root / "1/info_label/00008_00005.txt").write_text("nothing")
    with open(root / "1/info_label/00009_00006.txt", "a") as file:
        file.write("*, R, 9, Sedan, 1, 2\n")
    write.write_calibration(root / "2/info_calib/calib_radar_lidar.txt", 9, -2.5, 0.25)
    (root / "1/info_calib/calib_radar_lidar.txt").write_text("x\n1\n")
    (root / "1/description.txt").write_text("fog")
    train = [(1, f"{i + 3:05d}_{i:05d}") for i in range(1, 7)]
    test = [(1, "00004_00001"), (1, "00099_00096")]
    write.write_splits(root / "split", train, test)
    report = check_dataset([root])
    assert report.summary.problem_counts() == {
        "label file": 1,
        "label line": 1,
        "tesseract missing": 1,
        "split": 7,  # one frame in both, all of sequence 2 in none
        "label file missing": 1,
        "tesseract corrupted": 2,
        "calibration": 2,
        "description": 1,
    }
    text = report.to_text()
    for message in (
        "tesseract_00005.mat: truncated",
        "tesseract_00007.mat: arrDREA has shape (2, 3, 4, 5), expected",
        "no radar_tesseract/tesseract_00006.mat in",
        "00008_00005.txt:1: 'nothing' is not a header",
        "00009_00006.txt:",
        "calib_radar_lidar.txt:2: '1', expected three numbers",
        "frame difference 9, but radar minus LiDAR",
        "1/00004_00001: the first of 1 frames that are in both",
        "1/00099_00096: in split test but",
        f"{report.num_problems} problems",
    ):
        assert message in text
    assert report.sequences[0]["radar_corrupted"] == 2
    KRadar(root, split="train")
    assert "1/00004_00001: the first of 1 frames that are in both" in caplog.text
    data = KRadar(root)
    assert len(data) == 11
    assert data[0].radar_from_lidar_m == (-2.54, 0.3, 0.0)
    assert (data[0].time, data[0].weather) == ("night", "normal")  # of sequence 1
    found = {frame.header.radar: frame.tesseract_path for frame in data[:5]}
    assert found[6] is None
    assert found[4] is not None


@pytest.mark.parametrize(
    ("folder", "message"),
    [
        ("info_label", "sequences without labels: 2"),
        ("radar_tesseract", "sequences without radar data: 2"),
        ("cam-front", "sequences without images: 2"),
    ],
)
def test_a_sequence_that_lacks_what_others_have_is_listed(root, folder, message):
    for number in ("1", "2"):
        (root / number / "cam-front").mkdir()
        (root / number / "cam-front/cam-front_00005.png").touch()
    assert check_dataset(root).num_problems == 0
    shutil.rmtree(root / "2" / folder)
    (root / "2" / folder).write_text("../labels/2")  # a link that became a text file
    report = check_dataset(root)
    assert message in [text for kind, text in report.summary.problems]
    assert f"problem: sequences: 1\n    {message}\n" in report.to_text()
    counted = KRadar(root).counts["sequences without labels"]
    assert counted == (folder == "info_label")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda x, *box: (-x, *box), "objects out of view"),
        (lambda x, y, *box: (1e-3 * x, 1e-3 * y, *box), "objects out of view"),
        (lambda *box: (*box[:6], math.radians(box[6])), "yaw unit"),
        (lambda *box: (*box[:3], *(0.5 * v for v in box[3:6]), box[6]), "object sizes"),
        (lambda *box: (*box[:3], *(2 * v for v in box[3:6]), box[6]), "object sizes"),
        (lambda *box: (*box[:3], box[4], box[3], *box[5:]), "object sizes"),
    ],
)
def test_labels_in_other_units_are_reported_by_sequence(root, change, expected):
    boxes = [(20.0, y, 0.0, 4.5, 2.0, 1.8, yaw) for y, yaw in ((-3, 0), (3, 3.12))]

    def kinds(change):
        for path in root.glob("*/info_label/*.txt"):
            radar, lidar = map(int, path.stem.split("_"))
            labels = [Label("Sedan", tuple(change(*box))) for box in boxes]
            write.write_labels(path, (radar, lidar, 1, 1, 1), 1.0, labels)
        return check_dataset(root).summary.problem_counts()

    assert kinds(lambda *box: box) == {}
    assert kinds(change)[expected] == 2


def test_objects_that_cannot_be_meant_are_named_by_line(root):
    path = root / "1/info_label/00004_00001.txt"
    sizes = [(45, 2, 2), (4.5, 2, 0.1), (4.5, 2, 2), (4.4, 2, 2)]
    places = [(20, 0, 0), (30, 0, 0), (40, 0, 0), (40, 0.05, 0)]
    labels = [Label("Sedan", (*a, *b, 0)) for a, b in zip(places, sizes, strict=True)]
    write.write_labels(path, (4, 1, 1, 1, 1), 1.0, labels)
    problems = check_dataset(root).summary.problems
    assert problems == [
        ("object size", f"{path}:2: Sedan of 45 x 2 x 2 m, {SEDAN}"),
        ("object size", f"{path}:3: Sedan of 4.5 x 2 x 0.1 m, {SEDAN}"),
        ("object twice", f"{path}:5: Sedan at the center of another object"),
    ]
    assert len(KRadar(root)[0].labels) == 4


def test_values_are_read_only_if_asked(root):
    grid = KRadar(root).grid
    path = root / "1/DERA_tesseract/DERA_tesseract_00005.npy"
    path.parent.mkdir()
    np.save(path, np.full(grid.projection_shape, 0.5))
    assert check_dataset(root).num_problems == 0
    np.save(path, np.full(grid.shape_drea, 1e6))
    (message,) = check_dataset(root).to_dict()["summary"]["problems"]
    assert "00005.npy: shape (6, 16, 5, 12) of float64" in message
    np.save(path, np.full(grid.projection_shape, np.nan))
    assert check_dataset(root).num_problems == 0
    tesseract = np.ones((6, 16, 5, 12), np.float32)
    tesseract[0, 0, 0, 0] = np.nan
    tensor = root / "1/radar_tesseract/tesseract_00005.mat"
    write.write_tesseract(tensor, tesseract)
    assert check_dataset(root).num_problems == 0
    found = check_dataset(root, deep=True).summary.problem_counts()
    assert found == {"projection corrupted": 1, "tesseract corrupted": 1}


def test_an_image_that_is_not_complete_is_found_if_asked(root):
    number = KRadar(root)[0].header.camera_front
    path = root / f"1/cam-front/cam-front_{number:05d}.png"
    path.parent.mkdir(exist_ok=True)
    Image.new("RGB", (256, 72), "red").save(path)
    usual = check_dataset(root, deep=True).summary.problems
    path.write_bytes(path.read_bytes()[:90])
    assert check_dataset(root).summary.problems == usual
    found = check_dataset(root, deep=True).summary.problems
    ((kind, text),) = set(found) - set(usual)
    assert kind == "image or calibration"
    assert f"{path}: corrupted, not a readable image" in text


def test_no_frames_are_no_clean_bill(root):
    with pytest.raises(UserError, match="no frames of these sequences and weathers"):
        check_dataset(root, weather=["sleet"])
