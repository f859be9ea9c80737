"""docs/reports/preset_sources.md lists every field of both presets with what it stands at now."""

import pathlib
import re

import pytest

from radejax.config import load_config

ROOT = pathlib.Path(__file__).resolve().parents[2]


def _tables():
    """Values in `paper` and `official` and the source, by field, of both tables."""
    text = (ROOT / "docs" / "reports" / "preset_sources.md").read_text(encoding="utf-8")
    part = text.partition("## Every field of both presets\n")[2].partition("\n## ")[0]
    tables = {}
    for name in ("RADE-Net", "DinoRADE"):
        lines = part.partition(f"### {name}")[2].partition("\n### ")[0].splitlines()
        rows = [line.strip("| ").split(" | ") for line in lines if line[:3] == "| `"]
        assert {len(row) for row in rows} == {4}
        tables[name] = {
            field.strip("`"): (paper, paper if same == "the same" else same, source)
            for field, paper, same, source in rows
        }
        assert len(tables[name]) == len(rows)  # a field once
    return tables


TABLES = _tables()


@pytest.mark.parametrize(
    ("config", "rows"),
    [
        ("radenet", TABLES["RADE-Net"]),
        ("dinorade", TABLES["RADE-Net"] | TABLES["DinoRADE"]),
    ],
)
def test_the_page_has_every_field_of_both_presets(config, rows):
    for i, preset in enumerate(("paper", "official")):
        values = load_config(f"{config}:{preset}")
        fields = {re.sub(r"weights\..*", "weights", n): x for n, x in values.fields()}
        fields["loss.weights"] = dict(values.loss.weights)
        for section in ("simulation", "data.camera"):  # those of None
            fields.pop(section, None)
        assert set(rows) == set(fields)
        found = {name: row[i].strip("`") for name, row in rows.items()}
        assert found == {name: repr(value) for name, value in fields.items()}
    assert all(source.strip() for *_, source in rows.values())
