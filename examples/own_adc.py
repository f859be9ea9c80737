"""Trains RADE-Net on raw ADC recordings: `.bin` files of Texas Instruments and JSON files of boxes.

    python examples/own_adc.py data/own_adc

The folder has the files `adc/DRIVE.bin`, in the layout of xWR16xx, and `boxes/DRIVE.json`, a list
of the boxes of every frame in the radar frame; if it is missing, the command simulates such a
recording. It checks the signs of the axes, draws one frame, trains and evaluates in about four
minutes on two cores. `docs/adc.md` explains this file.
"""

from __future__ import annotations

import json
import pathlib

import click
import numpy as np
from own_radar import get_config as radar_config

import radejax
from radejax.cli import entry
from radejax.config import Config
from radejax.core import files
from radejax.core.errors import DataError, require
from radejax.core.structures import CLASSES as SIMULATED
from radejax.data.adc import LIGHT_MPS, FmcwRadar, adc_to_power, read_ti_bin
from radejax.data.dataset import LabeledFrame, LabeledFrames
from radejax.data.projection import LOG_SCALE_DB, find_problem, project_tensor
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.config import SimulationOptions
from radejax.simulation.radar.adc import simulate_adc
from radejax.simulation.simulator import SequenceSimulator, make_source
from radejax.visualize.style import save_figure

CLASSES = ("Sedan", "Bus or Truck")
CARRIER_HZ = 77e9
SPACING_M = LIGHT_MPS / CARRIER_HZ / 2
RADAR = FmcwRadar(
    tx_m=[(0.0, -4 * SPACING_M * i, 0.0) for i in range(3)],  # x forward, y left, z up
    rx_m=[(0.0, -SPACING_M * i, 0.0) for i in range(4)],
    azimuth_rad=np.arcsin(np.linspace(-0.8, 0.8, 48)),  # positive to the right
    carrier_hz=CARRIER_HZ,
    slope_hz_per_s=23.4e12,  # range bins of 1 m
    sample_rate_hz=10e6,
    chirp_period_s=20e-6,
    num_chirps=32,
    num_samples=64,
)
GRID = RADAR.make_grid()

# Reader ------------------------------------------------------------------------------


class AdcFrame(LabeledFrame):
    """One frame of a `.bin` file; its name is its number in the file."""

    def read_projection(self, grid: RadarGrid) -> np.ndarray:
        samples = read_ti_bin(
            self.radar_path, int(self.name), RADAR, is_interleaved=False
        )
        power = np.asarray(adc_to_power(samples, RADAR))  # [D, R, E, A]
        projection = grid.measured_channels(project_tensor(power))
        if problem := find_problem(projection.max(axis=0), float(power.min())):
            raise DataError(f"{self.radar_path}, frame {self.name}: {problem}")
        return projection


class AdcRecordings(LabeledFrames):
    """The frames of a folder; every fifth drive is in the test split."""

    @classmethod
    def from_options(cls, options, classes):
        root, frames = pathlib.Path(options.roots[0]), []
        for path in sorted((root / "boxes").glob("*.json")):
            for number, objects in enumerate(json.loads(path.read_text())):
                frame = AdcFrame(
                    radar_path=root / "adc" / f"{path.stem}.bin",
                    sequence=int(path.stem),
                    name=f"{number:04d}",
                    boxes=np.array([one["box"] for one in objects]).reshape(-1, 7),
                    classes=np.array([one["class"] for one in objects]),
                )
                frames.append(frame)
        return cls(frames, GRID)

    def of_split(self, split):
        require(split in ("train", "test"), "split", split, "train or test")
        others = {f.key for f in self if (f.sequence % 5 == 0) != (split == "test")}
        return self.without(others, f"not of {split}")


# Check -------------------------------------------------------------------------------


def echoes_db(frames, mirrored: bool = False) -> float:
    """Returns the mean level at the boxes above that of the other azimuths.

    If azimuths are mirrored and the level rises, the order or the signs of the antennas are wrong.
    """
    found = []
    for frame in frames.with_valid_boxes(CLASSES):
        level = frame.read_projection(GRID).max(-1)
        x, y = frame.boxes[:, 0], frame.boxes[:, 1] * (-1 if mirrored else 1)
        r, a = GRID.nearest_bin(x, y).T
        found += (level[r, a] - np.median(level[r], axis=1)).tolist()
    return float(np.mean(found)) * LOG_SCALE_DB


# Config ------------------------------------------------------------------------------


def get_config() -> Config:
    """Returns the config of `own_radar.py` for this recording."""
    return radar_config().replace(
        classes=CLASSES,
        model={"doppler_bins": GRID.num_doppler, "input_center": 0.09},
        data={"format": "own_adc:AdcRecordings"},
    )


# Recording ---------------------------------------------------------------------------


def simulate(root: pathlib.Path, num_drives: int) -> None:
    """Writes a simulated recording with four frames per drive."""
    options = SimulationOptions(
        grid=GRID.to_dict(),
        radar={"azimuth_elements": 12.0, "elevation_elements": 1.0},
        train_sequences=num_drives,
        test_sequences=0,
        frames_per_sequence=4,
    )
    source = make_source(options)
    for folder in ("adc", "boxes"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for number in source.numbers:
        sequence = source.make(number)
        simulator = SequenceSimulator(sequence, options)
        boxes, counts = [], []
        for spec in source.frames(number):
            frame = sequence.frame(spec.scene_idx)
            given = simulator.radar_input(frame)
            samples = simulate_adc(
                given.scatterers, given.noise_power, given.key, RADAR
            )
            counts.append(to_counts(np.asarray(samples)))
            objects = zip(frame.cls, frame.boxes, strict=True)
            is_seen = simulator.is_radar_visible(frame, given)
            boxes.append([
                {"class": SIMULATED[cls], "box": box.tolist()}
                for (cls, box), seen in zip(objects, is_seen, strict=True)
                if seen
            ])  # fmt: skip
        np.concatenate(counts).tofile(root / "adc" / f"{number:04d}.bin")
        text = json.dumps(boxes)  # after the radar file
        (root / "boxes" / f"{number:04d}.json").write_text(text)


def to_counts(samples: np.ndarray) -> np.ndarray:
    """Returns 16-bit samples in the order of xWR16xx, with the noise at a few counts."""
    pairs = samples.reshape(*samples.shape[:-1], -1, 2) * 2e-5
    words = np.stack([pairs.real, pairs.imag], axis=-2)  # two real, two imaginary parts
    return np.clip(np.rint(words), -(2**15), 2**15 - 1).astype("<i2").ravel()


@click.command()
@click.argument("root", type=click.Path(path_type=pathlib.Path))
@click.option("--workdir", default="runs/own_adc", show_default=True)
@click.option("--drives", default=100, show_default=True, help="Drives to simulate.")
@click.option("--epochs", help="Epochs. Default: that of the config.", type=int)
def main(root, workdir, drives, epochs):
    """Train on the recordings in ROOT, which are simulated if they are missing."""
    entry.set_up_jax()
    with entry.exit_codes():
        if not (root / "boxes").exists():
            with files.swapped_in(root) as folder:  # all drives or none
                simulate(folder, drives)
        config = get_config().replace(data={"roots": (str(root),)})
        frames = AdcRecordings.from_options(config.data, CLASSES)
        require(len(frames) > 0, "ROOT", str(root), "a folder with recordings")
        first = frames.part({frame.sequence for frame in frames[:40]}, None)
        levels = echoes_db(first), echoes_db(first, mirrored=True)
        click.echo("echoes at boxes {:.1f} dB, mirrored {:.1f} dB".format(*levels))
        frame = max(frames, key=lambda frame: len(frame.boxes))
        scene = radejax.frame_scene(frame, frame.read_projection(GRID), GRID)
        save_figure(radejax.draw_frame(scene), root / "frame.png")
        if epochs is not None:
            config = config.replace(train={"num_epochs": epochs})
        radejax.run(config, workdir)


if __name__ == "__main__":
    main()
