"""Every public name of `import radejax` exists and is imported on first use."""

import ast
import pathlib

import radejax


def test_editors_and_type_checkers_see_every_public_name():
    tree = ast.parse(pathlib.Path(radejax.__file__).read_text(encoding="utf-8"))
    declared = {
        alias.asname: (node.module, alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        and (node.module or "").startswith("radejax")
        for alias in node.names
    }
    assert declared.keys() == {*radejax.__all__, "__version__"}
    assert set(radejax.__all__) <= set(dir(radejax))
    for name, (module, attribute) in declared.items():
        imported = getattr(__import__(str(module), fromlist=[""]), attribute)
        assert getattr(radejax, name) is imported
