"""Windows, wheels and lights lie on their faces and inside their boxes."""

from __future__ import annotations

import numpy as np
import pytest

from radejax.core.structures import CLASSES
from radejax.simulation.camera import details, shapes
from radejax.simulation.world.scene import REFLECTOR_KINDS
from radejax.simulation.world.traffic import make_sequence


def test_rectangle_on_a_slanted_face_by_hand():
    # A face 4 wide below, 2 wide above, 2 high: at half height it reaches from 0.5 to 3.5.
    face = np.array([[[0.0, 0, 0], [4, 0, 0], [3, 0, 2], [1, 0, 2]]])
    found = details.on_faces(face, np.array([[0.0, 0.5]]), np.array([[0.5, 1.0]]))
    expected = [[0.5, 0, 1], [2.0, 0, 1], [2.0, 0, 2], [1.0, 0, 2]]
    np.testing.assert_allclose(found[0], expected)


@pytest.mark.parametrize("cls", CLASSES)
def test_details_stay_in_the_box(cls):
    corners = shapes.blocks_of(cls)
    for detail in details.DETAILS[cls]:
        face = corners[detail.block][shapes._VERTICES[detail.face]][None]
        quad = details.on_faces(face, np.array([detail.u]), np.array([detail.v]))
        assert np.abs(quad).max() <= 1.0 + 2e-2, detail


def frame_of(environment, seed):
    rng = np.random.default_rng(seed)
    return make_sequence(1, (environment, "day", "normal"), 2, rng).frame(0)


def test_rails_follow_the_road_and_trees_face_the_camera():
    frame = frame_of("highway", 0)
    origin = np.array([-2.5, 0.3, 0.7])
    corners, colors, depth, _, box = details.make_panels(frame, origin, -0.9, 0.0)
    assert (box == -1).all()
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
    frame, origin = frame_of("countryside", 1), np.zeros(3)
    green = details.make_panels(frame, origin, -0.9, 0.0).color
    white = details.make_panels(frame, origin, -0.9, 0.9).color
    assert white.mean() > green.mean() + 20.0
