"""Descriptions of output folders."""

import json

import pytest

from radejax.core.errors import DataError, UserError
from radejax.core.manifest import Manifest, state_of


def test_a_folder_without_a_description_has_no_manifest(tmp_path):
    assert Manifest.open(tmp_path) is None


def test_what_several_calls_log_is_read_by_the_next_one(tmp_path):
    source = tmp_path / "radar.npy"
    source.write_bytes(b"1234")
    state = state_of([source, None, tmp_path / "absent.png"])
    assert [entry[:2] for entry in state] == [["radar.npy", 4]]
    job = tmp_path / "out"
    for name in ("a.json", "b.json"):
        with Manifest.claim(job, "boxes", {}, ["a.json", "b.json"]).log() as add:
            add(name, state)
            (job / name).write_text("[]")
    found = Manifest.open(job)
    assert found.sources == {"a.json": state, "b.json": state}
    assert found.is_done("a.json")
    found.check_whole("*.json", "fix it")
    with found.log():  # a call that writes nothing leaves no file
        pass
    assert len(list(job.glob("manifest.*.jsonl"))) == 2


def test_an_incomplete_last_line_is_ignored(tmp_path):
    Manifest.claim(tmp_path, "boxes", {})
    (tmp_path / "manifest.1.jsonl").write_text('["a", []]\n["b", [["c.n')
    assert Manifest.open(tmp_path).sources == {"a": []}


@pytest.mark.parametrize(
    ("options", "names", "message"),
    [
        ({"step": 2}, ["a"], "holds other boxes: options.step is 1 there and 2 here"),
        ({"step": 1}, ["a", "b"], r"names is \['a'\] there and \['a', 'b'\] here"),
    ],
)
def test_another_job_in_the_folder_is_an_error(tmp_path, options, names, message):
    Manifest.claim(tmp_path, "boxes", {"step": 1}, ["a"])
    content = json.loads((tmp_path / "manifest.json").read_text())
    content["radejax"] = "0.1.0"  # another version may continue
    (tmp_path / "manifest.json").write_text(json.dumps(content))
    Manifest.claim(tmp_path, "boxes", {"step": 1}, ["a"])
    with pytest.raises(UserError, match=message):
        Manifest.claim(tmp_path, "boxes", options, names)


@pytest.mark.parametrize(
    ("logged", "there", "message"),
    [
        (
            "a",
            "a",
            "an interrupted job, which did not write 1 of 2 files, such as b.json",
        ),
        ("ab", "b", "a partial copy, without 1 of 2 files, such as a.json"),
        (
            "ab",
            "abc",
            "1 files that are not of the job that wrote the others, such as c",
        ),
    ],
)
def test_missing_and_foreign_files_are_distinguished(tmp_path, logged, there, message):
    manifest = Manifest.claim(tmp_path, "boxes", {}, ["a.json", "b.json"])
    with manifest.log() as add:
        for name in logged:
            add(f"{name}.json", [])
    for name in there:
        (tmp_path / f"{name}.json").write_text("[]")
    with pytest.raises(DataError, match=f"{message}.*; fix it"):
        Manifest.open(tmp_path).check_whole("*.json", "fix it")
