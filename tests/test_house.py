"""The structure that docs/architecture.md promises, read from the code's own imports."""

import ast
import pathlib

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
