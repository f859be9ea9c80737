import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner

from radejax.cli.main import main
from radejax.core.errors import UserError
from radejax.evaluation import files as predictions
from radejax.evaluation import kitti, report
from radejax.evaluation.files import Source
from radejax.evaluation.results import EvaluationOptions

OPTIONS = EvaluationOptions(
    bootstrap=30, roi=None, plots=False, protocols=("all_point", "kradar_r40")
)


@pytest.fixture(scope="module")
def scene(random_scene):
    return random_scene(8, num_frames=30, num_objects=90)


def ap(made, protocol=None, condition="all"):
    return [
        row.ap_or_none
        for row in made.results
        if row.condition == condition and protocol in (None, row.protocol)
    ]


def test_every_way_in_gives_the_same_numbers(stored, scene):
    folder, source = stored
    one = report.evaluate_files(folder / "found.json", folder / "a", source, OPTIONS)
    # A report brings everything that is needed to repeat it.
    two = report.evaluate_files(folder / "a", folder / "b", Source(), OPTIONS)
    assert ap(one) == ap(two)
    kitti.write_kitti(folder / "kitti", *scene)
    three = report.evaluate_files(folder / "kitti", folder / "c", Source(), OPTIONS)
    assert ap(one, "kradar_r40", "fog") == ap(three, "kradar_r40", "fog") != []
    four = report.evaluate_files(folder / "kitti", folder / "d", source, OPTIONS)
    in_truth = np.isin(scene[1]["frame"], scene[0]["frame"])
    assert four.metrics["num_predictions"] == in_truth.sum()


def test_comparison_of_reports(stored, scene):
    folder, source = stored
    _, found, frames = scene
    few = {k: v[::3] for k, v in found.items()}
    predictions.write_table(folder / "few.json", few, frames)
    for name in ("found", "few"):
        report.evaluate_files(folder / f"{name}.json", folder / name, source, OPTIONS)
    pair = [folder / "few", folder / "found"]
    text, rows = report.compare_files(pair, folder / "out", Source(), OPTIONS)
    assert next(row for row in rows if row["cls"] == "Sedan")["difference"] > 0
    assert (folder / "out" / "comparison.txt").read_text() == text
    written = json.loads((folder / "out" / "comparison.json").read_text())
    assert written["rows"] == rows
    of_files = [folder / "few.json", folder / "found.json"]
    again, _ = report.compare_files(of_files, None, source, OPTIONS)
    assert again.splitlines()[3:14] == text.splitlines()[3:14]
    three = [*pair, folder / "few"]
    text, rows_of_three = report.compare_files(three, None, Source(), OPTIONS)
    assert text.count("B - A") == 2
    assert "RADE-Net, Table III" in text
    assert rows_of_three[: len(rows)] == rows


def test_predictions_that_were_stored_cut_say_so(stored, scene):
    folder, _ = stored
    truth, found, frames = scene
    kept = {k: v[found["score"] > 0.3] for k, v in found.items()}
    for name, table, min_score in (("old", kept, 0.3), ("new", found, 0.05)):
        options = dataclasses.replace(OPTIONS, score_threshold=0.3, min_score=min_score)
        made = report.write_report(truth, table, frames, folder / name, options)
        thresholds = {r.protocol: r.score_threshold for r in made.results}
        assert thresholds == {"all_point": min_score, "kradar_r40": 0.3}
        (folder / name / "source.json").write_text('{"roots": []}')
    old = report.evaluate_files(folder / "old", folder / "a", Source(), OPTIONS)
    assert "has predictions from score 0.3 on only" in old.metrics["warnings"][0]
    assert "WARNING: " in old.text
    assert "/all_point/score>0.3/" in old.metrics["ap"][0]["name"]
    new = report.evaluate_files(folder / "new", folder / "b", Source(), OPTIONS)
    assert new.metrics["warnings"] == []
    runs = [folder / "old", folder / "new"]
    _, rows = report.compare_files(runs, None, Source(), OPTIONS)
    # Both above what one has stored.
    assert {row["difference"] for row in rows} == {0.0}


def test_frames_without_sequences_cannot_be_compared(scene, tmp_path):
    kitti.write_kitti(tmp_path, *scene)
    with pytest.raises(UserError, match="has no column sequence"):
        report.compare_files([tmp_path, tmp_path], None, Source(), OPTIONS)


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_command_line(stored):
    folder, source = stored
    done = run(
        "score", folder / "found.json", "--ground-truth", source.ground_truth,
        "--frames", source.frames, "--roi", "none", "--out", folder / "out",
        "--protocols", "all_point,kradar_r40", "--iou", "0.3", "--classes", "Sedan",
        "--bootstrap", "10",
    )  # fmt: skip
    assert done.exit_code == 0, done.stderr
    assert "AP 3D / BEV at IoU 0.3, all_point" in done.stdout
    assert (folder / "out" / "metrics.json").is_file()
    compared = run(
        "compare", folder / "out", folder / "out", "--bootstrap", 20,
        "--roi", "none", "--classes", "Sedan",
    )  # fmt: skip
    assert compared.exit_code == 0, compared.stderr
    assert "B - A" in compared.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("evaluate",), "radejax evaluate RUN"),
        (("compare", "a"), "at least two runs"),
        (("compare", "a", "b", "--bootstrap=0"), "a comparison needs 1 resample"),
        (("score", "a.json", "--protocols", "x"), "config.evaluation.protocols is"),
        (("score", "none.npz", "--ground-truth", "none.npz"), "none.npz"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(arguments, message):
    done = run(*arguments)
    assert done.exit_code == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_bad_content_is_one_line_and_exit_code_1(tmp_path):
    (tmp_path / "p.json").write_text("{}")
    done = run("score", tmp_path / "p.json", "--ground-truth", tmp_path / "p.json")
    assert done.exit_code == 1
    assert "expected a list of records" in done.stderr
