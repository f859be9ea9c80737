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
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def _parts() -> list[str]:
    """Names of the parts of `.ci/run`."""
    (line,) = re.findall(
        r'^parts="(.*)"$', CI.read_text(encoding="utf-8"), re.MULTILINE
    )
    return line.split()


def test_a_run_without_words_runs_every_part() -> None:
    text = CI.read_text(encoding="utf-8")
    functions = re.findall(r"^(\w+)\(\) \{$", text, re.MULTILINE)
    assert functions == _parts()
    everything = text[text.index("== fresh virtual environment") :].splitlines()
    assert [line for line in everything if line in functions] == functions


def test_an_unknown_part_is_rejected_with_the_names_of_all() -> None:
    done = subprocess.run(
        ["bash", str(CI), "lnt"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr == f"no part 'lnt'; parts: {' '.join(_parts())}\n"


@pytest.mark.parametrize(
    "path",
    [
        *WORKFLOWS,
        ROOT / "CONTRIBUTING.md",
        ROOT / ".github" / "pull_request_template.md",
    ],
    ids=lambda path: path.name,
)
def test_what_calls_the_ci_calls_parts_that_are_there(path: pathlib.Path) -> None:
    text = path.read_text(encoding="utf-8")
    calls = re.findall(r"bash \.ci/run((?: \w+)+)(?:$|`)", text, re.MULTILINE)
    assert calls
    assert {word for call in calls for word in call.split()} <= set(_parts())


def test_the_workflows_call_every_part_on_every_python() -> None:
    jobs = [
        job
        for path in WORKFLOWS
        for job in yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values()
    ]
    runs = " ".join(step.get("run", "") for job in jobs for step in job["steps"])
    assert all(re.search(rf"\.ci/run[\w ]* {part}\b", runs) for part in _parts())
    (matrix,) = [job["strategy"]["matrix"] for job in jobs if "strategy" in job]
    versions = "Programming Language :: Python :: "
    assert [versions + python for python in matrix["python"]] == [
        line for line in PROJECT["project"]["classifiers"] if line.startswith(versions)
    ]
    assert matrix["dependencies"] == ["lowest", "newest"]
    extras = set(re.findall(r"\.\[(\w+)\]|--extra (\w+)", runs))
    names = {name for pair in extras for name in pair if name}
    assert names <= set(PROJECT["project"]["optional-dependencies"])


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == radejax.__version__
    assert citation["license"] == PROJECT["project"]["license"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    sources = [ref["identifiers"] for ref in citation["references"]]
    assert all(source[0]["value"] in readme for source in sources)


def test_the_version_is_in_one_place_and_in_the_changelog() -> None:
    assert PROJECT["project"]["dynamic"] == ["version"]
    source = PROJECT["tool"]["setuptools"]["dynamic"]["version"]
    assert source == {"attr": "radejax.__version__"}
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


def test_types_are_checked_in_every_module_and_every_exception_is_named() -> None:
    settings = PROJECT["tool"]["mypy"]
    assert settings["packages"] == ["radejax"]
    assert not {"exclude", "ignore_errors"} & settings.keys()
    assert not any("ignore_errors" in override for override in settings["overrides"])
    ignored = [
        (path.name, line)
        for path in (ROOT / "radejax").rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if "type: ignore" in line
    ]
    assert all("type: ignore[" in line for _, line in ignored), ignored
    assert len(ignored) <= 12, ignored
    assert (ROOT / "radejax" / "py.typed").is_file()
    assert "py.typed" in PROJECT["tool"]["setuptools"]["package-data"]["radejax"]
