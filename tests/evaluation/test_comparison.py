import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner

from radejax.cli.main import main
from radejax.core.errors import UserError
from radejax.evaluation import comparison, kitti
from radejax.evaluation.comparison import compare, compare_files
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, evaluate_files
from radejax.evaluation.report import write_report
from radejax.evaluation.results import (
    EvaluationOptions,
    interval,
    resample,
    sequence_weights,
)

CLASSES = ("Sedan", "Bus or Truck")


@pytest.fixture
def scene(random_scene):
    return random_scene(1, num_frames=60, num_objects=200, ties=False)


def make(truth, found, frames):
    return EvaluationSet(truth, found, classes=CLASSES, frames=frames)


def thin(found, keep):
    rows = np.random.default_rng(0).random(len(found["score"])) < keep
    return {k: v[rows] for k, v in found.items()}


def test_a_run_does_not_differ_from_itself(scene):
    data = make(*scene)
    rows = compare(data, data, scene[2]["sequence"], resamples=100)
    assert {row.cls for row in rows} == {"Sedan", "Bus or Truck", "mean"}
    for row in rows:
        assert (row.difference, row.low, row.high) == (0, 0, 0)
        assert row.p_value == 1
        assert not row.is_significant


def test_a_large_difference_is_significant_and_antisymmetric(scene):
    truth, found, frames = scene
    good, bad = make(truth, found, frames), make(truth, thin(found, 0.3), frames)
    terms = {
        "resamples": 1000,
        "iou": 0.2,
        "protocol_names": ("all_point",),
    }
    forward = compare(bad, good, frames["sequence"], **terms)
    backward = compare(good, bad, frames["sequence"], **terms)
    for one, other in zip(forward, backward, strict=True):
        assert one.difference == pytest.approx(-other.difference)
        assert (one.low, one.high) == pytest.approx((-other.high, -other.low))
        assert one.p_value == pytest.approx(other.p_value)
    sedan = next(row for row in forward if row.cls == "Sedan")
    assert sedan.difference > 10
    assert sedan.low > 0
    assert sedan.is_significant


def test_the_comparison_is_paired(scene):
    """The interval of the difference is narrower than unpaired resampling gives."""
    truth, found, frames = scene
    one, other = make(truth, found, frames), make(truth, thin(found, 0.95), frames)
    row = compare(
        one, other, frames["sequence"], resamples=300, protocol_names=("all_point",)
    )[0]
    samples = [
        resample(
            data,
            sequence_weights(frames["sequence"], resamples=300, seed=seed),
            "all_point",
            "bev",
            0.3,
        )
        for seed, data in enumerate((other, one))
    ]
    low, high = interval((samples[0] - samples[1])[:, 0])
    assert row.high - row.low < 0.7 * (high - low)


def test_holm():
    adjusted = comparison._holm(np.array([0.01, 0.04, 0.03, 0.005]))
    assert adjusted == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_runs_on_different_data_cannot_be_compared(scene):
    truth, found, frames = scene
    data = make(truth, found, frames)
    other = {k: v[1:] for k, v in truth.items()}
    moved = {**truth, "box": truth["box"] + 0.1}
    three = EvaluationSet(truth, found, classes=(*CLASSES, "Bicycle"), frames=frames)
    for run, message in (
        (make(other, found, frames), r"different objects \(200 and 199\)"),
        (make(moved, found, frames), "different objects"),
        (three, "different classes"),
    ):
        with pytest.raises(UserError, match=message):
            compare(data, run, frames["sequence"])


# Runs in files ------------------------------------------------------------------------

OPTIONS = EvaluationOptions(
    bootstrap=30, roi=None, plots=False, protocols=("all_point", "kradar_r40")
)


def test_comparison_of_reports(stored, stored_scene, write_table):
    folder, source = stored
    _, found, frames = stored_scene
    few = {k: v[::3] for k, v in found.items()}
    write_table(folder / "few.json", few, frames)
    for name in ("found", "few"):
        evaluate_files(folder / f"{name}.json", folder / name, source, OPTIONS)
    pair = [folder / "few", folder / "found"]
    text, rows = compare_files(pair, folder / "out", Source(), OPTIONS)
    assert next(row for row in rows if row["cls"] == "Sedan")["difference"] > 0
    assert (folder / "out" / "comparison.txt").read_text() == text
    written = json.loads((folder / "out" / "comparison.json").read_text())
    assert written["rows"] == rows
    of_files = [folder / "few.json", folder / "found.json"]
    again, _ = compare_files(of_files, None, source, OPTIONS)
    assert again.splitlines()[3:14] == text.splitlines()[3:14]
    three = [*pair, folder / "few"]
    text, rows_of_three = compare_files(three, None, Source(), OPTIONS)
    assert text.count("B - A") == 2
    assert rows_of_three[: len(rows)] == rows


def test_a_warning_names_the_score_from_which_predictions_were_stored(
    stored_scene, tmp_path
):
    truth, found, frames = stored_scene
    kept = {k: v[found["score"] > 0.3] for k, v in found.items()}
    for name, table, min_score in (("old", kept, 0.3), ("new", found, 0.05)):
        options = dataclasses.replace(OPTIONS, score_threshold=0.3, min_score=min_score)
        made = write_report(truth, table, frames, tmp_path / name, options)
        thresholds = {r.protocol: r.score_threshold for r in made.results}
        assert thresholds == {"all_point": min_score, "kradar_r40": 0.3}
    old = evaluate_files(tmp_path / "old", tmp_path / "a", Source(), OPTIONS)
    assert "has only predictions from score 0.3 on" in old.metrics["warnings"][0]
    assert "WARNING: " in old.text
    assert "/all_point/score>0.3/" in old.metrics["ap"][0]["name"]
    new = evaluate_files(tmp_path / "new", tmp_path / "b", Source(), OPTIONS)
    assert new.metrics["warnings"] == []
    runs = [tmp_path / "old", tmp_path / "new"]
    _, rows = compare_files(runs, None, Source(), OPTIONS)
    # Both runs are compared above the score from which one was stored.
    assert {row["difference"] for row in rows} == {0.0}


def test_incomparable_runs_are_reported(stored_scene, tmp_path):
    kitti.write_kitti(tmp_path, *stored_scene)
    once = dataclasses.replace(OPTIONS, bootstrap=0)
    for paths, options, message in (
        ([tmp_path, tmp_path], OPTIONS, "has no column sequence"),
        ([tmp_path], OPTIONS, "at least two runs"),
        ([tmp_path, tmp_path], once, "a comparison needs 1 resample"),
    ):
        with pytest.raises(UserError, match=message):
            compare_files(paths, None, Source(), options)


def test_command_line(stored):
    folder, source = stored
    arguments = [
        "compare", folder / "found.json", folder / "found.json", "--bootstrap", 20,
        "--ground-truth", source.ground_truth, "--roi", "none", "--classes", "Sedan",
    ]  # fmt: skip
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.stderr
    assert "B - A" in done.stdout
