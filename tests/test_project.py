"""Contributing pages, workflows and `.ci/run` agree."""

import pathlib
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile

import pytest
import yaml

import radejax

ROOT = pathlib.Path(__file__).resolve().parents[1]
CI = ROOT / ".ci" / "run"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_ci_runs_every_part_and_names_them() -> None:
    text = CI.read_text(encoding="utf-8")
    functions = re.findall(r"^(\w+)\(\) \{$", text, re.MULTILINE)
    command = ["bash", str(CI), "lnt"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stderr == f"no part 'lnt'; parts: {' '.join(functions)}\n"
    everything = text[text.index("== fresh virtual environment") :].splitlines()
    assert [line for line in everything if line in functions] == functions
    jobs = [
        job
        for path in (ROOT / ".github" / "workflows").glob("*.yml")
        for job in yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values()
    ]
    runs = " ".join(step.get("run", "") for job in jobs for step in job["steps"])
    assert all(re.search(rf"\.ci/run[\w ]* {part}\b", runs) for part in functions)


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == radejax.__version__
    assert citation["license"] == PROJECT["project"]["license"]


def test_the_version_is_in_one_place_and_in_the_changelog() -> None:
    assert PROJECT["project"]["dynamic"] == ["version"]
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, second, *_ = re.findall(r"^## \[(.*)\]", changes, re.MULTILINE)
    assert (first, second) == ("Unreleased", radejax.__version__)


def test_the_package_is_imported_from_the_folder_above_a_clone(
    tmp_path: pathlib.Path,
) -> None:
    """There, the clone itself could be a namespace package of the same name."""
    pytest.importorskip("setuptools", "77")
    clone, site = tmp_path / "radejax", tmp_path / "site"
    (clone / "radejax").mkdir(parents=True)
    for name in ("pyproject.toml", "README.md", "radejax/__init__.py"):
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
