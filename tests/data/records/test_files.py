import json
import os
import socket

import numpy as np
import pytest

from radejax.core import files as core_files
from radejax.core.errors import DataError, UserError
from radejax.data.records import files
from radejax.data.records.files import RecordFileWriter

NAME = files.file_name(3, 12)


def write(folder, count=3):
    writer = RecordFileWriter(folder, NAME)
    for i in range(count):
        writer.write(f"1/{i}", np.full((2, 3), i, np.float16))
    writer.skipped["1/9"] = "gone"
    return writer.commit()


def test_written_whole_with_a_manifest(tmp_path):
    entry = write(tmp_path)
    assert NAME == "projections-00003-of-00012.arrayrecord"
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        NAME,
        "projections-00003-of-00012.json",
    ]
    assert entry.frames == ["1/0", "1/1", "1/2"]
    assert entry.skipped == {"1/9": "gone"}
    assert entry.num_bytes == (tmp_path / NAME).stat().st_size
    assert entry.sha256 == files.sha256(tmp_path / NAME)
    assert files.read_manifest_of(tmp_path, NAME) == entry


def test_what_is_not_committed_is_not_there(tmp_path):
    writer = RecordFileWriter(tmp_path, NAME)
    writer.write("1/0", np.ones(3))
    assert files.read_manifest_of(tmp_path, NAME) is None
    writer.discard()
    assert not list(tmp_path.iterdir())


def test_a_file_of_another_size_is_not_finished(tmp_path):
    write(tmp_path)
    (tmp_path / NAME).write_bytes(b"short")
    assert files.read_manifest_of(tmp_path, NAME) is None
    (tmp_path / NAME).unlink()
    assert files.read_manifest_of(tmp_path, NAME) is None


def test_damaged_manifest_is_named(tmp_path):
    write(tmp_path)
    path = files.manifest_path(tmp_path, NAME)
    path.write_text(json.dumps({"name": NAME}))
    with pytest.raises(
        DataError, match=r"00003-of-00012\.json: it lacks frames.*; delete it"
    ):
        files.read_manifest_of(tmp_path, NAME)


def test_leftovers_of_killed_processes_are_removed(tmp_path):
    host = socket.gethostname()
    dead = tmp_path / f".{NAME}.{host}.{2**22 + 1}.tmp"  # beyond any process number
    mine = tmp_path / f".{NAME}.{host}.{os.getpid()}.tmp"
    elsewhere = tmp_path / f".{NAME}.another.1.tmp"
    for path in (dead, mine, elsewhere):
        path.write_bytes(b"x")
    core_files.remove_stale(tmp_path, NAME)
    assert sorted(tmp_path.iterdir()) == sorted([mine, elsewhere])


def test_full_disk(tmp_path, monkeypatch):
    writer = RecordFileWriter(tmp_path, NAME)

    class Full:
        def write(self, content):
            raise RuntimeError("write() failed: No space left on device")

        def close(self):
            raise RuntimeError("write() failed: No space left on device")

    monkeypatch.setattr(writer, "_writer", Full())
    with pytest.raises(UserError, match="no space left on the disk of"):
        writer.write("1/0", np.ones(3))
    with pytest.raises(UserError, match="run the same command again"):
        writer.commit()
    writer.discard()
    assert not list(tmp_path.iterdir())
