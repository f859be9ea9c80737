"""Tests of the benchmark runner: order, time limit, comparison of results, and its page."""

import functools
import json
import os
import pathlib
import platform
import subprocess
import sys
import time
import types
from typing import Any

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """`run.py`, the module of its page, and its cases."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import case
    import page
    import run

    monkeypatch.setattr(run, "SECONDS_A_CASE", 0.05)
    monkeypatch.setattr(run.rival, "start", lambda platform: None)
    return types.SimpleNamespace(
        run=functools.partial(_run, run), module=run, page=page, Case=case.Case
    )


def _run(
    module: Any, chosen: Any, seconds: float = 600.0, store: Any = None, **machine: Any
) -> Any:
    """Run benchmarks; `machine` replaces what they are given."""
    store = store or (lambda so_far: None)
    return module.run(chosen, seconds, module.machine_of() | machine, store)


def _case(modules: Any, order: list[str], **fields: Any) -> Any:
    def call(name: str, seconds: float) -> tuple[float, float]:
        order.append(name)
        return seconds, 2 * seconds

    columns = {
        "radejax": functools.partial(call, "radejax", 0.02),
        "rival": functools.partial(call, "rival", 0.05),
    }
    fields = {"name": "something", "columns": columns, "frames": 2} | fields
    return modules.Case(**fields)


def test_implementations_alternate(modules: Any) -> None:
    order: list[str] = []
    cost = {"mib": 3.0, "compile_s": 12.0}
    first = _case(modules, order, error=1e-6, note=lambda: "after it", **cost)
    chosen = {
        "first": lambda machine: iter([first]),
        "second": lambda machine: iter([_case(modules, order)]),
    }
    result = modules.run(chosen)
    assert order == ["radejax", "rival"] * (len(order) // 2)
    row, other = result["rows"]
    assert (row["benchmark"], row["repeats"]) == ("first", modules.module.MAX_REPEATS)
    assert row["wall_s"] == {"radejax": 0.02, "rival": 0.05}
    assert (row["error"], other["error"]) == (1e-6, None)
    text = modules.page.table({"runs": [json.loads(json.dumps(result))]})
    assert (
        "| something | float32 | 2 | 10 ms (20 ms) | rival 25 ms (50 ms) | 2.50 | 1e-06 "
        "| 3 MiB | 12 s | after it |" in text
    )
    assert "Not run" not in text


def test_no_case_starts_after_the_time_limit(modules: Any) -> None:
    order: list[str] = []

    def cases(machine: Any) -> Any:
        time.sleep(0.2)  # a case that was prepared is measured
        yield _case(modules, order, name="prepared")
        raise AssertionError("another case is prepared")

    late = modules.run({"one": cases, "two": cases}, 0.1)
    assert [row["name"] for row in late["rows"]] == ["prepared"]
    assert late["not_run"] == ["further cases of one", "two"]
    text = modules.page.table({"runs": [late]})
    assert "Not run: further cases of one, two." in text


@pytest.mark.parametrize("error", [0.1, float("nan")])
def test_other_numbers_are_no_measurement(modules: Any, error: float) -> None:
    order: list[str] = []
    row = modules.module.measured(_case(modules, order, error=error), 10.0)
    assert not order
    assert "wall_s" not in row
    assert row["refused"].startswith("results differ by")


def test_failed_cases_are_listed_and_the_others_are_measured(modules: Any) -> None:
    def fails(machine: Any) -> Any:
        raise RuntimeError("out of memory")
        yield

    chosen = {
        "bad": fails,
        "good": lambda machine: iter([_case(modules, [])]),
    }
    text = modules.page.devices_table([modules.run(chosen)])
    assert "Not measured: bad: RuntimeError('out of memory')." in text
    assert "| something |" in text


def test_a_run_that_is_stopped_keeps_what_it_measured(modules: Any) -> None:
    def stopped(machine: Any) -> Any:
        raise KeyboardInterrupt
        yield

    chosen = {"one": lambda machine: iter([_case(modules, [])])}
    kept: list[dict[str, Any]] = []
    with pytest.raises(KeyboardInterrupt):
        modules.run(chosen | {"two": stopped}, store=kept.append)
    assert [row["benchmark"] for row in kept[-1]["rows"]] == ["one"]


def test_a_call_continues_where_an_earlier_one_ended(
    modules: Any, tmp_path: pathlib.Path
) -> None:
    def cases(benchmark: str, machine: Any) -> Any:
        for i in (1, 2):
            time.sleep(0.2)
            yield _case(modules, [], name=f"{benchmark} {i}")

    def call(seconds: float, **versions: str) -> list[str]:
        facts = modules.module.facts(modules.module.machine_of())
        facts["versions"] |= versions
        measured, complete = modules.page.measured(facts, tmp_path)
        names = [name for name in ("a", "b") if name not in complete]
        chosen = {name: functools.partial(cases, name) for name in names}
        found = modules.run(chosen, seconds, measured=measured) | facts
        modules.page.store(found, tmp_path)
        return [row["name"] for row in found["rows"]]

    assert call(0.1) == ["a 1"]
    assert call(600.0) == ["a 2", "b 1", "b 2"]
    assert call(600.0) == []
    (file,) = tmp_path.iterdir()
    runs = json.loads(file.read_text())["runs"]
    assert [len(run["rows"]) for run in runs] == [1, 3]
    assert [run["not_run"] for run in runs] == [[], []]
    assert call(0.1, radejax="99.0") == ["a 1"]  # as if it were another version
    runs = json.loads(file.read_text())["runs"]
    assert [[row["name"] for row in run["rows"]] for run in runs] == [
        ["b 1", "b 2"],
        ["a 1"],
    ]


def test_a_process_is_timed_until_its_texts(
    modules: Any, tmp_path: pathlib.Path
) -> None:
    import start

    words = "import os, time; print('a 1/', flush=True); time.sleep(0.3); "
    words += "sum(range(10**7)); print(os.getcwd(), 'there 1/'); time.sleep(60)"
    arguments = ["-c", words], tmp_path, tmp_path / "kept"
    (begun, there, wall), processor = start.until(["a", "there", "1/"], *arguments)
    assert begun < there - 0.2
    assert there <= wall < 50  # it was ended
    assert 0.01 < processor < 50
    text = "import os; raise SystemExit([k for k in os.environ if k[:8] == 'JAX_COMP'])"
    with pytest.raises(RuntimeError, match=r"no 'there'.*JAX_COMP"):
        start.until(["there"], ["-c", text], tmp_path, tmp_path / "kept")


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_acceptance_stores_every_part_and_repeats_none(
    tmp_path: pathlib.Path,
) -> None:
    command = [sys.executable, "benchmarks/accept.py", "--short"]
    command += ["--out", str(tmp_path), "--work", str(tmp_path / "work")]

    def call(*more: str) -> str:
        done = subprocess.run(
            [*command, *more],
            cwd=ROOT,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert call("--minutes", "0") == ""
    whole = call()
    (file,) = tmp_path.glob("*.json")
    tables = {table["part"]: table for table in json.loads(file.read_text())["tables"]}
    parts = ["environment", "quickstart", "radenet", "dinorade", "boxes", "exports"]
    assert list(tables) == parts
    assert all(table["title"] in whole for table in tables.values())
    assert "| quickstart, seeds 0, 1, 2 | - | - | 76.2 |" in whole
    differences = [row[2:] for row in tables["exports"]["rows"]]
    assert max(float(x) for row in differences for x in row) < 1e-4
    assert call() == ""


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (
            [
                "cpu family\t: 25",
                "model\t\t: 17",
                "model name\t: AMD EPYC",
                "stepping\t: 1",
            ],
            "AMD EPYC family 25 model 17",
        ),
        (["BogoMIPS\t: 50.00", "CPU part\t: 0xd40"], platform.machine()),
    ],
)
def test_processors_of_one_name_are_distinguished(
    modules: Any, tmp_path: pathlib.Path, lines: list[str], expected: str
) -> None:
    path = tmp_path / "cpuinfo"
    path.write_text("\n\n".join(["processor\t: 0\n" + "\n".join(lines) + "\n"] * 2))
    assert modules.module.processor_name(path) == expected


def test_what_is_stored_is_on_the_page(
    modules: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path
) -> None:
    results, page = tmp_path / "results", tmp_path / "page.md"
    monkeypatch.setattr(modules.page, "RESULTS", results)
    monkeypatch.setattr(modules.page, "PAGE", page)
    page.write_text(f"before\n{modules.page.BEGIN}\nold\n{modules.page.END}\nafter\n")
    for number, names in enumerate((("one", "two"), ("two",), ("three",))):
        case = _case(modules, [], name=f"run {number}")
        chosen = {name: lambda _, case=case: iter([case]) for name in names}
        result = modules.run(chosen) | {"device": "A device (TM), 2 cores"}
        result["versions"] = {"radejax": f"0.{number}"}
        modules.page.store(result, results)
    (file,) = results.iterdir()
    assert file.name == "a_device_tm_2_cores.json"
    stored = [
        [(row["benchmark"], row["name"]) for row in run["rows"]]
        for run in json.loads(file.read_text())["runs"]
    ]
    assert stored == [[("one", "run 0")], [("two", "run 1")], [("three", "run 2")]]
    modules.page.write_page()
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert [text.count(f"| run {i} |") for i in range(3)] == [1, 1, 1]
    assert "old" not in text


def test_the_committed_page_is_what_the_committed_files_give(
    modules: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path
) -> None:
    committed = modules.page.PAGE.read_text()
    page = tmp_path / "page.md"
    page.write_text(committed)
    monkeypatch.setattr(modules.page, "PAGE", page)
    modules.page.write_page()
    assert page.read_text() == committed, (
        "docs/reports/benchmarks.md is not what docs/reports/benchmarks/*.json say: "
        "python benchmarks/run.py --tables"
    )
