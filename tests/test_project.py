"""The version of the package and its installation from a clone."""

import pathlib
import re

import yaml

import radejax

ROOT = pathlib.Path(__file__).resolve().parents[1]


def test_citation_and_changelog_are_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == radejax.__version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, second, *_ = re.findall(r"^## \[(.*)\]", changes, re.MULTILINE)
    assert (first, second) == ("Unreleased", radejax.__version__)
