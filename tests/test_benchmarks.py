"""The benchmark runner, its page, the stages of a detector and the acceptance: one run each."""

import functools
import json
import os
import pathlib
import subprocess
import sys

import pytest

from . import small_models as small

ROOT = pathlib.Path(__file__).resolve().parents[1]


@pytest.mark.slow  # compiles each stage on its own
def test_stages_add_up(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import stages

    (row,) = stages.measure(small.detector("camera"), (2,), repeats=1)
    assert list(row["stages"]) == list(stages.STAGES)
    assert row["sum_s"] == pytest.approx(sum(row["stages"].values()))
    assert "batch 2" in stages.as_table([row])


@pytest.mark.slow
def test_benchmarks_are_measured_and_stored(tmp_path):
    command = [sys.executable, "benchmarks/run.py", "--only", "loader"]
    subprocess.run(
        [*command, "--minutes", "0.2", "--out", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        check=True,
    )
    (file,) = tmp_path.glob("*.json")
    (run,) = json.loads(file.read_text())["runs"]
    assert run["rows"][0]["name"] == "records to batches"


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_acceptance_stores_every_part_and_repeats_none(tmp_path):
    command = [sys.executable, "benchmarks/accept.py", "--short"]
    command += ["--out", str(tmp_path), "--work", str(tmp_path / "work")]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    run = functools.partial(subprocess.check_output, command, cwd=ROOT, text=True)
    whole = run(env=environment)
    (file,) = tmp_path.glob("*.json")
    tables = {table["part"]: table for table in json.loads(file.read_text())["tables"]}
    parts = ["environment", "quickstart", "radenet", "dinorade", "boxes", "exports"]
    assert list(tables) == parts
    assert all(table["title"] in whole for table in tables.values())
    differences = [row[2:] for row in tables["exports"]["rows"]]
    assert max(float(x) for row in differences for x in row) < 1e-4
    assert run(env=environment) == ""
