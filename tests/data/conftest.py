"""A small dataset in K-Radar's folders, written with the package's own writers."""

import pathlib

import numpy as np
import pytest

from radejax.data.kradar import write
from radejax.data.kradar.labels import LABEL_CLASSES, MEDIAN_SIZES_M, Label
from radejax.geometry.radar_grid import RadarGrid

GRID = RadarGrid.reduced(num_doppler=6, num_range=16, num_elevation=5, num_azimuth=12)


def make_labels(rng: np.random.Generator, number: int) -> list[Label]:
    """Objects ahead of the sensor, of all classes, some hidden from the radar."""
    labels = []
    for track_id in range(number):
        x, y = rng.uniform(10, 60), rng.uniform(-6, 6)
        z, scale, yaw = rng.uniform(-1, 1), rng.uniform(0.7, 1.4, 3), rng.uniform(-4, 4)
        cls = LABEL_CLASSES[rng.integers(7)]
        box = (x, y, z, *scale * MEDIAN_SIZES_M[cls], yaw)
        visibility = rng.choice(["R", "R", "L", "L1"])
        labels.append(Label(cls, tuple(map(float, box)), str(visibility), track_id))
    return labels


def write_kradar(
    root: pathlib.Path, *, sequences=(1, 2), num_frames=6, grid=GRID, seed=0
) -> None:
    """Sequences with labels, tesseracts, calibration, description and splits."""
    rng = np.random.default_rng(seed)
    write.write_grid(root, grid)
    splits = {"train": [], "test": []}
    for sequence in sequences:
        folder = root / str(sequence)
        path = folder / "info_calib/calib_radar_lidar.txt"
        write.write_calibration(path, 3, -2.5, 0.25)
        write.write_description(folder / "description.txt", "urban", "day", "fog")
        for lidar in range(1, num_frames + 1):
            name = f"{lidar + 3:05d}_{lidar:05d}"
            write.write_labels(
                folder / f"info_label/{name}.txt",
                (lidar + 3, lidar, 2 * lidar, lidar, 2 * lidar + 1),
                1643292946.5 + lidar / 10,
                make_labels(rng, int(rng.integers(0, 5))),
            )
            write.write_tesseract(
                folder / f"radar_tesseract/tesseract_{lidar + 3:05d}.mat",
                (10 ** rng.uniform(3, 15, grid.shape_drea)).astype(np.float32),
            )
            split = "train" if (lidar - 1) * 4 // num_frames % 2 == 0 else "test"
            splits[split].append((sequence, name))
    write.write_splits(root / "split", splits["train"], splits["test"])


@pytest.fixture(scope="session")
def kradar_writer():
    """The function that writes such a dataset."""
    return write_kradar


@pytest.fixture(scope="session")
def kradar_root(tmp_path_factory) -> pathlib.Path:
    """A dataset of two sequences with six frames each. Do not change it."""
    root = tmp_path_factory.mktemp("kradar")
    write_kradar(root)
    return root
