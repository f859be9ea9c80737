"""Packages import only from the layers below them, and modules have no import cycles."""

import ast
import graphlib
import pathlib
import runpy
import subprocess
import sys

import pytest

PACKAGE = pathlib.Path(__file__).resolve().parents[1] / "radejax"

LAYERS = (
    {"core", "geometry"},
    {"models", "detection", "data", "visualize"},
    {"losses", "evaluation", "simulation", "weights"},
    {"config"},
    {"training", "configs"},
    {"inference"},
    {"runs"},
    {"cli"},
    {"__main__"},
)
"""The table of docs/architecture.md, lowest first.

Packages of one layer do not import each other, except that `geometry` uses `core`. The module
`config` composes the options of all packages, those of the training included.
"""
UPWARD = {"radejax.config -> radejax.training.options"}
LAYER = {package: i for i, layer in enumerate(LAYERS) for package in layer}


def _modules():
    """Syntax tree of every module by its dotted name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ("radejax", *path.relative_to(PACKAGE).with_suffix("").parts)
        name = ".".join(parts).removesuffix(".__init__")
        found[name] = ast.parse(path.read_text(encoding="utf-8"))
    return found


MODULES = _modules()


def _imports(tree):
    """Modules of radejax that a module imports, inside functions as well."""
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports are not used"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            while name and name not in MODULES:
                name = name.rpartition(".")[0]
            if name and name != "radejax":
                yield name


GRAPH = {name: set(_imports(tree)) - {name} for name, tree in MODULES.items()}


def _package(module):
    return module.split(".")[1]


def test_every_package_has_a_layer():
    found = {_package(name) for name in GRAPH if name != "radejax"}
    assert found == set(LAYER) - {"configs"}  # a link to configs/, which is not walked


def test_packages_import_only_from_lower_layers():
    wrong = {
        f"{source} -> {target}"
        for source, targets in GRAPH.items()
        if source != "radejax"
        for target in targets
        if _package(source) != _package(target) != "core"
        if LAYER[_package(source)] <= LAYER[_package(target)]
    }
    assert wrong == UPWARD
    of_core = [GRAPH[name] for name in GRAPH if name.startswith("radejax.core")]
    assert all(".core." in target for target in set.union(*of_core))


def test_modules_have_no_import_cycles():
    graph = {name: targets for name, targets in GRAPH.items() if name != "radejax"}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError


def test_windows_is_named(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(ImportError, match="radejax runs on Linux and macOS; on"):
        runpy.run_path(str(PACKAGE / "__init__.py"))


def test_imports_are_few_and_change_neither_logging_nor_signals():
    """Commands load only the libraries that they need."""
    code = (
        "import importlib, logging, pkgutil, signal, sys\n"
        "def state():\n"
        "    logger = logging.root\n"
        "    signals = [signal.getsignal(x) for x in signal.valid_signals()]\n"
        "    return logger.handlers[:], logger.level, logger.filters[:], signals\n"
        "before = state()\n"
        "from radejax.cli.main import main\n"
        "main(['detect', '--help'], 'radejax', standalone_mode=False)\n"
        "after_help = {'jax', 'flax', 'matplotlib', 'numpy', 'absl'} & set(sys.modules)\n"
        "assert not after_help, after_help\n"
        "from radejax import Detector\n"
        "Detector.from_workdir('radejax/cli/demo_model')\n"
        "after_model = {'orbax', 'grain', 'matplotlib'} & set(sys.modules)\n"
        "assert not after_model, after_model\n"
        "import radejax\n"
        "optional = ('radejax.cli', 'radejax.__main__', 'radejax.visualize.recordings')\n"
        "for module in pkgutil.walk_packages(radejax.__path__, 'radejax.'):\n"
        "    if not module.name.startswith(optional):\n"
        "        importlib.import_module(module.name)\n"
        "assert {'orbax', 'grain', 'matplotlib'} <= set(sys.modules)\n"
        "assert state() == before, state()\n"
    )
    command = [sys.executable, "-c", code]
    subprocess.run(command, cwd=PACKAGE.parent, check=True)
