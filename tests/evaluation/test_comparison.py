import json
import re

import numpy as np
import pytest
import scipy.stats
from click.testing import CliRunner

from radejax.cli.main import main
from radejax.core.errors import UserError
from radejax.evaluation import analysis, comparison, kitti
from radejax.evaluation.comparison import compare, compare_files
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, evaluate_files
from radejax.evaluation.report import write_report
from radejax.evaluation.results import (
    ReportOptions,
    compute_results,
    interval,
    make_set,
    resample,
    sequence_weights,
)

CLASSES = ("Sedan", "Bus or Truck")


@pytest.fixture
def scene(random_scene):
    return random_scene(1, num_frames=60, num_objects=200, ties=False)


def settings(**options):
    defaults = {
        "classes": CLASSES,
        "protocols": ("all_point",),
        "iou_thresholds": (0.3,),
    }
    return ReportOptions(**{**defaults, "bootstrap": 50, "roi": None, **options})


def make(truth, found, frames):
    return EvaluationSet(truth, found, classes=CLASSES, frames=frames)


def thin(found, keep):
    rows = np.random.default_rng(0).random(len(found["score"])) < keep
    return {k: v[rows] for k, v in found.items()}


def test_a_run_does_not_differ_from_itself(scene):
    data = make(*scene)
    options = settings(bootstrap=100, protocols=("all_point", "kradar_r40"))
    rows = compare({"": data}, {"": data}, scene[2], options)
    assert {row.cls for row in rows} == {"Sedan", "Bus or Truck", "mean"}
    assert {row.kind for row in rows} == {"all", "weather", "distance"}
    seeds = {f"seed{i}": data for i in range(3)}
    for row in rows + compare(seeds, seeds, scene[2], options):
        assert row.difference == pytest.approx(0, abs=1e-6)
        assert not row.is_significant
        if np.isnan(row.low):  # one sequence has all objects
            assert row.kind != "all"
            continue
        assert (row.low, row.high) == pytest.approx((0, 0), abs=1e-6)
        assert row.p_value == 1


def test_a_large_difference_is_significant_and_antisymmetric(scene):
    truth, found, frames = scene
    good, bad = make(truth, found, frames), make(truth, thin(found, 0.3), frames)
    options = settings(bootstrap=100, iou_thresholds=(0.2,))
    goods, bads = ({f"seed{i}": run for i in range(3)} for run in (good, bad))
    forward = compare(bads, goods, frames, options)
    backward = compare(goods, bads, frames, options)
    for one, other in zip(forward, backward, strict=True):
        assert one.difference == pytest.approx(-other.difference)
        ends = pytest.approx((-other.high, -other.low), nan_ok=True)
        assert (one.low, one.high) == ends
        assert one.p_value == pytest.approx(other.p_value, nan_ok=True)
    sedan = next(row for row in forward if row.cls == "Sedan")
    assert sedan.difference > 10
    assert sedan.low > 0
    assert sedan.is_significant


def test_the_comparison_is_paired(scene):
    """The interval of the difference is narrower than unpaired resampling gives."""
    truth, found, frames = scene
    one, other = make(truth, found, frames), make(truth, thin(found, 0.95), frames)
    options = settings(bootstrap=300)
    row = compare({"": one}, {"": other}, frames, options, spaces=["bev"])[0]
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
    adjusted = comparison._holm([0.01, 0.04, 0.03, 0.005])
    assert adjusted == pytest.approx([0.03, 0.06, 0.06, 0.02])

    assert comparison._holm([0.01, np.nan, 0.04]) == pytest.approx(
        [0.02, np.nan, 0.04], nan_ok=True
    )


@pytest.mark.parametrize("num_seeds", [1, 3])
def test_a_single_class_in_one_sequence_is_not_tested(scene, num_seeds):
    truth, found, frames = scene
    sequence = dict(zip(frames["frame"], frames["sequence"], strict=True))
    number = np.array([sequence[frame] for frame in truth["frame"]])
    truth = {name: column[number == number[0]] for name, column in truth.items()}
    for classes in (("Sedan",), CLASSES):
        data = EvaluationSet(truth, found, classes=classes, frames=frames)
        seeds = {f"seed{i}": data for i in range(num_seeds)}
        for row in compare(seeds, seeds, frames, settings(classes=classes)):
            assert np.isnan([row.low, row.high, row.p_adjusted]).all()
            assert row.is_significant is None


@pytest.mark.parametrize("num_seeds", [1, 3])
def test_a_class_in_one_sequence_is_not_tested(scene, num_seeds):
    truth, found, frames = scene
    sequence = dict(zip(frames["frame"], frames["sequence"], strict=True))
    number = np.array([sequence[frame] for frame in truth["frame"]])
    is_kept = (truth["cls"] != "Sedan") | (number == number[0])
    truth = {name: column[is_kept] for name, column in truth.items()}
    good, bad = make(truth, found, frames), make(truth, thin(found, 0.3), frames)
    runs = [{f"seed{i}": data for i in range(num_seeds)} for data in (bad, good)]
    rows = compare(*runs, frames, settings())
    tables = comparison.comparison_tables(rows, "a", "b")
    words = {cell for table in tables for row in table.rows for cell in row}
    assert ("not tested" in words) == (num_seeds == 3)
    assert "-" in words
    for row in rows:
        values = row.low, row.high, row.p_value, row.p_adjusted
        if row.cls == "Sedan":
            assert np.isnan(values).all()
            assert row.is_significant is None
        elif row.kind == "all":
            assert not np.isnan(values).any()
            assert (row.is_significant is None) == (num_seeds == 1)


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
            compare({"": data}, {"": run}, frames, settings())


# Seeds --------------------------------------------------------------------------------


def drawn_aps(rng, of_seeds, num_seeds=3, num_sequences=12, num_resamples=100):
    """APs of the seeds of two runs that do not differ, over all sequences and resamples."""
    easy = rng.normal(0, 5, num_sequences)  # the same for all trainings
    weights = rng.multinomial(
        num_sequences, np.full(num_sequences, 1 / num_sequences), num_resamples
    )
    weights = np.concatenate([np.ones((1, num_sequences)), weights]) / num_sequences
    skill = rng.normal(60, of_seeds, (2, num_seeds, 1))
    aps = skill + easy + rng.normal(0, 1, (2, num_seeds, num_sequences))
    return aps @ weights.T


@pytest.mark.parametrize("is_paired", [True, False])
@pytest.mark.parametrize("of_seeds", [0.0, 0.3, 3.0])
def test_at_most_5_percent_of_equal_configs_differ(of_seeds, is_paired):
    rng = np.random.default_rng(0)
    p_values, covered = [], []
    for _ in range(1000):
        a, b = drawn_aps(rng, of_seeds)
        *_, low, high, p_value = comparison.difference(a, b, is_paired, 12)
        p_values.append(p_value)
        covered.append(low <= 0 <= high)
    # 1,000 draws have a standard error of 0.7 %.
    assert np.mean(np.array(p_values) < 0.05) <= 0.064
    assert np.mean(covered) >= 0.936
    assert np.mean(np.array(p_values) < 0.01) <= 0.02
    assert np.mean(np.array(p_values) < 0.5) > 0.2  # it can find differences


def test_a_gain_is_printed_with_its_deviation_and_paired_by_seed():
    a = np.array([[50.0], [53.0], [59.0]]) + np.array([0, -1, 1, -2, 2])
    b = a + np.array([[3.0], [4.0], [5.0]])
    ap_a, ap_b, gain, std, low, high, p_value = comparison.difference(a, b, True, 9)
    assert (ap_a, ap_b, gain, std) == pytest.approx((54, 58, 4, 1))
    # The sequences add nothing, so that it is the t-test of three pairs.
    assert (low, high) == pytest.approx(
        (4 - 4.303 / 3**0.5, 4 + 4.303 / 3**0.5), abs=0.01
    )
    assert p_value == pytest.approx(
        scipy.stats.ttest_1samp([3, 4, 5], 0).pvalue, rel=0.01
    )
    *_, std, low, high, p_value = comparison.difference(a, b, False, 9)
    assert std == pytest.approx((21 + np.var(b[:, 0], ddof=1)) ** 0.5)
    assert p_value > 0.3
    a[:, 1:] = b[:, 1:] = np.nan  # the class is in no resample
    *_, low, high, p_value = comparison.difference(a, b, True, 9)
    assert np.isnan([low, high, p_value]).all()


def drawn_training(rng, truth, frames):
    """Evaluation set of a training that finds about 60 % of the objects."""
    count = len(truth["frame"])
    is_found = rng.random(count) < rng.normal(0.6, 0.1)
    is_wrong = rng.random(count) < 0.2
    found = {k: np.concatenate([v[is_found], v[is_wrong]]) for k, v in truth.items()}
    found["box"][is_found.sum() :, 1] += 30
    found["score"] = rng.uniform(0.3, 1, len(found["frame"]))
    return make(truth, found, frames)


def test_seeds_of_one_config_are_never_called_different():
    """Single trainings differ by more than their sequences explain; sets of seeds do not."""
    rng = np.random.default_rng(1)
    frame, box = (
        np.repeat(np.arange(40), 4),
        np.tile([0.0, 0, 0, 4, 2, 1.5, 0], (160, 1)),
    )
    box[:, 0] = np.tile([10, 20, 30, 40], 40)
    truth = {"frame": frame, "box": box, "cls": np.tile(CLASSES, 80)}
    frames = {
        "frame": np.arange(40),
        "sequence": np.arange(40) // 4,
        "weather": np.repeat(["fog", "rain"], 20),
    }
    options, p_values, num_different = settings(bootstrap=20), [], 0
    for _ in range(20):
        runs = [
            {f"seed{i}": drawn_training(rng, truth, frames) for i in range(3)}
            for _ in range(2)
        ]
        rows = compare(*runs, frames, options, spaces=["bev"])
        assert {row.condition for row in rows} >= {"all", "fog", "rain", "20-40 m"}
        num_different += any(row.is_significant for row in rows)
        one, other = ({"seed0": run["seed0"]} for run in runs)
        rows = compare(one, other, frames, options, spaces=["bev"])
        assert [row.is_significant for row in rows] == [None] * len(rows)
        tables = comparison.comparison_tables(rows, "a", "b")
        assert not any("significant" in table.render() for table in tables)
        assert "variation between trainings is not counted" in tables[0].title
        p_values += [row.p_value for row in rows if row.kind == "all"]
    assert num_different <= 1  # 5 % of the pairs of sets of seeds
    # This is why single trainings are not tested.
    assert np.mean(np.array(p_values) < 0.1) > 0.2


def test_one_class_has_no_second_row_for_its_mean(scene):
    truth, found, frames = scene
    data = EvaluationSet(truth, found, classes=("Sedan",), frames=frames)
    rows = compare({"": data}, {"": data}, frames, settings(bootstrap=3))
    assert {row.cls for row in rows} == {"Sedan"}


def test_rows_by_weather_and_distance_agree_with_the_report(scene):
    truth, found, frames = scene
    options = settings(protocols=("all_point", "kradar_r40"), score_threshold=0.4)
    data = make_set(truth, found, frames, options)
    results = compute_results(data, frames, options)
    rows = compare({"": data}, {"": data}, frames, options)
    assert {row.score_threshold for row in rows if row.protocol == "all_point"} == {0.0}
    aps = {row.key: row for row in results}
    for row in rows:
        if row.kind != "distance":
            same = aps[row.protocol, row.condition, row.cls, row.space, row.iou]
            assert row.ap_a == pytest.approx(same.ap)
            assert row.score_threshold == same.score_threshold
    by_distance = {
        (entry["distance"], entry["cls"]): entry["ap"]
        for entry in analysis.subsets(data, frames, 0.3)["distance"]
    }
    found = [
        r for r in rows if (r.kind, r.space) == ("distance", "3d") and r.cls != "mean"
    ]
    assert len(found) > 2
    for row in found:
        assert row.ap_a == pytest.approx(by_distance[row.condition, row.cls])


# Runs in files ------------------------------------------------------------------------

OPTIONS = ReportOptions(
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
    labels = re.findall(r"\\label.*", (folder / "out" / "comparison.tex").read_text())
    assert len(set(labels)) == len(labels) == 3
    assert "**B = " in (folder / "out" / "comparison.md").read_text()
    three = [*pair, folder / "few"]
    text, rows_of_three = compare_files(three, None, Source(), OPTIONS)
    assert text.count("B - A") == 2 * 3  # over all frames, by weather and by distance
    assert rows_of_three[: len(rows)] == rows


def test_a_warning_names_the_score_from_which_predictions_were_stored(
    stored_scene, tmp_path
):
    truth, found, frames = stored_scene
    kept = {k: v[found["score"] > 0.3] for k, v in found.items()}
    for name, table, min_score in (("old", kept, 0.3), ("new", found, 0.05)):
        options = OPTIONS.replace(score_threshold=0.3, min_score=min_score)
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
    once = OPTIONS.replace(bootstrap=0)
    for paths, options, message in (
        ([tmp_path, tmp_path], OPTIONS, "has no column sequence"),
        ([tmp_path], OPTIONS, "at least two runs"),
        ([tmp_path, tmp_path], once, "a comparison needs 1 resample"),
    ):
        with pytest.raises(UserError, match=message):
            compare_files(paths, None, Source(), options)


@pytest.fixture
def two_runs(stored, stored_scene):
    """Two folders of three seeds with reports of the settings of a run, and the first."""
    folder, _ = stored
    truth, found, frames = stored_scene
    changes = {"score_threshold": 0.4, "min_score": 0.1, "classes": ("Sedan",)}
    options = OPTIONS.replace(**changes)
    for run, keep in (("a", 0.5), ("b", 0.9)):
        for seed in range(3):
            rows = np.random.default_rng(seed).random(len(found["score"])) < keep
            table = {k: v[rows] for k, v in found.items()}
            place = folder / run / f"seed{seed}" / "evaluation"
            write_report(truth, table, frames, place, options, run=run)
    return folder / "a", folder / "b"


def test_folders_of_seeds_and_of_runs_are_compared(two_runs, tmp_path):
    words = ["--bootstrap", "20", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(main, ["compare", *map(str, two_runs), *words])
    assert done.exit_code == 0, done.output
    title = done.stdout.splitlines()[0]
    assert "gain ± standard deviation of 3 seeds" in title
    assert "over seeds and sequences" in title
    assert re.search(r"kradar_r40, score>0.4 .*\d ± \d", done.stdout)
    assert re.search(r"all_point, score>0.1 .* (not )?significant", done.stdout)
    for ending in ("md", "tex"):
        text = (tmp_path / "out" / f"comparison.{ending}").read_text()
        assert re.search(r"\+\d+\.\d\d ± \d", text)
    one, other = (str(run / "seed1") for run in two_runs)
    single = CliRunner().invoke(main, ["compare", one, other, *words[:2]])
    assert single.exit_code == 0, single.output
    assert "variation between trainings is not counted" in single.stdout
    assert "significant" not in single.stdout
    # Both print the APs of the report of the run.
    metrics = json.loads((two_runs[0] / "seed1/evaluation/metrics.json").read_text())
    for row in metrics["ap"]:
        if (row["condition"], row["cls"], row["iou"]) == ("all", "Sedan", 0.3):
            terms = f"{row['protocol']}, score>{row['score_threshold']:g} "
            assert re.search(f"{terms}.* {row['ap']:.2f} ", single.stdout), terms


def test_scoring_a_run_repeats_its_report(two_runs, tmp_path):
    run = two_runs[0] / "seed0"
    out = tmp_path / "again"
    done = CliRunner().invoke(main, ["score", str(run), "--out", str(out)])
    assert done.exit_code == 0, done.output
    first, again = (
        json.loads((place / "metrics.json").read_text())["ap"]
        for place in (run / "evaluation", out)
    )
    names = ("name", "ap", "num_gt", "score_threshold")
    assert [[x[name] for name in names] for x in again] == [
        [x[name] for name in names] for x in first
    ]
    done = CliRunner().invoke(main, ["score", str(two_runs[0])])
    assert done.exit_code == 2
    assert "holds several seeds" in done.stderr


def test_command_line(stored):
    folder, source = stored
    arguments = [
        "compare", folder / "found.json", folder / "found.json", "--bootstrap", 20,
        "--ground-truth", source.ground_truth, "--roi", "none", "--classes", "Sedan",
    ]  # fmt: skip
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.stderr
    assert "B - A" in done.stdout
