"""Trains RADE-Net on RADIATE: 360-degree radar images of 8 bits, boxes in pixels, a stereo camera.

    python examples/radiate.py radiate_sdk/data/radiate

The folder has the sequences of RADIATE (Sheeny et al., ICRA 2021, arXiv:2010.09076) in the files of
its SDK, github.com/marcelsheeny/radiate_sdk, whose sample `tiny_foggy` has 18 frames. The command
draws one frame, trains and evaluates. `docs/own_radar.md` explains readers and has the results.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib

import click
import numpy as np
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

import radejax
from radejax.cli import entry
from radejax.config import Config
from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, require
from radejax.data.dataset import LabeledFrame, LabeledFrames
from radejax.data.projection import linear_power, to_log_scale
from radejax.geometry.camera import LOOKING_AHEAD, CameraCalibration
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.options import RadeNetOptions, azimuth_axis_deg
from radejax.visualize.style import save_figure

# Labels have no height. These are those of the SDK.
HEIGHTS_M = {"car": 1.5, "van": 2.0, "truck": 2.5, "bus": 3.0}
CLASSES = tuple(HEIGHTS_M)
PIXEL_M = 0.173611  # a range bin of the radar images, and a pixel of the labels
SHAPE = 576, 400  # ranges, and azimuths clockwise from ahead
# Of them, these are one bin, by the maximum; the antenna's beam is 1.8 degrees wide.
MERGED = 4, 2
BINS = SHAPE[0] // MERGED[0], SHAPE[1] // MERGED[1]
CAMERA_DELAY_S = 0.25  # of the radar images, as in the SDK
GRID = RadarGrid(
    range_m=PIXEL_M * (MERGED[0] * np.arange(BINS[0]) + (MERGED[0] - 1) / 2),
    azimuth_rad=2 * np.pi * ((np.arange(BINS[1]) + 0.25) / BINS[1] - 0.5),
    elevation_rad=np.array([]),  # not measured
    doppler_mps=np.array([0.0]),
    fov_range_m=100.0,
    fov_azimuth_rad=np.pi,
)

# Reader ------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RadiateFrame(LabeledFrame):
    """One turn of the antenna."""

    split: str

    def read_projection(self, grid: RadarGrid) -> np.ndarray:
        with wrap_read_errors(self.radar_path, "a PNG image"):
            image = np.asarray(Image.open(self.radar_path))
        if image.shape != SHAPE:
            raise DataError(f"{self.radar_path}: shape {image.shape}, expected {SHAPE}")
        # The scale of the 8 bits is not published.
        power = linear_power(image, "db", self.radar_path, db_per_step=0.5)
        from_behind = np.roll(power, SHAPE[1] // 2, axis=1)  # -180 degrees
        blocks = from_behind.reshape(BINS[0], MERGED[0], BINS[1], MERGED[1])
        return to_log_scale(blocks.max(axis=(1, 3)))[:, :, None]

    def read_calibration(self, radar_from_lidar_m=None) -> CameraCalibration:
        """Returns the left camera, for images that are not rectified."""
        path = self.camera_calibration_path
        with wrap_read_errors(path, "a calibration of RADIATE"):
            camera = yaml.safe_load(path.read_text())["left_cam_calib"]
            turn = Rotation.from_euler("XYZ", -np.array(camera["R"]), degrees=True)
            return CameraCalibration(
                intrinsics=[camera[x] for x in ("fx", "fy", "cx", "cy")],
                distortion=[camera[x] for x in ("k1", "k2", "p1", "p2", "k3")],
                rotation=turn.as_matrix().T @ LOOKING_AHEAD,
                translation_m=-np.array(camera["T"]),
                width=camera["res"][0],
                height=camera["res"][1],
                radar_from_lidar_m=(0.0, 0.0, 0.0),
            )


class Radiate(LabeledFrames):
    """All sequences of a folder. The last fifth of the frames of each is in the test split."""

    license = "MIT for the sample in the SDK; otherwise see the terms of RADIATE"

    @classmethod
    def from_options(cls, options, classes):
        root, frames = pathlib.Path(options.roots[0]), []
        for number, meta in enumerate(sorted(root.glob("*/meta.json")), 1):
            frames += read_sequence(meta.parent, number, options.camera_calibration)
        return cls(frames, GRID)

    def of_split(self, split):
        require(split in ("train", "test"), "split", split, "train or test")
        others = {frame.key for frame in self if frame.split != split}
        return self.without(others, f"not of {split}")


def read_sequence(folder, number, calibration) -> list[RadiateFrame]:
    """Returns the frames of a sequence."""
    meta = json.loads((folder / "meta.json").read_text())
    objects = json.loads((folder / "annotations" / "annotations.json").read_text())
    camera_s = read_times(folder / "zed_left.txt")
    radar_s = read_times(folder / "Navtech_Polar.txt")
    frames = []
    for name, time_s in radar_s.items():
        position = int(name) - 1  # in the lists of boxes
        seen = [one for one in objects if one["bboxes"][position]]
        boxes = [to_box(one["bboxes"][position], one["class_name"]) for one in seen]
        late_s = {x: abs(time_s - CAMERA_DELAY_S - s) for x, s in camera_s.items()}
        image = min(late_s, key=late_s.get)
        has_camera = calibration is not None and late_s[image] < 0.1
        frame = RadiateFrame(
            sequence=number,
            name=name,
            boxes=np.reshape(boxes, (-1, 7)),
            classes=np.array([one["class_name"] for one in seen]),
            weather=meta["type"],
            split="train" if len(frames) < len(radar_s) * 4 // 5 else "test",
            radar_path=folder / "Navtech_Polar" / f"{name}.png",
            camera_path=folder / "zed_left" / f"{image}.png" if has_camera else None,
            camera_calibration_path=pathlib.Path(calibration) if has_camera else None,
        )
        frames.append(frame)
    return frames


def read_times(path: pathlib.Path) -> dict[str, float]:
    """Returns the times in seconds by frame of lines such as `Frame: 000001 Time: 15.5`."""
    with wrap_read_errors(path, "a list of frames and times"):
        lines = [line.split() for line in path.read_text().splitlines()]
        return {name: float(time) for _, name, _, time in lines}


def to_box(label, cls: str) -> list[float]:
    """Returns the box of a rectangle in pixels, which is turned about its center.

    Pixels count to the right and down from the corner of the map whose center is the radar. Without
    rotation, the object looks up, which is ahead.
    """
    left, top, width, length = label["position"]
    x = (SHAPE[0] - (top + length / 2)) * PIXEL_M
    y = (SHAPE[0] - (left + width / 2)) * PIXEL_M
    size = [length * PIXEL_M, width * PIXEL_M, HEIGHTS_M.get(cls, 1.8)]
    z = -1.7 + size[2] / 2  # the SDK's ground is 1.7 m below the radar
    return [x, y, z, *size, np.deg2rad(label["rotation"])]


# Config ------------------------------------------------------------------------------


def get_config() -> Config:
    """Returns the config of a small network."""
    model = RadeNetOptions(
        num_classes=len(CLASSES),
        doppler_bins=1,
        elevation_bins=0,
        widths=(16, 32, 64),
        decoder_width=16,
        num_groups=8,
        heatmap_prior=0.02,
        input_center=0.11,  # mean of the input, which training prints
        input_scale=20.0,
        beam_azimuth_deg=azimuth_axis_deg(GRID),
    )
    return Config().replace(
        classes=CLASSES,
        model=model,
        data={"format": "radiate:Radiate"},
        train={"batch_size": 1, "num_epochs": 40, "warmup_steps": 20},
        evaluation={"roi": None},
    )


@click.command()
@click.argument("root", type=click.Path(path_type=pathlib.Path, exists=True))
@click.option("--calibration", type=click.Path(exists=True), help="default-calib.yaml.")
@click.option("--workdir", default="runs/radiate", show_default=True)
@click.option("--epochs", default=40, show_default=True, help="Epochs.")
def main(root, calibration, workdir, epochs):
    """Train on the sequences of RADIATE in ROOT."""
    entry.set_up_jax()
    with entry.exit_codes():
        data = {"roots": (str(root),), "camera_calibration": calibration}
        config = get_config().replace(data=data, train={"num_epochs": epochs})
        frames = Radiate.from_options(config.data, CLASSES)
        require(len(frames) > 0, "ROOT", str(root), "a folder with sequences")
        frame = max(frames, key=lambda frame: len(frame.boxes))
        scene = radejax.frame_scene(frame, frame.read_projection(GRID), GRID)
        save_figure(radejax.draw_frame(scene), f"{workdir}.png")
        radejax.run(config, workdir)


if __name__ == "__main__":
    main()
