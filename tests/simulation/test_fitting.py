"""`radejax simulate --fit` on files, and the simulation of what it found."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from radejax.cli.main import main
from radejax.core.errors import DataError, UserError
from radejax.data.kradar.tesseract import read_tesseract
from radejax.data.kradar.write import write_tesseract
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset
from radejax.simulation.fitting import fit_files

SMALL = {"image_width": 0, "image_height": 0, "frames_per_sequence": 1}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> pathlib.Path:
    """Three frames of the realistic sensor."""
    options = SimulationOptions(**SMALL, train_sequences=3, test_sequences=0)
    return simulate_dataset(options, tmp_path_factory.mktemp("a") / "b", progress=False)


def test_command_writes_section_and_figure_and_simulates_them(recorded, tmp_path):
    out = tmp_path / "fit"
    arguments = ["simulate", "--fit", str(recorded / "1"), "--fit", str(recorded / "2")]
    done = CliRunner().invoke(main, [*arguments, "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "noise_db: [1" in done.output
    with Image.open(out / "fit.png") as figure:
        assert figure.width > 2 * figure.height
    section = json.loads((out / "radar.json").read_text())
    assert len(section["grid"]["range_m"]) == 64
    low, high = section["radar"]["noise_db"]
    assert 107.0 < low <= high < 111.0
    again = tmp_path / "again"
    arguments = ["simulate", "--radar", str(out / "radar.json"), "--frames", "1"]
    config = tmp_path / "config.py"
    config.write_text(
        "from radejax.config import Config\n"
        "def get_config(arg=None):\n"
        "    model = {'doppler_bins': 16, 'elevation_bins': 9}\n"
        f"    simulation = {dict(SMALL, train_sequences=1, test_sequences=0)}\n"
        "    return Config(model=model, simulation=simulation)\n"
    )
    arguments += ["--config", str(config), "--out", str(again)]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    marker = json.loads((again / "simulation.json").read_text())
    assert marker["config"]["radar"] == section["radar"]
    assert next(again.glob("*/radar_tesseract/*.mat")).stat().st_size > 1e6


def test_files_of_another_sensor_and_folders_without_tensors_are_named(
    recorded, tmp_path
):
    (path, *_) = sorted(recorded.glob("*/radar_tesseract/*.mat"))
    moved = tmp_path / path.name  # without the `radar_grid.json` of its root
    moved.write_bytes(path.read_bytes())
    with pytest.raises(DataError, match=r"\(64, 256, 37, 107\)"):
        fit_files([moved], tmp_path / "out")
    with pytest.raises(UserError, match=r"no radar tensors in .*tesseract_\*\.mat"):
        fit_files([recorded / "split"], tmp_path / "out")
    decibels = 10.0 * np.log10(read_tesseract(path) + 1e-3)
    write_tesseract(moved, decibels.astype(np.float32))
    (tmp_path / "radar_grid.json").write_bytes(
        (recorded / "radar_grid.json").read_bytes()
    )
    with pytest.raises(DataError, match=f"{path.name}: .*as in decibels"):
        fit_files([moved], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    done = CliRunner().invoke(
        main, ["simulate", "--radar", str(path), "--out", str(tmp_path / "x")]
    )
    assert done.exit_code != 0
    assert "is not UTF-8 text" in done.output
