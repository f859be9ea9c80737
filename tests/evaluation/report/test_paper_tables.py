"""Which of our numbers stand beside published ones, and where a difference is given."""

import dataclasses
import re

import numpy as np
import pytest

from radejax.core.structures import CLASSES, NARROW_ROI
from radejax.data.kradar import KRadar
from radejax.data.kradar.folders import SIMULATION_MARKER
from radejax.evaluation.files import load
from radejax.evaluation.report import compare, paper_tables, report, tables
from radejax.evaluation.report.measure import Options, Origin, rare_classes
from radejax.evaluation.report.published import Terms, published_rows

AS_PAPERS = Options(
    run="mine",
    iou_thresholds=(0.3,),
    protocols=("coco101", "kradar_r40"),
    score_threshold=0.3,
    roi=NARROW_ROI,
    label_version="v2.1",
    plots=False,
)
THEIRS = published_rows("DinoRADE", "3", method="DinoRADE")[0].terms
MOTORCYCLE_OR_NONE = "mean over 4 classes"


@pytest.fixture(scope="module")
def real(shared, tmp_path_factory):
    """Truth and invented predictions on the test split of K-Radar's labels v2.1."""
    labels = shared / "data" / "kradar" / "labels_v2_1.zip"
    data = KRadar(labels=labels, split="test")
    truth, frames = load.tables_from_frames(data, "test")
    rng = np.random.default_rng(5)
    box = truth["box"] + rng.normal(0, 0.2, truth["box"].shape) * [1, 1, 1, 0, 0, 0, 1]
    score = rng.uniform(0.1, 1, len(box))
    return truth, {**truth, "box": box, "score": score}, frames


def _tables(real, tmp_path, frames=None, **changes):
    """Titles and rendered tables of a report's published part."""
    truth, found, own = real
    options = dataclasses.replace(AS_PAPERS, **changes)
    made = report.write_report(truth, found, frames or own, tmp_path, options)
    found = {table.title: table for table in _published(made, options)}
    return [next(t for k, t in found.items() if f"{name})" in k) for name in _LAYOUTS]


_LAYOUTS = ("layout of Table I", "layout of Table II", "DinoRADE's Table 3")


def _published(made, options):
    return paper_tables.beside_published(
        tables.index(made.rows), options, Origin(**made.metrics["origin"])
    )


def _differences(table):
    """Rows with a difference, by what they are to."""
    return [
        row[:2]
        for row in table.rows
        if "difference" in row or row[0].startswith("mine -")
    ]


def test_a_difference_stands_exactly_where_terms_are_the_same(real, tmp_path):
    one, two, three = _tables(real, tmp_path)
    # Five classes of v2.1: Table 2 and 3, and the classes of Table II, not its mean.
    assert _differences(one) == []
    assert [row[0] for row in two.rows if row[1] == "difference"] == [
        "Sedan", "Sedan", "Bus or Truck", "Bus or Truck", "Pedestrian", "Pedestrian",
        "Motorcycle", "Bicycle", "Bicycle", "mean",
    ]  # fmt: skip
    assert two.notes == [
        f"No difference to the mean of RADE-Net, Table II: {MOTORCYCLE_OR_NONE}."
    ]
    assert [row[0] for row in _differences(three)] == [
        "mine - RADE-Net", "mine - DPFT", "mine - DinoRADE",
    ]  # fmt: skip
    assert not three.notes
    # The published rows of Table I stand, and a note says why nothing is subtracted.
    assert any(row[0] == "RADE-Net" and "64.1" in row for row in one.rows)
    text = " ".join(one.notes)
    assert "evaluation not stated (copied from earlier work)" in text
    assert re.search(
        r"RADE-Net \(RADE-Net, Table I\).*labels: v1.1, ours v2.1; classes: Sedan, ours "
        r"Bicycle \+ Bus or Truck",
        text,
    )
    values = {tuple(row[:2]): row for row in three.rows}
    ours, theirs, gap = (
        float(values[key][3])
        for key in [
            ("mine", "coco101"),
            ("DinoRADE", "DinoRADE, Table 3"),
            ("mine - DinoRADE", "difference"),
        ]
    )
    assert gap == pytest.approx(ours - theirs, abs=0.011)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"protocols": ("kradar_r40",)}, "protocol: coco101, ours kradar_r40"),
        ({"score_threshold": 0.0}, "score cut: 0.3, ours 0.0"),
        ({"empty_frames": "frame"}, "skip: class, ours frame"),
        ({"roi": "wide"}, "roi: narrow, ours wide"),
        ({"label_version": "v2.0"}, "labels: v2.1, ours v2.0"),
        ({"classes": ("Sedan",)}, "ours Sedan"),
    ],
)
def test_one_term_that_differs_leaves_no_difference(real, tmp_path, change, reason):
    for table in _tables(real, tmp_path, **change)[1:]:
        assert _differences(table) == []
        assert any(reason in note for note in table.notes)
        assert any("71.38" in row for row in table.rows)  # theirs stands


def test_sedan_of_v1_1_is_compared_with_tables_1_alone(real, tmp_path):
    # The flag stands for labels that are not at hand; what is compared is the point.
    change = {"classes": ("Sedan",), "label_version": "v1.1"}
    one, two, three = _tables(real, tmp_path, **change)
    assert {row[1] for row in _differences(one)} == {
        "RADE-Net, Table I",
        "DinoRADE, Table 1",
    }
    assert {row[0] for row in _differences(one)} == {
        "mine - RADE-Net",
        "mine - DinoRADE",
    }
    assert _differences(two) == _differences(three) == []


def test_frames_and_split_must_be_those_of_the_row(real, tmp_path):
    frames = real[2]
    other = {**frames, "split": np.full(frames["frame"].size, "all")}
    unknown = {k: v for k, v in frames.items() if k != "split"}
    for table, reason in ((other, "ours all"), (unknown, "ours not known")):
        three = _tables(real, tmp_path, table)[2]
        assert _differences(three) == []
        assert f"split: test, {reason}" in three.notes[0]
    truth, found, frames = real
    count = frames["frame"].size - 1
    kept = {k: v[:count] for k, v in frames.items()}
    fewer = [{k: v[t["frame"] < count] for k, v in t.items()} for t in (truth, found)]
    three = _tables((*fewer, kept), tmp_path)[2]
    assert _differences(three) == []
    assert "frames: 17536, ours 17535" in three.notes[0]


def test_simulated_frames_have_no_published_row_anywhere(random_scene, tmp_path):
    truth, found, frames = random_scene(8, num_frames=30, num_objects=90)
    frames["simulated"] = np.ones(30, bool)
    made = report.write_report(
        truth, found, frames, tmp_path, run="mine", roi=None, worst_frames=1
    )
    texts = {p.name: p.read_text() for p in made.files if p.suffix in (".md", ".tex")}
    assert len(texts) == 2
    for text in (*texts.values(), made.text):
        assert not re.search("RADE-Net|DinoRADE, Table|RTNH", text.split("recall")[0])
        assert "Table" not in text
    titles = re.findall(
        r"^(?:\*\*|\\caption{)(.*)$", "\n".join(texts.values()), re.MULTILINE
    )
    assert titles
    assert all(title.startswith("Simulated data: ") for title in titles)
    assert all(row["name"].endswith("/simulated") for row in made.metrics["ap"])
    assert "30 simulated frames" in made.text
    # What was written says so when it is scored again and compared.
    again = compare.evaluate_files(tmp_path, tmp_path / "b", load.Source(), Options())
    assert again.metrics["origin"]["is_simulated"]
    text, _ = compare.compare_files(
        [tmp_path, tmp_path / "b"], None, load.Source(), Options(), resamples=20
    )
    assert text.count("Simulated data: ") == 2
    assert "RADE-Net" not in text


def test_reports_of_before_name_their_data(random_scene, tmp_path):
    root = tmp_path / "data"
    root.mkdir()
    (root / SIMULATION_MARKER).write_text("{}")
    report.write_report(*random_scene(8), tmp_path / "a", roi=None, plots=False)
    (tmp_path / "a" / "source.json").write_text(f'{{"roots": ["{root}"]}}')
    options = Options(plots=False, roi=None)
    made = compare.evaluate_files(
        tmp_path / "a", tmp_path / "b", load.Source(), options
    )
    assert made.metrics["origin"]["is_simulated"]


def test_terms_say_what_differs():
    assert THEIRS.classes == tuple(sorted(CLASSES))
    assert THEIRS.differences(THEIRS) == ""
    for name in Terms._fields:
        other = THEIRS._replace(**{name: None})
        assert other.differences(THEIRS).startswith(f"{name.replace('_', ' ')}: ")


@pytest.mark.slow  # reads the labels of the train split too
def test_marks_are_those_that_dinorade_prints(real, shared, tmp_path):
    labels = shared / "data" / "kradar" / "labels_v2_1.zip"
    objects, frames = load.tables_from_frames(KRadar(labels=labels, split="train"))
    rare = rare_classes(objects, frames, CLASSES, NARROW_ROI)
    (printed,) = published_rows("DinoRADE", "2", space="3d")
    stars = {(cls, at) for cls, at in rare if printed.get(cls, at) is not None}
    assert stars == {
        *(("Motorcycle", "all"), ("Motorcycle", "normal")),
        *(("Pedestrian", "normal"), ("Pedestrian", "rain"), ("Bus or Truck", "rain")),
    }
    _, by_class, _ = _tables(real, tmp_path, rare=rare)
    rows = {row[0]: row[2:] for row in by_class.rows if row[1] == "mine"}
    assert [cell[0] == "*" for cell in rows["Motorcycle"][:4]] == [True] * 4
    assert not any("*" in cell for cell in [*rows["Sedan"], *rows["mean"]])
    assert tables.RARE_NOTE in by_class.notes
    text = (tmp_path / "report.txt").read_text()
    assert tables.RARE_NOTE in text
    assert any(line.count("*") >= 2 for line in text.splitlines() if "Motorcy" in line)
