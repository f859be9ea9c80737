"""Walls and ghosts."""

import numpy as np
import pytest

from radejax.simulation.radar import clutter, scattering
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.scene import REFLECTOR_KINDS, Reflectors, SceneFrame


def frame_with(boxes=(), reflectors=None):
    boxes = np.asarray(boxes, float).reshape(-1, 7)
    count, empty = len(boxes), np.zeros(0)
    if reflectors is None:
        reflectors = Reflectors(np.zeros((0, 3)), empty, empty, empty.astype(int))
    return SceneFrame(
        boxes=boxes,
        velocity_mps=np.zeros((count, 2)),
        cls=np.zeros(count, int),
        track=np.arange(count),
        track_id=np.arange(count),
        ego_velocity_mps=np.zeros(2),
        reflectors=reflectors,
        reflector_idx=np.arange(len(reflectors.kind)),
        index=0,
        time_s=0.0,
        ego_along_m=0.0,
    )


def test_walls_flash_when_seen_straight_on_and_hide_behind_vehicles():
    reflectors = Reflectors(
        np.array([[20.0, 0.1, 0.0], [20.0, 12.0, 0.0]]),
        np.zeros(2),
        np.array([np.pi, np.pi / 2]),  # facing us; parallel to the road
        np.full(2, REFLECTOR_KINDS.index("wall")),
    )
    parameters = RadarParameters(pattern_exponent=0.0)
    free = clutter.scatter_surroundings(
        frame_with(reflectors=reflectors), np.zeros(2), parameters
    )
    assert free.power[0] > 5.0 * free.power[1]
    truck = [10.0, 0.0, 0.0, 8.0, 2.5, 3.0, 0.0]
    hidden = clutter.scatter_surroundings(
        frame_with([truck], reflectors), np.zeros(2), parameters
    )
    loss = 10 * np.log10(hidden.power / free.power)
    np.testing.assert_allclose(loss, [scattering.OCCLUDED_DB, 0.0], atol=1e-9)


PARAMETERS = RadarParameters(pattern_exponent=0.0)


class TestGhosts:
    def test_mirror_image_position_velocity_and_loss(self):
        part = scattering.FrameScattering(
            np.array([[20.0, 2.0, 0.0], [20.0, 8.0, 0.0], [90.0, 0.0, 0.0]]),
            np.array([[3.0, -1.0]] * 3),
            np.ones(3),
            np.zeros(3),
            np.zeros(3, int),
        )
        ghosts = clutter.scatter_ghosts(part, (6.0,))
        # Only the first: the second is behind the wall, the third too far.
        np.testing.assert_allclose(ghosts.position_m, [[20.0, 10.0, 0.0]])
        np.testing.assert_allclose(ghosts.velocity_mps, [[3.0, 1.0]])
        expected = 10 ** (clutter.MIRROR_DB / 10) * (404.0 / 500.0) ** 2
        assert ghosts.power[0] == pytest.approx(expected)
        assert ghosts.owner.tolist() == [-1]

    def test_without_walls_no_ghosts(self):
        part = scattering.FrameScattering(
            np.ones((1, 3)), np.ones((1, 2)), np.ones(1), np.zeros(1), np.zeros(1, int)
        )
        ghosts = clutter.scatter_ghosts(part, ())
        assert len(ghosts.power) == 0
