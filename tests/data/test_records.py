"""Records: one file per frame, resumable, sharded, never half written."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.dataset import LabeledFrames
from radejax.data.kradar import KRadar
from radejax.data.kradar.tesseract import project_file, read_tesseract
from radejax.data.projection import project_tensor
from radejax.data.records import Records, open_embeddings, open_projections, preprocess
from radejax.geometry.radar_grid import RadarGrid

from .. import small_models as small

KRADAR = RadarGrid.kradar()


@pytest.fixture(scope="module")
def data(kradar_root):
    return KRadar(kradar_root)


@pytest.fixture(scope="module")
def folder(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("records")
    run(data, path)
    return path


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "records")


@pytest.fixture
def root(kradar_root, tmp_path):
    return shutil.copytree(kradar_root, tmp_path / "kradar")


def run(data, out, **options):
    return preprocess(data, out, **{"num_workers": 0, "progress": False, **options})


def contents(folder):
    paths = (path for path in folder.rglob("*.*") if path.suffix != ".jsonl")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def wait_until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


# Reading -----------------------------------------------------------------------------


def test_every_frame_is_its_projection(data, folder):
    records = open_projections(folder, data.grid)
    assert records.keys() == {frame.key for frame in data}
    assert (records.grid, records.dtype) == (data.grid, "float16")
    for frame in data:
        wanted = project_file(frame.tesseract_path).astype(np.float16)
        np.testing.assert_array_equal(records[frame.key], wanted)
        assert records[frame.key].dtype == np.float16
    with pytest.raises(FileNotFoundError):
        records["1/none"]


def test_corrupted_records_are_named(data, copy):
    records, key = open_projections(copy), data[4].key
    path = records.path(key)
    content = path.read_bytes()
    other = np.zeros(records.shape, np.float32)
    for part in (content[:-1], content[:100], content[:7], b"", b"PK\3\4", b"x" * 300):
        path.write_bytes(part)
        with pytest.raises(DataError, match=rf"{key}\.npy: corrupted.*delete it and"):
            records[key]
    for array in (other, other[:1].astype(np.float16), np.array([None])):
        np.save(path, array, allow_pickle=True)
        with pytest.raises(DataError, match=r"not a float16 array of shape \(16,"):
            records[key]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dtype": "int4"}, "dtype is 'int4'"),
        ({"source": 3}, "corrupted"),
        ({"shape": [2, 3, 4]}, "arrays of shape"),
    ],
)
def test_corrupted_descriptions_are_named(copy, change, message):
    path = copy / "manifest.json"
    content = json.loads(path.read_text())
    content["options"] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=rf"manifest\.json: .*{message}"):
        _ = open_projections(copy).grid
    path.write_text("{")
    with pytest.raises(DataError, match="is not valid JSON"):
        open_projections(copy)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"no manifest\.json; expected a"):
        open_projections(copy)


# Writing -----------------------------------------------------------------------------


def test_processes_shards_and_one_process_write_the_same(data, folder, tmp_path):
    wanted = contents(folder)
    assert len(wanted) == 13
    report = run(data, tmp_path / "many", num_workers=2)
    assert (report.num_frames, report.num_found, report.num_written) == (12, 0, 12)
    assert "12 frames: 0 were done, 12 preprocessed, 0 skipped" in report.to_text()
    assert contents(tmp_path / "many") == wanted
    for index in (1, 0):
        assert run(data, tmp_path / "shards", shard=(index, 2)).num_frames == 6
    assert contents(tmp_path / "shards") == wanted


def test_another_run_writes_what_is_missing(data, folder, copy):
    records = open_projections(copy)
    for frame in (data[1], data[7]):
        records.path(frame.key).unlink()
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*.npy")}
    report = run(data.without({f.key for f in data[:2] + data[9:]}, "test"), copy)
    assert (report.num_frames, report.num_found, report.num_written) == (7, 6, 1)
    assert run(data, copy).num_written == 1
    assert contents(copy) == contents(folder)
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())


_JOB = """
import sys
from radejax.data.kradar import KRadar
from radejax.data.records import preprocess
if __name__ == "__main__":
    preprocess(KRadar(sys.argv[1]), sys.argv[2], num_workers=1, progress=False)
"""


def test_resumes_after_a_kill(data, folder, root, tmp_path):
    out = tmp_path / "out"
    blocked = root / "2/radar_tesseract/tesseract_00005.mat"  # the 8th frame
    content = blocked.read_bytes()
    blocked.unlink()
    os.mkfifo(blocked)  # a worker waits there forever
    (tmp_path / "job.py").write_text(_JOB)
    command = [sys.executable, tmp_path / "job.py", root, out]
    job = subprocess.Popen(command, env={**os.environ, "JAX_PLATFORMS": "cpu"})
    wait_until(lambda: len(list(out.rglob("*.npy"))) == 7)
    job.send_signal(signal.SIGKILL)
    job.wait()
    blocked.unlink()
    blocked.write_bytes(content)
    report = run(KRadar(root), out)
    assert (report.num_written, report.num_found) == (5, 7)
    assert contents(out) == contents(folder)


@pytest.mark.slow
def test_an_interrupt_of_all_processes_is_one_line(root, tmp_path):
    out = tmp_path / "out"
    blocked = min(root.glob("1/radar_tesseract/*.mat"))  # of the first frame
    blocked.unlink()
    os.mkfifo(blocked)  # a worker waits there forever
    # Started in the background, Ctrl-C would be ignored by all of them.
    command = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from radejax.cli.main import main; main(prog_name='radejax')"
    )
    words = [sys.executable, "-c", command, "preprocess", root, "--out", out]
    job = subprocess.Popen(
        [*words, "--workers=2"],
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_until(lambda: list(out.rglob("*.npy")))
    os.killpg(job.pid, signal.SIGINT)
    _, errors = job.communicate(timeout=20)  # does not wait for its workers
    assert job.returncode == 130
    assert errors.rstrip().splitlines()[-1] == "error: interrupted"
    assert "Traceback" not in errors


def test_bad_frames_are_skipped_counted_and_tried_again(root, tmp_path):
    bad = root / "1/radar_tesseract/tesseract_00005.mat"
    content = bad.read_bytes()
    bad.write_bytes(content[:-7])
    (root / "2/radar_tesseract/tesseract_00009.mat").unlink()
    data, out = KRadar(root), tmp_path / "out"
    report = run(data, out, num_workers=1)
    assert report.num_written == 10
    assert list(report.skipped) == ["1/00005_00002", "2/00009_00006"]
    assert "skipped 2/00009_00006: no radar tensor in any root" in report.to_text()
    assert "skipped 1/00005_00002: " in report.to_text()
    with pytest.raises(UserError, match=r"2 of 12 .* is 1/00005_00002: run `radejax"):
        open_projections(out).require(data)
    bad.write_bytes(content)
    report = run(data, out)
    assert (report.num_found, report.num_written) == (10, 1)
    assert list(report.skipped) == ["2/00009_00006"]


@pytest.mark.parametrize("num_workers", [0, 1])
def test_records_of_tensors_that_were_replaced_are_counted(
    root, tmp_path, caplog, num_workers
):
    out, path = tmp_path / "out", root / "1/radar_tesseract/tesseract_00005.mat"
    for shard in (0, 1):
        run(KRadar(root), out, shard=(shard, 2), num_workers=num_workers)
    run(KRadar(root), out)
    assert not caplog.messages
    other = path.with_name("tesseract_00006.mat").read_bytes()
    path.write_bytes(other)
    before = contents(out)
    for _ in range(2):  # the record stays until it is deleted
        assert run(KRadar(root), out).num_found == 12
        assert "out: 1 of 12 files were made from" in caplog.text
        assert "such as 1/00005_00002: delete these" in caplog.text
        caplog.clear()
    assert contents(out) == before
    (out / "1/00005_00002.npy").unlink()
    assert run(KRadar(root), out).num_written == 1
    run(KRadar(root), out)
    assert not caplog.messages


def test_released_projections_are_taken_as_input(root, tmp_path):
    wanted = {}
    for frame in KRadar(root):
        tesseract = read_tesseract(frame.tesseract_path)
        projection = project_tensor(tesseract).astype(np.float64)
        folder = root / str(frame.sequence) / "DERA_tesseract"
        folder.mkdir(exist_ok=True)
        name = f"DERA_tesseract_{frame.header.radar:05d}.npy"
        np.save(folder / name, projection.transpose(2, 0, 1))
        wanted[frame.key] = projection.astype(np.float16)
        frame.tesseract_path.unlink()
    assert run(KRadar(root), tmp_path / "out").num_written == 12
    records = open_projections(tmp_path / "out")
    for key, projection in wanted.items():
        np.testing.assert_array_equal(records[key], projection)


def test_a_folder_has_records_of_one_kind(data, tmp_path):
    # That of a call that failed before its first record does not count.
    Records.create(tmp_path, (2, 3), "uint8", {"image": {}})
    empty = Records.create(tmp_path, (2, 4), None, {}, "float32")
    assert (empty.shape, empty.dtype) == ((2, 4), "uint8")
    run(data, tmp_path, dtype="uint8", shard=(0, 2))
    run(data, tmp_path)  # the type that is there
    records = open_projections(tmp_path)
    exact = project_file(data[0].tesseract_path)
    assert np.abs(records[data[0].key] / 255 - exact).max() <= 0.5001 / 255
    with pytest.raises(UserError, match=r"other records: options\.dtype is 'uint8'"):
        run(data, tmp_path, dtype="float16")
    with pytest.raises(UserError, match=r"options\.source\.grid\.azimuth_rad differs"):
        run(LabeledFrames(data, KRADAR), tmp_path)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda data, _: run(LabeledFrames([], data.grid), "x"), "no frames to preproc"),
        (lambda data, _: run(data, "x", dtype="int4"), "dtype is 'int4', expected one of"),
        (lambda data, _: run(data, "x", shard=(2, 2)), "i from 0 to n - 1"),
        (lambda _, folder: open_projections(folder, KRADAR), r"6 x 16 x 5 x 12 bins.*64 x 256 x"),
        (lambda _, folder: open_embeddings(folder), "not embeddings of images"),
    ],
)  # fmt: skip
def test_wrong_arguments(data, folder, call, message):
    with pytest.raises((DataError, UserError), match=message):
        call(data, folder)


def test_uneven_axes_are_kept_and_told_apart(tmp_path):
    uneven = small.uneven_grid()
    source = {"grid": uneven.to_dict()}
    Records.create(tmp_path, uneven.projection_shape, "float16", source)
    assert open_projections(tmp_path, uneven).grid == uneven
    first, last = uneven.azimuth_rad[[0, -1]]
    axes = {"azimuth_rad": np.linspace(first, last, 14)}
    even = small.uneven_grid(range_m=np.linspace(2.0, 30.0, 16), **axes)
    message = r"of 4 x 16 x 0 x 14 bins.*, not uniform, expected .* deg: .*--records"
    with pytest.raises(UserError, match=message):
        open_projections(tmp_path, even)
