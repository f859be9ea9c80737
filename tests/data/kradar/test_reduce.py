"""Datasets of reduced releases: written, recognized, spread over disks, mixed."""

import shutil

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.data.kradar import KRadar, write
from radejax.data.kradar.check import check_dataset
from radejax.data.kradar.folders import is_elevation_axis_up
from radejax.data.kradar.reduce import reduce_dataset
from radejax.data.kradar.reduced import project_reduced, reduce_tensor, strongest_points
from radejax.data.kradar.tesseract import read_tesseract
from radejax.data.records import Records, preprocess


def reduced_root(source, out, release):
    report = reduce_dataset([source], out, release, 0.2)
    assert not report.skipped
    return out


@pytest.mark.parametrize("release", ["polar3d", "rpc"])
def test_frames_are_those_of_the_tensors(kradar_root, tmp_path, release):
    root = reduced_root(kradar_root, tmp_path / "out", release)
    whole, data = KRadar(kradar_root), KRadar(root)
    assert (whole.release, data.release) == (None, release)
    # Except in K-Radar itself, which has no grid file, the elevation axis points up.
    assert is_elevation_axis_up([kradar_root])
    assert not is_elevation_axis_up([tmp_path])
    assert [f.key for f in data] == [f.key for f in whole]
    assert not data.summary().problems
    assert data.grid == whole.grid
    for frame, full in zip(data, whole, strict=True):
        np.testing.assert_array_equal(frame.boxes, full.boxes)
        assert frame.weather == full.weather == "fog"
        polar = reduce_tensor(read_tesseract(full.tesseract_path), data.grid)
        if release == "rpc":
            polar = strongest_points(polar, data.grid, 0.2, is_axis_up=True)
        name = f"{release}_{frame.header.radar:05d}.npy"
        assert frame.radar_path == root / str(frame.sequence) / name
        stored = np.load(frame.radar_path)
        np.testing.assert_array_equal(stored, polar)
        assert stored.dtype == np.float64
        projection = frame.read_projection(data.grid)
        np.testing.assert_array_equal(projection, project_reduced(polar, data.grid))


def test_writing_resumes_and_lists_corrupted_tensors(kradar_root, tmp_path):
    source = shutil.copytree(kradar_root, tmp_path / "in")
    (source / "records").mkdir()
    (source / "manifest.1.jsonl").touch()  # of another job
    broken, decibels = sorted((source / "1/radar_tesseract").iterdir())[:2]
    broken.write_bytes(b"no tensor")
    write.write_tesseract(decibels, 10 * np.log10(read_tesseract(decibels)))
    out = tmp_path / "out"
    report = reduce_dataset([source], out, "polar3d")
    assert (report.num_frames, report.num_written) == (12, 10)
    assert report.skipped.keys() == {str(broken), str(decibels)}
    assert "not a MATLAB v5 file" in report.skipped[str(broken)]
    assert "as in decibels" in report.skipped[str(decibels)]
    names = [path.name for path in out.iterdir()]
    (log,) = (name for name in names if name.endswith(".jsonl"))
    assert log != "manifest.1.jsonl"
    assert {*names} == {"1", "2", "manifest.json", log, "radar_grid.json", "split"}
    assert (out / "1/description.txt").is_symlink()
    (out / "2/polar3d_00005.npy").unlink()
    again = reduce_dataset([source], out, "polar3d")
    assert (again.num_found, again.num_written, len(again.skipped)) == (9, 1, 2)
    with pytest.raises(UserError, match=r"rate is 1\.5, expected"):
        reduce_dataset([source], out, "rpc", 1.5)
    with pytest.raises(UserError, match=r"other reduced frames: .*release is 'polar3d"):
        reduce_dataset([source], out, "rpc")
    with pytest.raises(UserError, match=r"no radar_tesseract/\*\.mat in"):
        reduce_dataset([out], tmp_path / "again", "rpc")
    assert not (tmp_path / "again").exists()
    with pytest.raises(UserError, match="expected another folder than the roots"):
        reduce_dataset([source], source, "rpc")


def test_folders_of_a_write_protected_root_are_written_to(kradar_root, tmp_path):
    source = shutil.copytree(kradar_root, tmp_path / "in")
    second = shutil.copytree(source / "2", tmp_path / "second" / "2").parent
    for root in (source, second):
        for folder in (root, *root.glob("**/")):
            folder.chmod(0o555)
    out = tmp_path / "out"
    assert reduce_dataset([source, second], out, "polar3d").num_written == 12
    assert {folder.stat().st_mode & 0o777 for folder in out.glob("**/")} == {0o755}
    assert source.stat().st_mode & 0o777 == 0o555


def test_bad_and_missing_frames_are_found_and_skipped(kradar_root, tmp_path):
    root = reduced_root(kradar_root, tmp_path / "out", "polar3d")
    (root / "2/polar3d_00005.npy").unlink()
    path = root / "1/polar3d_00006.npy"
    np.save(path, np.load(path)[[0, 1]] * [[[[1e13]]], [[[1]]]])
    path.with_name("polar3d_00007.npy").write_bytes(b"\x93NUMPY")
    shallow, deep = (check_dataset(root, deep=deep) for deep in (False, True))
    for report, count in ((shallow, 1), (deep, 2)):
        counts = {"tesseract missing": 1, "projection corrupted": count}
        assert report.summary.problem_counts() == counts
        assert "2/00005_00002: no polar3d_00005.npy in " in report.to_text()
        assert [row["projections"] for row in report.sequences] == [6, 5]
    records = tmp_path / "records"
    report = preprocess(KRadar(root), records, num_workers=0, progress=False)
    missing = "2/00005_00002"
    assert sorted(report.skipped) == ["1/00006_00003", "1/00007_00004", missing]
    assert Records.open(records).source["release"] == "polar3d"
    with pytest.raises(UserError, match="release"):
        preprocess(KRadar(kradar_root), records, progress=False)
    assert "divided by 1e+13" in report.skipped["1/00006_00003"]


def test_mixed_roots_and_unusable_points_are_rejected(kradar_root, tmp_path):
    polar = reduced_root(kradar_root, tmp_path / "polar", "polar3d")
    points = reduced_root(kradar_root, tmp_path / "points", "rpc")
    for roots, names in (
        ([kradar_root, polar], r"tesseract_0000\d.mat and .*polar3d_0000\d.npy"),
        ([points, polar], r"polar3d_0000\d.npy and .*rpc_0000\d.npy"),
    ):
        with pytest.raises(UserError, match=f"{names} are different forms") as error:
            KRadar(roots)
        assert str(error.value).endswith("name only roots of one form")
    for path in points.glob("*/rpc_*.npy"):
        path.rename(path.with_name(path.name.replace("rpc", "sprdr")))
    with pytest.raises(UserError, match=r"sprdr_0000\d.npy: points \[N, 4\]"):
        KRadar(points)
