import dataclasses
import pathlib
import zipfile

import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.kradar import KRadar, dataset, write
from radejax.geometry.radar_grid import RadarGrid

LABEL = "00004_00001"
HEADER = (
    "* idx(tesseract_os2-64_cam-front_os1-128_cam-lrr)=00004_00001_00002_00003_00004, "
    "timestamp=1643292946.710046076"
)


def touch(path: pathlib.Path, text: str = "x") -> pathlib.Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_sequence_spread_over_roots(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    first = touch(a / "7/radar_tesseract/tesseract_00001.mat")
    touch(b / "7/radar_tesseract/tesseract_00001.mat")
    second = touch(b / "7/cam-front/cam-front_00001.png")
    touch(b / "12/description.txt")
    touch(b / "resources/readme.txt")
    sequences = dataset.find_sequences([a, b])
    assert list(sequences) == [7, 12]
    seven = sequences[7]
    assert seven.find("radar_tesseract", "tesseract_00001.mat") == first
    assert seven.find("cam-front", "cam-front_00001.png") == second
    assert seven.find("cam-front", "cam-front_00002.png") is None
    with pytest.raises(FileNotFoundError, match=r"c: no such folder"):
        dataset.find_sequences([tmp_path / "c"])


@pytest.mark.parametrize(
    ("version", "folder"),
    [("v1.0", "info_label"), ("v2.0", "info_label_v2"), ("v2.1", "info_label")],
)
def test_own_labels_by_version(tmp_path, version, folder):
    touch(tmp_path / f"3/info_label/{LABEL}.txt")
    touch(tmp_path / f"3/info_label_v2/{LABEL}.txt")
    touch(tmp_path / "3/info_label/readme.txt")
    source = dataset.find_own_labels(dataset.find_sequences([tmp_path]), version)
    assert source.paths == {(3, LABEL): tmp_path / f"3/{folder}/{LABEL}.txt"}


@pytest.mark.parametrize(
    "layout",
    [
        "{}/{}.txt",
        "KRadar_revised_visibility/{}/{}.txt",
        "{}_info_label_revised/{}.txt",
        "labels/{}/info_label/{}.txt",
    ],
)
@pytest.mark.parametrize("zipped", [False, True])
def test_label_revisions_in_their_layouts(tmp_path, layout, zipped):
    names = [layout.format(12, LABEL), layout.format(3, LABEL), "readme.txt"]
    if zipped:
        path = tmp_path / "labels.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for name in names:
                archive.writestr(name, name)
    else:
        path = tmp_path / "labels"
        for name in names:
            touch(path / name, name)
    source = dataset.find_labels(path)
    assert list(source.paths) == [(3, LABEL), (12, LABEL)]
    with source.reader() as read:
        assert read(source.paths[12, LABEL]) == names[0].encode()
    assert source.where((3, LABEL)).endswith(names[1])


def test_bad_label_sources(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such labels"):
        dataset.find_labels(tmp_path / "none")
    with pytest.raises(UserError, match="must be a folder or a zip"):
        dataset.find_labels(touch(tmp_path / "labels.txt"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no label files in it"):
        dataset.find_labels(tmp_path / "empty")


def test_a_frame_twice_names_both(tmp_path):
    for folder in ("1", "01", "a/1"):
        touch(tmp_path / f"labels/{folder}/{LABEL}.txt")
    both = rf"frame 1/{LABEL} is there twice, as .*01/{LABEL}\.txt and .*1/{LABEL}\.txt"
    with pytest.raises(DataError, match=both):
        dataset.find_labels(tmp_path / "labels")
    path = tmp_path / "labels.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"1/{LABEL}.txt", "x")
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr(f"1/{LABEL}.txt", "y")
    with pytest.raises(DataError, match=f"as 1/{LABEL}.txt and 1/{LABEL}.txt"):
        dataset.find_labels(path)
    for name in ("1", "01"):
        touch(tmp_path / f"root/{name}/description.txt")
    with pytest.raises(DataError, match=r"sequence 1 is there twice, as .*01 and .*1:"):
        dataset.find_sequences([tmp_path / "root"])


def test_one_bad_member_leaves_the_others(tmp_path):
    path = tmp_path / "labels.zip"
    content = HEADER.encode()
    bomb = bytes(2 << 20)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"1/{LABEL}.txt", content)
        archive.writestr("1/00005_00002.txt", bomb)
    data = KRadar(labels=path)
    assert [frame.name for frame in data] == [LABEL]
    ((_, bombed),) = data.summary().problems
    assert "2097152 bytes, expected at most" in bombed
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(DataError, match=r"labels\.zip: corrupted, not a zip file"):
        KRadar(labels=path)


def test_a_label_that_is_a_folder_is_reported(tmp_path):
    touch(tmp_path / f"1/{LABEL}.txt", HEADER)
    (tmp_path / "1/00005_00002.txt").mkdir()
    data = KRadar(labels=tmp_path)
    assert len(data) == 1
    assert "is a folder, expected a label file" in str(data.summary().problems[0])


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000, '{"range_m": 1e400}', "1"])
def test_damaged_grids_are_named(tmp_path, text):
    touch(tmp_path / "radar_grid.json", text)
    with pytest.raises(DataError, match=r"radar_grid\.json"):
        dataset.read_grid([tmp_path])


def test_split_files_and_camera_calibration_are_found(tmp_path):
    split = touch(tmp_path / "b/resources/split/test.txt")
    near = [tmp_path / "a", tmp_path / "b"]
    assert dataset.find_split_file("test", near) == split
    assert dataset.find_split_file("train", near) is None
    common = touch(tmp_path / "c/common/cam_front0.yml")
    own = touch(tmp_path / "c/calib_seq_v2/seq_03/cam_1.yml")
    assert dataset.find_camera_calibration([tmp_path / "c"], 3) == (own, True)
    assert dataset.find_camera_calibration([tmp_path / "c"], 4) == (common, False)
    found = dataset.find_camera_calibration([tmp_path / "c"], 3, common_only=True)
    assert found == (common, False)
    assert dataset.find_camera_calibration([tmp_path / "d"], 4) == (None, False)


def test_height_of_the_radar_is_kradars_or_the_simulations(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    touch(a / "1/x")
    assert dataset.read_radar_from_lidar_z([a]) == 0.7
    touch(
        b / "simulation.json", '{"config": {"radar_from_lidar_m": [-2.54, 0.3, 0.2]}}'
    )
    assert dataset.read_radar_from_lidar_z([a, b]) == 0.2
    touch(a / "simulation.json", "{}")
    assert dataset.read_radar_from_lidar_z([a]) == 0.7
    with pytest.raises(DataError, match="different heights of the sensors in"):
        dataset.read_radar_from_lidar_z([a, b])
    touch(b / "simulation.json", '{"config": {"radar_from_lidar_m": [1]}}')
    with pytest.raises(DataError, match=r"radar_from_lidar_m is not three numbers"):
        dataset.read_radar_from_lidar_z([b])


def test_grid_of_the_roots(tmp_path):
    grid = RadarGrid.reduced(num_doppler=4, num_range=8, num_elevation=3, num_azimuth=7)
    a, b = tmp_path / "a", tmp_path / "b"
    assert dataset.read_grid([a]) == RadarGrid.kradar()
    write.write_grid(a, grid)
    assert dataset.read_grid([a, b]) == grid
    write.write_grid(b, dataclasses.replace(grid, fov_range_m=50.0))
    with pytest.raises(DataError, match="different sensor axes"):
        dataset.read_grid([a, b])
    touch(b / "radar_grid.json", '{"range_m": 3}')
    with pytest.raises(
        DataError, match=r"radar_grid\.json: not the axes of a sensor \('azimuth_rad"
    ):
        dataset.read_grid([b])
