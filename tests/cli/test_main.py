"""The command line: help with examples, JSON, exit codes, no tracebacks."""

import json
import sys
from types import SimpleNamespace
from unittest import mock

import click
import pytest

from radejax.cli import main
from radejax.cli.figures import MODEL
from radejax.core.errors import UserError
from radejax.inference.saved import save_model

from .. import small_models
from ..commands import run


def _commands():
    found = []
    for name, command in main.main.commands.items():
        if isinstance(command, click.Group):
            found += [[name, sub] for sub in command.commands]
        else:
            found.append([name])
    return found


@pytest.mark.parametrize("command", _commands(), ids=" ".join)
def test_help_shows_an_example(command):
    text = run(*command, "--help").output
    assert "Example: radejax " + " ".join(command) in " ".join(text.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["detect", "/nowhere", "--workdir", "/nowhere", "--out", "x"], "'/nowhere'"),
        (["simulate", "--config", "nowhere.py", "--out", "x"], "nowhere.py"),
        (["simulate", "--sequences", "5", "--out", "x"], "real labels"),
        (["preprocess", ".", "--out", "x", "--shard", "3/2"], "3/2"),
        (["demo", "--out", "demo"], "cannot write a figure as 'demo'; suffixes: ["),
        (["export", ".", "--out", __file__], "is a file"),
        (["evaluate"], "error: give the workdir of a run"),
        (["evaluate", "run", "--frames=x"], "No such option"),
        (["score", "x", "--iou=x"], "'x', expected 0.3,0.5"),
        (
            ["detect", ".", "--model", ".", "--out", "x", "--step", "last"],
            "'last' is neither",
        ),
    ],
)
def test_wrong_use_is_exit_code_2_and_a_clear_line(arguments, message, tmp_path):
    assert message in run(*arguments, code=2).output


def test_failed_frames_are_listed_with_exit_code_1(tmp_path, monkeypatch):
    count = {"frames": 1, "boxes": 2, "clipped": 0, "truncated": 0, "done": 0}
    failed = {f"5/{i:05d}": "x of the box is nan" for i in range(30)}
    place = "radejax.inference.detect_files"
    monkeypatch.setattr(f"{place}.find_inputs", lambda *args, **options: None)
    monkeypatch.setattr(f"{place}.detect_files", lambda *_, **__: (count, failed))
    words = ("detect", tmp_path, "--workdir", MODEL, "--out", tmp_path / "out")
    first, *lines = run(*words, code=1).stdout.splitlines()
    assert first.endswith("; 30 failed")
    assert lines == [f"failed {k}: {x}" for k, x in list(failed.items())[:20]]
    assert json.loads(run(*words, "--json", code=1).stdout)["failed"] == failed


def test_debug_shows_the_traceback(tmp_path):
    words = ("export", tmp_path, "--out", tmp_path / "out")
    assert run(*words, code=2).output.startswith(f"error: no model in {tmp_path}")
    assert isinstance(run(*words, "--debug", code=1).exception, FileNotFoundError)


def test_evaluate_takes_flags_as_its_script_does(monkeypatch):
    from radejax.runs import evaluate

    made = SimpleNamespace(metrics={}, folder="there")
    evaluate_run = mock.Mock(return_value=made)
    monkeypatch.setattr(evaluate, "evaluate_run", evaluate_run)
    flags = ("--checkpoint=best", "--data", "a,b", "--data=c", "--label-version=v1.0")
    assert "Written to there" in run("evaluate", "--workdir", "run", *flags).output
    other = {"roots": ("a", "b", "c"), "label_version": "v1.0"}
    evaluate_run.assert_called_once_with("run", step="best", split="test", other=other)


def test_export_takes_an_exported_folder(tmp_path):
    packed = tmp_path / "packed"
    save_model(small_models.saved(), packed)
    done = run("export", packed, "--out", tmp_path / "hub", "--format", "huggingface")
    assert f"MiB written to {tmp_path / 'hub'}" in done.output
    for name in ("model.safetensors", "config.json"):
        written = (tmp_path / "hub" / name).read_bytes()
        assert written == (packed / name).read_bytes()


def test_roots_are_separate_repeated_or_with_commas(tmp_path, monkeypatch):
    from radejax.data.kradar import check

    names = ("a", "b", "c", "d,e")
    for name in names:
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)

    def look(roots, *_, **__):
        raise UserError(f"opened {' '.join(map(str, roots))}")

    monkeypatch.setattr(check, "check_dataset", look)
    monkeypatch.setattr("radejax.cli.entry.read_frames", look)
    for words, text in (
        (("data", "check", *names), "opened a b c d,e"),
        (("data", "check", "a", "x"), "'x' does not exist"),
        (("overlay", "1", "--data", "a,b", "--data", "c"), "opened a b c"),
    ):
        assert text in run(*words, code=2).output


def test_a_part_of_the_data_is_chosen(monkeypatch, tmp_path):
    from radejax.data.kradar import check

    seen = []

    def look(*_, **options):
        seen.append((options["sequences"], options["weather"]))
        raise UserError("opened")

    monkeypatch.setattr(check, "check_dataset", look)
    monkeypatch.setattr("radejax.cli.entry.read_frames", look)
    monkeypatch.setitem(sys.modules, "rerun", None)
    text = run("view", tmp_path, code=2).output
    assert text.startswith("error: recordings need rerun, wh")
    assert not seen  # no frames are read, and there is no bar
    checked = "radejax.visualize.recordings.check_recording"
    monkeypatch.setattr(checked, lambda path: None)
    part = ("--sequences", "1,58", "--weather", "fog", "--weather", "rain")
    for command in (["data", "check"], ["preprocess", "--out", tmp_path], ["view"]):
        assert "opened" in run(*command, tmp_path, *part, code=2).output
    assert seen == 3 * [((1, 58), ("fog", "rain"))]
    run("data", "check", tmp_path, code=2)
    assert seen[-1] == (None, None)
