"""Docstrings have one grammatical form, and their examples run.

Every public function of the pure packages has an example.
"""

import ast
import doctest
import importlib
import pathlib

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]


Documented = ast.FunctionDef | ast.ClassDef


def _documented(node, prefix):
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
def test_examples_run(name):
    module, text = EXAMPLES[name]
    names = dict(vars(importlib.import_module(module)))
    example = doctest.DocTestParser().get_doctest(text, names, name, module, 0)
    said = []
    doctest.DocTestRunner().run(example, out=said.append)
    assert not said, "".join(said)
