"""Cross-sections, faces, occlusion, micro-Doppler and ghosts of objects."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from radejax.core.structures import CLASSES
from radejax.simulation.radar import scattering
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.scene import REFLECTOR_KINDS, Reflectors, SceneFrame

PARAMETERS = RadarParameters(pattern_exponent=0.0)
SIZES = {
    "Sedan": (4.6, 1.9, 1.5),
    "Bus or Truck": (9.0, 2.5, 3.0),
    "Pedestrian": (0.6, 0.6, 1.7),
    "Motorcycle": (2.1, 0.8, 1.5),
    "Bicycle": (1.8, 0.6, 1.6),
}


def make_frame(boxes, cls, velocity=None, *, index=0, tracks=None, reflectors=None):
    boxes = np.asarray(boxes, float).reshape(-1, 7)
    count, empty = len(boxes), np.zeros(0)
    if reflectors is None:
        reflectors = Reflectors(np.zeros((0, 3)), empty, empty, empty.astype(int))
    return SceneFrame(
        boxes=boxes,
        velocity_mps=np.zeros((count, 2)) if velocity is None else np.array(velocity),
        cls=np.array([CLASSES.index(c) for c in cls], int),
        track=np.arange(count) if tracks is None else np.array(tracks),
        ego_velocity_mps=np.zeros(2),
        reflectors=reflectors,
        reflector_idx=np.arange(len(reflectors.kind)),
        index=index,
    )


def centers_of(cls, count=1, seed=0):
    return centers_of_all([cls] * count, seed)


def centers_of_all(names, seed=0):
    classes = np.array([CLASSES.index(name) for name in names], int)
    sizes = np.array([SIZES[name] for name in names]).reshape(-1, 3)
    rng = np.random.default_rng(seed)
    return scattering.make_object_scatterers(classes, sizes, rng)


class TestCrossSection:
    @pytest.mark.parametrize("cls", CLASSES)
    def test_mean_and_spread_of_a_class(self, cls):
        law = scattering.CLASS_SCATTERING[cls]
        count = 400
        centers = centers_of(cls, count)
        angle = np.linspace(0, 2 * np.pi, 36, endpoint=False)
        cosine = centers.normal[:, :2] @ np.stack([np.cos(angle), np.sin(angle)])
        gain = scattering.face_gain(cosine, centers.glint[:, None])
        power = centers.power_m2 * gain.mean(1)
        rcs = np.bincount(centers.track, power)
        # Mean in square meters within the spread's statistical error.
        relative = np.sqrt(np.exp((law.spread_db * np.log(10) / 10) ** 2) - 1)
        limit = 4.0 * relative / np.sqrt(count) + 0.05
        assert rcs.mean() / 10 ** (law.rcs_dbsm / 10) == pytest.approx(1.0, abs=limit)
        assert np.std(10 * np.log10(rcs)) == pytest.approx(law.spread_db, rel=0.15)

    def test_flat_faces_flash_at_normal_incidence(self):
        cosine = np.cos(np.deg2rad([0.0, 3.0, 6.0, 30.0, 60.0]))
        gain = scattering.face_gain(cosine, np.full(5, 6.0))
        assert gain[0] == pytest.approx(7.02)
        assert gain[2] == pytest.approx(cosine[2] ** 2 + 6.0 / np.e + 0.02)
        assert (np.diff(gain) < 0).all()

    def test_faces_turned_away_return_next_to_nothing(self):
        gain = scattering.face_gain(np.array([-0.01, -1.0]), np.array([6.0, 6.0]))
        assert gain.max() < 0.03

    def test_centers_lie_on_the_faces(self):
        position = centers_of("Sedan", 5).position
        assert np.abs(position).max() <= 1.0
        flat = np.abs(position[:, :2]).max(1)
        np.testing.assert_allclose(flat, 1.0)

    def test_no_objects(self):
        nothing = centers_of_all([])
        found, lit = scattering.scatter_objects(make_frame([], []), nothing, PARAMETERS)
        assert len(found.power) == len(lit) == 0


def test_car_behind_a_truck_is_weak_and_unlit():
    truck = [15.0, 0.0, 0.6, 9.0, 2.5, 3.0, 0.0]
    car = [30.0, 0.0, -0.1, 4.6, 1.9, 1.5, 0.0]
    names = ["Bus or Truck", "Sedan"]
    centers = centers_of_all(names)
    both = make_frame([truck, car], names)
    alone = make_frame([car], ["Sedan"], tracks=[1])
    hidden, lit = scattering.scatter_objects(both, centers, PARAMETERS)
    free, lit_alone = scattering.scatter_objects(alone, centers, PARAMETERS)
    assert lit[1] < 0.05
    assert lit[0] == lit_alone[0] == 1.0
    drop = hidden.power[hidden.owner == 1].sum() / free.power.sum()
    assert 10 * np.log10(drop) == pytest.approx(scattering.OCCLUDED_DB, abs=0.5)


def at(position_m, velocity_mps=(0.0, 0.0), power=1.0):
    """Scatterers of one phase and owner."""
    position = np.array(position_m, float)
    count = len(position)
    velocity = np.broadcast_to(velocity_mps, (count, 2))
    rest = np.zeros(count), np.zeros(count, int)
    return scattering.FrameScattering(position, velocity, np.full(count, power), *rest)


class TestMotion:
    def test_range_rate_of_a_moving_target_seen_from_a_moving_ego(self):
        part = at([[30.0, 40.0, 0.0]], (2.0, 11.0))
        ego = np.array([12.0, 0.0])
        seen = scattering.to_scatterers(part, ego, PARAMETERS.wavelength_m)
        # (2 - 12, 11) . (0.6, 0.8) = -6 + 8.8
        assert seen.velocity_mps[0] == pytest.approx(2.8, abs=1e-5)
        assert seen.range_m[0] == pytest.approx(50.0)
        assert seen.azimuth_rad[0] == pytest.approx(-np.arctan2(40, 30))

    def test_amplitude_has_the_power_and_the_phase_of_the_way(self):
        wavelength = PARAMETERS.wavelength_m
        part = at([[20 * wavelength, 0, 0], [20.125 * wavelength, 0, 0]], power=4.0)
        seen = scattering.to_scatterers(part, np.zeros(2), PARAMETERS.wavelength_m)
        # An eighth of a wavelength farther: a quarter turn.
        np.testing.assert_allclose(seen.amplitude[0], [2.0, 0.0], atol=1e-3)
        np.testing.assert_allclose(seen.amplitude[1], [0.0, 2.0], atol=1e-3)
        assert np.abs(seen.amplitude[2:]).max() == 0.0

    def test_wheels_and_legs_spread_in_doppler_and_bodies_do_not(self):
        centers = centers_of("Pedestrian", 40)
        boxes = np.tile([15.0, 0.0, 0.0, 0.6, 0.6, 1.7, 0.0], (40, 1))
        walking = make_frame(boxes, ["Pedestrian"] * 40, [[1.4, 0.0]] * 40, index=4)
        found, _ = scattering.scatter_objects(walking, centers, PARAMETERS)
        speed = found.velocity_mps[:, 0]
        is_micro = centers.micro > 0
        np.testing.assert_allclose(speed[~is_micro], 1.4)
        assert speed[is_micro].std() > 0.3
        assert speed.min() >= 0.0
        assert speed.max() <= 2.8
        still = dataclasses.replace(walking, velocity_mps=np.zeros((40, 2)))
        found, _ = scattering.scatter_objects(still, centers, PARAMETERS)
        assert np.abs(found.velocity_mps).max() == 0.0


def test_walls_flash_when_seen_straight_on_and_hide_behind_vehicles():
    reflectors = Reflectors(
        np.array([[20.0, 0.1, 0.0], [20.0, 12.0, 0.0]]),
        np.zeros(2),
        np.array([np.pi, np.pi / 2]),  # facing us; parallel to the road
        np.full(2, REFLECTOR_KINDS.index("wall")),
    )
    empty = make_frame([], [], reflectors=reflectors)
    free = scattering.scatter_surroundings(empty, np.zeros(2), PARAMETERS)
    assert free.power[0] > 5.0 * free.power[1]
    truck = [10.0, 0.0, 0.0, 8.0, 2.5, 3.0, 0.0]
    frame = make_frame([truck], ["Bus or Truck"], reflectors=reflectors)
    hidden = scattering.scatter_surroundings(frame, np.zeros(2), PARAMETERS)
    loss = 10 * np.log10(hidden.power / free.power)
    np.testing.assert_allclose(loss, [scattering.OCCLUDED_DB, 0.0], atol=1e-9)


class TestGhosts:
    def test_mirror_image_position_velocity_and_loss(self):
        part = at([[20, 2, 0], [20, 8, 0], [90, 0, 0]], (3.0, -1.0))
        ghosts = scattering.scatter_ghosts(part, (6.0,))
        # Only the first: the second is behind the wall, the third too far.
        np.testing.assert_allclose(ghosts.position_m, [[20.0, 10.0, 0.0]])
        np.testing.assert_allclose(ghosts.velocity_mps, [[3.0, 1.0]])
        expected = 10 ** (scattering.MIRROR_DB / 10) * (404.0 / 500.0) ** 2
        assert ghosts.power[0] == pytest.approx(expected)
        assert ghosts.owner.tolist() == [-1]
