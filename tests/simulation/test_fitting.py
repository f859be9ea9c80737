"""Parameters that are estimated from simulated tensors, and `radejax simulate --fit`."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from radejax.config import Config
from radejax.core.errors import DataError, UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset
from radejax.simulation.fitting import fit_files, fit_radar
from radejax.simulation.radar import sensor, tensor
from radejax.simulation.radar.tensor import RadarParameters

from .. import small_models as small
from ..commands import run
from .radar.test_tensor import points

GRID = RadarGrid.reduced(
    num_doppler=16, num_range=64, num_elevation=9, num_azimuth=56, max_range_m=75.6
)


def recording(grid=GRID, seed=0, **changes):
    """One echo of 45 dB in the noise of a sensor."""
    values = {"range_profile": 1.0, "noise_db": 100.0, "array_pedestal": 0.5} | changes
    parameters = RadarParameters(**values)
    state = sensor.draw_state(grid, parameters, np.random.default_rng(seed))
    amplitude = 10.0 ** (145.0 / 20.0)
    target = points(grid.range_m[20], 0.2, 0.0, grid.doppler_mps[3], amplitude)
    noise = sensor.receiver_noise(grid, parameters).astype(np.float32)
    given = target, noise, tensor.frame_key(seed), state
    options = {"grid": grid, "parameters": parameters, "output": "tesseract"}
    rows = tensor.simulate(*given, **options)
    return np.asarray(rows).transpose(tensor.TESSERACT_OF_ROWS), parameters


@settings(max_examples=5, deadline=None)
@given(
    seed=st.integers(0, 100),
    noise_db=st.floats(40.0, 120.0),
    leakage=st.floats(0.02, 0.08),
    range_correlation=st.floats(0.05, 0.44),
    beam_spread_db=st.sampled_from([0.0, 0.5]),
    azimuth_elements=st.sampled_from([24.0, 40.0]),
    elevation_elements=st.sampled_from([8.0, 12.0]),
    doppler_pedestal=st.sampled_from([0.0, 0.2, 1.0]),
    array_pedestal=st.sampled_from([0.2, 0.5]),
)
def test_the_parameters_of_a_simulated_recording_are_found(seed, noise_db, **changes):
    power, wanted = recording(seed=seed, **changes)
    power = power * 10.0 ** ((noise_db - 100.0) / 10.0)
    found = fit_radar([power], GRID)
    assert found["noise_db"] == pytest.approx(noise_db, abs=0.8)
    correlation = wanted.range_correlation
    assert found["range_correlation"] == pytest.approx(correlation, abs=0.05)
    # The gains drawn for few independent beams may spread by half of the parameter.
    state = sensor.draw_state(GRID, wanted, np.random.default_rng(seed))
    spread_db = np.std(20.0 * np.log10(state.beam_gain))
    assert found["beam_spread_db"] == pytest.approx(spread_db, abs=0.3)
    assert abs(10.0 * np.log10(found["leakage"] / wanted.leakage)) < 5.0
    # A correlation of 0.01 instead of 0 is that of a pedestal of 0.8 instead of 1.
    pedestal = wanted.doppler_pedestal
    error = abs(found["doppler_pedestal"] - pedestal)
    assert error < (0.35 if pedestal == 1.0 else 0.1)
    # More elements with a stronger taper have nearly the same beam.
    for axis in ("azimuth", "elevation"):
        noise = []
        for fields in (found, wanted.to_dict()):
            window = fields[f"{axis}_elements"], fields["array_pedestal"]
            basis = tensor.array_basis(getattr(GRID, f"{axis}_rad"), *window)
            noise.append(basis @ basis.T)
        np.testing.assert_allclose(*noise, atol=0.12)
    range_m, level_db = np.array(found["profile_db"]).T
    profile = 10.0 * np.log10(sensor.receiver_noise(GRID, wanted).mean(1)) - 100.0
    rows = np.abs(GRID.range_m[:, None] - range_m).argmin(0)
    np.testing.assert_allclose(level_db[1:-1], profile[rows][1:-1], atol=2.5)
    # It is steepest at the ends.
    np.testing.assert_allclose(level_db, profile[rows], atol=3.0)


def test_recordings_without_noise_are_refused():
    with pytest.raises(DataError, match="no recordings"):
        fit_radar([], GRID)
    power, _ = recording()
    for wrong in (np.ones_like(power), 10.0 * np.log10(power), np.zeros_like(power)):
        with pytest.raises(DataError, match="linear power"):
            fit_radar([wrong], GRID)


@pytest.mark.parametrize(
    "profile", [[(1.0,)], [(2.0, 0.0), (1.0, 0.0)], 3.0, [(-1.0, 0.0)], [(1.0, "a")]]
)
def test_profiles_that_are_not_points_by_range_are_refused(profile):
    with pytest.raises(UserError, match="profile_db"):
        RadarParameters(profile_db=profile)


SMALL = {"image_width": 0, "image_height": 0, "frames_per_sequence": 1}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Three frames of the realistic sensor."""
    options = SimulationOptions(**SMALL, train_sequences=3, test_sequences=0)
    return simulate_dataset(options, tmp_path_factory.mktemp("a") / "b", progress=False)


def test_command_writes_section_and_figure_and_simulates_them(recorded, tmp_path):
    out = tmp_path / "fit"
    words = ["--fit", recorded / "1", "--fit", recorded / "2", "--out", out]
    assert "noise_db: [1" in run("simulate", *words).output
    with Image.open(out / "fit.png") as figure:
        assert figure.width > 2 * figure.height
    section = json.loads((out / "radar.json").read_text())
    assert len(section["grid"]["range_m"]) == 64
    low, high = section["radar"]["noise_db"]
    assert 107.0 < low <= high < 111.0
    again = tmp_path / "again"
    config = Config(
        model={"doppler_bins": 16, "elevation_bins": 9},
        simulation=SMALL | {"train_sequences": 1, "test_sequences": 0},
    )
    words = ["--radar", out / "radar.json", "--frames", 1, "--out", again]
    words += ["--config", small.write_config(tmp_path / "config.py", config)]
    run("simulate", *words)
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
