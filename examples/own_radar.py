"""Trains RADE-Net on another radar: power tensors as `.npy` files and a CSV of boxes.

    python examples/own_radar.py data/own_radar

The radar has no elevation, and its beams are uniform in sin(azimuth). The folder has the files
`radar/DRIVE_FRAME.npy`, linear power `[range, azimuth, Doppler]`, and `boxes.csv` with boxes in a
vehicle frame; if it is missing, the command simulates such a recording. It draws one frame, trains
and evaluates in about three minutes on two cores. `docs/own_radar.md` explains this file.
"""

from __future__ import annotations

import collections
import csv
import pathlib
import tempfile

import click
import numpy as np

import radejax
from radejax.cli import entry
from radejax.config import Config
from radejax.core.archives import read_npy
from radejax.core.errors import DataError, require
from radejax.data.dataset import LabeledFrame, LabeledFrames
from radejax.data.projection import linear_power, to_log_scale
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.options import RadeNetOptions
from radejax.simulation.config import SimulationOptions
from radejax.visualize.style import save_figure

CLASSES = ("car", "truck")
GRID = RadarGrid(
    range_m=np.arange(2.0, 66.0),
    azimuth_rad=np.arcsin(np.linspace(-0.8, 0.8, 48)),  # positive to the right
    elevation_rad=np.array([]),  # not measured
    doppler_mps=np.linspace(-8.0, 8.0, 16, endpoint=False),
    fov_range_m=65.0,
    fov_azimuth_rad=0.9,
)
# Mounting of the radar in the vehicle frame (x forward, y left, z up, origin on the ground below
# the rear axle): position, and yaw, positive to the left.
MOUNTING_M = (3.6, 0.2, 0.5)
MOUNTING_YAW_RAD = 0.1

# Reader ------------------------------------------------------------------------------


class OwnFrame(LabeledFrame):
    """One file of linear power `[R, A, D]`."""

    def read_projection(self, grid: RadarGrid) -> np.ndarray:
        """Returns the normalized logarithm of the power, with one channel per Doppler bin."""
        power = linear_power(read_npy(self.radar_path), "power", self.radar_path)
        return to_log_scale(power)


class OwnRadar(LabeledFrames):
    """The frames of a folder; every fifth drive is in the test split."""

    @classmethod
    def from_options(cls, options, classes):
        root, frames = pathlib.Path(options.roots[0]), []
        labels_file = root / "boxes.csv"
        boxes_of = read_boxes(labels_file) if labels_file.exists() else {}
        for path in sorted((root / "radar").glob("*.npy")):
            names, boxes = boxes_of.pop(path.stem, (np.zeros(0), np.zeros((0, 7))))
            drive, _, number = path.stem.partition("_")
            frames.append(
                OwnFrame(
                    radar_path=path,
                    sequence=int(drive),
                    name=number,
                    boxes=to_radar_frame(boxes),
                    classes=names,
                )
            )
        data = cls(frames, GRID)
        data.counts["frames"] = len(frames)
        data.counts["frames of boxes.csv without a radar file"] = len(boxes_of)
        return data

    def of_split(self, split):
        require(split in ("train", "test"), "split", split, "train or test")
        others = {f.key for f in self if (f.sequence % 5 == 0) != (split == "test")}
        return self.without(others, f"not of {split}")


FIELDS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_deg")


def read_boxes(path: pathlib.Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Returns the class names `[N]` and boxes `[N, 7]` in the vehicle frame by frame."""
    rows = collections.defaultdict(list)
    with open(path, newline="") as file:
        reader = csv.DictReader(file)
        for row in reader:
            try:
                box = [float(row[name]) for name in FIELDS]
                rows[row["frame"]].append((row["class"], box))
            except (KeyError, TypeError, ValueError) as error:
                raise DataError(f"{path}, line {reader.line_num}: {error!r}") from None
    columns = {frame: zip(*found, strict=True) for frame, found in rows.items()}
    return {
        frame: (np.array(names), np.array(boxes))
        for frame, (names, boxes) in columns.items()
    }


def to_radar_frame(boxes: np.ndarray) -> np.ndarray:
    """Returns boxes `[N, 7]` with yaws in radians and their origin at the radar."""
    x, y, z = (boxes[:, :3] - MOUNTING_M).T
    cos, sin = np.cos(MOUNTING_YAW_RAD), np.sin(MOUNTING_YAW_RAD)
    yaw = np.deg2rad(boxes[:, 6]) - MOUNTING_YAW_RAD
    x, y = cos * x + sin * y, cos * y - sin * x
    return np.column_stack([x, y, z, boxes[:, 3:6], yaw])


# Config ------------------------------------------------------------------------------


def get_config() -> Config:
    """Returns the config of a small network."""
    model = RadeNetOptions(
        num_classes=2,
        doppler_bins=16,
        elevation_bins=0,
        widths=(16, 32, 64),
        decoder_width=16,
        num_groups=8,
        heatmap_prior=0.02,  # score of the untrained network
        input_center=0.515,  # mean of the input, which training prints
        input_scale=20.0,
    )
    return Config().replace(
        classes=CLASSES,
        model=model,
        data={"format": "own_radar:OwnRadar"},
        loss={"heatmap_sigma_bins": 1.0},  # by default 3 bins; less if bins are long
        train={"batch_size": 4, "num_epochs": 10, "warmup_steps": 20},
        evaluation={"roi": None},  # by default K-Radar's lanes, 6.4 m to each side
    )


# Recording ---------------------------------------------------------------------------


def simulate(root: pathlib.Path, num_drives: int) -> None:
    """Writes a simulated recording with one frame per drive."""
    options = SimulationOptions(
        grid=GRID.to_dict(),
        radar={"azimuth_elements": 32.0, "elevation_elements": 3.0},
        train_sequences=num_drives,
        test_sequences=0,
        frames_per_sequence=1,
        image_width=0,
    )
    cos, sin = np.cos(MOUNTING_YAW_RAD), np.sin(MOUNTING_YAW_RAD)
    names = {"Sedan": "car", "Bus or Truck": "truck", "Pedestrian": "pedestrian"}
    rows = [("frame", "class", *FIELDS)]
    (root / "radar").mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for frame in radejax.KRadar(radejax.simulate(options, folder), classes=names):
            stem = f"{frame.sequence:04d}_0001"
            power = radejax.read_tesseract(frame.radar_path)  # [D, R, 1, A]
            np.save(root / "radar" / f"{stem}.npy", power[:, :, 0].transpose(1, 2, 0))
            for cls, (x, y, z, *size, yaw) in zip(
                frame.classes, frame.boxes, strict=True
            ):
                place = np.add((cos * x - sin * y, sin * x + cos * y, z), MOUNTING_M)
                yaw_deg = np.rad2deg(yaw + MOUNTING_YAW_RAD)
                rows.append((stem, names[cls], *place, *size, yaw_deg))
    with open(root / "boxes.csv", "w", newline="") as file:  # after all other files
        csv.writer(file).writerows(rows)


@click.command()
@click.argument("root", type=click.Path(path_type=pathlib.Path))
@click.option("--workdir", default="runs/own_radar", show_default=True)
@click.option("--drives", default=500, show_default=True, help="Drives to simulate.")
@click.option("--epochs", help="Epochs. Default: that of the config.", type=int)
def main(root, workdir, drives, epochs):
    """Train on the recording in ROOT, which is simulated if it is missing."""
    entry.set_up_jax()
    with entry.exit_codes():
        if not (root / "boxes.csv").exists():
            simulate(root, drives)
        config = get_config().replace(data={"roots": (str(root),)})
        frames = OwnRadar.from_options(config.data, CLASSES)
        frame = max(frames, key=lambda frame: len(frame.boxes))
        scene = radejax.frame_scene(frame, frame.read_projection(GRID), GRID)
        save_figure(radejax.draw_frame(scene), root / "frame.png")
        if epochs is not None:
            config = config.replace(train={"num_epochs": epochs})
        radejax.run(config, workdir)


if __name__ == "__main__":
    main()
