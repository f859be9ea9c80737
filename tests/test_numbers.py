"""The numbers of README and of the results are those of stored results.

Rows of tables and differences with their intervals are looked up as a whole, because nearly
every single number between 0 and 100 stands somewhere. Labels of rows and whole numbers
below 1,000 are not checked, except for milliseconds.
"""

import json
import pathlib
import re
import statistics

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
REPORTS = ROOT / "docs" / "reports"

DIFFERENCE = re.compile(r"-?\d+\.\d \(-?\d+\.\d to -?\d+\.\d\)")
NUMBER = re.compile(r"\d+\.\d+(?: ± \d+\.\d+)?|\d+,\d{3}|\d+ ms")
APS_OF_PAPERS = re.compile(r"\d+\.\d\d")
QUOTED = ("claim", "paper")
"""Columns with numbers of the papers, whose APs have two digits after the point."""

OTHERS = {
    "0.015": "docs/reports/2026-11-24_camera_by_condition.md, the gate",
    "0.46": "range bin of K-Radar in meters",
    "1.4": "three of them",
    "3.6": "three range bins of the quickstart",
    "2.5": "differences of table_releases.json, rounded",
    "33.4": "quickstart_realistic.json, mean of seed 0 on 224 scenes",
    "0.05": "evaluation.min_score",
    "0.3": "IoU threshold",
    "0.75": "heatmap sigma",
    "1.2": "range bin of the quickstart in meters",
    "1,024": "held-out scenes of quickstart_realistic.json",
    "5,600": "steps of the quickstart",
    "1,440": "docs/protocols.md, APs that were compared",
    "2.0": "license",
    "2.1": "label version",
    "11.1": "MB of 256 x 107 x 101 float32",
    "22.1": "the same in float64",
    "95.7": "percent by which 11.1 is smaller than 259.5",
    "6.4": "narrow region in meters",
    "91.5": "percent by which 22.1 is smaller than 259.5",
    "3.7": "80.5 - 76.8 of recorded.json",
    "259.5": "MB of 64 x 256 x 37 x 107 float32",
    **dict.fromkeys(("9.0", "17.1"), "minutes, benchmarks/runs.json"),
    **dict.fromkeys(("1.8", "1.9", "4.1"), "GiB and GB, benchmarks/runs.json"),
}
"""Numbers that are not results in the stored files, and what they are."""


def _ablation_rows(rows):
    """The APs of each cell in all conditions together, in the order of the file."""
    for cell in {row["cell"] for row in rows}:
        yield " ".join(
            f"{row['ap']:.1f}" + (f" ± {row['std']:.1f}" if "std" in row else "")
            for row in rows
            if row["cell"] == cell and row["condition"] == "all" and "ap" in row
        )


def _realistic_rows():
    """Means and standard deviations of the quickstart's seeds, and APs of CFAR."""
    stored = json.loads((REPORTS / "ablations/quickstart_realistic.json").read_text())
    for protocol in ("all_point", "kradar_r40"):
        for seeds in stored["ap"].values():
            names = [name for name in seeds["seed 0"] if name.startswith(protocol)]
            aps = [[seed[name] for seed in seeds.values()] for name in names]
            spreads = [(statistics.mean(x), statistics.stdev(x)) for x in aps]
            means = [f"{mean:.1f} ± {std:.1f}" for mean, std in spreads]
            yield from (" ".join(means), *means)
        cfar = stored["cfar"]["difference"].items()
        yield _row(x["CFAR"] for name, x in cfar if name.startswith(protocol))


def _robustness_rows():
    """A radar or field, and its APs: of two trainings, or of its lowest and highest value."""
    stored = json.loads((REPORTS / "ablations/robustness.json").read_text())
    realistic = stored["trained on realistic"]["ap"]
    for name in realistic:
        field = name.split()[0]
        aps = [ap for other, ap in realistic.items() if other.split()[0] == field]
        if name in (ideal := stored["trained on ideal"]["ap"]):
            aps.append(ideal[name])
        yield f"{field} {_row(aps)}"
    models = stored["augmentation"]["ap"].values()
    for name in next(iter(models)):
        row = _row(ap[name] for ap in models if name in ap)
        yield f"{name} {row}"
        yield f"{name.split()[0]} {row}"  # whole numbers are no APs


def _calibration_rows():
    """Lowest score, calibration errors of score and probability, ratio and its interval."""
    stored = json.loads((REPORTS / "calibration.json").read_text())
    for row in stored["calibration_errors"]:
        low, high = row["ratio_interval"]
        errors = f"{row['score']:.3f} {row['probability']:.3f}"
        yield f"{row['min_score']} {errors} {row['ratio']:.2f} {low:.2f} {high:.2f}"


def _row(aps):
    return " ".join(f"{ap:.1f}" for ap in aps)


def _objects(value):
    """All objects of a JSON value."""
    if isinstance(value, dict):
        yield value
        value = list(value.values())
    if isinstance(value, list):
        for part in value:
            yield from _objects(part)


@pytest.fixture(scope="module")
def stored():
    """Rows, differences and times as the pages print them."""
    published = ROOT / "radejax" / "evaluation" / "published.csv"
    found = {*APS_OF_PAPERS.findall(published.read_text(encoding="utf-8"))}
    found |= {*_realistic_rows(), *_robustness_rows(), *_calibration_rows()}
    for path in REPORTS.rglob("*.json"):
        for part in _objects(json.loads(path.read_text(encoding="utf-8"))):
            if {"difference", "low", "high"} <= part.keys():
                found.add("{difference:.1f} ({low:.1f} to {high:.1f})".format(**part))
            if "cell" in next(iter(part.get("rows", ())), ()):
                found |= {*_ablation_rows(part["rows"])}
            if part.get("name") == "projection on the host":
                found |= {f"{1000 * x:.0f} ms" for x in part["wall_s"].values()}
    return found


def _printed(page):
    """Differences, rows of tables, and numbers in sentences of a page."""
    text = re.sub(r"```.*?```|\]\([^)]*\)", "", page, flags=re.DOTALL)
    for block in text.split("\n\n"):
        if block.startswith("|"):
            header, _, *rows = [line.split("|")[1:-1] for line in block.splitlines()]
            for row in rows:
                cells = list(zip(map(str.strip, header), row, strict=True))
                for name, cell in cells:
                    yield from APS_OF_PAPERS.findall(cell) if name in QUOTED else ()
                left_out = (*QUOTED, "variant")
                own = " ".join(x for name, x in cells if name not in left_out)
                yield from DIFFERENCE.findall(own)
                if numbers := NUMBER.findall(DIFFERENCE.sub("", own)):
                    yield " ".join([*re.findall(r"`(\w+)`", row[0]), *numbers])
        else:
            sentences = " ".join(re.sub("`[^`]*`", "", block).split())
            yield from DIFFERENCE.findall(sentences)
            yield from NUMBER.findall(DIFFERENCE.sub("", sentences))


@pytest.mark.parametrize("name", ["README.md", "docs/quickstart.md", "docs/results.md"])
def test_printed_numbers_are_stored(name, stored):
    printed = list(_printed((ROOT / name).read_text(encoding="utf-8")))
    assert len(printed) > 3
    lost = [x for x in printed if x not in stored and not {*x.split()} <= OTHERS.keys()]
    assert lost == [], "neither in a JSON file of docs/reports nor in OTHERS"


def test_the_tables_of_the_simulated_radar_are_stored():
    """The numbers of a cell are the first ones that are stored of its statistic."""
    stored = json.loads((REPORTS / "simulator_statistics.json").read_text())
    page = (ROOT / "docs" / "simulated_radar.md").read_text(encoding="utf-8")
    tables = [x for x in page.split("\n\n") if x.startswith("| statistic |")]
    assert len(tables) == 2
    for table in tables:
        lines = [line.split("|")[1:-1] for line in table.splitlines()]
        columns, _, *rows = [[cell.strip() for cell in line] for line in lines]
        assert len({*columns} & stored.keys()) == 3
        for row in rows:
            for column, cell in zip(columns, row, strict=True):
                if column in stored:
                    _check_cell(cell, stored[column][row[0]])


def _check_cell(cell, values):
    printed = re.findall(r"[-+]?\d+(?:\.\d+)?", cell)
    assert printed
    for text, value in zip(printed, values[: len(printed)], strict=True):
        assert float(text) == round(value, len(text.partition(".")[2])), cell
