"""The radar tensor of simulated ADC samples is that of the simulator."""

import jax
import numpy as np
import pytest

from radejax.data.adc import LIGHT_MPS, FmcwRadar, adc_to_power
from radejax.simulation.radar import tensor
from radejax.simulation.radar.adc import simulate_adc

HALF = LIGHT_MPS / 77e9 / 2
RADAR = FmcwRadar(
    tx_m=[(0, 4 * HALF * i, 0) for i in range(3)],
    rx_m=[(0, HALF * i, 0) for i in range(4)],
    azimuth_rad=np.arcsin(np.linspace(-0.75, 0.75, 25)),
    carrier_hz=77e9,
    slope_hz_per_s=30e12,
    sample_rate_hz=10e6,
    chirp_period_s=20e-6,
    num_chirps=32,
    num_samples=128,
)
PARAMETERS = tensor.RadarParameters(azimuth_elements=12.0, elevation_elements=1.0)


def _both(radar, scatterers, noise):
    grid = radar.make_grid()
    samples = simulate_adc(scatterers, noise, tensor.frame_key(1), radar)
    options = {"grid": grid, "parameters": PARAMETERS, "output": "tesseract"}
    rows = tensor.simulate(scatterers, noise, tensor.frame_key(2), **options)
    expected = np.asarray(rows).transpose(tensor.TESSERACT_OF_ROWS)
    return np.asarray(adc_to_power(samples, radar)), expected


@pytest.mark.parametrize("is_complex", [True, False])
@pytest.mark.parametrize(("num_tx", "tolerance"), [(1, 3e-3), (3, 0.03)])
def test_sums_over_samples_and_antennas_are_the_transforms_of_the_windows(
    num_tx, tolerance, is_complex
):
    """Between bins, where the compensation of TDM is that of the bin and not of the target."""
    rx_m = [(0, HALF * i, 0) for i in range(12 // num_tx)]
    radar = RADAR.replace(tx_m=RADAR.tx_m[:num_tx], rx_m=rx_m, is_complex=is_complex)
    grid = radar.make_grid()
    rng, count = np.random.default_rng(0), 5
    scatterers = tensor.Scatterers(
        rng.uniform(5, 20, count).astype("f4"),
        rng.uniform(-0.7, 0.7, count).astype("f4"),
        np.zeros(count, "f4"),
        (rng.uniform(-1, 1, count) * 0.99 * grid.doppler_mps[-1]).astype("f4"),
        rng.normal(size=(count, 2)).astype("f4") * 1e3,
    )
    for i in range(count):  # phases between targets are not defined alike
        one = jax.tree.map(lambda x, i=i: x[i : i + 1], scatterers)
        found, expected = _both(radar, one, np.zeros((grid.num_range, 32), "f4"))
        np.testing.assert_allclose(found, expected, atol=tolerance * expected.max())


@pytest.mark.parametrize("is_complex", [True, False])
def test_noise_has_its_power_in_every_range_and_doppler_bin(is_complex):
    radar = RADAR.replace(is_complex=is_complex)
    shape = (radar.make_grid().num_range, 32)
    noise = np.full(shape, 3.0, np.float32)
    noise[:, 20:28] = 300.0
    nothing = tensor.Scatterers(*np.ones((4, 1), "f4"), np.zeros((1, 2), "f4"))
    found, expected = (p[:, 2:-2].mean((1, 2, 3)) for p in _both(radar, nothing, noise))
    np.testing.assert_allclose(found[22:26], 300.0, rtol=0.15)
    np.testing.assert_allclose(found[[*range(18), 30, 31]], 3.0, rtol=0.2)
    np.testing.assert_allclose(found[22:26], expected[22:26], rtol=0.2)
