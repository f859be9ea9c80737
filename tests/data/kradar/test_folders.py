import csv
import dataclasses
import zipfile

import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.kradar import KRadar, conditions, folders, write
from radejax.data.kradar.folders import read_calibration, read_split
from radejax.geometry.radar_grid import RadarGrid

LABEL = "00004_00001"
HEADER = (
    "* idx(tesseract_os2-64_cam-front_os1-128_cam-lrr)=00004_00001_00002_00003_00004, "
    "timestamp=1643292946.710046076"
)


def open_sequence(root, number=1, **options):
    """A dataset of one frame of a sequence."""
    touch(root / f"{number}/info_label/{LABEL}.txt", HEADER)
    return KRadar(root, **options)


def touch(path, text="x"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


# Sequences and their labels ---------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "folder"),
    [("v1.0", "info_label"), ("v2.0", "info_label_v2"), ("v2.1", "info_label")],
)
def test_own_labels_by_version(tmp_path, version, folder):
    touch(tmp_path / f"3/info_label/{LABEL}.txt")
    touch(tmp_path / f"3/info_label_v2/{LABEL}.txt")
    touch(tmp_path / "3/info_label/readme.txt")
    found = folders.find_own_labels(folders.find_sequences([tmp_path]), version)
    assert found == {(3, LABEL): tmp_path / f"3/{folder}/{LABEL}.txt"}


def test_own_labels_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("10_7", "9_6"):
        touch(tmp_path / f"1/info_label/{name}.txt")
    found = folders.find_own_labels(folders.find_sequences([tmp_path]), "v2.1")
    assert list(found) == [(1, "00009_00006"), (1, "00010_00007")]


LAYOUTS = ("{}/{}.txt", "KRadar_revised_visibility/{}/{}.txt")
LAYOUTS += ("{}_info_label_revised/{}.txt", "labels/{}/info_label/{}.txt")


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("zipped", [False, True])
def test_label_revisions_in_their_layouts(tmp_path, layout, zipped):
    names = [layout.format(12, LABEL), layout.format(3, LABEL), "readme.txt"]
    path = tmp_path / ("labels.zip" if zipped else "labels")
    if zipped:
        with zipfile.ZipFile(path, "w") as archive:
            for name in names:
                archive.writestr(name, name)
    else:
        for name in names:
            touch(path / name, name)
    found = folders.find_labels(path)
    assert list(found) == [(3, LABEL), (12, LABEL)]
    assert found[12, LABEL].read_text() == names[0]
    assert str(found[3, LABEL]) == f"{path}/{names[1]}"


def test_bad_label_sources(tmp_path):
    with pytest.raises(FileNotFoundError, match="none"):
        folders.find_labels(tmp_path / "none")
    with pytest.raises(DataError, match="not a folder or a zip file of labels"):
        folders.find_labels(touch(tmp_path / "labels.txt"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no label files in it"):
        folders.find_labels(tmp_path / "empty")


def test_a_frame_twice_names_both(tmp_path):
    for folder in ("1", "01", "a/1"):
        touch(tmp_path / f"labels/{folder}/{LABEL}.txt")
    both = rf"frame 1/{LABEL} is there twice, as .*01/{LABEL}\.txt and .*1/{LABEL}\.txt"
    with pytest.raises(DataError, match=both):
        folders.find_labels(tmp_path / "labels")
    for name in ("1", "01"):
        touch(tmp_path / f"root/{name}/description.txt")
    with pytest.raises(DataError, match=r"sequence 1 is there twice, as .*01 and .*1:"):
        folders.find_sequences([tmp_path / "root"])


def test_one_bad_member_leaves_the_others(tmp_path):
    path = tmp_path / "labels.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"1/{LABEL}.txt", HEADER)
        archive.writestr("1/00005_00002.txt", bytes(2 << 20))
        archive.writestr("1/00006_00003.txt", HEADER + "\n")
    content = bytearray(path.read_bytes())
    content[content.rindex(b"PK\x01\x02") + 8] |= 1  # encrypted
    path.write_bytes(content)
    data = KRadar(labels=path)
    assert [frame.name for frame in data] == [LABEL]
    (_, bomb), (_, encrypted) = data.summary().problems
    assert "labels.zip/1/00005_00002.txt: more than 262144 bytes" in bomb
    assert "labels.zip/1/00006_00003.txt: corrupted" in encrypted
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(DataError, match=r"labels\.zip: corrupted, not a folder or a"):
        KRadar(labels=path)


def test_links_other_spellings_and_an_archive_of_another_system(tmp_path, kradar_root):
    root, links = tmp_path / "root", tmp_path / "links"
    touch(root / "05/info_label/4_1.txt", HEADER)
    touch(root / "split/train.txt", "05,4_1.txt")
    links.mkdir()
    (links / "05").symlink_to(root / "05")
    for place, split in ((root, "train"), (links, None)):
        assert [frame.key for frame in KRadar(place, split=split)] == ["5/00004_00001"]
    assert list(folders.find_labels(links)) == [(5, LABEL)]
    touch(root / f"05/info_label/{LABEL}.txt", HEADER)
    with pytest.raises(DataError, match=rf"frame 5/{LABEL} is there twice, as"):
        KRadar(root)
    path = tmp_path / "labels.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"labels\\7\\{LABEL}.txt", HEADER)
        archive.writestr(f"__MACOSX/labels/7/._{LABEL}.txt", "x")
        archive.writestr("labels/7/.DS_Store", "x")
    assert [frame.key for frame in KRadar(labels=path)] == [f"7/{LABEL}"]


# Files of a whole dataset ----------------------------------------------------------


def test_split_files_and_camera_calibration_are_found(tmp_path):
    touch(tmp_path / "b/resources/split/test.txt", f"3,{LABEL}.txt")
    common = touch(tmp_path / "a/calib/common/cam_front0.yml")
    own = touch(tmp_path / "c/calib_seq_v2/seq_03/cam_1.yml")
    for number in (3, 4):
        open_sequence(tmp_path / "a", number)
    (tmp_path / "b/3").mkdir()
    roots, text = [tmp_path / "a", tmp_path / "b"], "sequences with the common camera"
    assert [frame.sequence for frame in KRadar(roots, split="test")] == [3]
    for is_common, wanted in ((False, [own, common]), (True, [common, common])):
        data = KRadar(roots, camera_calibration=tmp_path / "c", common_camera=is_common)
        assert [frame.camera_calibration_path for frame in data] == wanted
        assert data.counts[f"{text} calibration"] == wanted.count(common)
    data = open_sequence(tmp_path / "d", 4)
    assert data[0].camera_calibration_path is None
    assert data.counts["sequences without camera calibration"] == 1


def test_split_files_of_several_roots_are_merged(tmp_path):
    a, b, c = roots = [tmp_path / name for name in "abc"]
    for number, root in enumerate(roots, 1):
        open_sequence(root, number)
    touch(a / "split/train.txt", f"1,{LABEL}.txt")
    touch(a / "split/test.txt", "")
    touch(b / "resources/split/test.txt", f"2,{LABEL}.txt")
    touch(tmp_path / "split/train.txt", f"3,{LABEL}.txt")

    def sequences(split, labels=None, folders=roots):
        return [f.sequence for f in KRadar(folders, labels, split=split)]

    assert sequences("train") == [1]
    assert sequences("test") == [2]
    # The files next to the labels are read if no root has any.
    labels = touch(tmp_path / f"labels/3/{LABEL}.txt", HEADER).parents[1]
    assert sequences("train", labels, [c]) == [3]
    assert sequences("train", labels) == []
    touch(c / "split/train.txt", f"3,{LABEL}.txt\n2,{LABEL}.txt")
    assert sequences("train") == [1, 2, 3]
    problems = KRadar(roots, split="test").summary().problems
    (message,) = [text for kind, text in problems if kind == "split"]
    assert message.startswith(f"2/{LABEL}: the first of 1 frames that are in both")
    assert f"{a}/split/train.txt, {c}/split/train.txt and {a}/split/test.txt" in message


def test_height_of_the_radar_is_kradars_or_the_simulations(tmp_path):
    text = '{"config": {"radar_from_lidar_m": [-2.54, 0.3, %s]}}'
    assert open_sequence(tmp_path / "a")[0].radar_from_lidar_z_m == 0.7
    touch(tmp_path / "b/simulation.json", text % 0.2)
    data = open_sequence(tmp_path / "b")
    assert data[0].radar_from_lidar_z_m == 0.2
    assert data.is_simulated
    touch(tmp_path / "a/simulation.json", text % 0.7)
    with pytest.raises(DataError, match=r"a/simulation.json and .* differ"):
        KRadar([tmp_path / "a", tmp_path / "b"])
    touch(tmp_path / "b/simulation.json", '{"config": {"radar_from_lidar_m": [1]}}')
    with pytest.raises(DataError, match=r"simulation\.json: corrupted"):
        open_sequence(tmp_path / "b")


def test_grid_of_the_roots(tmp_path):
    grid = RadarGrid.reduced(num_doppler=4, num_range=8, num_elevation=3, num_azimuth=7)
    a, b = tmp_path / "a", tmp_path / "b"
    assert open_sequence(a).grid == RadarGrid.kradar()
    write.write_grid(a, grid)
    open_sequence(b)
    assert KRadar([a, b]).grid == grid
    write.write_grid(b, dataclasses.replace(grid, fov_range_m=50.0))
    with pytest.raises(DataError, match="datasets of different sensors"):
        KRadar([a, b])
    for text in ('{"range_m": 3}', "[" * 100_000, "9" * 5000, '{"range_m": 1e400}'):
        touch(b / "radar_grid.json", text)
        with pytest.raises(DataError, match=r"radar_grid\.json"):
            KRadar(b)


# Files of a sequence ----------------------------------------------------------------


def test_conditions_of_the_published_sequences(shared):
    with open(shared / "data/kradar/sequences.csv") as file:
        rows = {int(row["seq"]): row for row in csv.DictReader(file)}
    for number, row in rows.items():
        published = row["environment"], row["time"], row["weather"]
        assert conditions.KRADAR_CONDITIONS[number] == conditions.Conditions(*published)
    assert rows.keys() == conditions.KRADAR_CONDITIONS.keys()
    assert {row["weather"] for row in rows.values()} == set(conditions.WEATHERS)


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (read_calibration, "frame difference,x,y\n", ":2: '', expected three"),
        (read_calibration, "h\n1,2", ":2: '1,2', expected three numbers"),
        (conditions.read_description, "", ":1: '', expected 'environment"),
        (read_split, "1,00033_00001.txt\n1;x", ":2: '1;x', expected"),
    ],
)
def test_malformed_files_name_file_and_line(tmp_path, read, text, message):
    with pytest.raises(DataError, match=r"f\.txt" + message):
        read(touch(tmp_path / "f.txt", text))
    (tmp_path / "f.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match=r"f\.txt:1: byte 0xff is not UTF-8"):
        read(tmp_path / "f.txt")


def test_readers_accept_what_is_on_the_disks(tmp_path):
    path = tmp_path / "f.txt"
    path.write_bytes(b"frame difference,x,y\r\n 32, -2.54, 0.3\r\n")
    assert read_calibration(path) == (32, -2.54, 0.3)
    path.write_text("Urban, Day ,Normal")
    assert conditions.read_description(path).environment == "urban"
    path.write_text("1,00033_00001.txt\n2,00034_00002.txt")
    assert read_split(path) == [(1, "00033_00001"), (2, "00034_00002")]


def test_own_files_come_first(tmp_path):
    write.write_calibration(tmp_path / "1/info_calib/calib_radar_lidar.txt", 3, -2, 0.5)
    camera = touch(tmp_path / "calib/seq_01/cam_1.yml")
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
