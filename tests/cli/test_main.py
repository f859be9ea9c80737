"""The command line: help with examples, JSON, exit codes, no tracebacks."""

import json
import pathlib
import sys
from types import SimpleNamespace

import click.testing
import numpy as np
import pytest

from radejax.cli import main
from radejax.cli.figures import MODEL
from radejax.core.errors import UserError
from radejax.data.kradar import write
from radejax.data.kradar.labels import Label
from radejax.evaluation import kitti
from radejax.inference.saved import save_model

from .. import small_models


def _run(*arguments: object) -> click.testing.Result:
    return click.testing.CliRunner().invoke(main.main, [str(a) for a in arguments])


def _commands() -> list[list[str]]:
    found = []
    for name, command in main.main.commands.items():
        if isinstance(command, click.Group):
            found += [[name, sub] for sub in command.commands]
        else:
            found.append([name])
    return found


@pytest.mark.parametrize("command", _commands(), ids=" ".join)
def test_help_shows_an_example(command: list[str]) -> None:
    result = _run(*command, "--help")
    assert result.exit_code == 0
    assert "Example: radejax " + " ".join(command) in " ".join(result.output.split())


def test_help_of_evaluate_has_groups_of_options() -> None:
    text = _run("evaluate", "--help").output
    options, data, metrics = (
        text.index(f"\n{name}:") for name in ("Options", "Data", "Metrics")
    )
    assert options < data < text.index("--records") < metrics < text.index("--iou")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["detect", "/nowhere", "--workdir", "/nowhere", "--out", "x"], "'/nowhere'"),
        (["simulate", "--config", "nowhere.py", "--out", "x"], "nowhere.py"),
        (["simulate", "--sequences", "5", "--out", "x"], "real labels"),
        (["simulate", "--sequences", "5-6", "--out", "x"], "'5-6', expected 1,5,58"),
        (["preprocess", ".", "--out", "x", "--shard", "3/2"], "3/2"),
        (["preprocess", ".", "--out", "x", "--workers", "0"], "0 is not in the range"),
        (["demo", "--out", "demo"], "cannot write a figure as 'demo'; suffixes: ["),
        (["export", ".", "--out", __file__], "is a file"),
        (["data", "check", ".", "--weather="], "'', expected fog,rain"),
        (["evaluate", "run", "--data="], "'', expected A,B,..."),
        (["evaluate"], "error: give the workdir of a run"),
        (["evaluate", "run", "--frames=x"], "No such option"),
        (["score", "x", "--iou=x"], "'x', expected 0.3,0.5"),
        (["score", "x", "--roi=0,y"], "Invalid value for '--roi'"),
        (
            ["detect", ".", "--model", ".", "--out", "x", "--step", "last"],
            "'last' is neither a number nor \"best\"",
        ),
    ],
)
def test_wrong_use_is_exit_code_2_and_a_clear_line(
    arguments: list[str], message: str, tmp_path: pathlib.Path
) -> None:
    result = _run(*arguments)
    assert result.exit_code == 2
    assert message in result.output
    assert "Traceback" not in result.output


@pytest.fixture
def root(tmp_path: pathlib.Path) -> pathlib.Path:
    """A K-Radar root with one label and nothing else."""
    label = Label("Sedan", (10.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0), "R", 1)
    path = tmp_path / "kradar" / "1" / "info_label_v2_1" / "00033_00001.txt"
    write.write_labels(path, (33, 1, 2, 1, 4), 1.0, [label])
    return tmp_path / "kradar"


def test_check_reports_as_text_and_as_json(root: pathlib.Path) -> None:
    text = _run("data", "check", root)
    assert text.exit_code == 1, text.output  # the tesseract is missing
    assert "tesseract" in text.output
    values = _run("data", "check", root, "--json")
    assert isinstance(json.loads(values.output), dict)


def test_a_folder_without_frames_says_what_was_looked_for(
    root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    result = _run("detect", root, "--workdir", MODEL, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "tesseract_*.mat" in result.output


def test_failed_frames_are_listed_with_exit_code_1(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = {"frames": 1, "boxes": 2, "clipped": 0, "truncated": 0, "done": 0}
    failed = {f"5/{i:05d}": "x of the box is nan" for i in range(30)}
    place = "radejax.inference.detect_files"
    monkeypatch.setattr(f"{place}.find_inputs", lambda *args, **options: None)
    monkeypatch.setattr(
        f"{place}.detect_files", lambda *args, **options: (count, failed)
    )
    words = ("detect", tmp_path, "--workdir", MODEL, "--out", tmp_path / "out")
    result = _run(*words)
    assert result.exit_code == 1
    first, *lines = result.stdout.splitlines()
    assert first.endswith("; 30 failed")
    assert lines == [f"failed {k}: {x}" for k, x in list(failed.items())[:20]]
    result = _run(*words, "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["failed"] == failed


def test_debug_shows_the_traceback(tmp_path: pathlib.Path) -> None:
    arguments = ("export", tmp_path, "--out", tmp_path / "out")
    plain = _run(*arguments)
    assert plain.exit_code == 2
    assert plain.output.startswith(f"error: no model in {tmp_path}")
    assert isinstance(_run(*arguments, "--debug").exception, FileNotFoundError)


def test_evaluate_takes_flags_as_its_script_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from radejax.runs import evaluate

    seen = []

    def evaluate_run(workdir: str, **options: object) -> SimpleNamespace:
        seen.append((workdir, options))
        return SimpleNamespace(metrics={}, folder="there")

    monkeypatch.setattr(evaluate, "evaluate_run", evaluate_run)
    flags = ("--checkpoint=best", "--data", "a,b", "--data=c", "--label-version=v1.0")
    assert "Written to there" in _run("evaluate", "--workdir", "run", *flags).output
    other = {"roots": ("a", "b", "c"), "label_version": "v1.0"}
    assert seen.pop() == ("run", {"step": "best", "split": "test", "other": other})
    flags = "--roi=0,50,-5,5,-2,6 --min-score=0.01 --iou=0.5 --classes Sedan --name n"
    flags += " --split=train --protocols=all_point,auc --wanted-precision=0.8"
    assert _run("evaluate", "run", *flags.split()).exit_code == 0
    expected = {
        "split": "train",
        "other": None,
        "roi": (0.0, 50.0, -5.0, 5.0, -2.0, 6.0),
        "min_score": 0.01,
        "iou_thresholds": (0.5,),
        "classes": ("Sedan",),
        "protocols": ("all_point", "auc"),
        "wanted_precision": 0.8,
        "run": "n",
    }
    assert seen.pop() == ("run", expected)
    _run("evaluate", "run", "--roi=none")
    assert seen.pop() == ("run", {"split": "test", "other": None, "roi": None})


def test_export_takes_an_exported_folder(tmp_path: pathlib.Path) -> None:
    packed = tmp_path / "packed"
    save_model(small_models.saved(), packed)
    done = _run("export", packed, "--out", tmp_path / "hub", "--format", "huggingface")
    assert f"MiB written to {tmp_path / 'hub'}" in done.output
    for name in ("model.safetensors", "config.json"):
        written = (tmp_path / "hub" / name).read_bytes()
        assert written == (packed / name).read_bytes()
    for platform in ("foo", "gpu,foo"):
        wrong = _run("export", packed, "--out", tmp_path / "x", "--platforms", platform)
        assert wrong.exit_code == 2
        assert "error: platforms is (" in wrong.output
        assert "'foo'), expected" in wrong.output.replace("',)", "')")


def test_score_evaluates_predictions_in_files(tmp_path: pathlib.Path) -> None:
    box = np.array([[20.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], [30, 3, 0, 4, 2, 1.5, 0.1]])
    truth = {"frame": np.arange(2), "box": box, "cls": np.array(["Sedan"] * 2)}
    found = {**truth, "score": np.array([0.9, 0.8])}
    kitti.write_kitti(tmp_path / "kitti", truth, found, {"frame": np.arange(2)})
    arguments = ("score", tmp_path / "kitti", "--out", tmp_path / "out")
    assert json.loads(_run(*arguments, "--json").stdout)["num_ground_truth"] == 2
    assert (tmp_path / "out" / "metrics.json").is_file()
    words = ("--roi", "wide", "--bootstrap", 0, "--z-offset", "0.5")
    place = f"{tmp_path / 'kitti_evaluation'}_roi_wide_z_offset_m_0.5"
    text = _run("score", tmp_path / "kitti", *words).output
    assert text.endswith(f"Written to {place}\n")


def test_simulate_works_anywhere(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the repository's configs: the package has a small one of its own."""
    from radejax.simulation import dataset
    from radejax.simulation.config import SimulationOptions

    monkeypatch.chdir(tmp_path)
    seen = []
    monkeypatch.setattr(
        dataset, "simulate_dataset", lambda *a, **kw: seen.append((a, kw))
    )
    assert _run("simulate", "--out", "data", "--frames", 3).exit_code == 0
    (((config, out), _),) = seen
    assert config == SimulationOptions(frames_per_sequence=3)
    assert out == pathlib.Path("data")


def test_roots_are_separate_repeated_or_with_commas(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from radejax.data.kradar import check

    names = ("a", "b", "c", "d,e")
    for name in names:
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)

    def look(roots: object, *_: object, **__: object) -> None:
        raise UserError(f"opened {' '.join(map(str, roots))}")

    monkeypatch.setattr(check, "check_dataset", look)
    monkeypatch.setattr("radejax.cli.entry.read_frames", look)
    assert "opened a b c d,e" in _run("data", "check", *names).output
    assert "'x' does not exist" in _run("data", "check", "a", "x").output
    assert "opened a b c" in _run("overlay", "1", "--data", "a,b", "--data", "c").output


def test_a_part_of_the_data_is_chosen(
    monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path
) -> None:
    from radejax.data.kradar import check

    seen = []

    def look(*_: object, **options: object) -> None:
        seen.append((options["sequences"], options["weather"]))
        raise UserError("opened")

    monkeypatch.setattr(check, "check_dataset", look)
    monkeypatch.setattr("radejax.cli.entry.read_frames", look)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert _run("view", tmp_path).output.startswith("error: recordings need rerun, wh")
    assert not seen  # no frames are read, and there is no bar
    checked = "radejax.visualize.recordings.check_recording"
    monkeypatch.setattr(checked, lambda path: None)
    part = ("--sequences", "1,58", "--weather", "fog", "--weather", "rain")
    for command in (["data", "check"], ["preprocess", "--out", tmp_path], ["view"]):
        assert "opened" in _run(*command, tmp_path, *part).output
    assert seen == 3 * [((1, 58), ("fog", "rain"))]
    _run("data", "check", tmp_path)
    assert seen[-1] == (None, None)
