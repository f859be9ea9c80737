"""The example of ADC recordings: its files, its check of signs, and a whole run."""

import json
import pathlib

import numpy as np
import own_adc
import pytest
from click.testing import CliRunner

from radejax.data.adc import adc_to_power
from radejax.data.options import DataOptions
from radejax.data.projection import project_tensor


def read(root: pathlib.Path) -> own_adc.AdcRecordings:
    options = DataOptions(roots=(str(root),))
    return own_adc.AdcRecordings.from_options(options, own_adc.CLASSES)


def test_files_have_the_samples_and_the_signs_of_the_scene(
    tmp_path: pathlib.Path,
) -> None:
    own_adc.simulate(tmp_path, 5)
    frames = read(tmp_path)
    assert [len(frames.of_split(name)) for name in ("train", "test")] == [16, 4]
    assert frames[0].read_projection(own_adc.GRID).shape == (64, 48, 32)
    level = own_adc.echoes_db(frames)
    assert level > own_adc.echoes_db(frames, mirrored=True) + 3


def test_counts_are_read_as_they_were_written(tmp_path: pathlib.Path) -> None:
    rng = np.random.default_rng(0)
    samples = rng.integers(-99, 99, (2, *own_adc.RADAR.shape)) / 2e-5
    samples = (samples[0] + 1j * samples[1]).astype(np.complex64)
    own_adc.to_counts(samples).tofile(tmp_path / "1.bin")
    frame = own_adc.AdcFrame(
        sequence=1,
        name="0000",
        boxes=np.zeros((0, 7)),
        classes=np.zeros(0),
        radar_path=tmp_path / "1.bin",
    )
    power = np.asarray(adc_to_power(samples * np.float32(2e-5), own_adc.RADAR))
    expected = own_adc.GRID.measured_channels(project_tensor(power))
    found = frame.read_projection(own_adc.GRID)
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("commands_on_one_device")
def test_a_simulated_recording_is_trained_evaluated_and_drawn(
    tmp_path: pathlib.Path,
) -> None:
    root, run = tmp_path / "data", tmp_path / "run"
    arguments = [str(root), "--workdir", str(run), "--drives", "30", "--epochs", "1"]
    result = CliRunner().invoke(own_adc.main, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert (root / "frame.png").stat().st_size > 10_000
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text())
    assert metrics["options"]["classes"] == ["Sedan", "Bus or Truck"]
