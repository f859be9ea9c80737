"""The benchmark runner, its page, the stages of a detector and the acceptance: one run each."""

import functools
import json
import os
import pathlib
import subprocess
import sys
import types
from typing import Any

import pytest

from . import small_models as small

ROOT = pathlib.Path(__file__).resolve().parents[1]


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import case
    import page
    import run
    import stages

    monkeypatch.setattr(run, "SECONDS_A_CASE", 0.05)
    monkeypatch.setattr(run.rival, "start", lambda platform: None)
    return types.SimpleNamespace(run=run, page=page, case=case, stages=stages)


def test_cases_are_compared_alternated_and_stored(
    modules: types.SimpleNamespace, tmp_path: pathlib.Path
) -> None:
    order: list[str] = []

    def call(name: str, seconds: float) -> tuple[float, float]:
        order.append(name)
        return seconds, 2 * seconds

    def case(**fields: Any) -> Any:
        seconds = {"radejax": 0.02, "rival": 0.05}
        columns = {k: functools.partial(call, k, v) for k, v in seconds.items()}
        return modules.case.Case(**{"columns": columns, "frames": 2} | fields)

    def fails(_: Any) -> Any:
        raise RuntimeError("out of memory")
        yield

    chosen = {
        "good": lambda _: iter([case(name="equal", error=1e-6)]),
        "other": lambda _: iter([case(name="differs", error=float("nan"))]),
        "bad": fails,
        "late": lambda _: iter([case(name="too late")]),
    }
    machine = modules.run.machine_of()
    result = modules.run.run({k: chosen[k] for k in list(chosen)[:3]}, 600.0, machine)
    result["rows"] += modules.run.run({"late": chosen["late"]}, -1.0, machine)["rows"]
    assert order == ["radejax", "rival"] * (len(order) // 2)
    row, other, bad = result["rows"]
    assert row["wall_s"] == {"radejax": 0.02, "rival": 0.05}
    assert "wall_s" not in other
    assert other["refused"].startswith("results differ by")
    assert bad["refused"] == "RuntimeError('out of memory')"
    modules.page.store(result, tmp_path)
    (file,) = tmp_path.iterdir()
    text = modules.page.table({"runs": json.loads(file.read_text())["runs"]})
    times = "10 ms (20 ms) | rival 25 ms (50 ms) | 2.50 | 1e-06"
    assert f"| equal | float32 | 2 | {times} |" in text
    found, complete = modules.page.measured(modules.run.facts(machine), tmp_path)
    assert found == {("equal", "float32", 2)}  # not measured again
    assert complete == {"good"}


def test_the_committed_page_is_what_the_committed_files_give(
    modules: types.SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: pathlib.Path,
) -> None:
    committed, page = modules.page.PAGE.read_text(), tmp_path / "page.md"
    page.write_text(committed)
    monkeypatch.setattr(modules.page, "PAGE", page)
    modules.page.write_page()
    assert page.read_text() == committed, "python benchmarks/run.py --tables"


def test_the_latency_table_is_that_of_the_stored_result(
    modules: types.SimpleNamespace,
) -> None:
    import latency

    result = json.loads(latency.RESULT.read_text())
    page = latency.PAGE.read_text()
    assert latency.table(result) in page, "python benchmarks/latency.py"
    names = [variant.name for variant in latency.VARIANTS]
    assert [row["name"] for row in result["rows"]] == names
    means = [line for line in result["int8"] if line.startswith("| mean")]
    assert len(means) == 4
    for line in means:
        _, name, exact, quantized, _ = map(str.strip, line.split("|"))
        _, space, iou = name.split(", ")
        known = f"| mean AP {space.upper()}, {iou} | {exact} | {quantized} |"
        assert known in page


@pytest.mark.slow  # compiles each stage on its own
def test_stages_add_up(modules: types.SimpleNamespace) -> None:
    (row,) = modules.stages.measure(small.detector("camera"), (2,), repeats=1)
    assert list(row["stages"]) == list(modules.stages.STAGES)
    assert row["sum_s"] == pytest.approx(sum(row["stages"].values()))
    assert "batch 2" in modules.stages.as_table([row])


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_acceptance_stores_every_part_and_repeats_none(
    tmp_path: pathlib.Path,
) -> None:
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
