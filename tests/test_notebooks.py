"""The notebooks are complete and run from start to end."""

import json
import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SECONDS = 900

by_name = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@pytest.fixture(scope="session")
def work(tmp_path_factory):
    """Folder of the notebooks' runs and data: that of `.ci/run quickstart` if RADEJAX_WORK is set;
    otherwise the first notebook that needs a run trains a short one.
    """
    given = os.environ.get("RADEJAX_WORK")
    return pathlib.Path(given) if given else tmp_path_factory.mktemp("notebooks")


def code_cells(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


@pytest.mark.slow
@pytest.mark.timeout(SECONDS)
@by_name
def test_notebook_runs(path, work):
    """In a fresh process without a display, on the short quickstart.

    Cells are fed as one program through standard input: worker processes that the
    notebook starts must not find a main file to import, as in Jupyter.
    """
    program = "\n\n".join("".join(cell["source"]) for cell in code_cells(path))
    settings = {
        "RADEJAX_WORK": str(work),
        "RADEJAX_SHORT": "1",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    unset = ("DISPLAY", "MPLBACKEND", "KRADAR", "KRADAR_LABELS", "RADENET_PTH")
    inherited = {k: v for k, v in os.environ.items() if k not in unset}
    done = subprocess.run(
        [sys.executable, "-W", "error::FutureWarning", "-"],
        input=program,
        cwd=ROOT / "notebooks",
        env={**inherited, **settings},
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
