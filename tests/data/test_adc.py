"""From ADC samples to power: signs, sizes, aliasing, files and wrong input."""

import re

import jax
import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.adc import LIGHT_MPS, FmcwRadar, adc_to_power, read_ti_bin

WAVELENGTH_M = LIGHT_MPS / 77e9
HALF = WAVELENGTH_M / 2


def row(y, z=0.0):
    """Positions in half wavelengths."""
    y, z = np.broadcast_arrays(y, z)
    return HALF * np.stack([0.0 * y, y, z], -1)


# Three transmitters and four receivers: eight virtual antennas in a row and four above them.
RADAR = FmcwRadar(
    tx_m=row([0.0, 2.0, 4.0], [0.0, 1.0, 0.0]),
    rx_m=row(np.arange(4.0)),
    azimuth_rad=np.arcsin(np.linspace(-0.75, 0.75, 13)),
    elevation_rad=np.deg2rad([-30.0, 0.0, 30.0]),
    carrier_hz=77e9,
    slope_hz_per_s=30e12,
    sample_rate_hz=10e6,
    chirp_period_s=20e-6,
    num_chirps=16,
    num_samples=64,
)
GRID = RADAR.make_grid()


def echo(radar, range_m, velocity_mps=0.0, azimuth_rad=0.0, elevation_rad=0.0):
    """Samples of a moving point by the delays between its position and all antennas.

    In float64 and without the far field's approximation; it is the phase of the transmitted
    chirp less that of the delayed one, at every sample.
    """
    num_chirps, num_tx, _, num_samples = radar.shape
    flat = np.cos(elevation_rad)
    toward = np.array([
        flat * np.cos(azimuth_rad),
        -flat * np.sin(azimuth_rad),
        np.sin(elevation_rad),
    ])  # fmt: skip
    in_chirp = (np.arange(num_samples) - (num_samples - 1) / 2) / radar.sample_rate_hz
    chirp = np.arange(num_chirps)[:, None] * num_tx + np.arange(num_tx)
    time = chirp[:, :, None, None] * radar.chirp_period_s + in_chirp  # [D, T, 1, N]
    time = time - time.mean()
    place = (range_m + velocity_mps * time)[..., None] * toward
    way = np.linalg.norm(place - np.array(radar.tx_m)[:, None, None], axis=-1)
    way = way + np.linalg.norm(place - np.array(radar.rx_m)[:, None], axis=-1)
    delay = way / LIGHT_MPS
    now, slope = in_chirp, radar.slope_hz_per_s
    sent = radar.carrier_hz * now + slope / 2 * now**2
    received = radar.carrier_hz * (now - delay) + slope / 2 * (now - delay) ** 2
    samples = np.exp(2j * np.pi * (sent - received))
    return samples if radar.is_complex else 2 * samples.real


def power_of(radar, samples, **options):
    return np.asarray(adc_to_power(samples, radar, **options), np.float64)


def peak(power):
    return tuple(int(i) for i in np.unravel_index(power.argmax(), power.shape))


@pytest.mark.parametrize("is_complex", [True, False])
@pytest.mark.parametrize(
    ("doppler", "range_", "elevation", "azimuth"),
    [(8, 10, 1, 6), (11, 20, 1, 2), (3, 30, 1, 11), (8, 12, 2, 6), (9, 25, 0, 8)],
)
def test_a_point_is_at_its_place_with_the_power_of_the_windows(
    is_complex, doppler, range_, elevation, azimuth
):
    """Right azimuth and receding velocity are positive, and TDM does not shift the angle."""
    radar = RADAR.replace(is_complex=is_complex)
    grid = radar.make_grid()
    angles = grid.azimuth_rad[azimuth], grid.elevation_rad[elevation]
    samples = echo(radar, grid.range_m[range_], grid.doppler_mps[doppler], *angles)
    power = power_of(radar, samples)
    assert power.shape == grid.shape_drea
    assert peak(power) == (doppler, range_, elevation, azimuth)
    gains = [window.sum() ** 2 for window in radar.windows()]
    assert power.max() == pytest.approx(np.prod(gains), rel=0.01)


def test_axes_have_the_waveforms_resolution():
    assert GRID.range_m[:2] == pytest.approx([0, LIGHT_MPS / (2 * 30e12 * 64 / 10e6)])
    assert GRID.doppler_mps[[0, 8]] == pytest.approx([-WAVELENGTH_M / (4 * 60e-6), 0])
    assert RADAR.replace(max_range_m=10.0).make_grid().num_range == 13
    assert RADAR.replace(is_complex=False).make_grid().num_range == 32


def test_velocities_alias_and_real_samples_mirror_nothing():
    """A target of twice the axis's end is 0 m/s; the angle's compensation is then wrong."""
    around = 2 * -GRID.doppler_mps[0]
    radar = RADAR.replace(tx_m=RADAR.tx_m[:1])  # of three times the axis

    def peak_of(radar, velocity_mps):
        return peak(power_of(radar, echo(radar, GRID.range_m[20], velocity_mps)))

    assert peak_of(radar, 0.0) == peak_of(radar, 3 * around)
    assert peak_of(RADAR, around)[0] == 8
    assert peak_of(RADAR, around)[3] != 6


def test_sidelobes_in_range_and_doppler_are_those_of_a_hann_window():
    power = power_of(RADAR, echo(RADAR, GRID.range_m[20]))[..., 1, 6]
    for line in (power[8] / power.max(), power[:, 20] / power.max()):
        level = 10 * np.log10(line + 1e-12)
        beside = np.sort(level)[::-1][1:5]
        assert beside[:2] == pytest.approx([-6, -6], abs=0.1)
        assert (beside[2:] < -50).all()


def test_white_noise_keeps_its_power():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(2, *RADAR.shape))
    power = power_of(RADAR, (noise[0] + 1j * noise[1]).astype(np.complex64))
    assert power.mean() == pytest.approx(2.0, rel=0.1)
    real = RADAR.replace(is_complex=False)
    assert power_of(real, noise[0]).mean() == pytest.approx(1.0, rel=0.1)


def test_a_calibration_undoes_the_errors_of_the_channels():
    rng = np.random.default_rng(0)
    errors = np.exp(1j * rng.uniform(-2, 2, (3, 4)))
    samples = echo(RADAR, GRID.range_m[20], 0.0, 0.3, 0.0)
    expected = power_of(RADAR, samples)
    wrong = samples * errors[None, :, :, None]
    assert power_of(RADAR, wrong).max() < 0.7 * expected.max()
    found = power_of(RADAR, wrong, calibration=1 / errors)
    np.testing.assert_allclose(found, expected, atol=1e-5 * expected.max())


def test_frames_can_be_batched():
    samples = np.stack([echo(RADAR, r) for r in GRID.range_m[[20, 30]]])
    power = jax.vmap(lambda frame: adc_to_power(frame, RADAR))(samples)
    assert [peak(np.asarray(p))[1] for p in power] == [20, 30]


@pytest.mark.parametrize("is_offset_binary", [True, False])
@pytest.mark.parametrize("is_interleaved", [True, False])
@pytest.mark.parametrize("is_complex", [True, False])
def test_files_of_all_layouts_are_read(
    is_complex, is_interleaved, is_offset_binary, tmp_path
):
    """Written word by word as TI's document lists them."""
    radar = RADAR.replace(num_chirps=2, num_samples=4, is_complex=is_complex)
    shape = (3, *radar.shape, 2 if is_complex else 1)
    counts = np.random.default_rng(0).integers(-(2**15), 2**15, shape)
    words = []
    for chirp in counts.reshape(-1, 4, *shape[-2:]):  # [Q, N, parts]
        if is_interleaved:
            words += chirp.transpose(1, 2, 0).ravel().tolist()
        elif is_complex:
            for q, n in ((q, n) for q in range(4) for n in (0, 2)):
                words += [*chirp[q, n : n + 2, 0], *chirp[q, n : n + 2, 1]]
        else:
            words += chirp.ravel().tolist()
    path = tmp_path / "adc_data.bin"
    kind = "<u2" if is_offset_binary else "<i2"
    (np.array(words) + 2**15 * is_offset_binary).astype(kind).tofile(path)
    layout = {"is_interleaved": is_interleaved, "is_offset_binary": is_offset_binary}
    for frame, parts in enumerate(counts):
        expected = parts[..., 0] + (1j * parts[..., 1] if is_complex else 0)
        found = read_ti_bin(path, frame, radar, **layout)
        assert found.dtype == (np.complex64 if is_complex else np.float32)
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(DataError, match=r"adc_data.bin has 3 frames of .* above 3:"):
        read_ti_bin(path, 3, radar, **layout)
    longer = radar.replace(num_samples=6, rx_m=RADAR.rx_m[:3])
    with pytest.raises(DataError, match=r"adc_data.bin has 2.66667 frames"):
        read_ti_bin(path, 0, longer, **layout)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rx_m": [(0, 0, 0), (0, 0.5, 0)]}, "rx_m is in meters; its spacing is 0.5,"),
        ({"rx_m": [(0.0, 0.0)]}, r"radar.rx_m\[0\] is missing"),
        ({"azimuth_rad": np.arange(-50.0, 51.0)}, "3.14159 radians .* from -50 to 50"),
        ({"carrier_hz": 77.0}, "carrier_hz is 77.0, expected a number of at least"),
        ({"slope_hz_per_s": 30.0}, "is 30.0, expected Hz per second .30 MHz/us are"),
        ({"sample_rate_hz": 10_000.0}, "_rate_hz is 10000.0, expected at least 3.2e"),
    ],
)
def test_wrong_radars_are_named(change, message):
    with pytest.raises(UserError, match=message) as error:
        RADAR.replace(**change)
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    ("num_tx", "dtype", "message"),
    [
        (2, complex, r"samples is \(16, 2, 4, 64\), expected \(16, 3, 4, 64\):"),
        (3, np.int16, "type of samples is 'int16', expected complex"),
    ],
)
def test_samples_of_other_radars_are_named(num_tx, dtype, message):
    with pytest.raises(UserError, match=message) as error:
        adc_to_power(np.zeros((16, num_tx, 4, 64), dtype), RADAR)
    assert not getattr(error.value, "__notes__", None)  # as JAX adds them inside of jit
    assert error.value.__cause__ is None


COUNTS = np.random.default_rng(0).integers(-300, 300, (2, *RADAR.shape), np.int16)
SAMPLES = COUNTS[0] + 1j * COUNTS[1]
WRAPPED = COUNTS.view(np.uint16)  # two's complement
REAL = RADAR.replace(is_complex=False)


@pytest.mark.parametrize(
    ("radar", "samples", "message"),
    [
        (
            RADAR,
            np.where(np.arange(16)[:, None, None, None] == 3, np.nan, SAMPLES),
            "number of samples that are not finite is 768, expected 0",
        ),
        (RADAR, 0 * SAMPLES, "all samples are 0: check"),
        (REAL, WRAPPED[0], "samples are unsigned, from 0 to 65535, exp"),
        (RADAR, WRAPPED[0] + 1j * WRAPPED[1], "unsigned, from 0 to 65535, "),
        (REAL, (COUNTS[0] + 2048).astype(np.uint16), "subtract the middle, such as"),
    ],
)
def test_samples_that_no_adc_records_are_named(radar, samples, message):
    with pytest.raises(UserError, match=message):
        adc_to_power(samples, radar)


@pytest.mark.parametrize("shape", [(2, 3), (12,), (3, 1)])
def test_calibrations_of_other_channels_are_named(shape):
    message = f"shape of calibration is {shape}, expected (3, 4): tx_m, rx_m"
    with pytest.raises(UserError, match=re.escape(message)):
        adc_to_power(SAMPLES, RADAR, np.ones(shape))
