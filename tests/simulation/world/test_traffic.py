"""Procedural sequences: consistent motion, free lanes, every class, seeds."""

import itertools

import numpy as np
import pytest

from radejax.geometry.rotated_iou import bev_intersection
from radejax.simulation.world.environments import ENVIRONMENTS
from radejax.simulation.world.scene import FRAME_PERIOD_S, Road
from radejax.simulation.world.traffic import make_sequence


def sequence(environment="urban", seed=0, num_frames=20, **options):
    rng = np.random.default_rng(seed)
    return make_sequence(1, (environment, "day", "normal"), num_frames, rng, **options)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
class TestEveryEnvironment:
    def test_velocities_are_the_motion_of_the_boxes(self, environment):
        tracks = sequence(environment).tracks
        moved = np.diff(tracks.position_m[..., :2], axis=0) / FRAME_PERIOD_S
        mean = (tracks.velocity_mps[1:] + tracks.velocity_mps[:-1]) / 2
        # Swaying in the lane is not in the velocity: 0.15 m x 0.7 rad/s.
        np.testing.assert_allclose(moved, mean, atol=0.35)

    def test_boxes_do_not_overlap(self, environment):
        for seed in range(3):
            boxes = sequence(environment, seed).frame(10).boxes
            vehicles = boxes[boxes[:, 3] > 1.5]
            pairs = np.array(list(itertools.combinations(range(len(vehicles)), 2)))
            area = bev_intersection(vehicles[pairs[:, 0]], vehicles[pairs[:, 1]])
            smaller = vehicles[:, 3:5].prod(1)[pairs].min(1)
            overlapping = (area > 0.3 * smaller).sum()
            assert overlapping <= 0.04 * len(vehicles) + 1

    def test_nothing_stands_in_the_ego_vehicle(self, environment):
        for seed in range(4):
            boxes = sequence(environment, seed).frame(0).boxes
            inside = (np.abs(boxes[:, 0] + 1.5) < 3.0) & (np.abs(boxes[:, 1]) < 0.9)
            vehicles = boxes[:, 3] > 1.5
            assert not (inside & vehicles).any()

    def test_boxes_stand_on_the_ground(self, environment):
        scene = sequence(environment)
        boxes = scene.frame(3).boxes
        np.testing.assert_allclose(boxes[:, 2] - boxes[:, 5] / 2, scene.ground_m)

    def test_same_seed_same_scene(self, environment):
        a, b, other = (sequence(environment, s) for s in (5, 5, 6))
        np.testing.assert_array_equal(a.tracks.position_m, b.tracks.position_m)
        np.testing.assert_array_equal(a.reflectors.rcs_dbsm, b.reflectors.rcs_dbsm)
        assert a.tracks.position_m.shape != other.tracks.position_m.shape or (
            np.abs(a.tracks.position_m - other.tracks.position_m).max() > 1.0
        )


def test_all_classes_and_sedans_everywhere():
    seen = set()
    for environment in ENVIRONMENTS:
        for seed in range(4):
            scene = sequence(environment, seed)
            cls = set(scene.tracks.cls.tolist())
            assert 0 in cls
            seen |= cls
    assert seen == set(range(5))


def test_traffic_goes_both_ways_and_parks():
    scene = sequence("urban", num_frames=2)
    frame = scene.frame(0)
    speed = frame.velocity_mps[:, 0]
    assert (speed > 3).any()
    assert (speed < -3).any()
    assert (np.abs(speed) < 1e-9).any()


def test_frame_is_the_world_seen_from_the_ego():
    scene = sequence("mountain")
    frame, pose = scene.frame(15), scene.ego_pose[15]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    world = frame.boxes[:, :2] @ np.array([[c, s], [-s, c]]) + pose[:2]
    np.testing.assert_allclose(world, scene.tracks.position_m[15, frame.track, :2])
    turned = frame.velocity_mps @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(turned, scene.tracks.velocity_mps[15, frame.track])


def test_road_is_a_circle_of_the_given_radius():
    x, y, heading = Road(0.01).position(np.array([0.0, 50.0, 100.0]), 0.0)
    np.testing.assert_allclose(np.hypot(x, y - 100.0), 100.0)
    np.testing.assert_allclose(heading, [0.0, 0.5, 1.0])
    x, y, _ = Road(0.01).position(np.array([100.0]), 2.0)
    assert np.hypot(x, y - 100.0) == pytest.approx(98.0)
    assert Road().position(np.array([7.0]), 2.0)[:2] == (7.0, 2.0)
