"""Faces of drawn objects: inside their boxes, sorted, cut at the camera."""

import numpy as np
import pytest

from radejax.core.structures import CLASSES
from radejax.simulation.camera import shapes
from radejax.simulation.camera.details import DETAILS, Faces
from radejax.simulation.camera.renderer import stereo_calibration
from radejax.simulation.config import SimulationOptions
from radejax.simulation.world.scene import Reflectors, SceneFrame

CALIBRATION = stereo_calibration(SimulationOptions())[0]
NO_ROADSIDE = Faces(*map(np.zeros, ((0, 4, 3), (0, 3), 0, 0)), np.zeros(0, int))
DAY = shapes.Light(1.0, np.full(3, 128.0), 0.0, False)


@pytest.mark.parametrize("cls", CLASSES)
def test_blocks_fill_the_box_and_stay_in_it(cls):
    corners = shapes.blocks_of(cls).reshape(-1, 3)
    assert np.abs(corners).max() <= 1.0
    assert corners[:, 2].min() == -1.0
    assert corners[:, 2].max() == 1.0
    np.testing.assert_allclose(np.abs(corners[:, 1]).max(), 1.0)


def polygons(boxes, classes):
    colors = np.zeros((len(boxes), 2, 3)) + 100.0
    count = len(boxes)
    nothing = np.zeros(0, int)
    frame = SceneFrame(
        boxes=np.array(boxes, float),
        velocity_mps=np.zeros((count, 2)),
        cls=np.array([CLASSES.index(name) for name in classes]),
        track=np.arange(count),
        ego_velocity_mps=np.zeros(2),
        reflectors=Reflectors(np.zeros((0, 3)), np.zeros(0), np.zeros(0), nothing),
        reflector_idx=nothing,
        index=0,
    )
    return shapes.visible_polygons(frame, colors, CALIBRATION, DAY, NO_ROADSIDE)


def test_far_objects_come_first_and_hidden_faces_are_omitted():
    near = [10.0, 0.0, -0.1, 4.5, 1.9, 1.5, 0.0]
    far = [30.0, 1.0, -0.1, 4.5, 1.9, 1.5, 0.0]
    found = polygons([near, far], ["Sedan", "Sedan"])
    depth = [p.depth_m for p in found]
    assert depth == sorted(depth, reverse=True)
    assert {p.box for p in found} == {0, 1}
    # Three blocks, of five faces at most three look at the camera, and their details.
    assert len([p for p in found if p.box == 0]) <= 9 + len(DETAILS["Sedan"])


def test_objects_behind_or_outside_the_image_are_omitted():
    behind = [-12.0, 0.0, -0.1, 4.5, 1.9, 1.5, 0.0]
    beside = [5.0, 60.0, -0.1, 4.5, 1.9, 1.5, 0.0]
    assert polygons([behind, beside], ["Sedan", "Sedan"]) == []
