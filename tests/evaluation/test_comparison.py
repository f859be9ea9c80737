import json

import numpy as np
import pytest
import scipy.stats

from radejax.core.errors import UserError
from radejax.evaluation import comparison, kitti, results
from radejax.evaluation.comparison import compare, compare_files, difference
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, evaluate_files, stored_options
from radejax.evaluation.report import write_report
from radejax.evaluation.results import ReportOptions

from ..commands import run
from .scenes import random_scene

CLASSES = ("Sedan", "Bus or Truck")
TRUTH, FOUND, FRAMES = random_scene(1, num_frames=60, num_objects=200, ties=False)


def settings(**options):
    defaults = {"protocols": ("all_point",), "iou_thresholds": (0.3,), "bootstrap": 50}
    return ReportOptions(**defaults | {"classes": CLASSES, "roi": None} | options)


def make(truth=TRUTH, found=FOUND, frames=FRAMES, classes=CLASSES):
    return EvaluationSet(truth, found, classes=classes, frames=frames)


def thin(keep):
    rows = np.random.default_rng(0).random(len(FOUND["score"])) < keep
    return make(found={k: v[rows] for k, v in FOUND.items()})


def seeds(data, count=3):
    return {f"seed{i}": data for i in range(count)}


def test_a_run_does_not_differ_from_itself():
    data = make()
    options = settings(bootstrap=20, protocols=("all_point", "kradar_r40"))
    rows = compare(seeds(data, 1), seeds(data, 1), FRAMES, options)
    assert {row.cls for row in rows} == {"Sedan", "Bus or Truck", "mean"}
    assert {row.kind for row in rows} == {"all", "weather", "distance"}
    options = settings(bootstrap=20)
    for row in rows + compare(seeds(data), seeds(data), FRAMES, options):
        assert row.difference == pytest.approx(0, abs=1e-6)
        assert not row.is_significant
        if np.isnan(row.low):  # one sequence has all objects
            assert row.kind != "all"
            continue
        assert (row.low, row.high) == pytest.approx((0, 0), abs=1e-6)
        assert row.p_value == 1


def test_a_large_difference_is_significant_and_antisymmetric():
    goods, bads = seeds(make()), seeds(thin(0.3))
    options = settings(bootstrap=40, iou_thresholds=(0.2,))
    forward = compare(bads, goods, FRAMES, options, spaces=["bev"])
    backward = compare(goods, bads, FRAMES, options, spaces=["bev"])
    for one, other in zip(forward, backward, strict=True):
        assert one.difference == pytest.approx(-other.difference)
        ends = pytest.approx((-other.high, -other.low), nan_ok=True)
        assert (one.low, one.high) == ends
        assert one.p_value == pytest.approx(other.p_value, nan_ok=True)
    sedan = next(row for row in forward if row.cls == "Sedan")
    assert sedan.difference > 10
    assert sedan.low > 0
    assert sedan.is_significant


def test_the_comparison_is_paired():
    """The interval of the difference is narrower than unpaired resampling gives."""
    one, other = make(), thin(0.95)
    options = settings(bootstrap=200)
    row = compare({"": one}, {"": other}, FRAMES, options, spaces=["bev"])[0]
    samples = []
    for seed, data in enumerate((other, one)):
        terms = {"resamples": 300, "seed": seed}
        weights = results.sequence_weights(FRAMES["sequence"], **terms)
        ap = results.resample(data, weights, "all_point", "bev", 0.3)
        samples.append(ap[:, 0])
    low, high = results.interval(samples[0] - samples[1])
    assert row.high - row.low < 0.7 * (high - low)


@pytest.mark.parametrize("num_seeds", [1, 3])
@pytest.mark.parametrize("in_one", [("Sedan",), CLASSES])
def test_a_class_in_one_sequence_is_not_tested(num_seeds, in_one):
    number = FRAMES["sequence"][TRUTH["frame"]]
    is_kept = ~np.isin(TRUTH["cls"], in_one) | (number == number[0])
    truth = {name: column[is_kept] for name, column in TRUTH.items()}
    data = seeds(make(truth), num_seeds)
    rows = compare(data, data, FRAMES, settings(bootstrap=10))
    for row in rows:
        values = row.low, row.high, row.p_value, row.p_adjusted
        if row.cls in in_one or in_one == CLASSES:
            assert np.isnan(values).all()
            assert row.is_significant is None
        elif row.kind == "all":
            assert not np.isnan(values).any()
            assert (row.is_significant is None) == (num_seeds == 1)
    text = str([table.rows for table in comparison.comparison_tables(rows, "a", "b")])
    assert ("'not tested'" in text) == (num_seeds == 3 and in_one != CLASSES)
    assert "'-'" in text


# Seeds --------------------------------------------------------------------------------


def drawn_aps(rng, of_seeds, num_seeds=3, num_sequences=12, num_resamples=100):
    """APs of the seeds of two runs that do not differ, over all sequences and resamples."""
    easy = rng.normal(0, 5, num_sequences)  # the same for all trainings
    shares = np.full(num_sequences, 1 / num_sequences)
    weights = rng.multinomial(num_sequences, shares, num_resamples)
    weights = np.concatenate([np.ones((1, num_sequences)), weights]) / num_sequences
    skill = rng.normal(60, of_seeds, (2, num_seeds, 1))
    aps = skill + easy + rng.normal(0, 1, (2, num_seeds, num_sequences))
    return aps @ weights.T


def check_rates(found):
    """At most 5 percent of equal configs differ, and differences can be found."""
    p_values = np.array([one.p_value for one in found])
    # 1,000 draws have a standard error of 0.7 %.
    assert np.mean(p_values < 0.05) <= 0.064
    assert np.mean([one.low <= 0 <= one.high for one in found]) >= 0.936
    assert np.mean(p_values < 0.01) <= 0.02
    assert np.mean(p_values < 0.5) > 0.2


def test_the_rates_of_wrong_differences_are_those_in_the_explanation():
    for of_seeds in (0.0, 0.3, 3.0):
        rng = np.random.default_rng(0)
        pairs = [drawn_aps(rng, of_seeds) for _ in range(1000)]
        three = [difference(a, b, True, 12) for a, b in pairs]
        check_rates(three)
        if of_seeds == 0.3:
            check_rates([difference(a, b, False, 12) for a, b in pairs])


def test_a_gain_has_its_deviation_and_is_paired_by_seed():
    a = np.array([[50.0], [53.0], [59.0]]) + np.array([0, -1, 1, -2, 2])
    b = a + np.array([[3.0], [4.0], [5.0]])
    found = difference(a, b, True, 9)
    assert found[:4] == pytest.approx((54, 58, 4, 1))
    # The sequences add nothing, so that it is the t-test of three pairs.
    half = 4.303 / 3**0.5
    assert (found.low, found.high) == pytest.approx((4 - half, 4 + half), abs=0.01)
    expected = scipy.stats.ttest_1samp([3, 4, 5], 0).pvalue
    assert found.p_value == pytest.approx(expected, rel=0.01)
    unpaired = difference(a, b, False, 9)
    assert unpaired.std == pytest.approx((21 + np.var(b[:, 0], ddof=1)) ** 0.5)
    assert unpaired.p_value > 0.3
    a[:, 1:] = b[:, 1:] = np.nan  # the class is in no resample
    assert np.isnan(difference(a, b, True, 9)[4:]).all()


# Runs in files ------------------------------------------------------------------------

PROTOCOLS = ("all_point", "kradar_r40")
OPTIONS = ReportOptions(bootstrap=30, roi=None, plots=False, protocols=PROTOCOLS)


def test_comparisons_are_the_stored_ones(
    two_runs, tmp_path, monkeypatch, assert_stored
):
    monkeypatch.chdir(two_runs)
    options = ReportOptions(**stored_options("a")).replace(bootstrap=20, plots=False)
    text, rows = compare_files(["a", "b"], tmp_path, Source(), options)
    assert_stored(tmp_path / "comparison.md")
    assert_stored(tmp_path / "comparison.tex")
    assert (tmp_path / "comparison.txt").read_text() == text
    written = json.loads((tmp_path / "comparison.json").read_text())
    assert written["rows"] == rows
    single = ["a/seed1", "b/seed1", "a/seed2"]
    compare_files(single, tmp_path, Source(), options)
    assert_stored(tmp_path / "comparison.txt", "comparison_of_seeds.txt")
    # The rows contain the APs of the report of the run.
    metrics = json.loads((two_runs / "a/seed1/evaluation/metrics.json").read_text())
    written = json.loads((tmp_path / "comparison.json").read_text())["rows"]
    aps = {row["name"]: row["ap"] for row in metrics["ap"]}
    for row in written[:4]:
        name = f"Sedan/all/ap_{row['space']}_iou30/{row['protocol']}/"
        (ap,) = (ap for key, ap in aps.items() if key.startswith(name))
        assert row["ap_a"] == pytest.approx(ap)


def test_predictions_in_files_are_compared(stored, scene, write_table):
    folder, source = stored
    few = {k: v[::3] for k, v in scene[1].items()}
    write_table(folder / "few.json", few, scene[2])
    paths = [folder / "few.json", folder / "found.json"]
    _, rows = compare_files(paths, None, source, OPTIONS)
    assert next(row for row in rows if row["cls"] == "Sedan")["difference"] > 0
    none = OPTIONS.replace(bootstrap=0)
    with pytest.raises(UserError, match="needs 1 resample or more, or only --figures"):
        compare_files(paths, folder / "out", source, none)
    text, no_rows = compare_files(paths, folder / "out", source, none, figures="png")
    assert (text, no_rows) == ("no table without resamples: --bootstrap is 0\n", [])
    assert (folder / "out" / "comparison_3d_iou30.png").exists()
    words = ["compare", *paths, "--bootstrap", 30, "--roi", "none", "--json"]
    words += ["--ground-truth", source.ground_truth]
    words += ["--protocols", "all_point,kradar_r40"]
    assert json.loads(run(*words).stdout) == rows


def test_named_protocols_are_compared_besides_all_point(stored):
    folder, source = stored
    path = str(folder / "found.json")
    words = ["compare", path, path, "--ground-truth", source.ground_truth]
    words += ["--bootstrap", "2", "--roi", "none", "--json"]
    for named, expected in (
        ([], {"all_point", "kradar_r40"}),
        (["--protocols", "voc11,auc"], {"all_point", "voc11", "auc"}),
    ):
        rows = json.loads(run(*words, *named).stdout)
        assert {row["protocol"] for row in rows if row["kind"] == "all"} == expected
        others = {row["protocol"] for row in rows if row["kind"] != "all"}
        assert others == {"all_point"}


def test_frames_are_compared_by_key(scene, tmp_path):
    """A run was evaluated on a part of the frames only, which have other ids there."""
    truth, found, frames = scene
    chosen = frames["weather"] == frames["weather"][-1]
    ids = frames["frame"][chosen][::-1]
    part = {name: np.asarray(column)[chosen][::-1] for name, column in frames.items()}
    part["frame"] = np.arange(len(ids))

    def renumbered(table):
        rows = np.isin(table["frame"], ids)
        new = {old: i for i, old in enumerate(ids)}
        kept = {name: column[rows] for name, column in table.items()}
        return {**kept, "frame": np.array([new[x] for x in kept["frame"]])}

    write_report(truth, found, frames, tmp_path / "all", OPTIONS)
    tables = map(renumbered, (truth, found))
    write_report(*tables, part, tmp_path / "part", OPTIONS)
    runs = [tmp_path / "all", tmp_path / "part"]
    source = Source(weather=(str(part["weather"][0]),))
    _, rows = compare_files(runs, None, source, OPTIONS)
    assert rows
    assert {row["difference"] for row in rows} == {0.0}
    with pytest.raises(UserError, match=r"different frames \(\d+ and \d+\), such as"):
        compare_files(runs, None, Source(), OPTIONS)


def test_a_warning_names_the_score_from_which_predictions_were_stored(scene, tmp_path):
    truth, found, frames = scene
    kept = {k: v[found["score"] > 0.3] for k, v in found.items()}
    for name, table, min_score in (("old", kept, 0.3), ("new", found, 0.05)):
        options = OPTIONS.replace(score_threshold=0.3, min_score=min_score, bootstrap=0)
        made = write_report(truth, table, frames, tmp_path / name, options)
        thresholds = {r.protocol: r.score_threshold for r in made.results}
        assert thresholds == {"all_point": min_score, "kradar_r40": 0.3}
    options = OPTIONS.replace(bootstrap=0)
    old = evaluate_files(tmp_path / "old", tmp_path / "a", Source(), options)
    assert "has only predictions from score 0.3 on" in old.metrics["warnings"][0]
    assert "/all_point/score>0.3/" in old.metrics["ap"][0]["name"]
    new = evaluate_files(tmp_path / "new", tmp_path / "b", Source(), options)
    assert new.metrics["warnings"] == []
    # Both runs are compared above the score from which one was stored.
    runs = [tmp_path / "old", tmp_path / "new"]
    _, rows = compare_files(runs, None, Source(), OPTIONS)
    assert {row["difference"] for row in rows} == {0.0}


def test_incomparable_runs_are_reported(scene, tmp_path):
    kitti.write_kitti(tmp_path, *scene)
    once = OPTIONS.replace(bootstrap=0)
    data = make()
    moved = make({**TRUTH, "box": TRUTH["box"] + 0.1})
    three = make(classes=(*CLASSES, "Bicycle"))
    for call, message in (
        (lambda: compare_files([tmp_path] * 2, None, Source(), OPTIONS), "no column"),
        (lambda: compare({"": data}, {"": moved}, FRAMES, once), "different objects"),
        (lambda: compare({"": data}, {"": three}, FRAMES, once), "different classes"),
    ):
        with pytest.raises(UserError, match=message):
            call()
