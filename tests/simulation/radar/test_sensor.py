"""The realistic sensor: sizes of its effects, and their ranges over sequences."""

from __future__ import annotations

import numpy as np
import pytest

from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.config import SimulationOptions
from radejax.simulation.radar import propagation, sensor, tensor
from radejax.simulation.radar.tensor import DRAWN, RadarParameters
from radejax.simulation.simulator import SequenceSimulator, make_source

from .test_tensor import points

GRID = RadarGrid.reduced(
    num_doppler=16, num_range=64, num_elevation=9, num_azimuth=56, max_range_m=118.0
)


def simulators(count, **changes):
    config = SimulationOptions(train_sequences=count, test_sequences=0, **changes)
    source = make_source(config)
    for number in source.numbers:
        yield SequenceSimulator(source.make(number), config)


def state_of(seed=0, **changes):
    parameters = RadarParameters(**changes)
    return sensor.draw_state(GRID, parameters, np.random.default_rng(seed))


class TestDraws:
    def test_every_sequence_has_its_own_values_within_the_ranges(self):
        first, second = simulators(2)
        ranges = first.parameters.ranges
        assert {name for name, _, _ in ranges} == DRAWN
        for name, low, high in ranges:
            values = [getattr(made.drawn, name) for made in (first, second)]
            if name == "gain_db":  # 16 Doppler bins integrate a quarter of 64
                values = [value + 10.0 * np.log10(4.0) for value in values]
            assert low <= min(values) < max(values) <= high
        phases = [made._state.azimuth_phase_rad for made in (first, second)]
        assert (phases[0] != phases[1]).all()

    def test_frames_of_one_sequence_share_them_and_programs_are_shared_by_all(self):
        made, again = next(simulators(1)), next(simulators(1))
        assert made.drawn == again.drawn
        given = made.radar_input(made.sequence.frame(1))
        states = (made._state, given.state, again._state)
        phases = [state.elevation_phase_rad for state in states]
        np.testing.assert_array_equal(phases, [phases[0]] * 3)
        assert len({m.parameters for m in simulators(3)}) == 1  # static arguments

    def test_an_ideal_sensor_has_no_state(self):
        config = SimulationOptions(radar={"preset": "ideal"})
        assert config.radar.make_parameters() == RadarParameters()
        assert state_of() is None


class TestNoise:
    def profile_db(self, grid, **changes):
        parameters = RadarParameters(noise_db=0.0, **changes)
        mean = sensor.receiver_noise(grid, parameters).mean(1)
        return 10.0 * np.log10(mean)

    def test_profile_has_the_leak_the_dip_the_decay_and_the_rise(self):
        grid = RadarGrid.kradar()
        profile = self.profile_db(grid, range_profile=1.0)

        def median(low, high):
            return np.median(profile[(grid.range_m >= low) & (grid.range_m < high)])

        assert profile[0] == pytest.approx(45.0, abs=0.1)
        assert median(0, 1) == pytest.approx(12.0, abs=1.0)
        assert median(1, 5) == pytest.approx(4.0, abs=2.0)
        assert median(5, 10) == pytest.approx(-5.0, abs=0.5)
        assert abs(median(30, 95)) < 0.01
        assert median(107, 114) == pytest.approx(-4.0, abs=1.0)
        assert profile[-1] == pytest.approx(11.0, abs=0.1)

    def test_gain_of_the_receiver_moves_noise_and_echoes(self):
        sensors = RadarParameters(), RadarParameters(receiver_db=10.0)
        still = np.zeros(2)
        low, high = (propagation.noise_profile("rain", GRID, s, still) for s in sensors)
        np.testing.assert_allclose(high, 10.0 * low, rtol=1e-5)

    def test_leak_is_in_the_doppler_bin_of_velocity_zero(self):
        power = sensor.receiver_noise(GRID, RadarParameters(range_profile=1.0))
        still = np.abs(GRID.doppler_mps).argmin()
        assert (power[0].argmax(), power[-1].argmax()) == (still, still)
        assert power[0].max() > 1e4 * np.median(power[0])

    def test_window_of_echoes_is_that_of_the_noise(self):
        # 4/9 is the Hann window: half the amplitude one bin away, none two bins away.
        state = state_of(range_correlation=4.0 / 9.0)
        assert state.range_side == pytest.approx(0.5, abs=1e-3)
        assert state.range_pedestal == pytest.approx(0.0, abs=1e-3)
        flat = state_of(range_correlation=0.3)
        response = tensor.window_response(np.float32([1.0]), float(flat.range_pedestal))
        assert response[0] == pytest.approx(float(flat.range_side), abs=1e-5)


class TestLeakage:
    @pytest.mark.parametrize("elements", [12.0, 41.0])
    def test_mean_level_is_as_wanted_and_the_peak_remains(self, elements):
        beams = np.linspace(-0.9, 0.9, 91)
        basis = tensor.array_basis(beams, elements, 0.5)
        fields = {"leakage": 0.04, "array_pedestal": 0.5}
        parameters = RadarParameters(azimuth_elements=elements, **fields)
        power = []
        for seed in range(100):
            state = sensor.draw_state(GRID, parameters, np.random.default_rng(seed))
            phase = state.azimuth_phase_rad
            signal = tensor.array_signal(np.float32([beams[20]]), elements, 0.5, phase)
            power.append(np.square(basis @ np.asarray(signal)[:, 0]))
        assert np.array(power)[:, 20] == pytest.approx(1.0, abs=1e-4)
        away = np.array(power)[:, 60:]
        assert 10 * np.log10(away.mean()) == pytest.approx(-14.0, abs=1.0)
        assert away.mean(1).max() < 5.0 * away.mean()  # also in the worst sequence

    def test_pattern_moves_with_the_target(self):
        state = state_of(leakage=0.05)
        sines = np.linspace(-0.8, 0.8, 81)  # steps of 0.02
        basis = tensor.array_basis(np.arcsin(sines), 48.0, 0.2)

        def pattern(index):
            angle = np.float32([np.arcsin(sines[index])])
            signal = tensor.array_signal(angle, 48.0, 0.2, state.azimuth_phase_rad)
            return basis @ np.asarray(signal)[:, 0]

        np.testing.assert_allclose(pattern(30)[:-10], pattern(40)[10:], atol=1e-4)

    def test_an_echo_fills_its_range_row(self):
        parameters = RadarParameters(leakage=0.05)
        target = points(GRID.range_m[20], 0.2, 0.0, GRID.doppler_mps[3], 1e3)
        silence = np.zeros((64, 16), np.float32)
        options = {"grid": GRID, "parameters": parameters, "output": "tesseract"}

        def row(state):
            given = target, silence, tensor.frame_key(1), state
            return np.asarray(tensor.simulate(*given, **options))[20].mean((0, 1))

        ideal, real = row(None), row(state_of(3, leakage=0.05))
        away = np.abs(GRID.azimuth_rad - 0.2) > np.deg2rad(10.0)
        levels = [10 * np.log10(np.median(r[away]) / r.max()) for r in (ideal, real)]
        assert levels[0] < -30.0
        assert -24.0 < levels[1] < -8.0


def test_high_pass_by_hand():
    # Half the power at the corner; 12 dB less per halving of the range far below it.
    factor = sensor.high_pass(np.array([15.0, 1.0, 0.5, 1e3]), 15.0)
    assert factor[0] == 0.5
    assert 10 * np.log10(factor[1] / factor[2]) == pytest.approx(12.04, abs=0.01)
    assert factor[3] == pytest.approx(1.0, abs=1e-6)
    assert (sensor.high_pass(np.array([3.0, 9.0]), 0.0) == 1.0).all()


class TestGroundClutter:
    def clutter(self, speed_mps, **changes):
        values = {"ground_clutter": 0.0004, "gain_db": 209.0, "noise_db": 109.0}
        parameters, grid = RadarParameters(**values | changes), RadarGrid.kradar()
        ego = np.array([speed_mps, 0.0])
        noise = propagation.noise_profile("normal", grid, parameters, ego)
        return noise / 10.0**10.9 - 1.0  # above the noise

    def test_fills_the_zero_doppler_bins_near_a_standing_car(self):
        above = self.clutter(0.0, high_pass_m=15.0)
        grid = RadarGrid.kradar()
        still = np.abs(grid.doppler_mps).argmin()
        near = (grid.range_m > 8.0) & (grid.range_m < 20.0)
        assert (10 * np.log10(above[near, still]) > 8.0).all()
        assert above[near][:, still + 3].max() < 0.01
        assert above[200, still] < 1.0

    def test_moves_with_the_speed_and_keeps_its_power(self):
        rows = [self.clutter(speed)[40] for speed in (0.0, 1.0, 15.0)]
        sums = [row.sum(dtype=np.float64) for row in rows]
        np.testing.assert_allclose(sums, sums[0], rtol=2e-3)
        # From straight ahead to 53 degrees aside, 1 m/s approaches by 1 to 0.6 m/s.
        doppler = RadarGrid.kradar().doppler_mps
        moving = doppler[rows[1] > 0.1 * rows[1].max()]
        assert (moving.min(), moving.max()) == pytest.approx((-1.0, -0.6), abs=0.1)


def test_statistics_of_the_coarse_sensor_are_near_those_of_the_real_map():
    """The limits are those for full-size frames, where the coarse grid has the bins."""
    levels, leakage, states = [], [], []
    for made in simulators(5):
        given = made.radar_input(made.sequence.frame(0))
        level = 10.0 * np.log10(made.run(given, "tesseract").mean((0, 2)))
        noise = np.median(level[25:54])  # 30 to 65 m
        levels.append([noise, *(np.median(level[[0, 1, 5, 60]], axis=1) - noise)])
        states.append(made.drawn)
        excess = 10 ** (level / 10) - 10 ** (noise / 10)
        above = np.where(np.arange(64)[:, None] > 8, level - noise, -9.0)
        row, column = np.unravel_index(above.argmax(), above.shape)
        angle = made.grid.azimuth_rad
        far = np.abs(angle - angle[column]) > np.deg2rad(10.0)
        ratio = np.median(excess[row, far]) / excess[row, column]
        leakage.append(10 * np.log10(max(ratio, 1e-6)))
    noise, first, second, dip, end = np.median(levels, axis=0)
    assert 107.0 < noise < 111.0
    assert min(row[0] for row in levels) > 107.0
    assert first > 30.0
    assert 1.0 < second < 9.0
    assert -6.0 < dip < 6.0
    assert -7.0 < end < -2.0
    assert -20.0 < np.median(leakage) < -9.0
    assert len(set(states)) == 5
