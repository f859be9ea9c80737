import collections
import re

import numpy as np
import pytest

from radejax.config import config_file, load_config, load_module
from radejax.core.structures import CLASSES, NARROW_ROI
from radejax.data.kradar import KRadar
from radejax.evaluation import report
from radejax.evaluation.boxes import tables_from_frames
from radejax.evaluation.comparison import compare_files
from radejax.evaluation.files import Source, evaluate_files
from radejax.evaluation.report import PUBLISHED
from radejax.evaluation.results import ReportOptions, compute_results, make_set
from radejax.runs.evaluate import report_options


def printed(source, method=None, *, iou=0.3):
    """Function (class, space, condition) -> number of a row of a table, or None."""
    row, *_ = (
        r for r in PUBLISHED if r.source == source and method in (None, r.method)
    )

    def value(cls="Sedan", space="3d", condition="all"):
        text = row.values.get((condition, cls, space, iou), "-")
        return None if text == "-" else float(text)

    return value


OF_PAPERS = [row for row in PUBLISHED if ", Table " in row.source]


def test_published_file_has_all_numbers():
    assert collections.Counter(row.source for row in OF_PAPERS) == {
        "RADE-Net, Table I": 11,
        "RADE-Net, Table II": 1,
        "RADE-Net, Table III": 7,
        "DinoRADE, Table 1": 13,
        "DinoRADE, Table 2": 1,
        "DinoRADE, Table 3": 3,
        "DinoRADE, Table 4": 4,
    }
    texts = [text for row in OF_PAPERS for text in row.values.values()]
    values = [float(text) for text in texts if text != "-"]
    assert (len(texts), len(values)) == (454, 385)
    assert sum(values) == pytest.approx(19256.36, abs=1e-6)
    assert {row.label_version for row in OF_PAPERS} == {"v1.1", "v2.1"}
    for row in PUBLISHED:
        assert row.protocol in ("coco101", "not stated")
        assert row.region in ("narrow", "wide", "not stated")
        assert set(row.sensors) <= set("LCR")
        assert re.fullmatch(r"[\w-]+/[\w-]+|none|not stated", row.code)
        values = [float(text) for text in row.values.values() if text != "-"]
        assert values
        assert all(0 <= value <= 100 for value in values)


def test_rows_of_other_sources_as_printed():
    """The primary rows of section 1 of the overview of the field."""
    found = {
        (row.source, row.method, row.label_version, cls, space, iou): text
        for row in PUBLISHED
        if row not in OF_PAPERS
        for (condition, cls, space, iou), text in row.values.items()
        if condition == "all"
    }
    docs = "K-Radar, docs/"
    for key, text in {
        (docs + "sensor_fusion.md", "ASF", "v1.0", "Sedan", "3d", 0.3): "87.4",
        (docs + "sensor_fusion.md", "ASF", "v2.0", "Bus or Truck", "bev", 0.3): "70.2",
        (docs + "detection.md", "RTNH", "v1.0", "Sedan", "3d", 0.3): "47.4",
        (docs + "detection.md", "RTNH", "v2.0", "Bus or Truck", "bev", 0.3): "45.3",
        (docs + "labeling.md", "PVRCNN++", "v2.0", "Sedan", "bev", 0.3): "74.82",
        ("K-Radar, issue 70", "RTNH", "not stated", "Sedan", "3d", 0.3): "37.4",
        ("L4DR, logs/v1.1.txt", "L4DR", "v1.1", "Sedan", "bev", 0.5): "77.54",
        ("L4DR, logs/v2.1.txt", "L4DR", "v2.1", "Bus or Truck", "3d", 0.5): "39.11",
        ("DPFT, README.md", "DPFT", "v2.0", "Sedan", "3d", 0.3): "50.5",
        (
            "SRF, abstract",
            "SRF, classes not stated",
            "v2.0",
            "mean",
            "3d",
            0.3,
        ): "54.3",
    }.items():
        assert found[key] == text
    assert len(found) == 47


def test_rows_from_earlier_papers_say_what_labels_they_used():
    for source in ("RADE-Net, Table I", "DinoRADE, Table 1"):
        rows = {row.method: row for row in PUBLISHED if row.source == source}
        for method in {"DPFT", "RTNH", "WRCFormer"} & set(rows):
            row = rows[method]
            assert row.label_version == "v1.1"  # as these papers print it
            assert row.label_origin == "v1.0 in their own papers"
            terms = "protocol not stated, labels=v1.1 (v1.0 in their own papers)"
            assert row.terms == terms


@pytest.mark.parametrize(
    "row", PUBLISHED, ids=lambda row: f"{row.source}-{row.method}-{row.config}"
)
def test_a_published_row_has_a_config_or_is_not_trainable_here(row):
    is_own = row.protocol == "coco101" and row.method != "DPFT"
    assert (row.config != "not trainable here") == is_own
    if not is_own:
        return
    config = load_config(row.config)
    assert config.data.label_version == row.label_version
    # All five classes were trained, also where a table prints some of them.
    classes = ("Sedan",) if row.label_version == "v1.1" else CLASSES
    assert config.classes == classes
    assert {cls for _, cls, *_ in row.values} <= {*classes, "mean"}
    assert (config.model.name == "dinorade") == (row.sensors == "RC")
    options = report_options(config)
    assert options.paper_protocol == row.protocol
    assert options.settings_of(row.protocol)["score_threshold"] == 0.3
    assert row.score_threshold == "0.3"
    assert report.roi_name(options.roi) == row.region
    assert {iou for *_, iou in row.values} <= set(options.iou_thresholds)


@pytest.mark.parametrize("name", ["radenet", "dinorade"])
def test_the_ablation_tables_of_the_configs_are_the_published_ones(name):
    """The table in the docstring of a config: variant, AP 3D and AP BEV."""
    module = load_module(config_file(name))
    table = re.findall(r"^\| (\w+) \| ([\d.]+) \| ([\d.]+) \|$", module.__doc__, re.M)
    published = {}
    for row in PUBLISHED:
        if row.source in ("RADE-Net, Table III", "DinoRADE, Table 4"):
            config, _, options = row.config.partition(":")
            aps = [row.values["all", "Sedan", space, 0.3] for space in ("3d", "bev")]
            published[config, options.split(",")[0]] = aps
    assert {(name, v): [d3, bev] for v, d3, bev in table} == {
        key: aps for key, aps in published.items() if key[0] == name
    }
    unpublished = {"rcw_dinov2"} if name == "dinorade" else set()
    assert set(module.VARIANTS) - unpublished == {variant for variant, *_ in table}


def test_some_numbers_as_printed():
    rade = printed("RADE-Net, Table I", "RADE-Net")
    assert (rade(), rade(space="bev"), rade(condition="fog")) == (64.1, 68.7, 85.4)
    two = printed("RADE-Net, Table II")
    assert two("Bus or Truck", "bev", "heavysnow") == 85.94
    assert two("Pedestrian", "bev", "lightsnow") is None
    assert two("Sedan", "bev", "overcast") is None
    assert printed("DinoRADE, Table 2")("Pedestrian", condition="fog") == 50.98
    assert printed("DinoRADE, Table 4", "R+C*+W")(space="bev") == 72.42
    cell = "all", "Sedan", "3d", 0.5
    three = [row.values[cell] for row in OF_PAPERS if cell in row.values]
    assert three == ["32.85", "27.65", "32.73", "35.31", "39.02", "37.09", "38.04"]


def test_rows_that_two_tables_share_agree():
    for method in ("TED-S", "MixedFusion", "RTNH", "DPFT", "EchoFusion"):
        one = printed("RADE-Net, Table I", method)
        other = printed("DinoRADE, Table 1", method)
        for condition in report.CONDITIONS:
            assert one(condition=condition) == other(condition=condition)
    rade, dino = (printed("DinoRADE, Table 3", m) for m in ("RADE-Net", "DinoRADE"))
    two, weather = printed("RADE-Net, Table II"), printed("DinoRADE, Table 2")
    for space in ("3d", "bev"):
        for cls in ("Sedan", "Bus or Truck", "Pedestrian", "Bicycle"):
            assert two(cls, space) == rade(cls, space)
        for cls in ("mean", *CLASSES):
            assert dino(cls, space) == weather(cls, space)
        four = printed("DinoRADE, Table 4", "R+C+W")
        assert four("Sedan", space) == dino("Sedan", space)


@pytest.mark.parametrize(
    ("source", "method"),
    [("RADE-Net, Table II", "RADE-Net"), ("DinoRADE, Table 2", "DinoRADE")]
    + [("DinoRADE, Table 3", method) for method in ("RADE-Net", "DPFT", "DinoRADE")],
)
def test_means_are_means_of_their_classes(source, method):
    """A slip in copying a number would show here."""
    value = printed(source, method)
    for space in ("3d", "bev"):
        for condition in report.CONDITIONS:
            if (source, condition) == ("RADE-Net, Table II", "sleet"):
                continue  # printed 18.52 and 21.53, its classes give 18.49 and 21.35
            values = [value(cls, space, condition) for cls in CLASSES]
            values = [v for v in values if v is not None]
            mean = value("mean", space, condition)
            assert (mean is not None) == bool(values)
            if values:
                assert np.mean(values) == pytest.approx(mean, abs=0.0101)


# A run in the layouts of the papers ---------------------------------------------------

AS_PAPERS = ReportOptions(
    iou_thresholds=(0.3,),
    protocols=("coco101", "kradar_r40"),
    score_threshold=0.3,
    roi=NARROW_ROI,
    label_version="v2.1",
)


@pytest.fixture(scope="module")
def real(shared):
    """Ground truth and random predictions on the test split of K-Radar's labels v2.1."""
    labels = shared / "data" / "kradar" / "labels_v2_1.zip"
    truth, frames = tables_from_frames(KRadar(labels=labels, split="test"), "test")
    rng = np.random.default_rng(5)
    box = truth["box"] + rng.normal(0, 0.2, truth["box"].shape) * [1, 1, 1, 0, 0, 0, 1]
    score = rng.uniform(0.1, 1, len(box))
    return truth, {**truth, "box": box, "score": score}, frames


def _tables(real, split="test", **changes):
    """Rows of Tables I, II, DinoRADE's 3, III and of other methods."""
    options = AS_PAPERS.replace(**changes)
    results = compute_results(make_set(*real, options), real[2], options)
    by_key = {row.key: row for row in results}
    built = report.paper_tables("mine", by_key, options, split)
    return [table.rows for table in built]


def _differences(rows):
    """What rows with a difference are of and to."""
    return [row[1:3] for row in rows if row[0] == "difference"]


def test_a_difference_is_printed_where_protocol_labels_region_and_split_agree(real):
    one, two, three, ablations, others = _tables(real)
    assert _differences(one) == []  # of labels v1.1
    origin = "from the authors' release"
    terms = f"coco101, score>0.3, labels=v1.1 ({origin}), roi=narrow"
    row = ["RADE-Net (R)", "3D", "RADE-Net, Table I", terms, "64.1", "60.7"]
    assert row in [row[:6] for row in one]
    assert [cls for cls, _ in _differences(two)] == [
        "Sedan", "Sedan", "Bus or Truck", "Bus or Truck", "Pedestrian", "Pedestrian",
        "Motorcycle", "Bicycle", "Bicycle", "mean",
    ]  # fmt: skip
    assert len(_differences(three)) == 3
    *_, theirs, gap, _, ours = (float(row[6]) for row in three)
    assert [row[0] for row in three[-4:-1]] == ["DinoRADE (RC)", "difference", "mine"]
    assert [row[3].split(", ")[:3] for row in three[-2:]] == [
        ["kradar_r40", "score>0.3", "skip=frame"],
        ["coco101", "score>0.3", "skip=class"],
    ]
    assert gap == pytest.approx(ours - theirs, abs=0.011)
    assert _differences(ablations) == []
    assert len(ablations) == 7 + 4 + 2
    assert _differences(others) == []
    terms = "protocol not stated, score>0.3, labels=v2.1, roi=wide"
    source = "L4DR, logs/v2.1.txt"
    row = [
        "L4DR (LR)",
        "Bus or Truck",
        source,
        terms,
        "59.65",
        "63.82",
        "39.11",
        "55.12",
    ]
    assert row in others
    assert ["SRF, classes not stated (RC)", "mean", "SRF, abstract"] in [
        row[:3] for row in others
    ]


@pytest.mark.parametrize(
    "change",
    [
        {"protocols": ("kradar_r40",)},
        {"score_threshold": 0.2},
        {"roi": "wide"},
        {"label_version": "v2.0"},
        {"split": "all"},
        {"split": None},
    ],
)
def test_no_difference_is_printed_if_one_setting_differs(real, change):
    for rows in _tables(real, **change)[1:3]:
        assert _differences(rows) == []
        assert any("71.38" in row for row in rows)  # the published row remains


def test_sedan_of_v1_1_is_compared_with_tables_1(real):
    # The flag stands for labels that are not available here.
    rows = _tables(real, classes=("Sedan",), label_version="v1.1")[0]
    assert _differences(rows) == [
        ["3D", "RADE-Net, Table I"],
        ["3D", "DinoRADE, Table 1"],
        ["3D", "DinoRADE, Table 1"],
        ["BEV", "RADE-Net, Table I"],
    ]


def test_simulated_frames_have_no_published_row_anywhere(random_scene, tmp_path):
    truth, found, frames = random_scene(8, num_frames=30, num_objects=90)
    frames["simulated"] = np.ones(30, bool)
    options = ReportOptions(roi=None, bootstrap=20, iou_thresholds=(0.3, 0.5))
    made = report.write_report(truth, found, frames, tmp_path, options, run="mine")
    texts = [(tmp_path / name).read_text() for name in ("tables.md", "tables.tex")]
    for text in (*texts, made.text):
        assert not re.search("RADE-Net|DinoRADE|RTNH|Table", text.split("Intervals")[0])
    titles = re.findall(r"^(?:\*\*|\\caption{)(.*)$", "\n".join(texts), re.MULTILINE)
    assert titles
    assert all(title.startswith("Simulated data: ") for title in titles)
    assert all(row["name"].endswith("/simulated") for row in made.metrics["ap"])
    assert "30 simulated frames" in made.text
    # A report that is evaluated or compared again still says so.
    again = evaluate_files(tmp_path, tmp_path / "b", Source(), options)
    assert again.metrics["is_simulated"]
    text, _ = compare_files([tmp_path, tmp_path / "b"], None, Source(), options)
    assert text.count("Simulated data: ") == text.count("B - A") == 3
    assert "RADE-Net" not in text
