"""Panels of the roadside stand on the ground where the reflectors are."""

import numpy as np

from radejax.simulation.camera import panels
from radejax.simulation.world.scene import REFLECTOR_KINDS
from radejax.simulation.world.traffic import make_sequence


def test_rails_follow_the_road_and_trees_face_the_camera():
    scene = make_sequence(
        1, environment="highway", time="day", weather="normal", num_frames=2,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    frame = scene.frame(0)
    origin = np.array([-2.5, 0.3, 0.7])
    corners, depth, colors = panels.make_panels(frame, origin, -0.9, 0.0)
    assert corners.shape[1:] == (4, 3)
    assert len(corners) == len(depth) == len(colors) > 20
    assert corners[..., 2].min() == -0.9
    rails = frame.reflectors.kind == REFLECTOR_KINDS.index("rail")
    assert rails.any()
    width = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    is_rail = np.isclose(width, 2.1)
    along = (corners[is_rail, 1] - corners[is_rail, 0])[:, :2]
    assert np.abs(along[:, 1]).max() < 0.3  # the road is almost straight
    sight = corners[~is_rail].mean(1)[:, :2] - origin[:2]
    side = (corners[~is_rail, 1] - corners[~is_rail, 0])[:, :2]
    cosine = (sight * side).sum(1) / np.linalg.norm(sight, axis=1)
    walls = np.isclose(np.linalg.norm(side, axis=1), 6.4)
    np.testing.assert_allclose(cosine[~walls], 0.0, atol=1e-6)


def test_snow_whitens_trees():
    scene = make_sequence(
        1, environment="countryside", time="day", weather="normal", num_frames=2,
        rng=np.random.default_rng(1),
    )  # fmt: skip
    frame, origin = scene.frame(0), np.zeros(3)
    green = panels.make_panels(frame, origin, -0.9, 0.0)[2]
    white = panels.make_panels(frame, origin, -0.9, 0.9)[2]
    assert white.mean() > green.mean() + 20.0
