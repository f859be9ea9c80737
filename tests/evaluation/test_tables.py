"""Published rows, and tables of a run next to them."""

import collections
import zlib

import pytest

from radejax.config import load_config
from radejax.core.structures import CLASSES, NARROW_ROI
from radejax.evaluation import report
from radejax.evaluation.report import PUBLISHED, RunTables
from radejax.evaluation.results import ReportOptions, compute_results, make_set
from radejax.runs.evaluate import report_options

from .scenes import random_scene

OF_PAPERS = [row for row in PUBLISHED if ", Table " in row.source]


def test_published_file_has_all_numbers():
    """The counts and checksums are those of the file that was compared with its sources."""
    assert collections.Counter(row.source for row in OF_PAPERS) == {
        "RADE-Net, Table I": 11,
        "RADE-Net, Table II": 1,
        "RADE-Net, Table III": 7,
        "DinoRADE, Table 1": 13,
        "DinoRADE, Table 2": 1,
        "DinoRADE, Table 3": 3,
        "DinoRADE, Table 4": 4,
    }
    texts = [text for row in PUBLISHED for text in row.values.values()]
    assert all(0 <= float(text) <= 100 for text in texts if text != "-")
    others = [row for row in PUBLISHED if row not in OF_PAPERS]
    of_papers, of_others = (OF_PAPERS, 454, 1185164690), (others, 320, 1950159671)
    for rows, count, digest in (of_papers, of_others):
        assert sum(len(row.values) for row in rows) == count
        lines = [f"{row.source} {row.method} {row.values}" for row in rows]
        assert zlib.crc32("\n".join(lines).encode()) == digest


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
    assert options.settings_of(row.protocol)["score_threshold"] == 0.3
    is_ablation = row.source in report.ABLATIONS
    assert row.is_comparable(options, "test") != is_ablation
    assert {iou for *_, iou in row.values} <= set(options.iou_thresholds)


# A run in the layouts of the papers ---------------------------------------------------

AS_PAPERS = ReportOptions(iou_thresholds=(0.3,), protocols=("coco101", "kradar_r40"))
AS_PAPERS = AS_PAPERS.replace(score_threshold=0.3, roi=NARROW_ROI, label_version="v2.1")
SCENE = random_scene(9, num_frames=30, num_objects=150, num_classes=5)


def _tables(split="test", **changes):
    """Rows of Tables I, II, DinoRADE's 3, III and of other methods."""
    options = AS_PAPERS.replace(**changes)
    results = compute_results(make_set(*SCENE, options), SCENE[2], options)
    tables = RunTables("mine", {row.key: row for row in results}, options, split)
    return [table.rows for table in tables.papers()]


def _differences(rows):
    """What rows with a difference are of and to."""
    return [row[1:3] for row in rows if row[0] == "difference"]


def test_a_difference_is_printed_where_protocol_labels_region_and_split_agree():
    one, two, three, ablations, others = _tables()
    assert [cls for cls, _ in _differences(two)] == [
        "Sedan", "Sedan", "Bus or Truck", "Bus or Truck", "Pedestrian", "Pedestrian",
        "Motorcycle", "Bicycle", "Bicycle", "mean",
    ]  # fmt: skip
    assert len(_differences(three)) == 3
    *_, theirs, gap, _, ours = (float(row[6]) for row in three)
    assert gap == pytest.approx(ours - theirs, abs=0.011)
    for rows in (one, ablations, others):  # one is of labels v1.1
        assert _differences(rows) == []


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
def test_no_difference_is_printed_if_one_setting_differs(change):
    for rows in _tables(**change)[1:3]:
        assert _differences(rows) == []
        assert any("71.38" in row for row in rows)  # the published row remains


def test_sedan_of_v1_1_is_compared_with_tables_1():
    # The flag stands for labels that are not available here.
    rows = _tables(classes=("Sedan",), label_version="v1.1")[0]
    papers = ["RADE-Net, Table I", "DinoRADE, Table 1", "DinoRADE, Table 1"]
    expected = [["3D", paper] for paper in papers] + [["BEV", papers[0]]]
    assert _differences(rows) == expected
