"""Descriptions of output folders."""

import os

import pytest

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.manifest import (
    Manifest,
    add,
    checksums,
    read_checked,
    read_sources,
    state_of,
    warn_of_changes,
)


def test_what_several_calls_log_is_read_by_the_next_one(tmp_path):
    source = tmp_path / "radar.npy"
    source.write_bytes(b"1234")
    state = state_of([source, None, tmp_path / "absent.png"])
    assert [entry[:2] for entry in state] == [["radar.npy", 4]]
    job = tmp_path / "out"
    assert Manifest.open(tmp_path) is None
    for name in ("a.json", "b.json"):
        Manifest.claim(job, "boxes", {}, ["a.json", "b.json"])
        add(job, name, state)
        (job / name).write_text("[]")
    found = Manifest.open(job)
    assert found.sources == {"a.json": state, "b.json": state}
    assert found.is_done("a.json", state)
    assert not found.is_done("a.json", [])
    assert found.check_whole("*.json", "fix it") == set()
    add(job, "b.json", None)  # could not be made again
    (job / "b.json").unlink()
    assert Manifest.open(job).check_whole("*.json", "fix it") == {"b.json"}


def test_the_last_line_of_all_processes_holds_and_half_a_line_is_ignored(tmp_path):
    (tmp_path / "manifest.2.jsonl").write_text('[1, "a", []]\n[3, "b", [["c.n')
    (tmp_path / "manifest.1.jsonl").write_text('[2, "a", [["x", 1, 2]]]\n[3]\n')
    assert read_sources(tmp_path) == {"a": [["x", 1, 2]]}


def test_files_of_which_the_source_has_changed_are_counted(tmp_path, caplog):
    paths = {name: tmp_path / f"{name}.mat" for name in "abcdef"}
    for name in "abcde":
        paths[name].write_text(name)
        if name != "e":  # of an unknown source
            add(tmp_path, name, state_of([paths[name]]))
    add(tmp_path, "f", [["f.mat", 1, 2]])  # is missing now
    assert warn_of_changes(tmp_path, paths) == []
    assert not caplog.messages
    paths["b"].write_text("another size")
    os.utime(paths["c"], (1, 1))
    paths["d"] = paths["d"].rename(tmp_path / "d.npy")
    assert warn_of_changes(tmp_path, paths) == ["b", "c", "d"]
    (message,) = caplog.messages
    assert f"{tmp_path}: 3 of 6 files were made from other files than" in message
    assert "such as b, c, d: delete these, or the folder, and make" in message


def test_a_folder_in_which_nothing_was_written_may_get_other_options(tmp_path):
    def claim(what, step):
        Manifest.claim(tmp_path / "out", what, {"step": step}, patterns=["*.npy"])

    claim("points", 1)
    claim("points", 2)
    with pytest.raises(UserError, match="what is 'points' there and 'records' here"):
        claim("records", 2)
    (tmp_path / "out" / "a.npy").touch()
    with pytest.raises(UserError, match=r"options\.step is 2 there and 1 here"):
        claim("points", 1)
    (tmp_path / "out" / "manifest.json").unlink()
    with pytest.raises(UserError, match=r"a\.npy is there, but no manifest\.json that"):
        claim("points", 2)


def test_files_that_are_not_those_of_a_description_are_rejected(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    path = tmp_path / "report.json"
    sums = checksums(tmp_path, "a", "b", "missing")
    # $ printf a | sha256sum
    assert sums["a"].startswith("ca978112ca1bbdcafac231b39a23dc4d")
    assert list(sums) == ["a", "b"]
    for content in ({}, {"sha256": sums}, {"sha256": {**sums, "missing": ""}}):
        files.write_json(path, content)
        assert read_checked(path) == content
    (tmp_path / "b").write_text("a")
    with pytest.raises(DataError, match="/b is corrupted or of another folder: its"):
        read_checked(path)
