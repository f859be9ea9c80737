import dataclasses
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from radejax.core.errors import DataError, DiskFullError, UserError
from radejax.core.files import is_running
from radejax.data.kradar import KRadar
from radejax.data.records import job as projection_job
from radejax.data.records.job import parse_shard, project_dataset
from radejax.data.records.projections import RecordSource, skipped_frames
from radejax.data.tesseract import project_file
from radejax.geometry.radar_grid import RadarGrid


@pytest.fixture
def root(kradar_root, tmp_path):
    return shutil.copytree(kradar_root, tmp_path / "kradar")


def run(data, out, **options):
    options = {"num_workers": 0, "frames_per_file": 5, "progress": False, **options}
    return project_dataset(data, out, **options)


def contents(folder):
    """All files but the plan; manifests as values, without the order of keys."""
    return {
        path.name: path.read_bytes()
        for path in sorted(folder.iterdir())
        if path.name != "plan.json"
    }


def test_processes_shards_and_one_process_write_the_same(kradar_root, tmp_path):
    data = KRadar(kradar_root)
    one = run(data, tmp_path / "one")
    assert (one.num_projected, one.num_found, one.is_complete) == (12, 0, True)
    many = run(data, tmp_path / "many", num_workers=2)
    assert many.num_projected == 12
    assert 0 <= many.reading_share <= 1
    assert contents(tmp_path / "many") == contents(tmp_path / "one")
    for index in (1, 0):
        report = run(data, tmp_path / "shards", shard=f"{index}/2")
        assert report.is_complete == (index == 0)
    assert contents(tmp_path / "shards") == contents(tmp_path / "one")
    assert "12 frames: 12 projected" in one.to_text()


def test_second_run_does_what_is_missing(kradar_root, tmp_path):
    data = KRadar(kradar_root)
    run(data, tmp_path)
    wanted = contents(tmp_path)
    (tmp_path / "projections-00001-of-00003.arrayrecord").unlink()
    (tmp_path / "projections-00002-of-00003.json").unlink()
    (tmp_path / "manifest.json").unlink()
    report = run(data, tmp_path)
    assert (report.num_projected, report.num_found) == (7, 5)
    assert contents(tmp_path) == wanted


KILLED = """
import sys
import threading
from radejax.data.kradar import KRadar
from radejax.data.records.job import project_dataset
if __name__ == "__main__":
    project_dataset(
        KRadar(sys.argv[1]), sys.argv[2], num_workers=1, frames_per_file=5, progress=False
    )
"""


def test_resumes_after_a_kill(root, tmp_path):
    out = tmp_path / "out"
    blocked = root / "2/radar_tesseract/tesseract_00005.mat"  # the 8th frame
    content = blocked.read_bytes()
    blocked.unlink()
    os.mkfifo(blocked)  # a worker waits there for ever
    (tmp_path / "job.py").write_text(KILLED)
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    job = subprocess.Popen(
        [sys.executable, tmp_path / "job.py", root, out], env=environment
    )

    def temporary() -> list[pathlib.Path]:
        return list(out.glob(".projections-00001-of-00003*.tmp"))

    wait_until(temporary)
    worker = int(temporary()[0].name.split(".")[-2])
    job.send_signal(signal.SIGKILL)
    job.wait()
    wait_until(lambda: not is_running(worker))  # workers do not outlive their parent
    assert not (out / "manifest.json").exists()
    assert (out / "projections-00000-of-00003.json").exists()
    blocked.unlink()
    blocked.write_bytes(content)
    report = run(KRadar(root), out)
    assert (report.num_projected, report.num_found) == (7, 5)
    assert not temporary()
    data = KRadar(root)
    records = RecordSource(out, verify=True)
    for i, frame in enumerate(data):
        wanted = project_file(frame.tesseract_path).astype(np.float16)
        np.testing.assert_array_equal(records[i]["projection"], wanted)


@pytest.mark.slow
def test_an_interrupt_of_all_processes_is_one_line(root, tmp_path):
    out = tmp_path / "out"
    blocked = min(root.glob("1/radar_tesseract/*.mat"))  # of the first frame
    blocked.unlink()
    os.mkfifo(blocked)  # the worker waits there until it is opened below
    # Started in the background, Ctrl-C would be ignored by all of them.
    command = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    )
    command += "from radejax.cli.main import main; main(prog_name='radejax')"
    job = subprocess.Popen(
        [sys.executable, "-c", command, "project", root, "--out", out, "--workers=1"],
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    # The file of records is there, so the worker is at its first frame, or soon will be:
    # it looks whether to stop behind a frame only.
    wait_until(lambda: any("arrayrecord" in path.name for path in out.glob("*")))
    os.killpg(job.pid, signal.SIGINT)
    time.sleep(1.0)
    assert job.poll() is None  # waits for its worker
    with blocked.open("wb"):
        pass
    _, errors = job.communicate(timeout=120)
    assert job.returncode == 130
    assert errors.rstrip().splitlines()[-1] == "error: interrupted"
    assert "Traceback" not in errors


def wait_until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


@pytest.mark.parametrize("num_workers", [0, 1])
def test_bad_frames_are_named_or_left_out(root, tmp_path, num_workers):
    bad = root / "1/radar_tesseract/tesseract_00005.mat"
    bad.write_bytes(bad.read_bytes()[:-7])
    (root / "2/radar_tesseract/tesseract_00009.mat").unlink()
    data = KRadar(root)
    out = tmp_path / "out"
    with pytest.raises(
        DataError, match=r"frame 1/00005_00002: .*_00005\.mat: truncated"
    ):
        run(data, out, num_workers=num_workers)
    assert not list(out.glob("*-00000-of-*.arrayrecord"))
    assert not list(out.glob(".*.tmp"))
    report = run(data, out, num_workers=num_workers, skip_bad=True)
    assert report.num_projected + report.num_found == 10
    assert sorted(report.skipped) == ["1/00005_00002", "2/00009_00006"]
    assert "left out: 2/00009_00006: no tesseract in any root" in report.to_text()
    many = dataclasses.replace(report, skipped=dict.fromkeys(range(1187), "gone"))
    assert many.to_text().count("\nleft out: ") == 10
    assert "... and 1,177 more left out: manifest.json" in many.to_text()
    records = RecordSource(out)
    assert len(records) == 10
    assert records.manifest.skipped == report.skipped
    wanted = project_file(data[2].tesseract_path).astype(np.float16)
    np.testing.assert_array_equal(records[1]["projection"], wanted)
    # Without skip_bad a later run does not take the holes for finished.
    with pytest.raises(DataError, match="frame 1/00005_00002"):
        run(data, out)


def test_released_projections_are_taken_as_input(root, tmp_path):
    wanted = []
    for frame in KRadar(root):
        projection = project_file(frame.tesseract_path, dtype=np.float64)
        folder = root / str(frame.sequence) / "DERA_tesseract"
        folder.mkdir(exist_ok=True)
        name = f"DERA_tesseract_{frame.header.radar:05d}.npy"
        np.save(folder / name, projection.transpose(2, 0, 1))
        wanted.append(projection.astype(np.float16))
        frame.tesseract_path.unlink()
    report = run(KRadar(root), tmp_path / "out")
    assert report.num_projected == 12
    records = RecordSource(tmp_path / "out")
    for i, projection in enumerate(wanted):
        np.testing.assert_array_equal(records[i]["projection"], projection)
    assert records.manifest.sources["released_projections"] == 12


def test_eight_bits_state_what_they_lose(kradar_root, tmp_path):
    data = KRadar(kradar_root)
    run(data, tmp_path, dtype="uint8")
    records = RecordSource(tmp_path)
    stored = records[0]["projection"]
    assert stored.dtype == np.uint8
    exact = project_file(data[0].tesseract_path)
    error_db = np.abs(stored / 255 - exact).max() * 184.3
    encoding = json.loads((tmp_path / "manifest.json").read_text())["encoding"]
    assert error_db <= encoding["max_error_db"] * 1.001
    assert encoding["num_clipped"] == 0


@pytest.mark.parametrize("dtype", ["float16", "uint8", "float32"])
def test_compressed_records_are_the_same(kradar_root, tmp_path, dtype):
    data, plain, small = KRadar(kradar_root), tmp_path / "plain", tmp_path / "small"
    run(data, plain, dtype=dtype)
    run(data[:8], small, grid=data.grid, dtype=dtype, compress=True)
    assert run(data, small).num_projected == 4  # as what is there
    wanted, found = RecordSource(plain), RecordSource(small, verify=True)
    assert (wanted.manifest.compressed, found.manifest.compressed) == (False, True)
    for i in range(12):
        x = found[i]["projection"]
        assert (x.dtype, x.shape) == (np.dtype(dtype), data.grid.projection_shape)
        np.testing.assert_array_equal(x, wanted[i]["projection"])
    # Earlier versions read what is not compressed and refuse what is.
    versions = [
        json.loads((x / "manifest.json").read_text())["version"] for x in (small, plain)
    ]
    assert versions == [2, 1]


def test_records_of_a_folder_are_compressed_or_not(kradar_root, tmp_path):
    data = KRadar(kradar_root)
    run(data, tmp_path, shard="0/2", compress=True)
    with pytest.raises(UserError, match="compress is True there and False here"):
        run(data, tmp_path, compress=False)
    assert run(data, tmp_path).is_complete
    other = tmp_path / "other"
    run(data, other, shard="0/2")
    plan = json.loads((other / "plan.json").read_text())
    del plan["compress"]  # as versions before wrote it
    (other / "plan.json").write_text(json.dumps(plan))
    with pytest.raises(UserError, match="compress is False there and True here"):
        run(data, other, compress=True)
    assert run(data, other).is_complete


def test_a_folder_keeps_to_its_plan(kradar_root, tmp_path):
    data = KRadar(kradar_root)
    run(data, tmp_path)
    with pytest.raises(
        UserError,
        match=r"another projection: dtype is 'float16' there",
    ):
        run(data, tmp_path, dtype="uint8")
    other = RadarGrid.kradar()
    with pytest.raises(UserError, match=r"grid\.azimuth_rad differs"):
        run(data, tmp_path, grid=other)
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(DataError, match=r"plan\.json is not valid JSON"):
        run(data, tmp_path)


def test_records_serve_other_frames_of_the_same_data(kradar_root, tmp_path):
    data = KRadar(kradar_root)
    out, part = tmp_path / "out", {"grid": data.grid}
    run(data[:7], out, dtype="uint8", **part)
    fewer = run(data[2:5], out, **part)
    assert (fewer.num_frames, fewer.num_found, fewer.num_projected) == (3, 3, 0)
    assert fewer.is_complete
    more = run(data, out, frames_per_file=2)
    assert (more.num_frames, more.num_found, more.num_projected) == (12, 7, 5)
    records = RecordSource(out, verify=True)
    assert records.frames == [frame.key for frame in data]
    run(data, tmp_path / "whole", dtype="uint8")
    whole = RecordSource(tmp_path / "whole")
    for i in range(12):
        stored, wanted = records[i]["projection"], whole[i]["projection"]
        np.testing.assert_array_equal(stored, wanted)
    assert records.manifest.sources == whole.manifest.sources
    again = run(data, out)
    assert (again.num_found, again.num_projected) == (12, 0)


def test_what_was_only_planned_gives_way_and_what_was_begun_does_not(root, tmp_path):
    data = KRadar(root)
    bad = root / "1/radar_tesseract/tesseract_00004.mat"
    content = bad.read_bytes()
    bad.write_bytes(content[:-7])
    with pytest.raises(DataError, match=r"`radejax project --skip-bad` into .*out"):
        run(data, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["plan.json"]
    bad.write_bytes(content)
    run(data, tmp_path / "out", dtype="uint8", shard="0/2")
    with pytest.raises(
        UserError, match=r"num_frames is 12 there and 8 here.*finish it"
    ):
        run(data[:8], tmp_path / "out", grid=data.grid)


def test_frames_that_were_left_out_may_stay_so(root, tmp_path):
    (root / "2/radar_tesseract/tesseract_00009.mat").unlink()
    data = KRadar(root)
    run(data, tmp_path / "out", skip_bad=True)
    report = run(data, tmp_path / "out", retry_skipped=False)
    assert (report.num_found, list(report.skipped)) == (11, ["2/00009_00006"])
    assert skipped_frames(tmp_path / "out") == report.skipped
    assert skipped_frames(tmp_path / "nowhere") == {}


def test_wrong_arguments(kradar_root, tmp_path):
    data = KRadar(kradar_root)
    with pytest.raises(UserError, match="no frames to project"):
        run([], tmp_path, grid=data.grid)
    with pytest.raises(UserError, match="a plain list of frames has no grid"):
        run(list(data), tmp_path)
    with pytest.raises(UserError, match="must be at least 1, got 0"):
        run(data, tmp_path, frames_per_file=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is a file, expected a folder"):
        run(data, tmp_path / "file")
    assert parse_shard("3/8") == (3, 8)
    for shard, message in (
        ("8/8", "from 0 to n - 1"),
        ("x", "expected i/n"),
        ((1,), "i/n"),
    ):
        with pytest.raises(UserError, match=message):
            parse_shard(shard)


def test_a_full_disk_keeps_nothing_half_written(kradar_root, tmp_path, monkeypatch):
    class Full(projection_job.files.RecordFileWriter):
        def write(self, key, stored):
            raise DiskFullError("no space left on the disk of x")

    monkeypatch.setattr(projection_job.files, "RecordFileWriter", Full)
    with pytest.raises(UserError, match="no space left on the disk of"):
        run(KRadar(kradar_root), tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["plan.json"]


def test_a_killed_worker_is_one_line(root, tmp_path):
    blocked = root / "1/radar_tesseract/tesseract_00005.mat"
    blocked.unlink()
    os.mkfifo(blocked)
    out = tmp_path / "out"

    def kill_worker() -> None:
        wait_until(lambda: list(out.glob(".projections*.tmp")))
        (temporary,) = out.glob(".projections*.tmp")
        os.kill(int(temporary.name.split(".")[-2]), signal.SIGKILL)

    killer = threading.Thread(target=kill_worker)
    killer.start()
    with pytest.raises(UserError, match=r"a worker process ended early.*run the same"):
        run(KRadar(root), out, num_workers=1)
    killer.join()
