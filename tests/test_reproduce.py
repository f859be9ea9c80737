"""docs/reproduce.md agrees with published.csv, the configs and benchmarks/programs.py."""

import pathlib
import types

import pytest

from radejax.config import load_config, load_module
from radejax.evaluation.report import PUBLISHED, PublishedRow

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "reproduce.md").read_text(encoding="utf-8")


def _table(title: str) -> list[list[str]]:
    """Cells of the table after a heading, without its own head."""
    part = PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    return [line.strip("|").split("|") for line in lines[2:]]


ROWS = [[cell.strip() for cell in row] for row in _table("Rows")]
TRAINABLE = [row for row in PUBLISHED if row.config != "not trainable here"]


def _aps(row: PublishedRow) -> str:
    """The row's AP 3D and BEV as the page has them: the mean, or else Sedan."""
    is_mean = ("all", "mean", "3d", 0.3) in row.values
    cls = "mean" if is_mean else "Sedan"
    pair = [row.values.get(("all", cls, space, 0.3), "-") for space in ("3d", "bev")]
    return " / ".join(pair) + " (mean)" * is_mean


def test_the_page_has_every_trainable_row_with_its_config_and_aps() -> None:
    assert len(ROWS) == len(TRAINABLE) == 18
    for published, row in zip(TRAINABLE, ROWS, strict=True):
        assert row[0] == published.source.replace(", Table", "")
        # Of a longer list of components, the page has the last one.
        assert published.method.endswith(row[1].removeprefix("... "))
        assert row[2] == f"`{published.config}`"
        assert row[3] == _aps(published)


@pytest.fixture(scope="module")
def programs() -> types.ModuleType:
    return load_module(ROOT / "benchmarks" / "programs.py")


@pytest.mark.slow
@pytest.mark.parametrize("name", dict.fromkeys(row[2].strip("`") for row in ROWS))
def test_lower_bounds_are_those_that_the_program_computes(
    programs: types.ModuleType, name: str
) -> None:
    computed = programs.bounds_text(load_config(name))
    assert {row[5] for row in ROWS if row[2] == f"`{name}`"} == {computed}
