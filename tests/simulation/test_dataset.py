"""The written tree: readable as K-Radar's, the same bytes, resumable, guarded."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import scipy.io
from PIL import Image

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.manifest import checksums
from radejax.data.cameras import CameraOptions, camera_inputs
from radejax.data.kradar import KRadar, read_labels
from radejax.data.kradar.check import check_dataset
from radejax.data.kradar.tesseract import read_tesseract
from radejax.data.projection import project_tensor
from radejax.simulation import dataset
from radejax.simulation.camera.renderer import stereo_calibration
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset
from radejax.simulation.simulator import make_source

from .. import small_models as small


def small_config(**changes):
    grid = {"num_doppler": 8, "num_range": 32, "num_elevation": 5, "num_azimuth": 24}
    fields = {
        "train_sequences": 2,
        "test_sequences": 1,
        "frames_per_sequence": 3,
        "image_width": 64,
        "image_height": 36,
        "grid": grid | {"max_range_m": 62.0},
    }
    return SimulationOptions(**fields | changes)


def digests(root):
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return checksums(root, *(str(path.relative_to(root)) for path in files))


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    root = tmp_path_factory.mktemp("simulated") / "kradar"
    return simulate_dataset(small_config(), root, progress=False)


class TestTree:
    def test_reads_as_kradar_without_a_problem(self, tree):
        data = KRadar(tree, split="train")
        assert (len(data), len(KRadar(tree, split="test"))) == (6, 3)
        frame = data[0]
        conditions = frame.environment, frame.time, frame.weather
        assert conditions == ("urban", "day", "normal")
        assert np.asarray(Image.open(frame.camera_path)).shape == (36, 128, 3)
        power = scipy.io.loadmat(frame.tesseract_path)["arrDREA"]
        assert power.shape == data.grid.shape_drea == (8, 32, 5, 24)
        assert power.dtype == np.float32
        normalized = (10.0 * np.log10(power + 1e-10) + 1.2) / 184.3
        assert 0.0 <= normalized.min() < normalized.max() <= 1.0
        assert 0.45 < np.median(normalized) < 0.6  # the noise floor
        labels = [x for f in KRadar(tree, visibility=None) for x in f.labels]
        assert {label.visibility for label in labels} == {"R", "L"}

    def test_a_model_sees_through_the_cameras_that_drew_the_images(self, tree):
        cameras = camera_inputs(KRadar(tree)[:1], (36, 64), CameraOptions()).cameras
        drawn = stereo_calibration(small_config())[0].camera()
        found, expected = cameras[0].cam_from_ego, drawn.cam_from_ego
        np.testing.assert_allclose(found, expected, atol=1e-12)

    def test_file_numbers_agree_with_the_header(self, tree):
        for frame in KRadar(tree):
            header = frame.header
            assert frame.name == f"{header.radar:05d}_{header.lidar:05d}"
            assert frame.tesseract_path.name == f"tesseract_{header.radar:05d}.mat"
            assert frame.camera_path.name == f"cam-front_{header.camera_front:05d}.png"
        text = (tree / "1" / "info_calib" / "calib_radar_lidar.txt").read_text()
        first = KRadar(tree)[0].header
        assert text.splitlines()[1] == f"{first.radar - first.lidar},-2.54,0.3"

    def test_tracks_keep_identity_class_and_size(self, tree):
        folder = tree / "1" / "info_label_v2_1"
        frames = [read_labels(p) for p in sorted(folder.iterdir())]
        first, second = ({x.track_id: x for x in f} for f in frames[:2])
        both = first.keys() & second.keys()
        assert len(both) >= 5
        for track in both:
            a, b = first[track], second[track]
            assert a.cls == b.cls
            np.testing.assert_allclose(a.box[3:6], b.box[3:6])
            assert np.hypot(a.box[0] - b.box[0], a.box[1] - b.box[1]) < 6.0

    def test_velocities_are_the_motion_of_the_labels(self, tree):
        read = {f.key: f for f in KRadar(tree, visibility=None)}
        for number in (1, 2, 3):
            first, second, third = (f for f in read.values() if f.sequence == number)
            velocities = second.columns["velocity_mps"]
            ids = [f.columns["track_id"].tolist() for f in (first, second, third)]
            values = [first.boxes, velocities, third.boxes]
            known = [dict(zip(*x, strict=True)) for x in zip(ids, values, strict=True)]
            tracks = set.intersection(*map(set, known))
            assert len(tracks) >= 3
            for track in tracks:
                before, velocity, after = (values[track] for values in known)
                expected = (after[:2] - before[:2]) / 0.2
                np.testing.assert_allclose(velocity, expected, atol=0.7)

    def test_ego_motion_turns_relative_velocities_to_those_over_ground(self, tree):
        number = 3  # a mountain road, with bends
        path = tree / str(number) / "info_motion" / "ego.csv"
        names, *numbers = np.loadtxt(path, str, delimiter=",", unpack=True)
        ego = {column[0]: column[1:].astype(float) for column in numbers}
        steps = np.hypot(np.diff(ego["x_m"]), np.diff(ego["y_m"]))
        np.testing.assert_allclose(steps, 0.1 * ego["speed_mps"][:-1], rtol=1e-3)
        turns = np.diff(ego["heading_rad"])
        np.testing.assert_allclose(turns, 0.1 * ego["yaw_rate_radps"][:-1], atol=2e-6)
        assert np.abs(turns).max() > 1e-3
        scene = make_source(small_config()).make(number)
        frames = [f for f in KRadar(tree, visibility=None) if f.sequence == number]
        assert names.tolist() == ["frame", *(f.name for f in frames)]
        for index, frame in enumerate(frames):
            x_m, y_m = frame.boxes[:, :2].T
            turning = ego["yaw_rate_radps"][index] * np.stack([-y_m, x_m], 1)
            velocity = frame.columns["velocity_mps"] + turning
            velocity[:, 0] += ego["speed_mps"][index]
            tracks = frame.columns["track_id"] - 1  # of procedural sequences
            expected = np.linalg.norm(scene.tracks.velocity_mps[index, tracks], axis=1)
            speed = np.linalg.norm(velocity, axis=1)
            np.testing.assert_allclose(frame.columns["speed_mps"], speed, atol=1e-4)
            np.testing.assert_allclose(speed, expected, atol=0.1)


class TestRepeating:
    def test_same_seed_same_bytes_by_worker_processes(self, tree, tmp_path):
        out, options = tmp_path / "again", {"num_workers": 2, "progress": False}
        again = simulate_dataset(small_config(), out, **options)
        assert digests(again) == digests(tree)

    def test_resumes_after_an_interruption_with_the_same_bytes(
        self, tree, tmp_path, monkeypatch
    ):
        root = tmp_path / "interrupted"
        write, calls = dataset.Writer.write_frame, []

        def stops(*frame):
            if len(calls) == 4:
                raise KeyboardInterrupt
            calls.append(frame)
            write(*frame)

        monkeypatch.setattr(dataset.Writer, "write_frame", stops)
        with pytest.raises(KeyboardInterrupt):
            simulate_dataset(small_config(), root, num_workers=0, progress=False)
        marker = json.loads((root / dataset.SIMULATION_MARKER).read_text())
        assert not marker["finished"]
        monkeypatch.setattr(dataset.Writer, "write_frame", write)
        # A killed writer leaves its temporary file; a living one's is not touched.
        dead = subprocess.Popen([sys.executable, "-c", ""])
        dead.wait()
        busy = files.temporary_path(root / "1" / "tesseract_00001.mat")
        left = busy.with_name(busy.name.replace(f".{os.getpid()}.", f".{dead.pid}."))
        left.write_bytes(b"half")
        busy.write_bytes(b"half")
        simulate_dataset(small_config(), root, progress=False)
        assert not left.exists()
        busy.unlink()  # was still there
        assert digests(root) == digests(tree)

    def test_finished_dataset_is_reused_unchanged(self, tree, monkeypatch):
        monkeypatch.setattr(dataset.Writer, "write_frames", None)
        assert simulate_dataset(small_config(), tree, progress=False) == tree

    @pytest.mark.parametrize(
        ("lost", "message"),
        [
            ("2/cam-front/*.png", "2/cam-front has 2 of 3 files; copy it again"),
            ("split/test.txt", "split has 1 of 2 files"),
        ],
    )
    def test_an_incomplete_copy_is_an_error(self, tree, tmp_path, lost, message):
        copy = shutil.copytree(tree, tmp_path / "copy")
        min(copy.glob(lost)).unlink()
        with pytest.raises(DataError, match=f"copy is not complete: {message}"):
            simulate_dataset(small_config(), copy, progress=False)

    def test_radar_data_may_be_deleted_after_preprocessing(self, tree, tmp_path):
        left_out = shutil.ignore_patterns("radar_tesseract")
        copy = shutil.copytree(tree, tmp_path / "copy", ignore=left_out)
        assert simulate_dataset(small_config(), copy, progress=False) == copy


def test_folders_with_something_else_are_left_alone(tree, tmp_path):
    file = tmp_path / "holiday.txt"
    file.write_text("mine")
    for root, message in (
        (file, "is a file"),
        (tmp_path, "not empty"),
        (tree, "another simulation config.*seed"),
    ):
        with pytest.raises(UserError, match=message):
            simulate_dataset(small_config(seed=5), root, progress=False)


def test_expected_size_is_that_of_the_files(tree, tmp_path):
    changes = {"output": "projection", "train_sequences": 1, "frames_per_sequence": 1}
    projected = small_config(**changes)
    root = simulate_dataset(projected, tmp_path / "data", progress=False)
    for config, place, count in ((small_config(), tree, 9), (projected, root, 2)):
        num_frames, expected = dataset.expected_size(config, make_source(config))
        files = [p for p in place.rglob("*") if p.suffix in (".mat", ".npy", ".png")]
        assert num_frames == count
        assert expected == pytest.approx(sum(p.stat().st_size for p in files), rel=0.2)


def test_a_sensor_without_elevation_is_a_kradar_tree_without_its_channels(tmp_path):
    grid = small.uneven_grid(fov_range_m=60.0, range_m=np.geomspace(2.0, 60.0, 32))
    sizes = {"frames_per_sequence": 1, "image_width": 0, "train_sequences": 1}
    config = small_config(grid=grid.to_dict(), **sizes)
    root = simulate_dataset(config, tmp_path / "data", progress=False)
    assert check_dataset(root).num_problems == 0
    frames = KRadar(root)
    assert frames.grid == grid
    power = read_tesseract(frames[0].radar_path)
    assert power.shape == (4, 32, 1, 14)
    projection = frames[0].read_projection(grid)
    assert projection.shape == grid.projection_shape == (32, 14, 4)
    np.testing.assert_array_equal(projection, project_tensor(power)[..., :4])
