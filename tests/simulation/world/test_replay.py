"""Scenes from label files: boxes stay the labels', motion is theirs, splits are K-Radar's."""

import math

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.data.kradar import KRadar, motion, read_labels, write
from radejax.data.kradar.labels import Label
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset
from radejax.simulation.simulator import LabelSource
from radejax.simulation.world import replay

OFFSET = (-2.54, 0.3, 0.7)
NUM_FRAMES = 16
GRID = {"num_doppler": 8, "num_range": 32, "num_elevation": 5, "num_azimuth": 24}


def boxes_at(i):
    """Ego at 10 m/s: a parked car, one ahead at 12 m/s, one oncoming at 8 m/s."""
    t = 0.1 * i
    return [
        Label("Sedan", (30.0 - 10.0 * t, -5.0, -0.8, 4.5, 1.9, 1.6, 0.02), "R", 7),
        Label("Sedan", (20.0 + 2.0 * t, 0.0, -0.8, 4.6, 1.9, 1.5, 0.0), "R", 8),
        Label("Bus or Truck", (60 - 18 * t, 4.0, 0.0, 9.0, 2.5, 3.0, math.pi), "R", 8),
        Label("Pedestrian", (12.0, -8.0, -0.7, 0.6, 0.6, 1.7, 1.0), "L", -1),
        Label("Pedestrian Group", (25.0, -9.0, -0.7, 2.0, 2.0, 1.7, 1.0), "R", 9),
    ]


@pytest.fixture
def labels_folder(tmp_path):
    folder = tmp_path / "labels"
    for number in (3, 7):
        for i in range(NUM_FRAMES):
            name = f"{i + 31:05d}_{i + 1:05d}.txt"
            indices = (i + 31, i + 1, i + 5, i + 9, i + 11)
            path, time_s = folder / str(number) / name, 1.6e9 + 0.1 * i
            write.write_labels(path, indices, time_s, boxes_at(i))
    return folder


def make_config(folder, **changes):
    fields = {
        "scenes": str(folder),
        "frames_per_sequence": 0,
        "image_width": 0,
        "output": "projection",
        "grid": GRID,
    }
    return SimulationOptions(**fields | changes)


@pytest.fixture
def source(labels_folder):
    return LabelSource(make_config(labels_folder))


class TestScene:
    def test_objects_have_the_labels_boxes(self, source):
        scene = source.make(3)
        frame = scene.frame(5)
        cls, ids = scene.tracks.label_cls, scene.tracks.track_id
        tracks = zip(frame.track, frame.boxes, strict=True)
        boxes = {(cls[t], int(ids[t])): box for t, box in tracks}
        assert len(boxes) == 5
        for label in boxes_at(5):
            expected = np.array(label.box) + np.array([*OFFSET, 0, 0, 0, 0])
            found = boxes[(label.cls, label.track_id)]
            np.testing.assert_allclose(found[:6], expected[:6], atol=1e-9)
            assert math.cos(found[6] - expected[6]) == pytest.approx(1.0)

    def test_velocities_are_the_labels_motion(self, source):
        scene = source.make(3)
        frame = scene.frame(7)
        relative = frame.velocity_mps - frame.ego_velocity_mps
        cls, ids = scene.tracks.label_cls, scene.tracks.track_id
        tracks = zip(frame.track, relative, strict=True)
        found = {(cls[t], int(ids[t])): v[0] for t, v in tracks}
        expected = {("Bus or Truck", 8): -18, ("Sedan", 7): -10}
        for track, velocity in (expected | {("Pedestrian Group", 9): 0}).items():
            assert found[track] == pytest.approx(velocity, abs=1e-4)

    def test_ego_speed_is_that_at_which_parked_cars_stand(self, source):
        speed = source.make(3).ego_speed_mps
        np.testing.assert_allclose(speed, 10.0, atol=1e-4)

    def test_ids_of_two_classes_are_two_tracks_and_no_id_is_one_frame(self, source):
        tracks = source.make(3).tracks
        assert (tracks.track_id == 8).sum() == 2
        assert (tracks.track_id == -1).sum() == NUM_FRAMES
        assert (tracks.is_present.sum(0)[tracks.track_id == -1] == 1).all()

    def test_swapped_identity_is_not_taken_for_speed(self, source):
        tracks = source.make(3).tracks
        tracks.position_m[8, tracks.track_id == 7] += [500.0, 0.0, 0.0]
        clock = 0.1 * np.arange(NUM_FRAMES)
        relative = replay.relative_velocity(tracks, clock)
        assert np.abs(relative).max() < motion.MAX_SPEED_MPS


class TestWrittenTree:
    def test_labels_out_are_labels_in(self, labels_folder, tmp_path):
        config = make_config(labels_folder, sequences=[7])
        root = simulate_dataset(config, tmp_path / "out", progress=False)
        written = sorted((root / "7" / "info_label_v2_1").iterdir())
        assert len(written) == NUM_FRAMES
        for i, path in enumerate(written):
            original = labels_folder / "7" / path.name
            lines, given_lines = (p.read_text().splitlines() for p in (path, original))
            assert lines[0] == given_lines[0]
            given = {(x.cls, x.track_id): x.box for x in boxes_at(i)}
            for label in read_labels(path):
                expected = given[(label.cls, label.track_id)]
                np.testing.assert_allclose(label.box[:6], expected[:6], atol=1e-9)
        data = KRadar(root, visibility=None)
        assert data[0].projection_path.name == "DERA_tesseract_00031.npy"
        assert np.load(data[0].projection_path).shape == (13, 32, 24)

    def test_split_is_by_quarters(self, source):
        splits = [spec.split for spec in source.frames(3)]
        assert splits == ["train"] * 4 + ["test"] * 4 + ["train"] * 4 + ["test"] * 4

    def test_stride_and_number_of_frames(self, labels_folder):
        config = make_config(labels_folder, frame_stride=3, frames_per_sequence=4)
        source = LabelSource(config)
        assert [s.scene_idx for s in source.frames(3)] == [0, 3, 6, 9]
        assert source.frames(3)[1].indices == (34, 4, 8, 12, 14)

    @pytest.mark.parametrize("stride", [1, 2])
    @pytest.mark.parametrize("count", [1, 2, 3, 5, 9])
    def test_few_frames_are_in_both_splits(self, labels_folder, count, stride):
        whole = make_config(labels_folder, frame_stride=stride)
        specs = LabelSource(whole.replace(frames_per_sequence=count)).frames(3)
        assert len(specs) == min(count, NUM_FRAMES // stride)
        assert {s.split for s in specs} == {"train", *["test"] * (count > 1)}
        chosen = [s.scene_idx for s in specs]
        assert set(np.diff(chosen)) <= {stride}
        if count > 4 // stride:  # more frames than in the first quarter
            assert chosen[0] == 0
        all_specs = LabelSource(whole).frames(3)
        assert specs == [s for s in all_specs if s.scene_idx in chosen]

    def test_weather_is_that_of_the_description_beside_the_labels(self, labels_folder):
        config = make_config(labels_folder)
        assert LabelSource(config).conditions(7) == ("alleyway", "night", "normal")
        path = labels_folder / "7" / "description.txt"
        write.write_description(path, "urban", "day", "fog")
        assert LabelSource(config).make(7).weather == "fog"
        (labels_folder / "7").rename(labels_folder / "70")  # not one of K-Radar's
        assert LabelSource(config).conditions(70) == ("urban", "day", "fog")
        (labels_folder / "70" / "description.txt").unlink()
        with pytest.raises(UserError, match=r"70/description.txt is 'unknown,unknown'"):
            LabelSource(config)

    def test_missing_labels_and_unknown_sequences_are_errors(self, labels_folder):
        with pytest.raises(FileNotFoundError, match="No such file"):
            LabelSource(make_config(labels_folder / "nowhere"))
        with pytest.raises(UserError, match="sequence"):
            LabelSource(make_config(labels_folder, sequences=[4]))


@pytest.mark.slow
def test_all_of_kradar_makes_scenes(shared):
    values = make_config(shared / "data" / "kradar" / "labels_v2_1.zip")
    source = LabelSource(values)
    assert len(source.numbers) == 58
    for number in source.numbers:
        scene = source.make(number)
        speed = scene.ego_speed_mps
        assert (speed >= 0).all()
        assert (speed <= 40).all()
        assert -1.6 < scene.ground_m < 0.3
        assert np.isfinite(scene.tracks.velocity_mps).all()
