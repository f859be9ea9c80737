import dataclasses
import re

import numpy as np
import pytest

from radejax.core.structures import CLASSES, NARROW_ROI
from radejax.data.kradar import KRadar
from radejax.evaluation import published, report, tables
from radejax.evaluation.files import Source, tables_from_frames
from radejax.evaluation.published import PUBLISHED, published_rows
from radejax.evaluation.results import EvaluationOptions, evaluate_tables


def test_counts_of_rows():
    tables = {}
    for row in PUBLISHED:
        tables[row.source] = tables.get(row.source, 0) + 1
    assert tables == {
        "RADE-Net, Table I": 14,
        "RADE-Net, Table II": 2,
        "RADE-Net, Table III": 28,
        "DinoRADE, Table 1": 13,
        "DinoRADE, Table 2": 2,
        "DinoRADE, Table 3": 6,
        "DinoRADE, Table 4": 8,
    }


def test_no_number_was_lost_on_the_way_to_the_file():
    values = [value for row in PUBLISHED for value in row.values.values()]
    printed = [value for value in values if value is not None]
    assert (len(values), len(printed)) == (454, 385)
    assert sum(printed) == pytest.approx(19256.36, abs=1e-6)


def test_some_numbers_as_printed():
    rade = published_rows("RADE-Net", "I", method="RADE-Net")
    assert [row.get("Sedan") for row in rade] == [64.1, 68.7]
    assert rade[0].get("Sedan", "fog") == 85.4
    assert rade[1].get("Sedan", "heavysnow") == 68.7
    two = published_rows("RADE-Net", "II", space="bev")[0]
    assert two.get("Bus or Truck", "heavysnow") == 85.94
    assert two.get("Pedestrian", "lightsnow") is None
    assert two.get("Sedan", "overcast") is None
    dino = published_rows("DinoRADE", "2", space="3d")[0]
    assert dino.get("Pedestrian", "fog") == 50.98
    assert dino.get("Motorcycle", "normal") == 3.77
    four = published_rows("DinoRADE", "4", method="R+C*+W", space="bev")[0]
    assert four.get("Sedan") == 72.42
    three = published_rows("RADE-Net", "III", space="3d", iou=0.5)
    assert [row.get("Sedan") for row in three] == [
        32.85,
        27.65,
        32.73,
        35.31,
        39.02,
        37.09,
        38.04,
    ]


def test_rows_that_two_tables_share_agree():
    for method in ("TED-S", "MixedFusion", "RTNH", "DPFT", "EchoFusion"):
        one, other = (
            published_rows(*where, method=method, space="3d")[0].values
            for where in (("RADE-Net", "I"), ("DinoRADE", "1"))
        )
        assert one == other
    for space in ("3d", "bev"):
        two = published_rows("RADE-Net", "II", space=space)[0]
        three = published_rows("DinoRADE", "3", method="RADE-Net", space=space)[0]
        for cls in ("Sedan", "Bus or Truck", "Pedestrian", "Bicycle"):
            assert two.get(cls) == three.get(cls)
        dino = published_rows("DinoRADE", "3", method="DinoRADE", space=space)[0]
        weather = published_rows("DinoRADE", "2", space=space)[0]
        for cls in ("mean", *CLASSES):
            assert dino.get(cls) == weather.get(cls)
        assert published_rows("DinoRADE", "4", method="R+C+W", space=space)[0].get(
            "Sedan"
        ) == dino.get("Sedan")


@pytest.mark.parametrize(
    ("paper", "table"), [("RADE-Net", "II"), ("DinoRADE", "2"), ("DinoRADE", "3")]
)
def test_means_are_means_of_their_classes(paper, table):
    """A slip in copying a number would show here."""
    checked = 0
    for row in published_rows(paper, table):
        for condition in published.CONDITIONS:
            if (row.source, condition) == ("RADE-Net, Table II", "sleet"):
                continue  # printed 18.52 and 21.53, its classes give 18.49 and 21.35
            values = [row.get(cls, condition) for cls in CLASSES]
            values = [value for value in values if value is not None]
            if values and row.get("mean", condition) is not None:
                assert np.mean(values) == pytest.approx(
                    row.get("mean", condition), abs=0.0101
                ), (row.source, row.method, row.space, condition)
                checked += 1
    assert checked >= 6


def test_every_row_says_where_it_is_from():
    for row in PUBLISHED:
        assert row.label_version.startswith(("v1.1", "v2.1"))
        assert row.protocol in (published.AUTHORS_PROTOCOL, published.COPIED)
        assert row.space in ("3d", "bev")
        assert row.iou in (0.3, 0.5)
        assert all(0 <= v <= 100 for v in row.values.values() if v is not None)
    assert published_rows(method="nobody") == []


# A run in the layouts of the papers ---------------------------------------------------

AS_PAPERS = EvaluationOptions(
    iou_thresholds=(0.3,),
    protocols=("coco101", "kradar_r40"),
    score_threshold=0.3,
    roi=NARROW_ROI,
    label_version="v2.1",
)


@pytest.fixture(scope="module")
def real(shared):
    """Truth and invented predictions on the test split of K-Radar's labels v2.1."""
    labels = shared / "data" / "kradar" / "labels_v2_1.zip"
    truth, frames = tables_from_frames(KRadar(labels=labels, split="test"), "test")
    rng = np.random.default_rng(5)
    box = truth["box"] + rng.normal(0, 0.2, truth["box"].shape) * [1, 1, 1, 0, 0, 0, 1]
    score = rng.uniform(0.1, 1, len(box))
    return truth, {**truth, "box": box, "score": score}, frames


def _tables(real, split="test", **changes):
    """Tables I, II and DinoRADE's 3."""
    options = dataclasses.replace(AS_PAPERS, **changes)
    _, results = evaluate_tables(*real, options)
    return published.paper_tables(tables.index(results), options, "mine", split)


def _differences(table):
    """Rows with a difference, by what they are to."""
    return [
        row[:2]
        for row in table.rows
        if "difference" in row or row[0].startswith("mine -")
    ]


def test_a_difference_is_printed_where_protocol_labels_region_and_split_agree(real):
    one, two, three, _ = _tables(real)
    assert _differences(one) == []  # of labels v1.1
    assert [row[0] for row in two.rows if row[1] == "difference"] == [
        "Sedan", "Sedan", "Bus or Truck", "Bus or Truck", "Pedestrian", "Pedestrian",
        "Motorcycle", "Bicycle", "Bicycle", "mean",
    ]  # fmt: skip
    assert [row[0] for row in _differences(three)] == ["RADE-Net", "DPFT", "DinoRADE"]
    assert any(row[0] == "RADE-Net" and "64.1" in row for row in one.rows)
    values = {tuple(row[:2]): row for row in three.rows}
    ours, theirs, gap = (
        float(values[key][3])
        for key in [
            ("mine", "coco101"),
            ("DinoRADE", "DinoRADE, Table 3"),
            ("DinoRADE", "difference"),
        ]
    )
    assert gap == pytest.approx(ours - theirs, abs=0.011)


@pytest.mark.parametrize(
    "change",
    [
        {"protocols": ("kradar_r40",)},
        {"roi": "wide"},
        {"label_version": "v2.0"},
        {"split": "all"},
        {"split": None},
    ],
)
def test_one_setting_that_differs_leaves_no_difference(real, change):
    for table in _tables(real, **change)[1:3]:
        assert _differences(table) == []
        assert any("71.38" in row for row in table.rows)  # the published row remains


def test_sedan_of_v1_1_is_compared_with_tables_1(real):
    # The flag stands for labels that are not available here.
    one = _tables(real, classes=("Sedan",), label_version="v1.1")[0]
    assert {tuple(row) for row in _differences(one)} == {
        ("mine - RADE-Net", "RADE-Net, Table I"),
        ("mine - RADE-Net", "DinoRADE, Table 1"),
        ("mine - DinoRADE", "DinoRADE, Table 1"),
    }


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
    titles = re.findall(r"^(?:\*\*|% )(.*)$", "\n".join(texts.values()), re.MULTILINE)
    assert titles
    assert all(title.startswith("Simulated data: ") for title in titles)
    assert all(row["name"].endswith("/simulated") for row in made.metrics["ap"])
    assert "30 simulated frames" in made.text
    # A report that is evaluated or compared again still says so.
    options = EvaluationOptions(bootstrap=20)
    again = report.evaluate_files(tmp_path, tmp_path / "b", Source(), options)
    assert again.metrics["is_simulated"]
    text, _ = report.compare_files([tmp_path, tmp_path / "b"], None, Source(), options)
    assert text.count("Simulated data: ") == 2
    assert "RADE-Net" not in text
