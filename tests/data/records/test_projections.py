import concurrent.futures
import dataclasses
import json
import pickle
import shutil

import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.kradar import KRadar
from radejax.data.records.job import project_dataset
from radejax.data.records.projections import (
    Manifest,
    RecordSource,
    read_manifest,
    write_manifest,
)
from radejax.data.tesseract import project_file
from radejax.geometry.radar_grid import RadarGrid


@pytest.fixture(scope="module")
def data(kradar_root):
    return KRadar(kradar_root)


@pytest.fixture(scope="module")
def folder(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("records")
    project_dataset(data, path, num_workers=0, frames_per_file=5, progress=False)
    return path


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "records")


def test_every_frame_is_its_projection(data, folder):
    records = RecordSource(folder, grid=data.grid, verify=True)
    assert records.frames == [frame.key for frame in data]
    assert len(records) == 12
    for index, frame in enumerate(data):
        record = records[index]
        assert record["frame"] == index
        wanted = project_file(frame.tesseract_path).astype(np.float16)
        np.testing.assert_array_equal(record["projection"], wanted)
        assert record["projection"].dtype == np.float16
        assert not record["projection"].flags.writeable
    assert records.index_of()[data[7].key] == 7


@pytest.mark.parametrize("index", [12, -1])
def test_index_out_of_range(folder, index):
    with pytest.raises(IndexError, match=f"record {index} of 12"):
        RecordSource(folder)[index]


def test_threads_and_pickles_read_the_same(folder):
    records = RecordSource(folder)
    wanted = [records[i]["projection"] for i in range(12)]
    copy = pickle.loads(pickle.dumps(records))
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda i: copy[i % 12]["projection"], range(96)))
    for i, projection in enumerate(found):
        np.testing.assert_array_equal(projection, wanted[i % 12])


def test_manifest_survives(folder, tmp_path):
    manifest = read_manifest(folder)
    assert manifest.encoding == "float16"
    assert manifest.sources["tesseracts"] == 12
    assert manifest.skipped == {}
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest
    fields = json.loads((tmp_path / "manifest.json").read_text())
    assert fields["num_frames"] == 12
    assert fields["encoding"]["max_error_db"] == pytest.approx(0.045, abs=1e-4)


# What must not be read ---------------------------------------------------------------


def test_another_grid_is_an_error(folder, data):
    with pytest.raises(
        UserError, match=r"6 x 16 x 5 x 12 bins.*expected 64 x 256 x 37"
    ):
        RecordSource(folder, grid=RadarGrid.kradar())
    moved = dataclasses.replace(data.grid, range_m=data.grid.range_m * 1.1)
    with pytest.raises(UserError, match=r"to 118\.00 m.*to 129\.80 m"):
        RecordSource(folder, grid=moved)


def test_missing_and_unfinished_folders(tmp_path, copy):
    with pytest.raises(FileNotFoundError, match=r"none: no manifest\.json"):
        RecordSource(tmp_path / "none")
    with pytest.raises(FileNotFoundError, match="expected a folder that `radejax proj"):
        RecordSource(tmp_path)
    (copy / "manifest.json").unlink()
    with pytest.raises(FileNotFoundError, match="3 files of records are finished: run"):
        RecordSource(copy)


def test_missing_and_short_files_are_named(copy):
    path = copy / "projections-00001-of-00003.arrayrecord"
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(DataError, match=r"00001-of-00003.arrayrecord: \d+ bytes, man"):
        RecordSource(copy)
    path.unlink()
    with pytest.raises(DataError, match=r"00001-of-00003\.arrayrecord: missing"):
        RecordSource(copy)
    path.write_bytes(b"x" * len(content))
    with pytest.raises(
        DataError, match=r"00001-of-00003\.arrayrecord: (0 rec|damaged)"
    ):
        RecordSource(copy)


def test_a_flipped_byte_is_found(copy):
    path = copy / "projections-00002-of-00003.arrayrecord"
    content = bytearray(path.read_bytes())
    projection = RecordSource(copy)[10]["projection"]
    content[content.index(projection.tobytes()) + 100] ^= 1
    path.write_bytes(content)
    with pytest.raises(
        DataError, match=r"00002-of-00003\.arrayrecord: checksum differs"
    ):
        RecordSource(copy, verify=True)
    records = RecordSource(copy)  # sizes are as they were
    with pytest.raises(DataError, match=r"record 0 \(frame 2/00008_00005\) is damaged"):
        records[10]
    records[11]


FILE = {"name": "x", "frames": ["1/a"], "skipped": {}, "num_bytes": 1, "sha256": ""}
FILE |= {"num_clipped": 0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 3}, r"radejax-projections version 3, this .* up to version 2"),
        ({"format": "x"}, r"x version 1, this radejax reads radejax-projections"),
        ({"grid": {}}, r"grid lacks range_m"),
        ({"files": [{}]}, r"files\[0\] lacks name, frames.*; delete it"),
        (
            {"files": [FILE | {"name": "../x"}]},
            r"files\[0\]: '../x' is no name of a file",
        ),
        ({"files": [FILE, FILE | {"name": "y"}]}, r"frame 1/a is there twice"),
        (
            {"encoding": {"dtype": "int4"}},
            r"encoding\.dtype is 'int4', expected one of",
        ),
    ],
)
def test_other_versions_and_damaged_manifests(copy, change, message):
    path = copy / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(DataError, match=r"manifest\.json: " + message):
        RecordSource(copy)
    path.write_text("{")
    with pytest.raises(DataError, match="is not valid JSON"):
        read_manifest(copy)


def test_records_of_another_shape_are_damage(copy):
    manifest = read_manifest(copy)
    smaller = RadarGrid.reduced(
        num_doppler=4, num_range=8, num_elevation=3, num_azimuth=7
    )
    write_manifest(
        copy, Manifest(smaller, manifest.encoding, manifest.sources, manifest.files)
    )
    with pytest.raises(DataError, match="bytes"):
        RecordSource(copy)[0]
