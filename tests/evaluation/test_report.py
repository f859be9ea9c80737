import csv
import errno
import json
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from radejax.core.errors import DataError, DiskFullError, UserError
from radejax.evaluation import evaluate, plots, published, report, results, tables
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import PROTOCOLS
from radejax.evaluation.results import EvaluationOptions
from radejax.visualize.style import SERIES_COLORS

TERMS = {"roi": None, "plots": False}


@pytest.fixture(scope="module")
def scene(random_scene):
    return random_scene(8, num_frames=30, num_objects=90)


@pytest.fixture(scope="module")
def written(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    drawn = []

    def draw(frame, path):
        drawn.append(frame)
        path.write_text("picture")

    made = report.write_report(
        *scene, out, run="mine", bootstrap=20, label_version="v2.1", draw_frame=draw,
        worst_frames=3, **TERMS
    )  # fmt: skip
    return made, out, drawn


def test_files_are_there_and_nothing_half_written(written):
    made, out, drawn = written
    names = {p.name for p in out.iterdir()}
    assert names == {
        "metrics.json", "metrics.csv", "report.txt", "tables.md", "tables.tex",
        "predictions.npz", "ground_truth.npz", "frames.json", "worst_frames",
    }  # fmt: skip
    assert all(path.is_file() for path in made.files)
    assert len(drawn) == 3
    assert [w["frame"] for w in made.metrics["worst_frames"]] == drawn
    assert (out / "report.txt").read_text() == made.text


def test_json_holds_the_numbers_of_evaluate(written, scene):
    _, out, _ = written
    metrics = json.loads(
        (out / "metrics.json").read_text(), parse_constant=lambda name: 1 / 0
    )
    rows = {row["name"]: row for row in metrics["ap"]}
    assert len(rows) == len(metrics["ap"])  # names are unique
    truth, found, frames = scene
    for protocol in PROTOCOLS:
        for result in evaluate(
            truth,
            found,
            iou_thresholds=(0.3, 0.5, 0.7),
            protocol=protocol,
            frames=frames,
            label_version="v2.1",
        ):
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
    assert metrics["subsets"]["time"]
    assert metrics["subsets"]["environment"]


def test_means_are_over_classes_that_occur(written):
    made, _, _ = written
    table = tables.index(made.results)
    for protocol in PROTOCOLS:
        for condition in ("all", "fog"):
            present = [
                row.ap_or_none
                for key, row in table.items()
                if key[:2] == (protocol, condition)
                and key[3:] == ("3d", 0.3)
                and key[2] != "mean"
                and row.ap_or_none is not None
            ]
            mean = table[protocol, condition, "mean", "3d", 0.3].ap_or_none
            assert mean == pytest.approx(np.mean(present))


def test_csv_is_the_same_table(written):
    made, out, _ = written
    with open(out / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(made.results)
    for row, measured in zip(rows, made.results, strict=True):
        shown = measured.ap_or_none
        assert row["ap"] == ("" if shown is None else repr(shown))


def test_a_class_that_does_not_occur_shows_a_dash(written):
    made, out, _ = written
    text = (out / "tables.md").read_text().split("**By ")[0]
    lines = [line for line in text.splitlines() if line.startswith("| Motorcycle")]
    ours = [line for line in lines if "Dino" not in line and "difference" not in line]
    assert ours
    for line in ours:
        cells = [cell.strip() for cell in line.split("|")[2:-1]]
        assert all(cell in ("-", "- / -", "mine") for cell in cells)
    assert (
        "0.99"
        not in made.text.split("Not part of")[0].split("Motorcycle")[1].split("\n")[0]
    )


def test_tables_stand_beside_the_published_rows(written):
    _, out, _ = written
    text = (out / "tables.md").read_text()
    for cell in ("85.4", "77.42", "64.06", "RADE-Net, Table II", "DinoRADE, Table 1"):
        assert cell in text
    latex = (out / "tables.tex").read_text()
    count = latex.count(r"\begin{tabular}")
    assert count == text.count("**") / 2 > 5
    assert latex.count(r"\toprule") == latex.count(r"\end{tabular}") == count
    titles = [line for line in latex.splitlines() if line.startswith("% AP")]
    assert any("kradar_r40, score>0, skip=frame" in title for title in titles)


def test_differences_are_ours_minus_theirs(written):
    made, _, _ = written
    table = tables.index(made.results)
    options = EvaluationOptions(roi="narrow", label_version="v1.1", plots=False)
    built = published.table_1(table, options, "mine", "test")
    row = next(
        row
        for row in built.rows
        if row[0] == "mine - RADE-Net"
        and row[1] == "RADE-Net, Table I"
        and row[3] == "3D"
    )
    ours = table["coco101", "all", "Sedan", "3d", 0.3].ap_or_none
    assert float(row[4]) == pytest.approx(ours - 64.1, abs=0.0051)
    assert row[6] == "-"  # no overcast frames here
    three = published.table_3({"one": table, "two": table})
    assert [row[0] for row in three.rows[-2:]] == ["one", "two"]
    assert len(three.rows) == 7 + 4 + 2


def test_what_was_left_out_is_counted(scene):
    truth, found, frames = scene
    data = EvaluationSet(truth, found, frames=frames, roi=(6, 20, -4, 4, -3, 3))
    options = EvaluationOptions(score_threshold=0.3)
    counts = results.exclusion_counts(data, options)
    kept = len(data.gt) + counts["ground truth: center outside the region of interest"]
    assert kept == len(truth["frame"])
    assert (
        counts["predictions: score not above 0.3 (counted by all_point)"]
        == (data.pred.score <= 0.3).sum()
    )
    empty = ~np.isin(np.arange(30), data.gt.frame)
    assert counts["frames: without ground truth (ignored by skip=frame)"] == empty.sum()
    above = data.pred.score > 0.3
    assert (
        counts["predictions: in frames without ground truth (ignored by skip=frame)"]
        == (empty[data.pred.frame] & above).sum()
    )
    found = data.results("coco101", score_threshold=0.3, spaces="3d")
    left = counts["predictions: in frames without their class (ignored by skip=class)"]
    assert sum(r.num_det for r in found) == above.sum() - left


def test_sizes_of_an_untrained_network(scene, tmp_path):
    truth, found, frames = scene
    broken = {**found, "box": found["box"].copy()}
    broken["box"][5, 3] = -0.2
    broken["box"][[6, 7], [4, 5]] = np.float32(0.01)  # as decoding clips them
    with pytest.raises(DataError, match=r"row 5: l of the box is -0.2 m"):
        report.write_report(truth, broken, frames, tmp_path, **TERMS)
    assert not list(tmp_path.iterdir())
    made = report.write_report(
        truth,
        broken,
        frames,
        tmp_path,
        invalid_sizes="false_positive",
        protocols=("all_point",),
        **TERMS,
    )
    what = "predictions: size not positive, kept as false positives"
    assert made.metrics["left_out"][what] == 1
    assert made.metrics["left_out"]["predictions: size clipped to 0.01 m, kept"] == 2
    whole = evaluate(truth, found, protocol="all_point", frames=frames)
    row = made.results[0]
    assert row.num_det == whole[0].num_det
    with pytest.raises(UserError, match='"error" or "false_positive"'):
        EvaluationOptions(invalid_sizes="drop")


def test_an_evaluation_that_fails_leaves_the_old_results(scene, tmp_path):
    out, terms = tmp_path / "out", {"protocols": ("all_point",), **TERMS}

    def draw(frame, path):
        path.write_text(f"first, {frame}")

    report.write_report(*scene, out, draw_frame=draw, worst_frames=4, **terms)
    (out / "notes.txt").write_text("mine")

    def content():
        return {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}

    before = content()

    def fill(frame, path):
        path.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with pytest.raises(DiskFullError, match="no space left on the disk of"):
        report.write_report(*scene, out, draw_frame=fill, run="second", **terms)
    assert content() == before
    made = report.write_report(*scene, out, draw_frame=draw, worst_frames=2, **terms)
    after = content()
    assert set(made.files) == set(after) - {out / "notes.txt"}
    assert len(list((out / "worst_frames").iterdir())) == 2  # of this evaluation alone


def test_conditions_are_in_the_papers_order():
    frames = {"frame": [0] * 4, "weather": ["sleet", "martian", "normal", "fog"]}
    masks = results.condition_masks(frames, "weather")
    assert list(masks) == ["normal", "fog", "sleet", "martian"]
    assert masks["fog"].tolist() == [False, False, False, True]
    assert results.condition_masks(frames, "time") == {}


def test_frames_with_ids_only(scene, tmp_path):
    truth, found, frames = scene
    only = {"frame": frames["frame"]}
    made = report.write_report(
        truth,
        found,
        only,
        tmp_path,
        EvaluationOptions(protocols=("all_point",), **TERMS),
    )
    assert {row.condition for row in made.results} == {"all"}
    assert "Total" in made.text


def test_nothing_at_all(tmp_path, scene):
    truth, found, frames = scene
    none = {k: v[:0] for k, v in found.items()}
    made = report.write_report(
        {k: v[:0] for k, v in truth.items()}, none, frames, tmp_path, **TERMS
    )
    assert all(row.ap_or_none is None for row in made.results)


def test_curves_are_drawn(scene, tmp_path):
    truth, found, frames = scene
    made = report.write_report(
        truth, found, frames, tmp_path, roi=None, protocols=("all_point",), run="x"
    )
    pictures = sorted(p.name for p in made.files if p.suffix == ".png")
    assert pictures == [
        "precision_recall_3d_iou30.png",
        "precision_recall_bev_iou30.png",
    ]
    for path in made.files:
        if path.suffix == ".png":
            assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_matplotlib_waits_until_something_is_drawn():
    code = "import sys, radejax.evaluation.report as _; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert b"radejax.evaluation.report" in done.stdout
    assert b"matplotlib" not in done.stdout


@pytest.mark.wrong_types
def test_panels_of_curves_say_the_protocol_and_none_is_blank():
    def result(cls, is_defined):
        line = np.array([0.0, 1.0])
        values = {"cls": cls, "ap": 50.0, "is_defined": is_defined}
        return SimpleNamespace(**values, recall=line, precision=line)

    everywhere = [result("Sedan", True), result("Bicycle", True), result("Bus", False)]
    in_fog = [result("Sedan", False), result("Bicycle", False), result("Bus", False)]
    rain = [result("Sedan", True), *in_fog[1:]]
    results = {"all": everywhere, "fog": in_fog, "rain": rain}
    figure = plots._precision_recall(results, "all_point, bev, IoU 0.3")
    titles = [ax.get_title() for ax in figure.axes]
    assert titles == [
        "Sedan, all_point, bev, IoU 0.3",
        "Bicycle, all_point, bev, IoU 0.3",
    ]
    names = [[line.get_label()[:4] for line in ax.lines] for ax in figure.axes]
    assert names == [["all,", "rain"], ["all,"]]
    assert not figure.axes[0].texts
    missed = SimpleNamespace(**vars(result("Bus", True)) | {"recall": np.zeros(2)})
    (panel,) = plots._precision_recall({"all": [missed]}, "all_point").axes
    assert [text.get_text() for text in panel.texts] == ["none found"]
    # Fog has a colour of its own where it is not drawn: rain's is the third.
    assert figure.axes[0].lines[1].get_color() == SERIES_COLORS[2]


def test_worst_frames_are_named_like_other_pictures(scene, tmp_path):
    truth, found, frames = scene
    ids = np.asarray(frames["frame"])
    names = {"name": np.array([f"{i:05d}_00001" for i in ids]), "sequence": ids + 3}
    report.write_report(
        truth, found, {**frames, **names}, tmp_path, worst_frames=2,
        draw_frame=lambda frame, path: path.write_text(str(frame)), **TERMS
    )  # fmt: skip
    drawn = sorted((tmp_path / "worst_frames").iterdir())
    assert len(drawn) == 2
    for path in drawn:
        frame = int(path.read_text())
        assert path.name == f"{frame + 3:02d}_{frame:05d}_00001.png"
