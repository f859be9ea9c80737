"""Writes simulated sequences as a K-Radar tree that no reader can tell from the real.

Frames are written one by one, the label file last: a frame is there when its label
file is. A killed run goes on where it stopped and ends with the same bytes.
"""

from __future__ import annotations

import concurrent.futures
import functools
import io
import json
import logging
import os
import pathlib
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from radejax.data import kradar_write
from radejax.errors import UserError
from radejax.simulation.camera import CameraRenderer, stereo_calibration
from radejax.simulation.config import SimulationConfig, default_config
from radejax.simulation.scene import FRAME_PERIOD_S, Sequence
from radejax.simulation.simulator import SequenceSimulator
from radejax.simulation.traffic import make_sequence

__all__ = ["default_config", "simulate_dataset"]

MARKER = "simulation.json"
_FIRST_TIMESTAMP_S = 1.65e9


def simulate_dataset(
    config: Any,
    root: str | os.PathLike,
    *,
    num_threads: int = 2,
    progress: bool = True,
) -> pathlib.Path:
    """Simulates a data set into `root`, or finishes or reuses the one that is there.

    Args:
        config: Plain values as `default_config` returns (a mapping or ConfigDict).
        root: Folder of the data set; made if missing.
        num_threads: Frames at a time.
        progress: Show a progress bar.

    Returns:
        `root` as a path, with a complete K-Radar tree in it: per sequence tesseracts,
        front images, labels (v2.1), calibration and description; splits, camera
        calibrations and, for a grid other than K-Radar's, `radar_grid.json`.

    Raises:
        UserError: A config value is wrong, `root` holds something else or a data set
            of another config, or the disk is full.
    """
    checked = SimulationConfig.from_mapping(config)
    root = pathlib.Path(root)
    if _is_finished(root, checked):
        logging.info("Simulated data set %s is complete: reused.", root)
        return root
    try:
        root.mkdir(parents=True, exist_ok=True)
        _write_marker(root, checked, finished=False)
        _write_common(root, checked)
        _write_frames(root, checked, num_threads, progress)
        _write_marker(root, checked, finished=True)
    except OSError as error:
        if error.errno in (28, 122):  # no space left, quota exceeded
            raise kradar_write.no_space_error(root / MARKER) from error
        raise
    return root


def _is_finished(root: pathlib.Path, config: SimulationConfig) -> bool:
    """True for a complete data set of this config; an error for anything alien."""
    if root.exists() and not root.is_dir():
        raise UserError(f"{root} is a file, expected a folder for the data set")
    marker = root / MARKER
    if not marker.exists():
        if root.exists() and any(not p.name.endswith(".tmp") for p in root.iterdir()):
            raise UserError(
                f"{root} is not empty and holds no simulated data set;"
                " choose another folder"
            )
        return False
    found = json.loads(marker.read_text())
    if found["fingerprint"] != config.fingerprint():
        changed = _changed_fields(found["config"], json.loads(config.to_json()))
        raise UserError(
            f"{root} holds a data set of another simulation config (differs in:"
            f" {', '.join(changed) or 'version'}); choose another folder or delete it"
        )
    return bool(found["finished"])


def _changed_fields(old: dict, new: dict) -> list[str]:
    return sorted(k for k in {*old, *new} if old.get(k) != new.get(k))


def _write_marker(
    root: pathlib.Path, config: SimulationConfig, *, finished: bool
) -> None:
    content = {
        "fingerprint": config.fingerprint(),
        "finished": finished,
        "config": json.loads(config.to_json()),
    }
    with kradar_write.atomic_write(root / MARKER) as file:
        file.write(json.dumps(content, indent=1, sort_keys=True).encode())


def _write_common(root: pathlib.Path, config: SimulationConfig) -> None:
    """Splits, sensor axes, camera calibrations."""
    train = range(1, config.train_sequences + 1)
    test = range(
        config.train_sequences + 1, config.train_sequences + config.test_sequences + 1
    )
    kradar_write.write_splits(
        root / "split",
        *(
            [(n, name) for n in part for name in _frame_names(config, n)]
            for part in (train, test)
        ),
    )
    if config.grid != "kradar":
        kradar_write.write_grid(root, config.make_grid())
    if config.image_width:
        pair = stereo_calibration(
            config.lidar_to_radar_m, config.image_width, config.image_height
        )
        for name, calibration in zip(("cam_front0", "cam_front1"), pair, strict=True):
            path = root / "calib" / "common" / f"{name}.yml"
            with kradar_write.atomic_write(path) as file:
                file.write(calibration.to_kradar_text().encode("ascii"))


def _offsets(config: SimulationConfig, number: int) -> np.ndarray:
    """Frame numbers of radar, front camera, long LiDAR, others at LiDAR frame 0."""
    rng = np.random.default_rng([config.seed, number, 3])
    return rng.integers(1, 42, size=4)


def _indices(
    config: SimulationConfig, number: int, frame: int
) -> tuple[int, int, int, int, int]:
    """Frame numbers of the five sensors in the order of a label header."""
    radar, camera, long_lidar, others = map(int, _offsets(config, number))
    lidar = frame + 1
    return lidar + radar, lidar, lidar + camera, lidar + long_lidar, lidar + others


def _frame_names(config: SimulationConfig, number: int) -> list[str]:
    """`<radar>_<lidar>` of every frame of a sequence."""
    indices = (_indices(config, number, i) for i in range(config.frames_per_sequence))
    return [f"{radar:05d}_{lidar:05d}" for radar, lidar, *_ in indices]


def _write_frames(
    root: pathlib.Path, config: SimulationConfig, num_threads: int, progress: bool
) -> None:
    """Every frame that is not there yet."""
    count = config.train_sequences + config.test_sequences
    total = count * config.frames_per_sequence
    bar = tqdm(total=total, unit="frame", desc="simulate", disable=not progress)
    with bar, concurrent.futures.ThreadPoolExecutor(max(num_threads, 1)) as pool:
        for number in range(1, count + 1):
            writer = _SequenceWriter(root, config, number)
            missing = writer.missing_frames()
            bar.update(config.frames_per_sequence - len(missing))
            futures = [pool.submit(writer.write, index) for index in missing]
            try:
                for future in concurrent.futures.as_completed(futures):
                    future.result()
                    bar.update()
            except BaseException:
                for future in futures:
                    future.cancel()
                raise


class _SequenceWriter:
    """Writes frames of one sequence into `<root>/<number>/`."""

    def __init__(
        self, root: pathlib.Path, config: SimulationConfig, number: int
    ) -> None:
        self.root, self.config, self.number = root, config, number
        self.folder = root / str(number)
        self.names = _frame_names(config, number)
        environment, time, weather = config.conditions(number)
        kradar_write.write_description(
            self.folder / "description.txt", environment, time, weather
        )
        kradar_write.write_calibration(
            self.folder / "info_calib" / "calib_radar_lidar.txt",
            int(_offsets(config, number)[0]),
            *config.lidar_to_radar_m[:2],
        )

    @functools.cached_property
    def sequence(self) -> Sequence:
        environment, time, weather = self.config.conditions(self.number)
        return make_sequence(
            self.number,
            environment=environment,
            time=time,
            weather=weather,
            num_frames=self.config.frames_per_sequence,
            rng=np.random.default_rng([self.config.seed, self.number]),
        )

    def missing_frames(self) -> list[int]:
        """Frames without a label file; makes the simulator if there are any."""
        labels = self.folder / "info_label_v2_1"
        there = set(os.listdir(labels)) if labels.is_dir() else set()
        missing = [i for i, n in enumerate(self.names) if f"{n}.txt" not in there]
        if missing:
            config = self.config
            self.simulator = SequenceSimulator(
                self.sequence, config.make_grid(), config.make_parameters(), config.seed
            )
            if config.image_width:
                pair = stereo_calibration(
                    config.lidar_to_radar_m, config.image_width, config.image_height
                )
                self.renderer = CameraRenderer(self.sequence, pair, config.seed)
        return missing

    def write(self, index: int) -> None:
        """One frame: radar, image, then labels."""
        config, simulator = self.config, self.simulator
        indices = _indices(config, self.number, index)
        radar_idx, _, camera_idx, *_ = indices
        frame = self.sequence.frame(index)
        given = simulator.radar_input(index, frame)
        output = simulator.run(given, config.output)
        if config.output == "tesseract":
            path = self.folder / "radar_tesseract" / f"tesseract_{radar_idx:05d}.mat"
            kradar_write.write_tesseract(path, output)
        else:
            self._write_array(f"projection_{radar_idx:05d}.npy", output)
        if config.image_width:
            path = self.folder / "cam-front" / f"cam-front_{camera_idx:05d}.png"
            with kradar_write.atomic_write(path) as file:
                file.write(_png(self.renderer.render(frame)))
        kradar_write.write_labels(
            self.folder / "info_label_v2_1" / f"{self.names[index]}.txt",
            indices,
            _FIRST_TIMESTAMP_S + 1000.0 * self.number + FRAME_PERIOD_S * index,
            simulator.labels(
                frame, given, config.lidar_to_radar_m, config.label_distance_m
            ),
        )

    def _write_array(self, name: str, values: np.ndarray) -> None:
        with kradar_write.atomic_write(self.folder / "projections" / name) as file:
            np.save(file, values)


def _png(image: np.ndarray) -> bytes:
    """PNG, fast rather than small."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=1)
    return buffer.getvalue()
