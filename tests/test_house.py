"""The structure that docs/architecture.md promises, read from the code's own imports."""

import ast
import pathlib
import re

import pytest

import radejax

PACKAGE = pathlib.Path(radejax.__file__).parent
FLOORS = (  # from the ground up
    "geometry",
    "visualize",
    "evaluation",
    "detection",
    "data",
    "models",
    "losses",
    "simulation",
    "interop",
    "training",
)
ROOF = {path.stem for path in PACKAGE.glob("*.py")} - {
    "__init__",
    "config",
    "entry",
    "errors",
    "files",
    "structures",
}
MODULES = sorted(path for floor in FLOORS for path in (PACKAGE / floor).glob("*.py"))


def _imported_rooms(path: pathlib.Path) -> set[str]:
    """Second names of all imports from radejax, those inside functions included."""
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        rooms |= {name.split(".")[1] for name in names if name.startswith("radejax.")}
    return rooms


@pytest.mark.parametrize("path", MODULES, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_a_floor_imports_only_from_the_floors_below(path: pathlib.Path) -> None:
    rooms = _imported_rooms(path)
    above = set(FLOORS[FLOORS.index(path.parent.name) + 1 :]) | ROOF
    assert not rooms & above


def _floors_of_the_page() -> dict[str, int]:
    """Floor of every room and module, from the ground, as docs/architecture.md says."""
    page = PACKAGE.parent / "docs" / "architecture.md"
    table = (
        page.read_text(encoding="utf-8").split("|---|---|---|\n")[1].split("\n\n")[0]
    )
    rows = [
        re.findall(r"`([\w/]+)(?:\.py)?`", r.split("|")[1]) for r in table.split("\n")
    ]
    return {
        name.rstrip("/"): floor
        for floor, row in enumerate(reversed(rows))
        for name in row
    }


def test_the_page_names_every_room_and_its_floor() -> None:
    floors = _floors_of_the_page()
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    rooms = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert set(floors) - {"train", "evaluate"} == modules | rooms
    for path in PACKAGE.glob("*.py"):
        if path.stem == "__init__":
            continue
        # Imports inside functions are conveniences, made when they are asked for.
        tree = ast.parse(path.read_text())
        imports = [n for n in tree.body if isinstance(n, ast.ImportFrom)]
        names = [f"{n.module}.{alias.name}" for n in imports for alias in n.names]
        for name in names:
            room = name.split(".")[1] if name.startswith("radejax.") else None
            if room in floors:
                assert floors[room] <= floors[path.stem], f"{path.stem}: {name}"
