"""The radar against theory: windows, bins, R^-4, interference, aliasing, noise."""

import jax
import numpy as np
import pytest

from radejax.data.projection import project_tensor
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar import propagation, tensor
from radejax.simulation.radar.scattering import received_power

from ... import small_models as small

GRID = RadarGrid.reduced(
    num_doppler=16, num_range=32, num_elevation=9, num_azimuth=24, max_range_m=31.0
)
PARAMETERS = tensor.RadarParameters(azimuth_elements=20.0, elevation_elements=12.0)
QUIET = np.zeros((32, 16), np.float32)


def points(range_m, azimuth=0.0, elevation=0.0, velocity=0.0, amplitude=1.0):
    """Scatterers of equal length from numbers or lists; amplitude may be complex."""
    numbers = range_m, azimuth, elevation, velocity, amplitude
    columns = np.broadcast_arrays(*map(np.atleast_1d, numbers))
    amplitude = columns[4].astype(complex)
    return tensor.Scatterers(
        *(c.astype(np.float32) for c in columns[:4]),
        np.stack([amplitude.real, amplitude.imag], -1).astype(np.float32),
    )


def tesseract(scatterers, *, noise=QUIET, grid=GRID, seed=(1,), **kwargs):
    kwargs = {"grid": grid, "parameters": PARAMETERS, "output": "tesseract"} | kwargs
    rows = tensor.simulate(scatterers, noise, tensor.frame_key(*seed), **kwargs)
    return np.asarray(rows, np.float64).transpose(tensor.TESSERACT_OF_ROWS)


@pytest.mark.parametrize("pedestal", [0.0, 0.08, 1.0])
def test_window_response_is_the_transform_of_the_window(pedestal):
    """Summed over the samples of the window."""
    offset = np.linspace(-9.7, 9.7, 195).astype(np.float32)
    response = tensor.window_response(offset, pedestal, 64.0)
    n = np.arange(64) - 63 / 2
    window = pedestal + (1 - pedestal) * np.cos(np.pi * n / 64) ** 2
    phase = np.exp(-2j * np.pi * np.multiply.outer(offset, n) / 64)
    expected = np.abs((phase * window).sum(-1)) / window.sum()
    np.testing.assert_allclose(np.abs(response), expected, atol=2e-6)


class TestPointTarget:
    def test_peaks_in_its_own_bin(self):
        for d, r, e, a in ((3, 10, 4, 11), (12, 20, 2, 5), (8, 5, 6, 18)):
            place = GRID.range_m[r], GRID.azimuth_rad[a], GRID.elevation_rad[e]
            power = tesseract(points(*place, GRID.doppler_mps[d], 3.0))
            assert np.unravel_index(power.argmax(), power.shape) == (d, r, e, a)
            assert power.max() == pytest.approx(9.0, rel=1e-5)

    @pytest.mark.parametrize("elements", [3.0, 12.0, 21.0, 48.0])
    @pytest.mark.parametrize("pedestal", [0.0, 0.2, 1.0])
    def test_beams_are_the_windows_transform(self, elements, pedestal):
        beams = np.linspace(-0.45, 0.45, 61)
        angle = np.linspace(-0.5, 0.5, 41).astype(np.float32)
        basis = tensor.array_basis(beams, elements, pedestal)
        pattern = basis @ tensor.array_signal(angle, elements, pedestal)
        x = (np.sin(beams)[:, None] - np.sin(angle)) * elements / 2.0
        expected = tensor.window_response(x.astype(np.float32), pedestal, elements)
        np.testing.assert_allclose(pattern, expected, atol=5e-6)


class TestPhysics:
    def test_twelve_db_per_doubling_of_range_and_ten_per_tenfold_cross_section(self):
        where = np.array([[20.0, 2.0, -0.3], [40.0, 4.0, -0.6]])
        power = received_power(where, np.array([100.0, 1.0]), PARAMETERS)
        assert 10 * np.log10(power[0] / power[1]) == pytest.approx(32.041, abs=1e-3)

    def test_aliasing_on_the_real_doppler_axis(self):
        grid = RadarGrid.kradar()
        # The axis repeats every 64 x 0.0604 = 3.865 m/s: 10 m/s is -1.595 m/s.
        response = np.abs(tensor.doppler_response(np.float32([10.0]), grid))[:, 0]
        assert grid.doppler_mps[response.argmax()] == pytest.approx(-1.595, abs=0.031)


class TestNoise:
    POWER = np.full((32, 16), 7.0, np.float32)
    NONE = points(10.0, amplitude=0.0)

    def test_is_exponential_with_the_given_mean(self):
        noise = tesseract(self.NONE, noise=self.POWER).ravel() / 7.0
        assert noise.mean() == pytest.approx(1.0, abs=4.0 / np.sqrt(noise.size))
        assert noise.std() == pytest.approx(1.0, abs=0.02)
        # Kolmogorov and Smirnov: distance from 1 - exp(-x).
        ranked = np.sort(noise)
        expected = 1.0 - np.exp(-ranked)
        distance = np.abs(np.arange(noise.size) / noise.size - expected).max()
        assert distance < 1.63 / np.sqrt(noise.size)  # 1 % level

    def test_frames_and_range_rows_are_independent(self):
        first = tesseract(self.NONE, noise=self.POWER)
        second = tesseract(self.NONE, noise=self.POWER, seed=(2,))
        limit = 8.0 / np.sqrt(first.size)  # neighbors in a row are not independent
        for a, b in ((first, second), (first[:, 1:], first[:, :-1])):
            assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < limit

    def test_neighbors_correlate_as_windows_and_arrays_say(self):
        # Powers of complex Gaussian noise correlate by the square of the field's
        # correlation, here summed over samples and antennas in float64.
        frames = (tesseract(self.NONE, noise=self.POWER, seed=(n,)) for n in range(6))
        noise = np.mean([self.correlations(power) for power in frames], axis=0)

        def field_correlation(count, pedestal, shift):
            n = np.arange(count) - (count - 1) / 2
            window = pedestal + (1 - pedestal) * np.cos(np.pi * n / count) ** 2
            phase = np.exp(2j * np.pi * n * shift / count)
            return ((window**2 * phase).sum() / (window**2).sum()).real

        a, b = np.sin(GRID.azimuth_rad[11:13])
        c, d = np.sin(GRID.elevation_rad[4:6])
        fields = (
            field_correlation(16, 0.0, 1.0),  # Hann: 2/3
            field_correlation(16, 0.0, 2.0),  # 1/6
            field_correlation(20, 0.2, (b - a) * 10),
            field_correlation(12, 0.2, (d - c) * 6),
        )
        expected = np.square(fields)
        np.testing.assert_allclose(expected[:2], [4 / 9, 1 / 36], atol=1e-12)
        np.testing.assert_allclose(noise, expected, atol=0.05)

    @staticmethod
    def correlations(power):
        """Doppler 1 and 2 bins apart, azimuth and elevation 1 bin near boresight."""
        pairs = (
            (power[1:], power[:-1]),
            (power[2:], power[:-2]),
            (power[..., 11], power[..., 12]),
            (power[:, :, 4], power[:, :, 5]),
        )
        return [np.corrcoef(x.ravel(), y.ravel())[0, 1] for x, y in pairs]

    def test_power_of_every_angle_bin_is_the_same(self):
        rows = tensor.array_basis(GRID.azimuth_rad, 21.0, 0.2)
        assert rows.shape == (24, 21)
        np.testing.assert_allclose(np.square(rows).sum(1), 1.0, rtol=1e-6)

    def test_profile_reaches_its_own_rows_and_doppler_bins(self):
        profile = np.full((32, 16), 1.0, np.float32)
        profile[20, 5] = 1000.0
        noise = tesseract(self.NONE, noise=profile)
        assert noise[5, 20].mean() == pytest.approx(1000.0, rel=0.3)
        noise[5, 20] = 1.0
        assert noise.max() < 30.0

    def test_adds_to_the_field_and_not_to_the_power(self):
        # With |s|^2 = 100 and noise of mean 1 the power varies by 2 s sqrt(1/2): a sum
        # of powers would vary by 1.
        rows = np.arange(4, 32, 4)
        place = GRID.range_m[rows], GRID.azimuth_rad[11], 0.0, GRID.doppler_mps[7]
        target, noise = points(*place, 10.0), np.ones((32, 16), np.float32)
        tensors = [tesseract(target, noise=noise, seed=(i,)) for i in range(22)]
        cells = [power[7, rows, 4, 11] for power in tensors]
        assert np.std(cells) == pytest.approx(20.0 * np.sqrt(0.5), rel=0.2)


def direct_tesseract(scatterers, grid, parameters):
    """The tensor from first principles: sums over samples and antennas, float64."""
    given = jax.tree.map(np.float64, scatterers)

    def transform(offset, num, pedestal):  # [bins, S] in bins of num samples
        n = np.arange(num) - (num - 1) / 2
        window = pedestal + (1 - pedestal) * np.cos(np.pi * n / num) ** 2
        phase = np.exp(2j * np.pi * offset[..., None] * n / num)
        return ((phase * window).sum(-1) / window.sum()).real

    def angle(axis, angles, num):
        sines = np.sin(axis)[:, None] - np.sin(angles)[None]
        return transform(sines * num / 2, int(num), parameters.array_pedestal)

    step = grid.doppler_mps[1] - grid.doppler_mps[0]
    wrapped = (grid.doppler_mps[:, None] - given.velocity_mps) / step
    wrapped = (wrapped + 8) % 16 - 8
    doppler = transform(wrapped, 16, 0.0)
    many = 4096  # a long chirp: the crop of its spectrum that the axis shows
    offset = (grid.range_m[:, None] - given.range_m) / grid.range_step_m
    ranges = transform(offset, many, 0.0)
    azimuth = angle(grid.azimuth_rad, given.azimuth_rad, 20)
    elevation = angle(grid.elevation_rad, given.elevation_rad, 12)
    amplitude = given.amplitude @ [1.0, 1j]
    axes = doppler, ranges, elevation, azimuth
    field = np.einsum("s,ds,rs,es,as->drea", amplitude, *axes)
    return np.abs(field) ** 2


class TestOutputs:
    def test_equals_the_sum_over_samples_and_antennas(self):
        rng = np.random.default_rng(1)
        scene = points(
            rng.uniform(3, 28, 12), rng.uniform(-0.8, 0.8, 12),
            rng.uniform(-0.2, 0.2, 12), rng.normal(0, 5, 12),
            rng.normal(size=12) + 1j * rng.normal(size=12),
        )  # fmt: skip
        expected = direct_tesseract(scene, GRID, PARAMETERS)
        atol = 1e-4 * expected.max()
        np.testing.assert_allclose(tesseract(scene), expected, atol=atol)

    NOISE = np.full((32, 16), 1e9, np.float32)

    def scene(self):
        rng = np.random.default_rng(0)
        return points(
            rng.uniform(3, 30, 64), rng.uniform(-0.9, 0.9, 64),
            rng.uniform(-0.2, 0.2, 64), rng.normal(0, 5, 64),
            1e6 * (rng.normal(size=64) + 1j * rng.normal(size=64)),
        )  # fmt: skip

    def projection(self, key):
        options = {"grid": GRID, "parameters": PARAMETERS}
        return tensor.simulate(self.scene(), self.NOISE, key, **options)

    def test_projection_equals_the_projected_tesseract(self):
        power = tesseract(self.scene(), noise=self.NOISE)
        fused = self.projection(tensor.frame_key(1))
        expected = project_tensor(power.astype(np.float32))
        np.testing.assert_allclose(fused, expected, rtol=0, atol=2e-6)

    def test_vmap_over_frames(self):
        keys = np.stack([tensor.frame_key(i) for i in range(2)])

        batch = jax.vmap(self.projection)(keys)
        np.testing.assert_allclose(batch[1], self.projection(keys[1]), atol=1e-5)

    def test_dropping_the_weakest_scatterers_changes_little(self):
        few = PARAMETERS.replace(max_scatterers_per_row=40)
        all_power = tesseract(self.scene(), noise=self.NOISE)
        some_power = tesseract(self.scene(), noise=self.NOISE, parameters=few)
        error = np.abs(some_power - all_power).max() / all_power.max()
        assert 0 < error < 1e-3


class TestOtherSensors:
    def test_an_echo_is_in_the_bins_of_uneven_axes(self):
        grid = small.uneven_grid(range_m=np.geomspace(4.0, 60.0, 40))
        quiet = np.zeros((40, 4), np.float32)
        given = points(grid.range_m[30], grid.azimuth_rad[3], 0.0, grid.doppler_mps[1])
        power = tesseract(given, noise=quiet, grid=grid)
        assert power.shape == grid.shape_drea == (4, 40, 1, 14)
        strongest = np.unravel_index(power.argmax(), power.shape)
        assert strongest == (1, 30, 0, 3)
        np.testing.assert_allclose(power.max(), 1.0, rtol=1e-4)
        # The main lobe is four bins wide, whatever their width.
        lobe = power[1, :, 0, 3]
        assert lobe[27] < 0.05 < lobe[29] < 0.5
        projection = tensor.simulate(
            given, quiet, tensor.frame_key(1), grid=grid, parameters=PARAMETERS
        )
        expected = project_tensor(power.astype(np.float32))[..., :4]
        np.testing.assert_allclose(projection, expected, atol=2e-4)

    @pytest.mark.parametrize("doppler_mps", [[], [0.0]])
    def test_one_doppler_bin_has_all_velocities(self, doppler_mps):
        grid = small.uneven_grid(
            elevation_rad=np.array([-0.1, 0.0, 0.1]), doppler_mps=np.array(doppler_mps)
        )
        quiet = np.zeros((16, 1), np.float32)
        given = points(grid.range_m[10], grid.azimuth_rad[3], 0.0, [3.0])
        power = tesseract(given, noise=quiet, grid=grid)
        np.testing.assert_allclose(power.max(), 1.0, rtol=1e-4)
        projection = tensor.simulate(
            given, quiet, tensor.frame_key(1), grid=grid, parameters=PARAMETERS
        )
        assert projection.shape == grid.projection_shape
        noise = propagation.noise_profile("fog", grid, PARAMETERS, np.zeros(2))
        assert noise.shape == (16, 1)
        assert (noise > 10.0 ** (PARAMETERS.noise_db / 10)).all()


def test_a_scanning_antenna_sees_all_around_with_its_beam():
    """The noise of azimuths is independent, and the beam does not widen off boresight."""
    grid = RadarGrid(
        range_m=GRID.range_m,
        azimuth_rad=np.linspace(-np.pi, np.pi, 360, endpoint=False),
        elevation_rad=np.array([]),
        doppler_mps=np.array([0.0]),
        fov_range_m=31.0,
        fov_azimuth_rad=np.pi,
    )
    width = np.deg2rad(4.0)
    scanning = PARAMETERS.replace(scan_beamwidth_rad=width)
    options = {"grid": grid, "parameters": scanning, "noise": np.zeros((32, 1), "f4")}
    for azimuth in np.deg2rad([-180.0, 0.0, 115.0]):
        power = tesseract(points(10.0, azimuth), **options)[0, 10, 0]
        peak = int(np.abs(grid.azimuth_rad - azimuth).argmin())
        assert power.argmax() == peak
        halves = power[[peak - 2, (peak + 2) % 360]] / power.max()
        np.testing.assert_allclose(halves, 0.25, rtol=0.1)  # on the way there and back
        assert power[(peak + 90) % 360] < 1e-9
    options["noise"] = np.ones((32, 1), "f4")
    noise = tesseract(points(10.0, amplitude=0.0), **options)[0, :, 0]
    assert noise.mean() == pytest.approx(1.0, rel=0.05)
    assert abs(np.corrcoef(noise[:, :-1].ravel(), noise[:, 1:].ravel())[0, 1]) < 0.05
