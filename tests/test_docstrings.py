"""Docstrings have one grammatical form, and their examples run.

Every public function of the pure packages has an example.
"""

import ast
import doctest
import importlib
import pathlib
import re
from collections.abc import Iterator

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
PURE = ("geometry", "losses", "detection", "evaluation")
"""Packages of functions from arrays to arrays."""

REPORTS = ("comparison", "files", "html", "kitti", "report", "results")
"""Modules of `evaluation` that read, write or compose reports."""

Documented = ast.FunctionDef | ast.ClassDef


def _documented(node: ast.AST, prefix: str) -> Iterator[tuple[str, Documented]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Documented):
            name = f"{prefix}.{child.name}"
            yield name, child
            yield from _documented(child, name)


NODES = {
    name: (module, node)
    for path in sorted((ROOT / "radejax").rglob("*.py"))
    for module in [".".join(path.relative_to(ROOT).with_suffix("").parts)]
    for name, node in _documented(ast.parse(path.read_text("utf-8")), module)
}
EXAMPLES = {
    name: (module, text)
    for name, (module, node) in NODES.items()
    if ">>>" in (text := ast.get_docstring(node) or "")
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_run(name: str) -> None:
    module, text = EXAMPLES[name]
    names = dict(vars(importlib.import_module(module)))
    example = doctest.DocTestParser().get_doctest(text, names, name, module, 0)
    said: list[str] = []
    doctest.DocTestRunner().run(example, out=said.append)
    assert not said, "".join(said)


def test_every_public_function_of_the_pure_packages_has_an_example() -> None:
    lacking = [
        name
        for name, (module, node) in NODES.items()
        if module.split(".")[1] in PURE
        and module.count(".") == 2
        and module.split(".")[2] not in REPORTS
        and name == f"{module}.{node.name}"
        and isinstance(node, ast.FunctionDef)
        and not node.name.startswith("_")
        and name not in EXAMPLES
    ]
    assert not lacking


def test_functions_are_described_in_the_third_person() -> None:
    """Properties have noun phrases, and commands the imperative of help texts."""
    other = re.compile(r"property|(^|\.)(command|group)\(")
    wrong = [
        f"{name}: {text.splitlines()[0]}"
        for name, (_, node) in NODES.items()
        if isinstance(node, ast.FunctionDef)
        and not any(other.search(ast.unparse(x)) for x in node.decorator_list)
        and (text := ast.get_docstring(node))
        and not re.match(r"[A-Z][a-z]*[^s]s\b", text)
    ]
    assert not wrong
