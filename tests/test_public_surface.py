"""Every public name of `import radejax` exists and is imported on first use."""

import subprocess
import sys

import radejax


def test_every_public_name_is_there() -> None:
    for name in radejax.__all__:
        assert callable(getattr(radejax, name)) or name == "CLASSES"


def test_importing_radejax_loads_no_model() -> None:
    code = "import sys, radejax; print([m for m in sys.modules if m == 'jax'])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
