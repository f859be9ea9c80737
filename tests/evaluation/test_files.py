import dataclasses
import json
import shutil
import types

import numpy as np
import pytest
from click.testing import CliRunner

from radejax.cli.main import main
from radejax.core.errors import DataError, UserError
from radejax.evaluation import boxes, files, kitti, report
from radejax.evaluation.files import Source
from radejax.evaluation.results import ReportOptions


def test_ground_truth_has_to_come_from_somewhere(stored):
    folder, source = stored
    with pytest.raises(UserError, match="give the ground truth with"):
        files.load(folder / "found.json", Source(), ("Sedan",))
    with pytest.raises(FileNotFoundError, match=r"none\.json"):
        files.load(folder / "none.json", source, ("Sedan",))
    (folder / "frames.json").write_text("[]")
    with pytest.raises(DataError, match=r"frames\.json is not a table of frames"):
        files.load(folder / "found.json", source, ("Sedan",))
    (folder / "frames.json").write_text('{"frame": [1, 2], "name": ["a"]}')
    with pytest.raises(
        DataError, match=r"frames\.json is .* column 'name' has shape \(1,\)"
    ):
        files.load(folder / "found.json", source, ("Sedan",))


def test_every_way_in_gives_the_same_numbers(stored, stored_scene):
    folder, source = stored
    options = ReportOptions(
        roi=None, plots=False, protocols=("all_point", "kradar_r40")
    )

    def aps(path, source, protocol=None, condition="all"):
        made = files.evaluate_files(path, folder / f"{path.name}_out", source, options)
        return [
            row.ap_or_none
            for row in made.results
            if row.condition == condition and protocol in (None, row.protocol)
        ]

    one = aps(folder / "found.json", source)
    # A report brings everything that is needed to repeat it.
    assert aps(folder / "found.json_out", Source()) == one
    kitti.write_kitti(folder / "kitti", *stored_scene)
    in_fog = "kradar_r40", "fog"
    expected = aps(folder / "found.json", source, *in_fog)
    assert aps(folder / "kitti", Source(), *in_fog) == expected != []
    assert aps(folder / "kitti", source, *in_fog) == expected


def test_ground_truth_by_id_without_a_frame_table(random_scene, write_table, tmp_path):
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
        other = dataclasses.replace(source, ground_truth=str(place))
        found = files.load(folder / "found.json", other, ("Sedan",))
        for a, b in zip(found[:3], expected[:3], strict=True):
            assert a.keys() == b.keys()
            for name in a:
                np.testing.assert_array_equal(a[name], b[name])


def test_options_of_a_report_or_of_the_config_of_a_run(stored, stored_scene):
    folder, _ = stored
    run = folder / "run"
    (run / "boxes").mkdir(parents=True)
    assert files.stored_options(folder / "found.json") == {}
    (run / "config.json").write_text('{"classes": ["Sedan", "Tram"], "seed": 1}')
    for place in (run, run / "boxes", run / "found.json"):
        assert files.stored_options(place) == {"classes": ("Sedan", "Tram")}
    options = ReportOptions(
        classes=("Sedan",), roi="wide", score_threshold=0.3, bootstrap=7, plots=False
    )
    report.write_report(*stored_scene, run / "evaluation", options)
    for place in (run, run / "evaluation"):
        found = ReportOptions(**files.stored_options(place))
        assert found == options
    assert files.report_folders(run) == {"": run / "evaluation"}
    assert files.report_folders(run / "boxes") == {"": run / "boxes"}


def test_own_classes_need_no_option(stored, write_table):
    folder, _ = stored
    run = folder / "run"
    box = np.array([[20.0, 0, 0, 4, 2, 1.5, 0]])
    table = {"frame": np.array([0]), "box": box, "cls": np.array(["Tram"])}
    ids = {"frame": np.array([0])}
    write_table(run / "found.json", {**table, "score": np.array([0.5])}, ids)
    write_table(run / "truth.json", table, ids)
    words = [
        "score",
        str(run / "found.json"),
        "--ground-truth",
        str(run / "truth.json"),
    ]
    words += ["--out", str(folder / "out"), "--protocols", "all_point", "--json"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 1
    assert "unknown class 'Tram'" in done.stderr
    (run / "config.json").write_text('{"classes": ["Tram"]}')
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.stderr
    row = next(row for row in json.loads(done.stdout)["ap"] if row["cls"] == "Tram")
    assert row["ap"] == 100
    # K-Radar's tools have no name for it, which keeps the report that was there.
    done = CliRunner().invoke(main, [*words, "--kitti"])
    assert done.exit_code == 2
    assert "K-Radar's tools have no key for class 'Tram'" in done.stderr
    assert (folder / "out" / "metrics.json").exists()


def test_exported_boxes_are_those_that_count(stored):
    folder, source = stored
    options = ReportOptions(
        roi=(0, 15, -3, 3, -2, 6),
        plots=False,
        kitti=True,
        score_threshold=0.3,
        classes=("Sedan",),
    )
    made = files.evaluate_files(folder / "found.json", folder / "out", source, options)
    place = folder / "out" / "kitti" / "0.3" / "all"
    truth, found, _ = kitti.read_kitti(place)
    assert len(truth["frame"]) == made.metrics["num_ground_truth"]
    assert made.metrics["left_out"][
        "ground truth: center outside the region of interest"
    ]
    assert set(truth["cls"]) == set(found["cls"]) == {"Sedan"}
    assert found["score"].min() > 0.3
    # The files give the APs of the report, so that K-Radar's own script does so too.
    whole = options.replace(roi=None, kitti=False)
    again = files.evaluate_files(place, folder / "again", Source(), whole)
    aps = {
        row.key: row.ap for row in again.results if row.protocol.startswith("kradar")
    }
    compared = [
        row for row in made.results if row.key in aps and row.condition == "all"
    ]
    assert len(compared) > 10
    for row in compared:
        assert aps[row.key] == pytest.approx(row.ap)


def test_figures_are_also_written_as_pdf(stored):
    folder, source = stored
    words = ["score", str(folder / "found.json"), "--out", str(folder / "out")]
    words += ["--ground-truth", source.ground_truth, "--bootstrap", "0"]
    done = CliRunner().invoke(main, [*words, "--roi", "none", "--figures", "pdf"])
    assert done.exit_code == 0, done.stderr
    drawn = sorted(path.name for path in (folder / "out").glob("precision_recall_*"))
    assert drawn == [f"precision_recall_{space}_iou30.pdf" for space in ("3d", "bev")]
    assert (folder / "out" / drawn[0]).read_bytes().startswith(b"%PDF")


def test_a_part_of_the_frames(stored, random_scene):
    folder, source = stored
    _, _, whole, _ = files.load(folder / "found.json", source, ("Sedan",))
    part = dataclasses.replace(source, weather=("fog", "rain"))
    truth, found, frames, _ = files.load(folder / "found.json", part, ("Sedan",))
    chosen = whole["frame"][np.isin(whole["weather"], ("fog", "rain"))]
    assert 0 < chosen.size < whole["frame"].size
    np.testing.assert_array_equal(frames["frame"], chosen)
    for table in (truth, found):
        assert set(table["frame"]) <= set(chosen.tolist())
        assert len(table["box"]) == len(table["frame"]) > 0
    none = dataclasses.replace(source, sequences=(77,))
    with pytest.raises(UserError, match="no frames of sequence 77; there are "):
        files.load(folder / "found.json", none, ("Sedan",))


def test_labels_of_kradar(shared, tmp_path):
    folder = shared / "data" / "kradar"
    source = Source(labels=str(folder / "labels_v2_1.zip"), split="test")
    first = (folder / "split" / "test.txt").read_text().splitlines()[0]
    record = {"frame": first.replace(",", "/"), "cls": "Sedan", "score": 0.5}
    record["box"] = [20, 0, 0, 4, 2, 1.5, 0]
    (tmp_path / "p.json").write_text(json.dumps([record]))
    truth, found, frames, left_out = files.load(tmp_path / "p.json", source, ("Sedan",))
    assert frames["frame"].size == 17536
    assert found["frame"].tolist() == [0]
    assert truth["frame"].size > 10000
    assert any(name.startswith("labels: ") for name in left_out)


def test_tables_from_frames():
    frame = types.SimpleNamespace(
        sequence=3,
        name="00001_00001",
        weather="fog",
        environment="urban",
        time="day",
        boxes=np.ones((2, 7)),
        classes=["Sedan", "Bicycle"],
        is_simulated=False,
    )
    empty = types.SimpleNamespace(
        **{**vars(frame), "boxes": np.zeros((0, 7)), "classes": [], "weather": "rain"}
    )
    truth, table = boxes.tables_from_frames([empty, frame])
    assert truth["frame"].tolist() == [1, 1]
    assert truth["cls"].tolist() == ["Sedan", "Bicycle"]
    assert table["weather"].tolist() == ["rain", "fog"]
    none, _ = boxes.tables_from_frames([])
    assert none["box"].shape == (0, 7)


# Tables -------------------------------------------------------------------------------


@pytest.fixture
def scene(random_scene):
    return random_scene(2)


def assert_same(one, other):
    for column, values in other.items():
        np.testing.assert_array_equal(one[column], values)


@pytest.mark.parametrize("suffix", ["npz", "json"])
@pytest.mark.parametrize("by_key", [True, False])
def test_round_trip_is_exact(tmp_path, scene, write_table, suffix, by_key):
    truth, found, frames = scene
    written_with = frames if by_key else {"frame": frames["frame"]}
    nothing = {k: v[:0] for k, v in found.items()}
    for table, scored in ((found, True), (truth, False), (nothing, True)):
        path = tmp_path / f"table.{suffix}"
        write_table(path, table, written_with)
        read = files.read_table(path, frames, scored=scored)
        assert_same(read, table)
    assert read["box"].shape == (0, 7)
    assert read["frame"].dtype == np.int64


def test_keys_survive_another_selection_of_frames(tmp_path, scene, write_table):
    _, found, frames = scene
    write_table(tmp_path / "p.json", found, frames)
    shifted = {**frames, "frame": frames["frame"] + 1000}
    read = files.read_table(tmp_path / "p.json", shifted)
    np.testing.assert_array_equal(read["frame"], found["frame"] + 1000)


def test_frame_keys():
    ids = {"frame": np.array([4, 5])}
    assert boxes.frame_keys(ids) == ["4", "5"]
    named = {**ids, "name": np.array(["00033_00001.txt", "00034_00002"])}
    assert boxes.frame_keys(named) == ["00033_00001", "00034_00002"]
    named["sequence"] = np.array([1, 12])
    assert boxes.frame_keys(named) == ["1/00033_00001", "12/00034_00002"]
    named["name"] = np.array(["1/00033_00001", "12/00034_00002"])
    assert boxes.frame_keys(named) == ["1/00033_00001", "12/00034_00002"]


def test_json_records(tmp_path):
    frames = {"frame": np.array([10, 11]), "name": np.array(["1/a", "1/b"])}
    box = [1, 2, 3, 4, 5, 6, 0.5]
    record = {"cls": "Sedan", "box": box, "score": 0.5}
    spelled = {"cls": "Sedan", "score": 0.5, **dict(zip("xyzlwh", box, strict=False))}
    for form in (
        {"frame": "1/b", **record},
        {"frame": "1/b.txt", **record},
        {"frame": 11, **spelled, "yaw": 0.5},
    ):
        path = tmp_path / "p.json"
        path.write_text(json.dumps([form]))
        read = files.read_table(path, frames)
        assert_same(
            read,
            {"frame": [11], "cls": ["Sedan"], "box": [box], "score": [0.5]},
        )


def test_wrong_files_are_named(tmp_path):
    frames = {"frame": np.array([0]), "name": np.array(["1/a"])}

    def raises(name, content, match, error=DataError):
        path = tmp_path / name
        path.write_bytes(content.encode())
        with pytest.raises(error, match=match):
            files.read_table(path, frames)

    with pytest.raises(FileNotFoundError, match="No such file"):
        files.read_table(tmp_path / "none.json")
    raises("a.txt", "", "a.txt is neither a .npz or .json file", UserError)
    raises("a.npz", "nonsense", "a.npz")
    raises("a.json", "{", "a.json is not valid JSON")
    good = {"frame": 0, "cls": "Sedan", "box": [1, 2, 3, 4, 5, 6, 7], "score": 1}
    for row, content in (
        (0, {}),
        (0, [1]),
        (1, [good, {k: v for k, v in good.items() if k != "score"}]),
        (0, [{k: v for k, v in good.items() if k != "box"}]),
        (0, [{**good, "score": "high"}]),
        (0, [{**good, "cls": "S" * 999}]),
        (0, [{**good, "frame": None}]),
    ):
        message = rf"a\.json: row {row}.* is .*expected a list of records with frame"
        raises("a.json", json.dumps(content), message)
    named = json.dumps([{**good, "frame": "1/b"}])
    raises("a.json", named, "row 0: frame '1/b', expected one of .*, such as '1/a'")
    with pytest.raises(DataError, match="such as None"):
        files.read_table(tmp_path / "a.json")
