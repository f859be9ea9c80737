"""Reader of drives of `.npz` files with images, as a user would write it."""

import pathlib

import numpy as np

from radejax.core.files import read_json
from radejax.data.dataset import LabeledFrame, LabeledFrames
from radejax.data.projection import project_tensor
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid


class ToyFrame(LabeledFrame):
    """One `DRIVE/NUMBER.npz`, and `NUMBER.png` beside it where there was a camera."""

    def read_projection(self, grid):
        """From linear power `[D, R, E, A]`."""
        return project_tensor(np.load(self.radar_path)["power"])

    def read_calibration(self, radar_from_lidar_m=None):
        shift = radar_from_lidar_m or self.radar_from_lidar_m
        fields = read_json(self.camera_calibration_path)
        return CameraCalibration.from_angles(**fields, radar_from_lidar_m=shift)


class Toy(LabeledFrames):
    """Drives of `ROOT/1`, `ROOT/2`, ...; the last one is the test split."""

    @classmethod
    def from_options(cls, options, classes):
        root, frames = pathlib.Path(options.roots[0]), []
        for path in sorted(root.glob("[0-9]*/*.npz")):
            content, image = np.load(path), path.with_suffix(".png")
            kept = np.isin(content["classes"], classes)
            frames.append(
                ToyFrame(
                    radar_path=path,
                    sequence=int(path.parent.name),
                    name=path.stem,
                    boxes=content["boxes"][kept],
                    classes=content["classes"][kept],
                    columns={"velocity_mps": content["velocity_mps"][kept]},
                    environment="urban",
                    time="day",
                    weather="normal",
                    camera_path=image if image.exists() else None,
                    camera_calibration_path=root / "camera.json",
                )
            )
        data = cls(frames, RadarGrid.from_dict(read_json(root / "grid.json")))
        data.counts["frames"] = len(frames)
        return data

    def of_split(self, split):
        last = max(frame.sequence for frame in self)
        is_test = {"train": False, "test": True}[split]
        others = {f.key for f in self if (f.sequence == last) != is_test}
        return self.without(others, f"not of {split}")
