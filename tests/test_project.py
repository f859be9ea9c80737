"""The version of the package and its installation from a clone."""

import pathlib
import re
import shutil
import subprocess
import sys
import zipfile

import pytest
import yaml

import radejax

ROOT = pathlib.Path(__file__).resolve().parents[1]


def test_citation_and_changelog_are_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == radejax.__version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, second, *_ = re.findall(r"^## \[(.*)\]", changes, re.MULTILINE)
    assert (first, second) == ("Unreleased", radejax.__version__)


def test_the_package_is_imported_from_the_folder_above_a_clone(
    tmp_path: pathlib.Path,
) -> None:
    """There, the clone itself could be a namespace package of the same name."""
    pytest.importorskip("setuptools", "77")
    clone, site = tmp_path / "radejax", tmp_path / "site"
    for name in (
        "pyproject.toml",
        "README.md",
        "radejax/__init__.py",
        "radejax/core/__init__.py",
        "radejax/core/version.py",
    ):
        (clone / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, clone / name)
    script = (
        f"from setuptools import build_meta; build_meta.build_editable({str(site)!r})"
    )
    site.mkdir()
    subprocess.run([sys.executable, "-c", script], cwd=clone, check=True)
    (wheel,) = site.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(site)
    script = (
        f"import site; site.addsitedir({str(site)!r}); import radejax; print(radejax)"
    )
    done = subprocess.run(
        [sys.executable, "-ESc", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert str(clone / "radejax" / "__init__.py") in done.stdout, done
