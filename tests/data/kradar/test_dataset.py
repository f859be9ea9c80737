import json
import math
import shutil

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.core.structures import CLASSES
from radejax.data.kradar import KRadar, write
from radejax.data.kradar.labels import LABEL_CLASSES, Label

NAME = "00004_00001"


def write_frame(root, labels, version="v2.1"):
    path = root / f"1/info_label/{NAME}.txt"
    write.write_labels(path, (4, 1, 2, 1, 3), 0.5, labels, version)


def sedan(x, y, visibility="R", cls="Sedan"):
    return Label(cls, (x, y, 0.5, 4.0, 2.0, 1.5, 0.25), visibility, 0)


# Numbers worked out by hand --------------------------------------------------------


def test_offset_and_filters(tmp_path):
    labels = [sedan(10.0, 1.0), sedan(20.0, 1.0, "L"), sedan(30.0, 1.0, "LL")]
    labels += [
        sedan(2.0, 1.0),  # x = -0.5 in the radar frame
        sedan(12.5, 20.0),  # 63 degrees to the left
        sedan(120.5, 0.0),  # 118.0003 m away
    ]
    labels += [sedan(40.0, 1.0, cls="Pedestrian Group"), sedan(50, -2, cls="Bicycle")]
    write_frame(tmp_path, labels)
    path = tmp_path / "1/info_calib/calib_radar_lidar.txt"
    write.write_calibration(path, 3, -2.5, 0.25)
    data = KRadar(tmp_path)
    (frame,) = data
    expected = [[x, y, 0.5, 4, 2, 1.5, 0.25] for x, y in ((7.5, 1.25), (47.5, -1.75))]
    np.testing.assert_allclose(frame.boxes, expected, rtol=1e-15)
    assert frame.boxes.dtype == np.float64
    assert frame.classes.tolist() == ["Sedan", "Bicycle"]
    assert frame.radar_from_lidar_m == (-2.5, 0.25, 0.0)
    assert len(frame.labels) == 8
    counts = {
        "objects left out by class": 1,
        "objects left out by visibility": 2,
        "objects left out by field of view": 3,
        "objects with an odd availability flag": 1,
        "objects kept": 2,
    }
    assert data.counts.items() >= counts.items()
    assert data.class_counts() == dict(zip(CLASSES, [1, 0, 0, 0, 1], strict=True))


def test_filters_can_be_changed(tmp_path):
    write_frame(tmp_path, [sedan(2.0, 1.0, "L1"), sedan(9, 0, cls="Bicycle Group")])
    every = {"visibility": None, "classes": LABEL_CLASSES, "field_of_view": False}
    everything = KRadar(tmp_path, **every)
    assert len(everything[0].boxes) == 2
    assert everything[0].columns["visibility"].tolist() == ["L1", "R"]
    write.write_calibration(tmp_path / "1/info_calib/calib_radar_lidar.txt", 3, 5.0, -1)
    shifted = KRadar(tmp_path, visibility=("L1",))
    np.testing.assert_allclose(shifted[0].boxes[:, :3], [[7.0, 0.0, 0.5]])
    assert KRadar(tmp_path, visibility={"L1"}).counts == shifted.counts


def test_lines_without_a_star_count_where_they_are_to(tmp_path):
    write_frame(tmp_path, [sedan(10, 0), sedan(20, 0)], "v1.1")
    path = tmp_path / f"1/info_label/{NAME}.txt"
    path.write_text(path.read_text().replace("\n*,", "\n#,", 1))
    kept = KRadar(tmp_path, version="v1.1")
    assert (kept.class_counts()["Sedan"], len(kept)) == (1, 1)
    assert kept.counts["disabled objects (no leading *)"] == 1
    released = KRadar(tmp_path, version="v1.1", include_unstarred_v11_labels=True)
    assert released.class_counts()["Sedan"] == 2
    assert not released.counts["disabled objects (no leading *)"]


def test_frame_knows_its_files(kradar_root):
    data = KRadar(kradar_root, split="train", camera_calibration=kradar_root)
    assert len(data) == 8
    frame = data[4]
    assert frame.key == "2/00004_00001"
    assert (frame.environment, frame.time, frame.weather) == ("urban", "day", "fog")
    folder = kradar_root / "2/radar_tesseract"
    assert frame.tesseract_path == folder / "tesseract_00004.mat"
    assert frame.camera_path is None
    assert frame.camera_calibration_path is None
    assert data.grid.shape_drea == (6, 16, 5, 12)
    assert [f.key for f in data[:2]] == ["1/00004_00001", "1/00005_00002"]
    assert data.counts["frames without front image"] == 8
    assert not data.summary().problems
    with pytest.raises(FileNotFoundError, match=r"no os2-64/os2-64_00001\.pcd in any"):
        data.lidar_path(frame)


def test_the_header_names_the_files_of_a_frame(tmp_path):
    write_frame(tmp_path, [])  # radar 4, LiDAR 1, camera 2
    image = tmp_path / "1/cam-front/cam-front_00002.png"
    npy = tmp_path / "1/DERA_tesseract/DERA_tesseract_00004.npy"
    scan = tmp_path / "1/os2-64/os2-64_00001.pcd"
    for path in (image, npy, scan):
        path.parent.mkdir()
        path.touch()
    (frame,) = data = KRadar(tmp_path)
    found = frame.camera_path, frame.projection_path, data.lidar_path(frame)
    assert found == (image, npy, scan)


# What is missing or malformed -------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: KRadar(None), "no sequence folders"),
        (lambda root: KRadar(root / "no_labels"), r"no v2\.1 labels in the sequence fold"),
        (lambda root: KRadar(root / "none"), "none"),
        (lambda root: KRadar(root, version="v9"), "version 'v9' does not exist"),
        (lambda root: KRadar(root, split="validation"), "'validation' is neither 'train',"),
        (lambda root: KRadar(root, classes=("Car",)), r"is \('Car',\), expected di"),
        (lambda root: KRadar(root, weather=("mist",)), r"unknown weather \('mist',\)"),
        (lambda root: KRadar(root, sequences=[9]), r"no labels .*\[9\]; .*\[1\]"),
        (lambda root: KRadar(root), r"not an object of v2\.1 .*--config\.data\.label_vers"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_error(tmp_path, call, message):
    root = tmp_path / "root"
    write_frame(root, [sedan(10, 0), sedan(20, 0)], "v2.0")
    (root / "no_labels/1").mkdir(parents=True)
    with pytest.raises((UserError, FileNotFoundError), match=message):
        call(root)
    assert len(KRadar(root, version="v2.0")[0].boxes) == 2


# The reference data -----------------------------------------------------------------


def test_parsed_objects_equal_the_reference(shared, tmp_path):
    folder = shared / "fixtures/ground_truth"
    fixture = json.loads((folder / "label_parsing.json").read_text())
    calibration = (folder / fixture["calib_file"]).read_bytes()
    for number, case in enumerate(fixture["cases"]):
        root = tmp_path / str(number)
        (root / "1/info_label").mkdir(parents=True)
        (root / "1/info_calib").mkdir()
        path = root / "1/info_calib/calib_radar_lidar.txt"
        path.write_bytes(calibration)
        if not case["calibrated"]:
            write.write_calibration(path, 32, 0.0, 0.0)
        shutil.copy(folder / case["file"], root / "1/info_label/00033_00001.txt")
        visibility = ("R",) if case["radar_only"] else ("R", "L")
        (frame,) = KRadar(root, version=case["version"], visibility=visibility)
        boxes, classes, flags = frame.boxes, frame.classes, frame.columns["visibility"]
        if case["narrow_roi_filter"]:
            x, y, z = boxes[:, :3].T
            rows = (x >= 0) & (x <= 72) & (abs(y) <= 6.4) & (z >= -2) & (z <= 6)
            boxes, classes, flags = boxes[rows], classes[rows], flags[rows]
        wanted = case["objects"]
        assert classes.tolist() == [o["class"] for o in wanted]
        assert flags.tolist() == [o["avail"] for o in wanted]
        values = np.array([o["values"] for o in wanted]).reshape(-1, 7)
        np.testing.assert_array_equal(boxes[:, [0, 1, 2, 6, 3, 4, 5]], values)


def test_published_counts_of_the_training_split(shared):
    data = KRadar(labels=shared / "data/kradar/labels_v2_1.zip", split="train")
    assert len(data) == 17458
    assert list(data.class_counts().values()) == [28074, 5800, 2318, 190, 586]
    counts = data.summary().counts
    assert counts["objects in the label files"] == 60012
    assert counts["objects left out by visibility"] == 22909
    boxes = np.concatenate([frame.boxes for frame in data])
    classes = np.concatenate([frame.classes for frame in data])
    x, y, z = boxes[:, :3].T
    ahead = (x >= 0) & (x <= 72)
    narrow = ahead & (abs(y) <= 6.4) & (z >= -2) & (z <= 6)
    wide = ahead & (abs(y) <= 16) & (z >= -2) & (z <= 7.6)
    found = [
        [(classes[part] == cls).sum() for cls in CLASSES] for part in (narrow, wide)
    ]
    assert found == [[19782, 4177, 1813, 160, 565], [25089, 5154, 2304, 190, 586]]
    assert sum(len(frame.boxes) > 0 for frame in data) == 14593
    assert data.counts["sequences with the default calibration"] == 58
    assert data.summary().problem_counts() == {"object size": 3, "object twice": 11}


@pytest.mark.slow
def test_all_real_label_files_are_read(shared):
    everything = {"visibility": None, "classes": LABEL_CLASSES, "field_of_view": False}
    data = KRadar(labels=shared / "data/kradar/labels_v2_1.zip", **everything)
    assert len(data) == 34994
    assert data.summary().problem_counts() == {"object size": 25, "object twice": 26}
    assert data.counts["frames without objects"] == 4307
    assert data.counts["objects with an odd availability flag"] == 3
    assert data.counts["files named unlike their header"] == 0
    assert max(len(frame.boxes) for frame in data) == 25
    boxes = np.concatenate([frame.boxes for frame in data])
    assert int((boxes[:, 0] < 0).sum()) == 8580
    assert int((boxes[:, 3] < boxes[:, 4]).sum()) == 2405
    assert int((np.abs(boxes[:, 6]) > math.pi).sum()) == 3218


def test_parts_of_the_frames_are_counted(kradar_root, tmp_path):
    data = KRadar(kradar_root)
    rest = data.without({data[0].key, "9/x"}, "no record of them")
    assert [frame.key for frame in rest] == [frame.key for frame in data][1:]
    assert rest.counts["frames left out: no record of them"] == 1
    assert "frames left out: no record of them" not in data.counts
    root = shutil.copytree(kradar_root, tmp_path / "kradar")
    write.write_description(root / "2/description.txt", "urban", "day", "rain")
    data = KRadar(root, weather=["rain"])
    assert {frame.sequence for frame in data} == {2}
    assert data.counts["frames left out by weather"] == 6
    assert len(KRadar(root, weather=("fog", "rain"))) == 12
