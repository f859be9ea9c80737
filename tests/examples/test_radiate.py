"""The example of RADIATE: geometry, unit and camera of written files, and a whole run."""

import json
import pathlib
import shutil

import numpy as np
import pytest
import radiate
import yaml
from click.testing import CliRunner
from PIL import Image

from radejax.core.errors import DataError, UserError
from radejax.data.options import DataOptions
from radejax.data.projection import LOG_SCALE_DB
from radejax.geometry.boxes import corners

CAR = {"position": [854, 561, 20, 30], "rotation": 90.0}  # left, top, width, length
CAMERA = {
    "T": [0.0, 0.0, 0.0], "R": [10.0, 0.0, 0.0], "res": [672, 376],
    "fx": 300.0, "fy": 310.0, "cx": 336.0, "cy": 188.0,
    "k1": 0.0, "k2": 0.0, "k3": 0, "p1": 0, "p2": 0,
}  # fmt: skip


def write_sequence(folder: pathlib.Path, num_frames: int) -> None:
    """A car at 50 m to the right, in the layout of RADIATE."""
    for name in ("Navtech_Polar", "zed_left", "annotations"):
        (folder / name).mkdir(parents=True)
    rng = np.random.default_rng(0)
    radar, camera = [], []
    for number in range(1, num_frames + 1):
        image = rng.integers(20, 40, radiate.SHAPE).astype(np.uint8)
        image[280:297, 98:103] = 150  # 5 m in range, a quarter of a turn
        Image.fromarray(image).save(folder / "Navtech_Polar" / f"{number:06d}.png")
        photo = Image.new("RGB", (672, 376))
        photo.save(folder / "zed_left" / f"{number:06d}.png")
        radar.append(f"Frame: {number:06d} Time: {1e9 + number}")
        camera.append(f"Frame: {number:06d} Time: {1e9 + number - 0.2}")
    for name, lines in (("Navtech_Polar", radar), ("zed_left", camera)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    boxes = [CAR] * num_frames + [[]] * 3  # lists of boxes are longer in the sample
    person = [{"position": [576, 400, 5, 5], "rotation": 0}] + [[]] * (num_frames + 2)
    objects = [
        {"id": 1, "class_name": "car", "bboxes": boxes},
        {"id": 2, "class_name": "pedestrian", "bboxes": person},
    ]
    text = json.dumps(objects)
    (folder / "annotations" / "annotations.json").write_text(text)
    (folder / "meta.json").write_text(json.dumps({"name": "fog_1", "type": "fog"}))


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> pathlib.Path:
    root = tmp_path_factory.mktemp("radiate")
    write_sequence(root / "data" / "fog_1", 5)
    text = yaml.safe_dump({"left_cam_calib": CAMERA})
    (root / "default-calib.yaml").write_text(text)
    return root


def read(root: pathlib.Path) -> radiate.Radiate:
    calibration = str(root / "default-calib.yaml")
    options = DataOptions(roots=(str(root / "data"),), camera_calibration=calibration)
    return radiate.Radiate.from_options(options, radiate.CLASSES)


def test_boxes_are_turned_counter_clockwise_from_ahead(root):
    frame = read(root)[0]
    assert frame.classes.tolist() == ["car", "pedestrian"]
    assert frame.weather == "fog"
    # The center is 288 pixels to the right of the radar, and 30 pixels are the length.
    expected = [0, -288 * 0.173611, -1.7 + 0.75, 5.20833, 3.47222, 1.5, np.pi / 2]
    np.testing.assert_allclose(frame.boxes[0], expected, atol=1e-4)
    # It looks to the left, so that its length is along y.
    spread = np.ptp(np.asarray(corners(frame.boxes[:1]))[0], axis=0)
    np.testing.assert_allclose(spread, [3.47222, 5.20833, 1.5], atol=1e-4)
    ahead = [(576 - 402.5) * 0.173611, (576 - 578.5) * 0.173611]
    np.testing.assert_allclose(frame.boxes[1, :2], ahead)
    label = {"position": [576, 400, 5, 5], "rotation": 350.0}  # 10 degrees to the right
    yaw = radiate.to_box(label, "car")[6]
    assert (np.cos(yaw), np.sin(yaw)) == pytest.approx((0.984808, -0.173648), abs=1e-5)


def test_rows_are_ranges_and_columns_azimuths_clockwise_from_ahead(root):
    frames = read(root).with_valid_boxes(radiate.CLASSES)
    assert frames.counts["objects left out: class 'pedestrian'"] == 1
    projection = frames[0].read_projection(radiate.GRID)
    assert projection.shape == radiate.GRID.projection_shape == (144, 200, 1)
    level = projection[..., 0]
    (row,), (column,) = radiate.GRID.nearest_bin(*frames[0].boxes[:, :2].T).T[
        ..., None, :
    ]
    assert level[row, column] == level.max()
    r, a = np.nonzero(level == level.max())
    azimuth_deg = np.rad2deg(radiate.GRID.azimuth_rad[a])
    assert (azimuth_deg.min(), azimuth_deg.max()) == pytest.approx(
        (88.65, 92.25), abs=0.1
    )
    range_m = radiate.GRID.range_m[r]
    assert (range_m.min(), range_m.max()) == pytest.approx((48.9, 51.6), abs=0.1)
    # The maximum of eight values from 20 to 39 is at most 39: 111 steps of 0.5 dB less.
    rise_db = (level.max() - level[:, :90].max()) * LOG_SCALE_DB
    assert rise_db == pytest.approx(55.5, abs=0.01)
    # Straight ahead and behind are neighbors of the middle and of both ends.
    assert abs(np.rad2deg(radiate.GRID.azimuth_rad[[0, 99, 100]])) == pytest.approx(
        [179.55, 1.35, 0.45]
    )


def test_the_camera_is_that_before_the_radar_and_turned_as_in_the_sdk(root):
    frame = read(root)[0]
    assert frame.camera_path.name == "000001.png"  # 0.05 s from 0.25 s before
    camera = frame.read_calibration()
    pixels, depth = camera.project_ego(np.array([[20.0, 0.0, 0.0], [20.0, 4.0, 0.0]]))
    # A pitch of 10 degrees moves a point ahead up by fy tan(10 deg).
    assert pixels[0] == pytest.approx([336.0, 188 - 310 * np.tan(np.deg2rad(10))])
    assert pixels[1][0] < 336  # left
    assert depth[0] == pytest.approx(20 * np.cos(np.deg2rad(10)))


def test_splits_are_by_time_and_wrong_files_are_named(root, tmp_path):
    frames = read(root)
    assert [f.name for f in frames.of_split("test")] == ["000005"]
    assert len(frames.of_split("train")) == 4
    with pytest.raises(UserError, match="split is 'val', expected train or test"):
        frames.of_split("val")
    shutil.copytree(root, tmp_path / "copy")
    copy = tmp_path / "copy" / "data" / "fog_1"
    turned = np.zeros(radiate.SHAPE[::-1], np.uint8)
    Image.fromarray(turned).save(copy / "Navtech_Polar" / "000001.png")
    with pytest.raises(
        DataError, match=r"000001.png: shape \(400, 576\), expected \(5"
    ):
        read(tmp_path / "copy")[0].read_projection(radiate.GRID)
    (copy / "zed_left.txt").write_text("Frame 1\n")
    with pytest.raises(DataError, match=r"zed_left.txt: corrupted, not a list of fram"):
        read(tmp_path / "copy")


@pytest.mark.slow
@pytest.mark.usefixtures("commands_on_one_device")
def test_written_files_are_trained_evaluated_and_drawn(root, tmp_path, monkeypatch):
    config = radiate.get_config()
    config = config.replace(model={"widths": (8, 16)}, train={"warmup_steps": 0})
    monkeypatch.setattr(radiate, "get_config", lambda: config)
    run = tmp_path / "run"
    calibration = ["--calibration", str(root / "default-calib.yaml")]
    arguments = [
        str(root / "data"),
        "--workdir",
        str(run),
        "--epochs",
        "1",
        *calibration,
    ]
    result = CliRunner().invoke(radiate.main, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert pathlib.Path(f"{run}.png").stat().st_size > 10_000
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text())
    assert metrics["options"]["classes"] == list(radiate.CLASSES)
