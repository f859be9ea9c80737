import csv

import pytest

from radejax.core.errors import DataError
from radejax.data.kradar import KRadar, write
from radejax.data.kradar.conditions import (
    KRADAR_CONDITIONS,
    WEATHERS,
    read_description,
)
from radejax.data.kradar.dataset import read_calibration, read_split, split_by_rule


def test_conditions_of_the_published_sequences(shared):
    with open(shared / "data/kradar/sequences.csv") as file:
        rows = list(csv.DictReader(file))
    assert sorted(KRADAR_CONDITIONS) == [int(row["seq"]) for row in rows]
    for row in rows:
        found = KRADAR_CONDITIONS[int(row["seq"])]
        assert (found.environment, found.time, found.weather) == (
            row["environment"],
            row["time"],
            row["weather"],
        )
    assert {row["weather"] for row in rows} == set(WEATHERS)


def test_rule_gives_alternating_quarters():
    names = [f"{i:05d}_00000" for i in range(10)]  # cuts at 2, 5, 7
    assert split_by_rule(names, "train") == names[:2] + names[5:7]
    assert split_by_rule(reversed(names), "test") == names[2:5] + names[7:]


def test_rule_equals_the_official_split(shared):
    folder = shared / "data/kradar/split"
    splits = {s: read_split(folder / f"{s}.txt") for s in ("train", "test")}
    names = {}
    for sequence, name in splits["train"] + splits["test"]:
        names.setdefault(sequence, []).append(name)
    for split, frames in splits.items():
        ruled = [(s, n) for s in sorted(names) for n in split_by_rule(names[s], split)]
        assert ruled == sorted(frames)


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (
            read_calibration,
            "frame difference,x,y\n",
            r":2: '', expected three",
        ),
        (read_calibration, "", r":2: '', expected three"),
        (read_calibration, "h\n1,2", r":2: '1,2', expected three numbers"),
        (read_calibration, "h\n1.5,2,3", r":2: .* \(whole\)"),
        (read_calibration, "h\n1,nan,3", r":2: '1,nan,3'"),
        (read_description, "", r":1: '', expected 'environment"),
        (read_description, "urban,night", r":1: 'urban,night'"),
        (read_description, "urban,,fog", r":1: 'urban,,fog'"),
        (read_split, "1,00033_00001.txt\n1;x", r":2: '1;x', expected"),
    ],
)
def test_malformed_files_name_file_and_line(tmp_path, read, text, message):
    (tmp_path / "f.txt").write_text(text)
    with pytest.raises(DataError, match=r"f\.txt" + message):
        read(tmp_path / "f.txt")


@pytest.mark.parametrize(
    "read",
    [read_calibration, read_description, read_split],
)
def test_binary_files_are_data_errors(tmp_path, read):
    (tmp_path / "f.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match=r"f\.txt:1: byte 0xff is not UTF-8"):
        read(tmp_path / "f.txt")


def test_readers_accept_what_is_on_the_disks(tmp_path):
    path = tmp_path / "f.txt"
    path.write_bytes(b"frame difference,x,y\r\n 32, -2.54, 0.3\r\n")
    assert read_calibration(path) == (32, -2.54, 0.3)
    path.write_text("Urban, Day ,Normal")
    assert read_description(path).environment == "urban"
    path.write_text("1,00033_00001.txt\n2,00034_00002.txt")
    assert read_split(path) == [(1, "00033_00001"), (2, "00034_00002")]


def open_sequence(root, number=1):
    """A data set of one frame of a sequence."""
    labels = root / f"{number}/info_label/00004_00001.txt"
    write.write_labels(labels, (4, 1, 2, 1, 3), 0.5, [])
    return KRadar(root)


def test_own_files_come_first(tmp_path):
    write.write_calibration(tmp_path / "1/info_calib/calib_radar_lidar.txt", 3, -2, 0.5)
    camera = tmp_path / "calib/seq_01/cam_1.yml"
    camera.parent.mkdir(parents=True)
    camera.write_text("")
    for weather, count in (("fog", 0), ("fogg", 1)):
        write.write_description(tmp_path / "1/description.txt", "a", "b", weather)
        data = open_sequence(tmp_path)
        assert data[0].radar_from_lidar_m == (-2.0, 0.5, 0.0)
        assert data[0].weather == weather
        assert data[0].camera_calibration_path == camera
        assert len(data.summary().notes) == count
    assert "weather 'fogg' is none of K-Radar's: normal, " in data.summary().notes[0]


def test_missing_files_have_defaults_and_are_counted(tmp_path):
    data = open_sequence(tmp_path, 38)
    assert data[0].radar_from_lidar_m == (-2.54, 0.3, 0.0)
    assert data[0].weather == "fog"
    assert data[0].camera_calibration_path is None
    assert data.counts["sequences with the default calibration"] == 1
    assert data.counts["sequences with built-in conditions"] == 1
    assert data.summary().problem_counts()["calibration missing"] == 1
    # Without folders there is no file to miss.
    data = KRadar(labels=tmp_path)
    assert not data.summary().problems
    assert data.counts["sequences with the default calibration"] == 1


def test_a_root_of_symbolic_links(kradar_root, tmp_path):
    (tmp_path / "radar_grid.json").symlink_to(kradar_root / "radar_grid.json")
    for sequence in "12":
        (tmp_path / sequence).symlink_to(kradar_root / sequence)
    assert [f.key for f in KRadar(tmp_path)] == [f.key for f in KRadar(kradar_root)]
    assert KRadar(tmp_path)[0].tesseract_path is not None
