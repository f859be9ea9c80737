import csv
import errno
import json
import math
import os
import re

import numpy as np
import pytest

from radejax.core.errors import DataError, DiskFullError
from radejax.evaluation import evaluate, report, scores
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, evaluate_files
from radejax.evaluation.results import ReportOptions

from .scenes import random_scene

OPTIONS = ReportOptions(roi=None, plots=False, protocols=("all_point",))
STORED = OPTIONS.replace(iou_thresholds=(0.3, 0.5), protocols=("coco101", "kradar_r40"))
STORED = STORED.replace(bootstrap=20, label_version="v2.1")


@pytest.fixture(scope="module")
def written(scene, tmp_path_factory):
    """Report of recorded frames, and its folder."""
    out = tmp_path_factory.mktemp("report")
    left_out = {"labels: not a class": 3}
    origin = report.Origin("mine", left_out=left_out, warnings=["a warning"])
    return report.write_report(*scene, out, STORED, origin), out


def test_texts_are_the_stored_ones(written, assert_stored):
    made, out = written
    assert_stored(out / "report.txt")
    assert_stored(out / "tables.md")
    assert made.text == (out / "report.txt").read_text()
    assert made.folder == out
    assert {path.name for path in out.iterdir()} == {
        *("metrics.json", "metrics.csv", "report.txt", "tables.md", "tables.tex"),
        *("tables", "predictions.npz", "ground_truth.npz", "frames.json"),
        "report.html",
    }
    # Each LaTeX table has its own file, named after its label.
    labels = re.findall(r"\\label{tab:(.*)}", (out / "tables.tex").read_text())
    assert {f"{label}.tex" for label in labels} == set(os.listdir(out / "tables"))
    assert len(labels) == len(re.findall(r"(?m)^\*\*", (out / "tables.md").read_text()))
    assert len(set(labels)) == len(labels)
    assert max(map(len, labels)) < 30


def test_simulated_frames_have_no_published_row(scene, tmp_path, assert_stored):
    truth, found, frames = scene
    frames = {**frames, "simulated": np.ones(30, bool)}
    origin = report.Origin("mine")
    made = report.write_report(truth, found, frames, tmp_path, STORED, origin)
    assert_stored(tmp_path / "report.txt", "simulated.txt")
    assert_stored(tmp_path / "tables.tex", "simulated.tex")
    assert all(row["name"].endswith("/simulated") for row in made.metrics["ap"])
    # A report that is evaluated again still says so.
    again = evaluate_files(tmp_path, tmp_path / "b", Source(), OPTIONS)
    assert again.metrics["is_simulated"]


def test_json_and_csv_hold_the_numbers_of_evaluate(written, scene):
    made, out = written
    text = (out / "metrics.json").read_text()
    metrics = json.loads(text, parse_constant=lambda name: 1 / 0)
    assert metrics == made.metrics
    rows = {row["name"]: row for row in metrics["ap"]}
    assert len(rows) == len(metrics["ap"])  # names are unique
    data = EvaluationSet(*scene[:2], frames=scene[2], label_version="v2.1")
    for protocol in ("coco101", "kradar_r40", "all_point"):
        for result in data.results(protocol, iou_thresholds=(0.3, 0.5)):
            row = rows[f"{result.cls}/all/{result.metric}"]
            assert row["num_gt"] == result.num_gt
            if result.is_defined:
                assert row["ap"] == pytest.approx(result.ap, abs=1e-12)
            else:
                official = None if math.isnan(result.ap) else 0.0
                assert (row["ap"], row["ap_official"]) == (None, official)
    with open(out / "metrics.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    for line, row in zip(lines, metrics["ap"], strict=True):
        assert line["ap"] == ("" if row["ap"] is None else repr(row["ap"]))


def test_invalid_sizes_are_rejected_or_kept_as_false_positives(scene, tmp_path):
    truth, found, frames = scene
    broken = {**found, "box": found["box"].copy()}
    broken["box"][5, 3] = -0.2
    broken["box"][[6, 7], [4, 5]] = np.float32(0.01)  # as decoding clips them
    with pytest.raises(DataError, match=r"row 5: l of the box is -0.2 m"):
        report.write_report(truth, broken, frames, tmp_path, OPTIONS)
    assert not list(tmp_path.iterdir())
    options = OPTIONS.replace(invalid_sizes="false_positive")
    made = report.write_report(truth, broken, frames, tmp_path, options)
    what = "predictions: size not positive, kept as false positives"
    assert made.metrics["left_out"][what] == 1
    assert made.metrics["left_out"]["predictions: size clipped to 0.01 m, kept"] == 2
    whole = evaluate(truth, found, protocol="all_point", frames=frames)
    assert made.results[0].num_det == whole[0].num_det


def test_an_evaluation_that_fails_leaves_the_old_results(scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    report.write_report(*scene, out, OPTIONS)
    (out / "notes.txt").write_text("mine")

    def content():
        return {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}

    before = content()

    def fill(path, *_):
        path.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(report, "write_boxes", fill)
        with pytest.raises(DiskFullError, match="no space left on the disk of"):
            report.write_report(*scene, out, OPTIONS, report.Origin("second"))
    assert content() == before
    report.write_report(*scene, out, OPTIONS, report.Origin("third"))
    assert (out / "notes.txt") in content()


def test_reports_without_conditions_or_boxes(scene, tmp_path):
    truth, found, frames = scene
    only = {"frame": frames["frame"]}
    made = report.write_report(truth, found, only, tmp_path / "a", OPTIONS)
    assert {row.condition for row in made.results} == {"all"}
    nothing = ({k: v[:0] for k, v in table.items()} for table in (truth, found))
    options = ReportOptions(figures="pdf")
    made = report.write_report(*nothing, frames, tmp_path, options)
    assert all(row.ap_or_none is None for row in made.results)
    for space in ("3d", "bev"):
        path = tmp_path / f"precision_recall_{space}_iou30.pdf"
        assert path.read_bytes().startswith(b"%PDF")


def test_score_thresholds_are_not_chosen_on_a_test_split(scene, tmp_path):
    truth, found, frames = scene
    other = EvaluationSet(*random_scene(1, num_frames=30, num_objects=90)[:2])
    split = {**frames, "split": np.full(30, "test")}

    def thresholds(frames, **options):
        made = report.write_report(truth, found, frames, tmp_path, OPTIONS, **options)
        rows = made.metrics["thresholds"]["chosen"]
        chosen = {row["cls"]: row for row in rows if row["rule"] == "best_f1"}
        return made.metrics["thresholds"]["chosen_on"], chosen, made.text

    on, chosen, text = thresholds(split)
    assert (on, chosen) == (None, {})
    assert "No score thresholds were chosen: `radejax evaluate RUN` does so" in text
    assert "Rule" not in text
    on, own, _ = thresholds(frames)
    assert on == "the evaluated frames themselves"
    on, chosen, text = thresholds(split, choosing=other)
    assert on == "the validation split"
    data = EvaluationSet(truth, found, frames=frames)
    for cls, row in chosen.items():
        there, here = (
            {x.cls: x for x in part.results("all_point", spaces="3d")}[cls]
            for part in (other, data)
        )
        threshold = scores.choose_thresholds(there, 0.9)["best_f1"]
        assert row["threshold"] == threshold
        assert row["f1"] == scores.rates_at(here, [threshold])["f1"] <= own[cls]["f1"]
        assert re.search(rf"{cls} +{threshold:.2f} .* best_f1", text)
        assert row["count"] == round(row["recall"] * here.num_gt) > 0
        assert row["num_gt"] == here.num_gt
    assert len(chosen) == 2
