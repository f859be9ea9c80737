"""The house that docs/architecture.md promises, measured in the code's own imports."""

import ast
import pathlib
import runpy
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
house = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "images" / "house.py")))

MOST_FLOORS, MOST_ROOMS = 8, 20
MOST_LINES, MOST_LINES_OF_A_FUNCTION = 400, 80
MOST_INSIDE = 70
"""Imports of ours inside functions: of commands, for a start without JAX."""

# What does not hold yet: a line is to go with the wall that it names.
KNOWN: set[str] = set()

READERS = ("radejax.core.config", "radejax.models", "radejax.simulation.config")
"""They make configs, or read the section that is theirs and nothing else."""

ARROWS = house.arrows()
FLOORS = house.floors_of_the_page()
FLOOR = {name: floor for floor, (_, rooms) in enumerate(FLOORS) for name in rooms}


def _agrees(kind: str, found: set[str]) -> None:
    """What is wrong is what is known to be, nothing less and nothing more."""
    assert found == {line for line in KNOWN if line.startswith(kind)}


def _is_wrong(arrow: SimpleNamespace) -> bool:
    """Not to a lower floor; inside a room only at the top of a module."""
    source, target = house.room(arrow.source), house.room(arrow.target)
    if target == house.GROUND or not {source, target} <= set(FLOOR):
        return False
    is_out = source != target or arrow.is_inside
    return is_out and FLOOR[source] <= FLOOR[target]


def test_the_page_has_every_room_once() -> None:
    named = [name for _, rooms in FLOORS for name in rooms]
    rooms = set(house.among_rooms(()))
    assert len(named) == len(set(named)) <= MOST_ROOMS
    assert set(named) <= rooms
    assert len(FLOORS) <= MOST_FLOORS
    _agrees("room", {f"room {name}" for name in rooms - set(named)})


def test_the_page_has_the_tree() -> None:
    """Where not: `python docs/images/house.py` writes it."""
    assert house.tree() in house.PAGE.read_text(encoding="utf-8")


def test_arrows_lead_to_lower_floors() -> None:
    wrong = {f"up {a.source} -> {a.target}" for a in ARROWS if _is_wrong(a)}
    _agrees("up", wrong)


def test_rooms_stand_on_eight_floors_without_circles() -> None:
    right = [arrow for arrow in ARROWS if not _is_wrong(arrow)]
    graph = house.among_rooms(right)
    assert house.circles(graph) == []
    assert max(house.heights(graph).values()) < MOST_FLOORS


def test_modules_have_no_circles() -> None:
    circles = house.circles(house.among_modules(ARROWS))
    _agrees("circle", {f"circle {' '.join(names)}" for names in circles})


def test_imports_inside_functions_are_few() -> None:
    inside = [f"{a.source}:{a.line} {a.target}" for a in ARROWS if a.is_inside]
    assert len(inside) <= MOST_INSIDE, inside


def _functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    """Every function and method of ours, after the module that has it."""
    for module, path in house.modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                yield module, node


def test_files_and_functions_are_short() -> None:
    for path in house.modules().values():
        assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES, path
    long = {
        f"long {module}.{function.name}"
        for module, function in _functions()
        if function.end_lineno - function.lineno >= MOST_LINES_OF_A_FUNCTION
    }
    _agrees("long", long)


def test_below_the_runs_functions_take_what_they_need() -> None:
    """No whole config: its fields, or a section as a mapping or a class of its own."""
    whole = {
        f"config {module}.{function.name}"
        for module, function in _functions()
        if module.startswith("radejax") and not module.startswith(READERS)
        if FLOOR.get(house.room(module), 0) < FLOOR["runs"]
        for argument in ast.walk(function.args)
        if isinstance(argument, ast.arg) and argument.arg == "config"
        if argument.annotation is None
        or ast.unparse(argument.annotation) in ("Any", "ConfigDict")
    }
    _agrees("config", whole)


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("import radejax", "jax numpy"),
        (
            "from radejax.cli.main import main; main(['detect', '--help'], 'radejax',"
            " standalone_mode=False)",
            "jax flax matplotlib numpy absl",
        ),
    ],
    ids=["import", "help"],
)
def test_what_need_not_wait_for_jax_does_not(code: str, absent: str) -> None:
    code += f"; import sys; sys.exit(str(set(sys.modules) & set({absent!r}.split())))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True
    )
    assert done.stderr.strip() == "set()"


def test_every_kind_of_import_is_seen() -> None:
    text = (
        "import a.b\nfrom a import b\nfrom . import c\nfrom ..d import e\n"
        "import_module('f.g')\nif TYPE_CHECKING:\n import h\ndef i():\n import j\n"
    )
    names = {
        name
        for node in ast.walk(ast.parse(text))
        for name in house._names(node, "p.q.r", is_package=False)
    }
    assert names == {"a.b", "p.q.c", "p.d.e", "f.g", "h", "j"}


def test_circles_and_floors_of_a_small_house() -> None:
    graph = {"a": {"b", "c"}, "b": {"c"}, "c": {"d"}, "d": {"c"}, "e": {"e"}}
    assert house.circles(graph) == [("c", "d"), ("e",)]
    assert house.heights(graph) == {"a": 2, "b": 1, "c": 0, "d": 0, "e": 0}
