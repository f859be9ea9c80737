import json
import shutil

import numpy as np
import pytest

import radejax
from radejax.core.errors import DataError, UserError
from radejax.data.kradar import KRadar
from radejax.evaluation import boxes, files, kitti
from radejax.evaluation.files import Source
from radejax.evaluation.report import write_report
from radejax.evaluation.results import ReportOptions

from ..commands import run
from ..data.conftest import write_kradar
from .scenes import random_scene

BOX = [20.0, 0, 0, 4, 2, 1.5, 0]


def assert_same(one, other):
    """Compares boxes with boxes or columns."""
    for column, values in boxes.columns_of_boxes(other).items():
        np.testing.assert_array_equal(getattr(one, column), values)


# Columns ------------------------------------------------------------------------------


def test_roi_names_and_bounds():
    assert boxes.roi_bounds("narrow") == (0, 72, -6.4, 6.4, -2, 6)
    assert boxes.roi_name((0, 72, -16, 16, -2, 7.6)) == "wide"
    assert boxes.roi_name((0, 10, -1, 1, -2, 2)) == "0,10,-1,1,-2,2"
    assert (boxes.roi_bounds(None), boxes.roi_name(None)) == (None, "none")


def test_read_boxes_takes_lists_empty_tables_and_boxes():
    table = {"frame": [1], "box": [BOX], "cls": ["Sedan"], "score": [1]}
    found = boxes.read_boxes(table, "predictions", scored=True)
    assert (found.frame.dtype, found.box.dtype) == (np.int64, np.float64)
    assert_same(boxes.read_boxes(found, "predictions", scored=True), table)
    truth = boxes.read_boxes(found, "ground truth", scored=False)
    assert truth.score is None
    with pytest.raises(UserError, match=r"predictions lack the columns \['score'\]"):
        boxes.read_boxes(truth, "predictions", scored=True)
    empty = {"frame": [], "box": [], "cls": []}
    assert boxes.read_boxes(empty, "x", scored=False).box.shape == (0, 7)


def test_frame_keys():
    ids = {"frame": np.array([4, 5])}
    assert boxes.frame_keys(ids) == ["4", "5"]
    named = {**ids, "name": np.array(["00033_00001.txt", "00034_00002"])}
    assert boxes.frame_keys(named) == ["00033_00001", "00034_00002"]
    named["sequence"] = np.array([1, 12])
    assert boxes.frame_keys(named) == ["1/00033_00001", "12/00034_00002"]
    named["name"] = np.array(["1/00033_00001", "12/00034_00002"])
    assert boxes.frame_keys(named) == ["1/00033_00001", "12/00034_00002"]


# Boxes in files -----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["npz", "json"])
@pytest.mark.parametrize("by_key", [True, False])
def test_round_trip_is_exact(tmp_path, write_table, suffix, by_key):
    truth, found, frames = random_scene(2)
    written_with = frames if by_key else {"frame": frames["frame"]}
    nothing = {k: v[:0] for k, v in found.items()}
    path = tmp_path / f"table.{suffix}"
    for table, scored in ((found, True), (truth, False), (nothing, True)):
        write_table(path, table, written_with)
        assert_same(files.read_table(path, frames, scored=scored), table)


def test_keys_survive_another_selection_of_frames(tmp_path, write_table):
    _, found, frames = random_scene(2)
    write_table(tmp_path / "p.json", found, frames)
    shifted = {**frames, "frame": frames["frame"] + 1000}
    read = files.read_table(tmp_path / "p.json", shifted)
    np.testing.assert_array_equal(read.frame, found["frame"] + 1000)


def test_further_columns_of_numbers_are_kept(tmp_path):
    _, found, frames = random_scene(2)
    further = {"probability": found["score"] / 2, "grid": np.ones(3)}
    np.savez(tmp_path / "p.npz", **found, **further)
    read = files.read_table(tmp_path / "p.npz", frames)
    assert list(read.extras) == ["probability"]
    np.testing.assert_array_equal(read.extras["probability"], found["score"] / 2)


NAMED = {"frame": np.array([10, 11]), "name": np.array(["1/a", "1/b"])}
RECORD = {"frame": "1/b", "cls": "Sedan", "box": BOX, "score": 0.5}


def test_json_records(tmp_path):
    spelled = {"frame": 11, "cls": "Sedan", "score": 0.5, "yaw": 0}
    spelled |= dict(zip("xyzlwh", BOX, strict=False))
    path = tmp_path / "p.json"
    for form in (RECORD, {**RECORD, "frame": "1/b.txt"}, spelled):
        path.write_text(json.dumps([form]))
        expected = {"frame": [11], "cls": ["Sedan"], "box": [BOX], "score": [0.5]}
        assert_same(files.read_table(path, NAMED), expected)


def without(name):
    return {k: v for k, v in RECORD.items() if k != name}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", "", "a.txt is neither a .npz or .json file"),
        ("a.json", "{", "a.json is not valid JSON"),
        ("a.json", [{**RECORD, "frame": "1/c"}], "row 0: frame '1/c', expected one of .*1/a"),
        ("a.json", [{**RECORD, "score": 2}], "a.json: frame 11, row 0: score 2.0 is outs"),
        ("a.json", [without("box")], "row 0 is .*expected a list of records with frame"),
    ],
)  # fmt: skip
def test_wrong_files_are_named(tmp_path, name, content, message):
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / name).write_text(text)
    with pytest.raises((DataError, UserError), match=message):
        files.read_table(tmp_path / name, NAMED)
    with pytest.raises(FileNotFoundError, match="No such file"):
        files.read_table(tmp_path / "none.json")


# Predictions with their ground truth --------------------------------------------------


def test_wrong_sources_are_named(stored):
    folder, source = stored
    path, table = folder / "found.json", folder / "frames.json"
    none = source.replace(sequences=(77,))
    text = table.read_text()
    shape = r"frames\.json is not .* column 'name' has shape \(1,\)"
    for given, frames, message in (
        (Source(), text, "give the ground truth with"),
        (none, text, "no frames of sequence 77; there are "),
        (source, "[]", r"frames\.json is not a table of frames"),
        (source, '{"frame": [1, 2], "name": ["a"]}', shape),
    ):
        table.write_text(frames)
        with pytest.raises((DataError, UserError), match=message):
            files.load(path, given, ("Sedan",))


def test_every_way_in_gives_the_same_numbers(stored, scene):
    folder, source = stored
    protocols = ("all_point", "kradar_r40")
    options = ReportOptions(roi=None, plots=False, protocols=protocols)

    def aps(path, source, protocol=None, condition="all"):
        made = files.evaluate_files(path, folder / f"{path.name}_out", source, options)
        rows = [row for row in made.results if row.condition == condition]
        return [x.ap_or_none for x in rows if protocol in (None, x.protocol)]

    one = aps(folder / "found.json", source)
    # A report contains everything that is needed to repeat it.
    assert aps(folder / "found.json_out", Source()) == one
    kitti.write_kitti(folder / "kitti", *scene)
    in_fog = "kradar_r40", "fog"
    expected = aps(folder / "found.json", source, *in_fog)
    assert aps(folder / "kitti", Source(), *in_fog) == expected != []
    assert aps(folder / "kitti", source, *in_fog) == expected


def test_ground_truth_by_id_without_a_frame_table(write_table, tmp_path):
    truth, found, frames = random_scene(8)
    ids = {"frame": frames["frame"]}
    write_table(tmp_path / "found.npz", found, ids)
    write_table(tmp_path / "truth.npz", truth, ids)
    source = Source(ground_truth=str(tmp_path / "truth.npz"))
    _, _, frames, _ = files.load(tmp_path / "found.npz", source, ("Sedan",))
    both = np.union1d(truth["frame"], found["frame"])
    np.testing.assert_array_equal(frames["frame"], both)


def test_ground_truth_of_a_report(stored):
    folder, source = stored
    expected = files.load(folder / "found.json", source, ("Sedan",))
    report = folder / "run" / "evaluation"
    report.mkdir(parents=True)
    shutil.copy(folder / "truth.npz", report / "ground_truth.npz")
    shutil.copy(folder / "frames.json", report)
    for place in (report, report.parent):
        other = source.replace(ground_truth=str(place))
        found = files.load(folder / "found.json", other, ("Sedan",))
        assert_same(found[0], expected[0])
        assert_same(found[1], expected[1])
        np.testing.assert_array_equal(found[2]["frame"], expected[2]["frame"])


def test_a_part_of_the_frames(stored):
    folder, source = stored
    _, _, whole, _ = files.load(folder / "found.json", source, ("Sedan",))
    part = source.replace(weather=("fog", "rain"))
    truth, found, frames, _ = files.load(folder / "found.json", part, ("Sedan",))
    chosen = whole["frame"][np.isin(whole["weather"], ("fog", "rain"))]
    assert 0 < chosen.size < whole["frame"].size
    np.testing.assert_array_equal(frames["frame"], chosen)
    for table in (truth, found):
        assert len(table) > 0
        assert set(table.frame) <= set(chosen.tolist())


def test_labels_of_kradar(tmp_path):
    write_kradar(tmp_path / "kradar")
    record = {**RECORD, "frame": "2/00009_00006"}
    (tmp_path / "p.json").write_text(json.dumps([record]))
    source = Source(labels=str(tmp_path / "kradar"), split="test")
    truth, found, frames, left_out = files.load(tmp_path / "p.json", source, ("Sedan",))
    data = KRadar(labels=tmp_path / "kradar", split="test")
    assert found.frame.tolist() == [[x.key for x in data].index("2/00009_00006")]
    assert frames["frame"].size == len(data) == 4
    assert len(truth) == data.class_counts()["Sedan"]
    assert any(name.startswith("labels: ") for name in left_out)


# Reports of files ---------------------------------------------------------------------


def test_options_of_a_report_or_of_the_config_of_a_run(stored, two_runs):
    run = stored[0] / "run"
    (run / "boxes").mkdir(parents=True)
    assert files.stored_options(stored[0] / "found.json") == {}
    (run / "config.json").write_text('{"classes": ["Sedan", "Tram"], "seed": 1}')
    for place in (run, run / "boxes", run / "found.json"):
        assert files.stored_options(place) == {"classes": ("Sedan", "Tram")}
    assert files.report_folders(run / "boxes") == {"": run / "boxes"}
    seed = two_runs / "a" / "seed0"
    for place in (seed, seed / "evaluation"):
        options = ReportOptions(**files.stored_options(place))
        assert (options.classes, options.score_threshold) == (("Sedan",), 0.4)
        assert options.roi is None
    assert files.report_folders(seed) == {"": seed / "evaluation"}
    assert list(files.report_folders(two_runs / "a")) == ["seed0", "seed1", "seed2"]


def test_a_config_of_another_program_has_no_classes(stored):
    folder, _ = stored
    for text, expected in (
        ('{"model_type": "dinov3_vit"}', {}),
        ('{"config": {"classes": ["Sedan"]}}', {"classes": ("Sedan",)}),
    ):
        (folder / "config.json").write_text(text)
        assert files.stored_options(folder / "found.json") == expected


def test_own_classes_that_are_not_chosen_are_known(scene, tmp_path):
    *tables, frames = scene
    names = (np.where(x["cls"] == "Sedan", "Car", "Tram") for x in tables)
    tables = [{**x, "cls": cls} for x, cls in zip(tables, names, strict=True)]
    options = ReportOptions(roi=None, plots=False, protocols=("all_point",))
    options = options.replace(classes=("Car", "Tram"))
    part = options.replace(classes=("Car",), known_classes=options.classes)
    for name, of in (("all", options), ("part", part)):
        write_report(*tables, frames, tmp_path / name, of)
    for words in (
        ("score", tmp_path / "all", "--classes", "Tram"),
        ("score", tmp_path / "part", "--classes", "Tram"),
        ("compare", tmp_path / "part", tmp_path / "all"),
    ):
        run(*words, "--bootstrap", 2)


def test_results_of_a_folder_are_named_after_it(two_runs, tmp_path, monkeypatch):
    names = ("lr0.001", "lr0.002")
    for name in names:
        shutil.copytree(two_runs / "a" / "seed0" / "evaluation", tmp_path / name)
    monkeypatch.chdir(tmp_path / names[1])
    for place in (f"../{names[0]}", "."):
        run("score", place, "--bootstrap", 0)
    for name in names:
        metrics = tmp_path / f"{name}_evaluation" / "metrics.json"
        assert json.loads(metrics.read_text())["run"] == name


def test_scoring_a_run_repeats_its_report(two_runs, tmp_path):
    seed = two_runs / "a" / "seed0"
    run("score", seed, "--out", tmp_path, "--bootstrap", 0)
    for name in ("metrics.csv", "tables.md"):
        one, other = (place / name for place in (seed / "evaluation", tmp_path))
        text = one.read_text().replace("| a ", "| seed0 ")
        assert text == other.read_text()
    assert "holds several seeds" in run("score", seed.parent, code=2).stderr


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ("Car", "classes is ('Car',), expected some of Bicycle, "),
        ("sedan,Sedan", "classes is ('sedan', 'Sedan'), expected some of Bicycle, "),
        ("Tram,Bicycle", None),  # one is in the ground truth, the other K-Radar's
    ],
)
def test_classes_that_do_not_exist_are_wrong_use(
    tmp_path, write_table, classes, message
):
    table = {"frame": [0], "box": [BOX], "cls": ["Tram"]}
    ids = {"frame": np.array([0])}
    write_table(tmp_path / "found.json", {**table, "score": [0.5]}, ids)
    write_table(tmp_path / "truth.json", table, ids)
    words = ["score", tmp_path / "found.json", "--classes", classes]
    words += ["--ground-truth", tmp_path / "truth.json", "--protocols", "all_point"]
    done = run(*words, code=2 if message else 0)
    assert (message or "") in done.stderr


@pytest.mark.parametrize(
    ("name", "code", "reason"),
    [
        ("metrics.json", 2, "metrics.json"),
        ("ground_truth.npz", 2, "ground_truth.npz"),
        ("frames.json", 1, "expected one of the frames that are eval"),
    ],
)
def test_a_part_of_a_report_has_no_score(two_runs, tmp_path, name, code, reason):
    shutil.copytree(two_runs / "a" / "seed0" / "evaluation", tmp_path / "report")
    (tmp_path / "report" / name).unlink()
    assert reason in run("score", tmp_path / "report", code=code).stderr


@pytest.mark.parametrize("name", ["metrics.json", "predictions.npz"])
def test_reports_mixed_by_a_partial_copy_are_rejected(two_runs, tmp_path, name):
    one, other = (two_runs / "a" / x / "evaluation" for x in ("seed0", "seed1"))
    report = shutil.copytree(one, tmp_path / "report")
    words = ["score", report, "--out", tmp_path / "out", "--bootstrap", 0]
    run(*words)  # a whole copy
    shutil.copy(other / name, report)
    text = "predictions.npz is corrupted or of another folder: its sha256 differs"
    compared = ["compare", other, report]
    for command in (words, compared, [*words, "--ground-truth", report]):
        assert text in run(*command, code=1).stderr
    shutil.copytree(one, report, dirs_exist_ok=True)
    shutil.copy(other / "predictions.npz", report / "ground_truth.npz")
    assert "ground_truth.npz is corrupted or of" in run(*words, code=1).stderr


def test_a_report_replaces_all_of_an_earlier_one(stored, caplog):
    folder, source = stored
    out = folder / "out"
    for is_on in (True, False):
        options = ReportOptions(roi=None, plots=is_on, kitti=is_on, classes=("Sedan",))
        files.evaluate_files(folder / "found.json", out, source, options)
        names = {path.name for path in out.iterdir()}
        assert ("kitti" in names) == is_on
        assert any(name.startswith("precision_recall_") for name in names) == is_on
        (out / "notes.txt").touch()
    assert "notes.txt" in names
    assert "are replaced" not in caplog.text
    files.evaluate_files(folder / "found.json", out, source, options, run="other")
    assert f"{out}: the results of radejax are replaced" in caplog.text
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["radejax"] == radejax.__version__


def test_exported_boxes_are_those_that_count(stored):
    folder, source = stored
    region = (0, 15, -3, 3, -2, 6)
    options = ReportOptions(roi=region, plots=False, kitti=True, classes=("Sedan",))
    options = options.replace(score_threshold=0.3)
    made = files.evaluate_files(folder / "found.json", folder / "out", source, options)
    place = folder / "out" / "kitti" / "0.3" / "all"
    truth, found, _ = kitti.read_kitti(place)
    assert len(truth) == made.metrics["num_ground_truth"]
    left_out = made.metrics["left_out"]
    assert left_out["ground truth: center outside the region of interest"]
    assert set(truth.cls) == set(found.cls) == {"Sedan"}
    assert found.score.min() > 0.3
    # The files give the APs of the report, so that K-Radar's own script does so too.
    whole = options.replace(roi=None, kitti=False)
    again = files.evaluate_files(place, folder / "again", Source(), whole)
    aps = {row.key: row.ap for row in again.results if "kradar" in row.protocol}
    compared = [x for x in made.results if x.key in aps and x.condition == "all"]
    assert len(compared) > 10
    for row in compared:
        assert aps[row.key] == pytest.approx(row.ap)
