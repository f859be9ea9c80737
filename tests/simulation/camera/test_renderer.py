"""Drawn objects lie where labels and calibration say, to the pixel."""

import numpy as np
import pytest

from radejax.core.structures import CLASSES
from radejax.data.kradar import read_labels, write
from radejax.geometry.camera import CameraCalibration
from radejax.simulation.camera import lens
from radejax.simulation.camera import renderer as camera
from radejax.simulation.config import FULL_SIZE, SimulationOptions
from radejax.simulation.simulator import SequenceSimulator
from radejax.simulation.world.scene import Reflectors, Road, Sequence, Tracks
from radejax.simulation.world.traffic import make_sequence

FULL = SimulationOptions(**FULL_SIZE, label_distance_m=100.0)
PAIR = camera.stereo_calibration(FULL)


def make_scene(boxes, classes, *, time="day", weather="normal"):
    """A sequence of one frame with boxes `[N, 7]` in the radar's frame."""
    boxes = np.asarray(boxes, float)
    count = len(boxes)
    empty = np.zeros(0)
    return Sequence(
        name=1,
        environment="highway",
        time=time,
        weather=weather,
        ego_along_m=np.zeros(1),
        ego_speed_mps=np.zeros(1),
        tracks=Tracks(
            boxes[None, :, :3],
            boxes[None, :, 6],
            np.zeros((1, count, 2)),
            np.ones((1, count), bool),
            boxes[None, :, 3:6],
            np.array([CLASSES.index(c) for c in classes]),
            np.arange(count),
            tuple(classes),
        ),
        reflectors=Reflectors(np.zeros((0, 3)), empty, empty, empty.astype(int)),
        road=Road(),
        lanes_m=(-1.7, 1.7),
        ground_m=-0.9,
    )


def shown_boxes(boxes, classes, side=0):
    """Which box every pixel of one camera shows."""
    sequence = make_scene(boxes, classes)
    renderer = camera.CameraRenderer(sequence, FULL)
    return renderer.shown_boxes(sequence.frame(0), side)


def bounds(pixels):
    return np.concatenate([pixels.min(0), pixels.max(0)])


def mask_bounds(mask, box):
    v, u = np.nonzero(mask == box)
    return np.array([u.min(), v.min(), u.max() + 1, v.max() + 1])


def corners(box):
    unit = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    local = unit * np.array(box[3:6]) / 2
    c, s = np.cos(box[6]), np.sin(box[6])
    return local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + box[:3]


POSES = [
    ("Bus or Truck", [22.0, 4.0, 0.6, 9.0, 2.5, 3.0, 0.3]),
    ("Bus or Truck", [30.0, -6.0, 0.6, 8.0, 2.4, 3.0, 3.0]),
    ("Sedan", [15.0, -3.0, -0.15, 4.5, 1.9, 1.5, 0.1]),
    ("Sedan", [12.0, 3.0, -0.15, 4.5, 1.9, 1.5, -2.0]),
    ("Pedestrian", [8.0, 1.0, -0.05, 0.6, 0.6, 1.7, 1.0]),
    ("Motorcycle", [14.0, -2.0, -0.15, 2.1, 0.8, 1.5, 0.4]),
    ("Bicycle", [10.0, 2.0, -0.1, 1.8, 0.6, 1.6, -0.6]),
]


class TestLabelsProjectOntoObjects:
    @pytest.mark.parametrize(("cls", "box"), POSES)
    def test_drawn_object_fills_its_projected_box(self, cls, box):
        for side in (0, 1):
            pixels, _ = PAIR[side].project_ego(corners(box))
            expected = bounds(pixels)
            drawn = mask_bounds(shown_boxes([box], [cls], side), 0)
            size = expected[2:] - expected[:2]
            # Never outside, and up to the rim: rounded bodies leave at most a tenth.
            assert (drawn[:2] >= expected[:2] - 1.5).all()
            assert (drawn[2:] <= expected[2:] + 1.5).all()
            assert (np.abs(drawn - expected) < 1.5 + 0.14 * np.tile(size, 2)).all()

    def test_through_label_file_and_calibration_file(self, tmp_path):
        box = [25.0, 0.5, 0.6, 9.0, 2.5, 3.0, 0.0]
        sequence = make_scene([box], ["Bus or Truck"])
        simulator = SequenceSimulator(sequence, FULL)
        frame = sequence.frame(0)
        labels = simulator.labels(frame, simulator.radar_input(frame))
        write.write_labels(tmp_path / "1.txt", [1] * 5, 0.0, labels)
        (tmp_path / "cam.yml").write_text(PAIR[0].to_kradar_text())
        calibration = CameraCalibration.from_kradar(tmp_path / "cam.yml")
        read = read_labels(tmp_path / "1.txt")[0]
        assert read.visibility == "R"
        seen = corners(read.box) + calibration.radar_from_lidar_m
        pixels, _ = calibration.project_ego(seen)
        mask = camera.CameraRenderer(sequence, FULL).shown_boxes(frame, 0)
        np.testing.assert_allclose(mask_bounds(mask, 0), bounds(pixels), atol=1.5)

    def test_near_objects_hide_far_ones(self):
        near = [10.0, 0.0, -0.15, 4.5, 1.9, 1.5, 0.0]
        far = [30.0, 0.0, -0.15, 4.5, 1.9, 1.5, 0.0]
        mask = shown_boxes([far, near], ["Sedan", "Sedan"])
        pixel, _ = PAIR[0].project_ego(np.array([10.0 - 2.25, 0.0, -0.3]))
        assert mask[int(pixel[1]), int(pixel[0])] == 1

    def test_object_through_the_camera_plane_does_not_break(self):
        box = [-2.0, 2.5, 0.6, 12.0, 2.5, 3.0, 0.0]
        mask = shown_boxes([box], ["Bus or Truck"])
        assert 0.02 < (mask == 0).mean() < 0.5


class TestGround:
    def test_rays_and_projection_are_inverses(self):
        ground = camera.trace_ground(PAIR[0], -0.9)
        index = np.arange(0, len(ground.x_m), 997)
        near = index[ground.depth_m[index] < 60.0]
        x_m, y_m = ground.x_m[near], ground.y_m[near]
        points = np.stack([x_m, y_m, np.full(len(near), -0.9)], 1)
        pixels, _ = PAIR[0].project_ego(points)
        v, u = np.nonzero(ground.hits)
        np.testing.assert_allclose(pixels[:, 0], u[near] + 0.5, atol=0.05)
        np.testing.assert_allclose(pixels[:, 1], v[near] + 0.5, atol=0.05)


class TestImage:
    SMALL = SimulationOptions(image_width=160, image_height=90, seed=3)

    def render(self, weather, time="day", **kwargs):
        rng = np.random.default_rng(0)
        sequence = make_sequence(2, ("urban", time, weather), 2, rng)
        renderer = camera.CameraRenderer(sequence, self.SMALL.replace(**kwargs))
        return renderer, renderer.render(sequence.frame(1)), sequence

    def test_shape_and_bytes_repeat(self):
        _, first, _ = self.render("heavysnow")
        _, second, _ = self.render("heavysnow")
        assert first.shape == (90, 320, 3)
        assert first.dtype == np.uint8
        np.testing.assert_array_equal(first, second)

    def test_night_is_darker_and_fog_has_less_contrast(self):
        _, day, _ = self.render("normal")
        _, night, _ = self.render("normal", "night")
        _, fog, _ = self.render("fog", cover_lens=False)
        assert night.mean() < 0.5 * day.mean()
        rows = slice(38, 52)  # about the horizon
        assert fog[rows].std() < 0.85 * day[rows].std()

    @pytest.mark.parametrize("level", lens.LEVELS)
    def test_covered_lens_hides_detail(self, level, monkeypatch):
        monkeypatch.setattr(lens, "cover_level", lambda *a: level)
        _, image, _ = self.render("rain")
        _, clear, _ = self.render("rain", cover_lens=False)
        changed = np.abs(image.astype(int) - clear.astype(int)).max(-1) > 8
        limits = {"clear": (0.0, 0.0), "partial": (0.08, 0.5), "heavy": (0.5, 0.95)}
        low, high = limits.get(level, (0.8, 1.0))
        assert low <= changed.mean() <= high


class TestSilhouettes:
    def test_oracle_shows_only_objects_in_class_colors_brighter_when_nearer(self):
        boxes = [[40.0, 4.0, -0.15, 4.5, 1.9, 1.5, 0.2], POSES[2][1], POSES[4][1]]
        options, images = SimulationOptions(camera_mode="oracle"), []
        names = ["Sedan", "Sedan", "Pedestrian"]
        for time, weather in (("day", "normal"), ("night", "heavysnow")):
            sequence = make_scene(boxes, names, time=time, weather=weather)
            renderer = camera.CameraRenderer(sequence, options)
            frame = sequence.frame(0)
            images.append(renderer.render(frame))
        image, mask = images[0], renderer.shown_boxes(frame, 0)
        np.testing.assert_array_equal(images[1], image)
        np.testing.assert_array_equal(image[:, :320].any(-1), mask >= 0)
        left = image[:, :320]
        far, near, person = (np.unique(left[mask == i], axis=0) for i in range(3))
        assert len(far) == len(near) == len(person) == 1  # flat
        origin = camera.shapes.camera_position(renderer.calibrations[0])
        for color, channel, box in ((far, 0, 0), (near, 0, 1), (person, 2, 2)):
            depth = np.linalg.norm(np.array(boxes[box][:3]) - origin)
            expected = np.eye(3)[channel] * int(255 * 20 / (20 + depth))
            np.testing.assert_array_equal(color[0], expected)
        assert near[0, 0] > 1.4 * far[0, 0]
