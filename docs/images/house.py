"""Draws the house from the code: rooms on their floors, and who imports whom.

    python docs/images/house.py

writes docs/images/house.png, and the tree of files into docs/architecture.md. The floors
are those of the page's table; `tests/test_house.py` holds the same graph to them.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import pathlib
import re
import textwrap
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "architecture.md"
GROUND = "radejax/__init__"
"""Room of the lazy names: whoever imports a module of the package runs it first."""


# The graph ---------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Arrow:
    """An import: module `source` names module `target`.

    Attributes:
        source, target: Dotted names, such as "radejax.core.files" or "train".
        line: Of the source's file.
        is_inside: Made when a function runs, not when the module is loaded.
    """

    source: str
    target: str
    line: int
    is_inside: bool


def modules() -> dict[str, pathlib.Path]:
    """File of every module of ours by its dotted name; tests and docs are not rooms."""
    folders = ("radejax", "configs", "benchmarks", "examples")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    found = {}
    for path in sorted([ROOT / "train.py", ROOT / "evaluate.py", *paths]):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts).removesuffix(".__init__")] = path
    return found


def room(module: str) -> str:
    """What holds a module: a package of radejax, a folder, or a script of the root."""
    first, *rest = module.split(".")
    if first != "radejax":
        return first if rest else f"{first}.py"
    return rest[0] if rest else GROUND


@functools.cache
def arrows() -> tuple[Arrow, ...]:
    """All imports among our modules: in functions and under TYPE_CHECKING as well."""
    known = modules()
    found: dict[Arrow, None] = {}  # in order, each once
    for source, path in known.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
        inside = {
            id(node)
            for function in ast.walk(tree)
            if isinstance(function, functions)
            for node in ast.walk(function)
        }
        for node in ast.walk(tree):
            for name in _names(node, source, path.name == "__init__.py"):
                target = _resolve(name, source, known)
                if target is not None and target != source:
                    arrow = Arrow(source, target, node.lineno, id(node) in inside)
                    found[arrow] = None
    return tuple(found)


def _names(node: ast.AST, source: str, is_package: bool) -> Iterator[str]:
    """Dotted names that a statement imports; "radejax.core.files.relative" for one."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        parent = source.split(".")
        parent = parent[: len(parent) + is_package - node.level] if node.level else []
        start = ".".join([*parent, *filter(None, [node.module])])
        yield from (f"{start}.{alias.name}" for alias in node.names)
    elif isinstance(node, ast.Call) and _called(node) == "import_module":
        yield from (a.value for a in node.args[:1] if isinstance(a, ast.Constant))


def _called(node: ast.Call) -> str | None:
    return getattr(node.func, "attr", getattr(node.func, "id", None))


def _resolve(name: str, source: str, known: Collection[str]) -> str | None:
    """The module of ours that a dotted name is of; scripts name their neighbours."""
    neighbour = f"{source.split('.')[0]}.{name.split('.')[0]}"
    if neighbour in known and not source.startswith("radejax"):
        return neighbour
    while name and name not in known:
        name = name.rpartition(".")[0]
    return name or None


def among_rooms(found: Iterable[Arrow]) -> dict[str, set[str]]:
    """Rooms that each room imports from."""
    graph: dict[str, set[str]] = {room(module): set() for module in modules()}
    for arrow in found:
        source, target = room(arrow.source), room(arrow.target)
        if source != target:
            graph[source].add(target)
    return graph


def among_modules(found: Iterable[Arrow]) -> dict[str, set[str]]:
    """Modules that each module imports."""
    graph: dict[str, set[str]] = {module: set() for module in modules()}
    for arrow in found:
        graph[arrow.source].add(arrow.target)
    return graph


def reached(graph: Mapping[str, set[str]], start: str) -> set[str]:
    """What `start` needs, directly or not; itself only in a circle."""
    found, waiting = set(), list(graph[start])
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += graph[name]
    return found


def circles(graph: Mapping[str, set[str]]) -> list[tuple[str, ...]]:
    """Groups of names that need each other."""
    needs = {name: reached(graph, name) for name in graph}
    groups = {
        tuple(sorted(other for other in needs[name] if name in needs[other]))
        for name in graph
        if name in needs[name]
    }
    return sorted(groups)


def heights(graph: Mapping[str, set[str]]) -> dict[str, int]:
    """Longest way down from each name, from 0; arrows within circles do not count."""
    needs = {name: reached(graph, name) for name in graph}

    @functools.cache
    def height(name: str) -> int:
        below = [other for other in graph[name] if name not in needs[other]]
        return max((1 + height(other) for other in below), default=0)

    return {name: height(name) for name in graph}


def floors_of_the_page() -> list[tuple[str, list[str]]]:
    """Name and rooms of every floor of docs/architecture.md's table, ground first."""
    page = PAGE.read_text(encoding="utf-8")
    rows = re.search(r"\| floor \|.*\n\|[-|]+\n((?:\|.*\n)+)", page).group(1)
    cells = [[cell.strip() for cell in row.split("|")] for row in rows.splitlines()]
    return [
        (name, [found.rstrip("/") for found in re.findall(r"`([^`]+)`", rooms)])
        for _, name, rooms, *_ in reversed(cells)
    ]


def tree() -> str:
    """Files of the package by room, from the upper floors down, as the page has them."""
    folders: dict[pathlib.Path, list[str]] = {}
    for module, path in modules().items():
        if module.startswith("radejax") and path.name != "__init__.py":
            folders.setdefault(path.parent, []).append(path.stem)
    rooms = [name for _, names in reversed(floors_of_the_page()) for name in names]
    package = ROOT / "radejax"
    order = sorted(
        (folder for folder in folders if folder != package),
        key=lambda folder: (rooms.index(folder.relative_to(package).parts[0]), folder),
    )
    lines = ["radejax/"]
    for folder in order:
        indent = "  " * len(folder.relative_to(package).parts)
        lines += textwrap.wrap(
            " ".join(sorted(folders[folder])),
            width=88,
            initial_indent=f"{indent + folder.name + '/':<16}",
            subsequent_indent=16 * " ",
        )
    return "\n".join(lines)


def count_lines(path: pathlib.Path) -> int:
    """Lines of code: without blank lines, comments and docstrings."""
    text = path.read_text(encoding="utf-8")
    prose = set()
    owners = (ast.Module, ast.ClassDef, ast.FunctionDef)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, owners) and ast.get_docstring(node) is not None:
            prose |= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return sum(
        number not in prose and bool(line.strip()) and line.strip()[0] != "#"
        for number, line in enumerate(text.splitlines(), 1)
    )


# The picture -------------------------------------------------------------------------

_WIDTH, _LEFT = 12.0, 1.5  # of the picture, and of the column of floors' names
_RISE, _HEIGHT = 1.0, 0.52  # from floor to floor, and of a room
_SMALLEST, _GAP = 1.05, 0.22  # width of a room, and between two
_INK, _PALE, _WRONG = "#22262E", "#5A6270", "#D62828"
_COLORS = (  # of the floors
    "#4C566A", "#3E6990", "#2F7F86", "#3F8F5F", "#7A8F35", "#B58A2B", "#BF6A3A",
    "#A84A5B",
)  # fmt: skip


@dataclasses.dataclass
class _Box:
    """A room: lower left corner, width, lines of its files, color of its floor."""

    left: float
    bottom: float
    width: float
    files: list[int]
    color: str

    @property
    def middle(self) -> float:
        return self.left + self.width / 2


def _place(graph: Mapping[str, set[str]]) -> dict[str, _Box]:
    """Rooms on their floors, as wide as their code, above what they import."""
    files: dict[str, list[int]] = {name: [] for name in graph}
    for module, path in modules().items():
        files[room(module)].append(count_lines(path))
    floors = [rooms for _, rooms in floors_of_the_page()]
    space = _WIDTH - _LEFT - 0.25
    most = max(sum(sum(files[name]) for name in rooms) for rooms in floors)
    free = space - max(map(len, floors)) * (_SMALLEST + _GAP) + _GAP
    boxes: dict[str, _Box] = {}

    def over(name: str) -> float:
        below = [boxes[other].middle for other in graph[name] if other in boxes]
        return sum(below) / len(below) if below else 0.0

    for floor, rooms in enumerate(floors):
        widths = {
            name: max(_SMALLEST, 0.11 * len(name)) + free * sum(files[name]) / most
            for name in rooms
        }
        left = _LEFT + (space - sum(widths.values()) - _GAP * (len(rooms) - 1)) / 2
        for name in sorted(rooms, key=over):
            sizes = sorted(filter(None, files[name]), reverse=True)
            boxes[name] = _Box(left, floor * _RISE, widths[name], sizes, _COLORS[floor])
            left += widths[name] + _GAP
    return boxes


def _drawn(graph: Mapping[str, set[str]], boxes: Mapping[str, _Box]) -> list[tuple]:
    """Pairs of rooms with an arrow: those down that no longer way implies, all others."""
    down, wrong = {name: set() for name in graph}, []
    for source in boxes:
        for target in graph[source] & set(boxes) - {GROUND}:
            if boxes[source].bottom > boxes[target].bottom:
                down[source].add(target)
            else:
                wrong.append((source, target))
    needs = {name: reached(down, name) for name in down}
    return wrong + [
        (source, target)
        for source, targets in down.items()
        for target in sorted(targets)
        if not any(target in needs[other] for other in targets)
    ]


def _draw_room(axes: Any, name: str, box: _Box) -> None:
    from matplotlib.patches import FancyBboxPatch, Rectangle

    style = "round,pad=0,rounding_size=0.06"
    corner = box.left, box.bottom
    frame = FancyBboxPatch(corner, box.width, _HEIGHT, boxstyle=style, zorder=3)
    frame.set(facecolor="white", edgecolor=box.color, linewidth=1.2)
    axes.add_patch(frame)
    x, y = box.left + 0.07, box.bottom
    text = {"va": "center", "zorder": 5}
    axes.text(x, y + 0.38, name, size=9.5, weight="bold", color=_INK, **text)
    count = f"{sum(box.files):,} lines"
    axes.text(x, y + 0.205, count, size=7.5, color=_PALE, **text)
    full = box.width - 0.14
    for lines in box.files:
        width = full * lines / sum(box.files)
        bar = Rectangle((x, y + 0.05), max(width - 0.012, 0.004), 0.065, lw=0, zorder=4)
        bar.set(color=box.color, alpha=0.8)
        axes.add_patch(bar)
        x += width


def _draw_arrow(axes: Any, start: tuple, end: tuple, color: str, is_down: bool) -> None:
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path

    (x0, y0), (x1, y1) = start, end
    bend = 0.5 * abs(y0 - y1)
    way = [start, (x0, y0 - bend), (x1, y1 + bend), end]
    arrow = FancyArrowPatch(
        path=Path(way, [Path.MOVETO] + 3 * [Path.CURVE4]),
        arrowstyle="-|>",
        mutation_scale=8,
        color=color if is_down else _WRONG,
        linewidth=1.1,
        linestyle="-" if is_down else "--",
        zorder=2,
    )
    axes.add_patch(arrow)


def draw(out: pathlib.Path) -> None:
    """Writes the picture of the house."""
    from matplotlib import pyplot as plt
    from matplotlib.patches import Rectangle

    graph = among_rooms(arrows())
    boxes = _place(graph)
    floors = floors_of_the_page()
    top = len(floors) * _RISE - 0.24
    figure = plt.figure(figsize=(_WIDTH, top + 1.05), dpi=150, facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, _WIDTH), ylim=(-0.95, top + 0.1))
    axes.axis("off")
    for floor, (name, _) in enumerate(floors):
        band = Rectangle((0.1, floor * _RISE - 0.24), _WIDTH - 0.2, _RISE, zorder=0)
        band.set(color="#F1F2F6" if floor % 2 else "#FAFAFC")
        axes.add_patch(band)
        y = floor * _RISE + _HEIGHT / 2
        axes.text(0.25, y, name, color=_COLORS[floor], size=10.5, va="center")
    for name, box in boxes.items():
        _draw_room(axes, name, box)
    pairs = _drawn(graph, boxes)
    by_place = sorted(boxes, key=lambda name: boxes[name].middle)
    for source, target in pairs:
        # Arrows share the foot of their source and the roof of their target.
        leaving = [name for name in by_place if (source, name) in pairs]
        coming = [name for name in by_place if (name, target) in pairs]
        a, b = boxes[source], boxes[target]
        x0 = a.left + a.width * (leaving.index(target) + 1) / (len(leaving) + 1)
        x1 = b.left + b.width * (coming.index(source) + 1) / (len(coming) + 1)
        is_down = a.bottom > b.bottom
        ends = (x0, a.bottom), (x1, b.bottom + _HEIGHT + 0.01)
        _draw_arrow(axes, *ends, a.color, is_down)
    total = sum(sum(box.files) for box in boxes.values())
    text = (
        "Arrow: imports from. Arrows that a longer way implies, and those to "
        f"{GROUND}, are not drawn; dashed red would run against the floors.\n"
        "Width and bar of a room: its files by lines of code, without docstrings, "
        f"comments and blank lines; {total:,} in all."
    )
    axes.text(0.25, -0.58, text, size=8.5, color=_PALE, va="center", linespacing=1.6)
    figure.savefig(out)
    plt.close(figure)


def main() -> None:
    """Draws the picture, and writes the page's tree anew."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--out", type=pathlib.Path, default=ROOT / "docs" / "images" / "house.png"
    )
    draw(parser.parse_args().out)
    page = PAGE.read_text(encoding="utf-8")
    block = re.search(r"(?<=```\n)radejax/\n.*?(?=\n```)", page, re.DOTALL)
    page = page[: block.start()] + tree() + page[block.end() :]
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
