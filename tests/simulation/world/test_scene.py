"""World to ego, and what a frame leaves out."""

import numpy as np
import pytest

from radejax.simulation.world import scene


@pytest.mark.parametrize(
    ("angle", "expected"), [(np.pi, -np.pi), (3.5 * np.pi, -0.5 * np.pi), (0.3, 0.3)]
)
def test_wrap_angle(angle, expected):
    assert scene.wrap_angle(angle) == pytest.approx(expected)


def test_groups_count_as_their_single_class():
    assert scene.class_index("Pedestrian Group") == scene.class_index("Pedestrian") == 2
    with pytest.raises(ValueError, match="Tram"):
        scene.class_index("Tram")


def test_points_seen_from_a_turned_ego_by_hand():
    # At (10, 5), heading left: what is 3 m along +y in the world is 3 m ahead.
    pose = np.array([10.0, 5.0, np.pi / 2])
    points = np.array([[10.0, 8.0, 0.5], [9.0, 5.0, 0.0]])
    seen = scene._to_ego(points, pose)
    np.testing.assert_allclose(seen, [[3.0, 0.0, 0.5], [0.0, 1.0, 0.0]], atol=1e-12)
