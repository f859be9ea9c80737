import csv
import errno
import json
import math
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from radejax.core.errors import DataError, DiskFullError
from radejax.evaluation import evaluate, report
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import PROTOCOLS
from radejax.evaluation.results import ReportOptions

OPTIONS = ReportOptions(roi=None, plots=False, protocols=("all_point",))


@pytest.fixture(scope="module")
def scene(random_scene):
    return random_scene(8, num_frames=30, num_objects=90)


@pytest.fixture(scope="module")
def written(scene, tmp_path_factory):
    """Report of all protocols, and its folder."""
    out = tmp_path_factory.mktemp("report")
    options = ReportOptions(roi=None, plots=False, bootstrap=20, label_version="v2.1")
    return report.write_report(*scene, out, options, run="mine"), out


def test_report_folder_has_all_files_and_no_temporary_ones(written):
    made, out = written
    names = {p.name for p in out.iterdir()}
    assert names == {
        "metrics.json", "metrics.csv", "report.txt", "tables.md", "tables.tex", "tables",
        "predictions.npz", "ground_truth.npz", "frames.json",
    }  # fmt: skip
    assert made.folder == out
    assert (out / "report.txt").read_text() == made.text


def test_json_and_csv_hold_the_numbers_of_evaluate(written, scene):
    made, out = written
    metrics = json.loads(
        (out / "metrics.json").read_text(), parse_constant=lambda name: 1 / 0
    )
    assert metrics == made.metrics
    rows = {row["name"]: row for row in metrics["ap"]}
    assert len(rows) == len(metrics["ap"])  # names are unique
    data = EvaluationSet(*scene[:2], frames=scene[2], label_version="v2.1")
    for protocol in PROTOCOLS:
        for result in data.results(protocol, iou_thresholds=(0.3, 0.5, 0.7)):
            row = rows[f"{result.cls}/all/{result.metric}"]
            if result.is_defined:
                assert row["ap"] == pytest.approx(result.ap, abs=1e-12)
                if not result.protocol.startswith("kradar"):
                    assert row["ap_low"] - 1e-9 <= row["ap_high"]
            else:
                assert row["ap"] is None
                official = None if math.isnan(result.ap) else 0.0
                assert row["ap_official"] == official
            assert row["num_gt"] == result.num_gt
    assert metrics["options"]["roi"] is None
    assert set(metrics["subsets"]) >= {"distance", "weather", "environment", "time"}
    with open(out / "metrics.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    for line, row in zip(lines, metrics["ap"], strict=True):
        assert line["ap"] == ("" if row["ap"] is None else repr(row["ap"]))


def test_means_are_over_classes_that_occur(written):
    table = {row.key: row for row in written[0].results}
    for protocol in PROTOCOLS:
        for condition in ("all", "fog"):
            present = [
                row.ap
                for (*key, cls, space, iou), row in table.items()
                if (*key, space, iou) == (protocol, condition, "3d", 0.3)
                and cls != "mean"
                and row.is_defined
            ]
            mean = table[protocol, condition, "mean", "3d", 0.3].ap_or_none
            assert mean == pytest.approx(np.mean(present))


def test_tables_include_the_published_rows(written):
    _, out = written
    text = (out / "tables.md").read_text()
    for cell in ("85.4", "77.42", "64.06", "RADE-Net, Table II", "DinoRADE, Table 1"):
        assert cell in text
    # A class that does not occur shows a dash.
    lines = text.split("**By ")[0].splitlines()
    ours = [line for line in lines if line.startswith("| Motorcycle")]
    assert len(ours) == 3 * len(PROTOCOLS)
    assert all({x.strip() for x in y.split("|")[2:-1]} == {"- / -"} for y in ours)
    latex = (out / "tables.tex").read_text()
    count = latex.count(r"\begin{tabular}")
    assert count == text.count("**") / 2 > 5
    assert latex.count(r"\toprule") == latex.count(r"\end{tabular}") == count
    caption = r"\\caption{AP .* kradar\\_r40, score\\ensuremath{>}0, skip=frame"
    assert re.search(caption, latex)
    # Each table has a label, and its own file named after it.
    labels = re.findall(r"\\label{tab:(.*)}", latex)
    assert len(set(labels)) == count
    assert {f"{label}.tex" for label in labels} == set(os.listdir(out / "tables"))
    ablations = out / "tables" / "ablations-sedan-layout-of-table-iii.tex"
    assert "39.02" in ablations.read_text()


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
            report.write_report(*scene, out, OPTIONS, run="second")
    assert content() == before
    report.write_report(*scene, out, OPTIONS, run="third")
    assert (out / "notes.txt") in content()


def test_frame_table_may_have_only_ids(scene, tmp_path):
    truth, found, frames = scene
    only = {"frame": frames["frame"]}
    made = report.write_report(truth, found, only, tmp_path, OPTIONS)
    assert {row.condition for row in made.results} == {"all"}
    assert "Total" in made.text


def test_report_without_any_boxes(tmp_path, scene):
    truth, found = ({k: v[:0] for k, v in table.items()} for table in scene[:2])
    options = ReportOptions()
    made = report.write_report(truth, found, scene[2], tmp_path, options)
    assert all(row.ap_or_none is None for row in made.results)
    assert (tmp_path / "precision_recall_bev_iou30.png").is_file()


def test_curves_are_drawn_of_classes_that_occur(scene, tmp_path, monkeypatch):
    from radejax.visualize import curves

    drawn = []
    draw = curves.draw_precision_recall

    def watched(panels):
        drawn.append(panels)
        return draw(panels)

    monkeypatch.setattr(curves, "draw_precision_recall", watched)
    options = OPTIONS.replace(plots=True)
    report.write_report(*scene, tmp_path, options)
    assert sorted(path.name for path in tmp_path.glob("*.png")) == [
        "precision_recall_3d_iou30.png",
        "precision_recall_bev_iou30.png",
    ]
    assert list(drawn[0]) == [
        f"{cls}, all_point, 3d, IoU 0.3" for cls in ("Sedan", "Bus or Truck")
    ]
    lines = drawn[0]["Sedan, all_point, 3d, IoU 0.3"]
    assert [name.split(",")[0] for name in lines] == ["all", "normal", "fog", "rain"]
    data = EvaluationSet(*scene[:2], frames=scene[2])
    whole = data.results("all_point", iou_thresholds=0.3, spaces="3d")[0]
    np.testing.assert_array_equal(lines[f"all, AP {whole.ap:.1f}"][0], whole.recall)


def test_matplotlib_is_imported_only_to_draw():
    code = "import sys, radejax.evaluation.report as _; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert b"radejax.evaluation.report" in done.stdout
    assert b"matplotlib" not in done.stdout
