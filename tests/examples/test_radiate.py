"""The example of RADIATE: geometry, unit and camera of written files, and a whole run."""

import json
import pathlib

import numpy as np
import pytest
import radiate
import yaml
from click.testing import CliRunner
from PIL import Image

CAR = {"position": [854, 561, 20, 30], "rotation": 90.0}  # left, top, width, length
CAMERA = {
    "T": [0.0, 0.0, 0.0], "R": [10.0, 0.0, 0.0], "res": [672, 376],
    "fx": 300.0, "fy": 310.0, "cx": 336.0, "cy": 188.0,
    "k1": 0.0, "k2": 0.0, "k3": 0, "p1": 0, "p2": 0,
}  # fmt: skip


def write_sequence(folder, num_frames):
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
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("radiate")
    write_sequence(root / "data" / "fog_1", 5)
    text = yaml.safe_dump({"left_cam_calib": CAMERA})
    (root / "default-calib.yaml").write_text(text)
    return root


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
