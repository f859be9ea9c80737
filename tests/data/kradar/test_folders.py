import dataclasses
import pathlib
import zipfile

import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.kradar import folders, write
from radejax.geometry.radar_grid import RadarGrid

LABEL = "00004_00001"


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
    sequences = folders.find_sequences([a, b])
    assert list(sequences) == [7, 12]
    seven = sequences[7]
    assert seven.find("radar_tesseract", "tesseract_00001.mat") == first
    assert seven.find("cam-front", "cam-front_00001.png") == second
    assert seven.find("cam-front", "cam-front_00002.png") is None
    with pytest.raises(FileNotFoundError, match=r"c: no such folder"):
        folders.find_sequences([tmp_path / "c"])


@pytest.mark.parametrize(
    ("version", "folder"),
    [("v1.0", "info_label"), ("v2.0", "info_label_v2"), ("v2.1", "info_label")],
)
def test_own_labels_by_version(tmp_path, version, folder):
    touch(tmp_path / f"3/info_label/{LABEL}.txt")
    touch(tmp_path / f"3/info_label_v2/{LABEL}.txt")
    touch(tmp_path / "3/info_label/readme.txt")
    source = folders.own_labels(folders.find_sequences([tmp_path]), version)
    assert source.files == {(3, LABEL): tmp_path / f"3/{folder}/{LABEL}.txt"}


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
    source = folders.labels_from(path)
    assert list(source.files) == [(3, LABEL), (12, LABEL)]
    contents = dict(source.read(list(source.files)))
    assert contents[12, LABEL] == names[0].encode()
    assert source.where((3, LABEL)).endswith(names[1])


def test_bad_label_sources(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such labels"):
        folders.labels_from(tmp_path / "none")
    with pytest.raises(UserError, match="must be a folder or a zip"):
        folders.labels_from(touch(tmp_path / "labels.txt"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no label files in it"):
        folders.labels_from(tmp_path / "empty")


def test_damaged_zip_names_the_member(tmp_path):
    path = tmp_path / "labels.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"1/{LABEL}.txt", "x" * 1000)
    path.write_bytes(path.read_bytes().replace(b"x" * 1000, b"y" * 1000))
    source = folders.labels_from(path)
    with pytest.raises(DataError, match=rf"labels\.zip/1/{LABEL}\.txt: damaged"):
        list(source.read([(1, LABEL)]))


def test_split_files_and_camera_calibration_are_found(tmp_path):
    split = touch(tmp_path / "b/resources/split/test.txt")
    near = [tmp_path / "a", tmp_path / "b"]
    assert folders.find_split_file("test", near) == split
    assert folders.find_split_file("train", near) is None
    common = touch(tmp_path / "c/common/cam_front0.yml")
    own = touch(tmp_path / "c/calib_seq_v2/seq_03/cam_1.yml")
    assert folders.find_camera_calibration([tmp_path / "c"], 3) == (own, True)
    assert folders.find_camera_calibration([tmp_path / "c"], 4) == (common, False)
    assert folders.find_camera_calibration([tmp_path / "d"], 4) == (None, False)


def test_grid_of_the_roots(tmp_path):
    grid = RadarGrid.reduced(num_doppler=4, num_range=8, num_elevation=3, num_azimuth=7)
    a, b = tmp_path / "a", tmp_path / "b"
    assert folders.read_grid([a]) == RadarGrid.kradar()
    write.write_grid(a, grid)
    assert folders.read_grid([a, b]) == grid
    write.write_grid(b, dataclasses.replace(grid, fov_range_m=50.0))
    with pytest.raises(DataError, match="different sensor axes"):
        folders.read_grid([a, b])
    touch(b / "radar_grid.json", '{"range_m": 3}')
    with pytest.raises(DataError, match=r"radar_grid\.json: no radar grid"):
        folders.read_grid([b])
