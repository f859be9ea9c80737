import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner

from radejax.cli.evaluate import evaluate
from radejax.core.errors import UserError
from radejax.evaluation.files import kitti, predictions
from radejax.evaluation.files.load import Source
from radejax.evaluation.report import compare as commands
from radejax.evaluation.report import report
from radejax.evaluation.report.measure import Options

OPTIONS = Options(roi=None, plots=False, protocols=("all_point", "kradar_r40"))


@pytest.fixture(scope="module")
def scene(random_scene):
    return random_scene(8, num_frames=30, num_objects=90)


def ap(report):
    return [row.shown for row in report.rows if row.condition == "all"]


def test_every_way_in_gives_the_same_numbers(stored, scene):
    folder, source = stored
    one = commands.evaluate_files(folder / "found.json", folder / "a", source, OPTIONS)
    # A report brings everything that is needed to repeat it.
    two = commands.evaluate_files(folder / "a", folder / "b", Source(), OPTIONS)
    assert ap(one) == ap(two)
    kitti.write_kitti(folder / "kitti", *scene)
    three = commands.evaluate_files(folder / "kitti", folder / "c", Source(), OPTIONS)
    official = [
        [
            row.shown
            for row in made.rows
            if (row.result.protocol, row.condition) == ("kradar_r40", "fog")
        ]
        for made in (one, three)
    ]
    assert official[0] == official[1]
    four = commands.evaluate_files(folder / "kitti", folder / "d", source, OPTIONS)
    in_truth = np.isin(scene[1]["frame"], scene[0]["frame"])
    assert four.metrics["num_predictions"] == in_truth.sum()


def test_comparison_of_two_reports(stored, scene):
    folder, source = stored
    _, found, frames = scene
    few = {k: v[::3] for k, v in found.items()}
    predictions.write_table(folder / "few.json", few, frames)
    for name in ("found", "few"):
        commands.evaluate_files(folder / f"{name}.json", folder / name, source, OPTIONS)
    text, rows = commands.compare_files(
        [folder / "few", folder / "found"],
        folder / "out",
        Source(),
        OPTIONS,
        resamples=50,
    )
    sedan = next(row for row in rows if row.cls == "Sedan")
    assert sedan.difference > 0
    assert "B - A" in text
    assert (folder / "out" / "comparison.txt").read_text() == text
    assert (folder / "out" / "comparison.json").is_file()
    again, _ = commands.compare_files(
        [folder / "few.json", folder / "found.json"],
        None,
        source,
        OPTIONS,
        resamples=50,
    )
    assert again.splitlines()[3:14] == text.splitlines()[3:14]
    three, rows = commands.compare_files(
        [folder / "few", folder / "found", folder / "few"],
        None,
        Source(),
        OPTIONS,
        resamples=10,
    )
    assert three.count("B - A") == 2
    assert "RADE-Net, Table III" in three
    assert len(rows) % 2 == 0
    with pytest.raises(UserError, match="at least two runs"):
        commands.compare_files([folder / "few"], None, Source(), OPTIONS)


def test_predictions_that_were_stored_cut_say_so(stored, scene):
    folder, _ = stored
    truth, found, frames = scene
    kept = {k: v[found["score"] > 0.3] for k, v in found.items()}
    for name, table, min_score in (("old", kept, 0.3), ("new", found, 0.05)):
        options = dataclasses.replace(
            OPTIONS, score_threshold=0.3, uncut=("all_point",), min_score=min_score
        )
        made = report.write_report(truth, table, frames, folder / name, options)
        cuts = {r.result.protocol: r.result.score_threshold for r in made.rows}
        assert cuts == {"all_point": min_score, "kradar_r40": 0.3}
        (folder / name / "source.json").write_text('{"roots": []}')
    path = folder / "old" / "metrics.json"
    content = json.loads(path.read_text())
    del content["options"]["min_score"]  # as runs of before wrote it
    path.write_text(json.dumps(content))
    old = commands.evaluate_files(folder / "old", folder / "a", Source(), OPTIONS)
    assert "has predictions from score 0.3 on only" in old.metrics["warnings"][0]
    assert "WARNING: " in old.text
    assert "/all_point/score>0.3/" in old.metrics["ap"][0]["name"]
    new = commands.evaluate_files(folder / "new", folder / "b", Source(), OPTIONS)
    assert new.metrics["warnings"] == []
    runs = [folder / "old", folder / "new"]
    _, rows = commands.compare_files(runs, None, Source(), OPTIONS, resamples=10)
    assert {row.difference for row in rows} == {0.0}  # both above what one has stored


def test_frames_without_sequences_cannot_be_compared(scene, tmp_path):
    kitti.write_kitti(tmp_path / "kitti", *scene)
    with pytest.raises(UserError, match="the frames do not say"):
        commands.compare_files(
            [tmp_path / "kitti", tmp_path / "kitti"], None, Source(), OPTIONS
        )


def run(*arguments):
    return CliRunner().invoke(evaluate, [str(argument) for argument in arguments])


def test_command_line(stored):
    folder, source = stored
    done = run(
        "--predictions", folder / "found.json", "--ground_truth", source.ground_truth,
        "--frames", source.frames, "--roi", "none", "--out", folder / "out",
        "--protocols", "all_point,kradar_r40", "--iou", "0.3", "--classes", "Sedan",
        "--bootstrap", "10",
    )  # fmt: skip
    assert done.exit_code == 0, done.stderr
    assert "AP 3D / BEV at IoU 0.3, all_point" in done.stdout
    assert (folder / "out" / "metrics.json").is_file()
    compared = run(
        "--compare", folder / "out", folder / "out", "--bootstrap", 20,
        "--roi", "none", "--classes", "Sedan",
    )  # fmt: skip
    assert compared.exit_code == 0, compared.stderr
    assert "B - A" in compared.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give one of --workdir, --predictions and --compare"),
        (("--compare", "a"), "at least two runs"),
        (("--predictions", "a.json", "--iou", "x"), "--iou must be numbers"),
        (("--predictions", "none.csv", "--ground_truth", "none.csv"), "none.csv"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(arguments, message):
    done = run(*arguments)
    assert done.exit_code == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_bad_content_is_one_line_and_exit_code_1(tmp_path):
    (tmp_path / "p.csv").write_text("frame,cls\n")
    done = run(
        "--predictions", tmp_path / "p.csv", "--ground_truth", tmp_path / "p.csv"
    )
    assert done.exit_code == 1
    assert "lacks columns" in done.stderr
