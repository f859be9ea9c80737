"""Writes simulated sequences as a K-Radar tree that no reader can tell from the real.

Frames are written one by one, the label file last: a frame is there when its label
file is. A killed run goes on where it stopped and ends with the same bytes.
"""

from __future__ import annotations

import concurrent.futures
import json
import logging
import os
import pathlib
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from radejax.core import files
from radejax.core.errors import UserError
from radejax.data.kradar import write as kradar_write
from radejax.data.kradar.folders import SIMULATION_MARKER
from radejax.geometry.calibration import CameraCalibration
from radejax.simulation.camera.renderer import CameraRenderer, stereo_calibration
from radejax.simulation.config import SimulationConfig, default_config
from radejax.simulation.scene_sources import FrameSpec, SceneSource, make_source
from radejax.simulation.simulator import SequenceSimulator

__all__ = ["default_config", "simulate_dataset"]

_PNG_BYTES_PER_PIXEL = 0.3  # 0.13 to 0.47 measured

_log = logging.getLogger(__name__)


def simulate_dataset(
    config: Mapping[str, Any],
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
        _log.info("Simulated data set %s is complete: reused.", root)
        return root
    source = make_source(checked)
    num_frames, size = expected_size(checked, source)
    _log.info("%s: %d frames, about %.2g GB", root, num_frames, size / 1e9)
    content = _marker(checked)
    with files.disk_full(root / SIMULATION_MARKER):
        files.write_json(root / SIMULATION_MARKER, content)
        files.remove_stale(root)
        _write_common(root, checked, source)
        _write_frames(root, checked, source, num_threads, progress)
        files.write_json(root / SIMULATION_MARKER, content | {"finished": True})
    return root


def expected_size(config: SimulationConfig, source: SceneSource) -> tuple[int, float]:
    """Frames of a data set and about how many bytes its files take."""
    grid = config.make_grid()
    is_whole = config.output == "tesseract"
    numbers = np.prod(grid.shape_drea if is_whole else grid.projection_shape)
    pixels = 2 * config.image_width * config.image_height
    frames = sum(len(source.frames(number)) for number in source.numbers)
    return frames, frames * (4.0 * numbers + _PNG_BYTES_PER_PIXEL * pixels)


def _is_finished(root: pathlib.Path, config: SimulationConfig) -> bool:
    """True for a complete data set of this config; an error for anything alien."""
    if root.exists() and not root.is_dir():
        raise UserError(f"{root} is a file, expected a folder for the data set")
    marker = root / SIMULATION_MARKER
    if not marker.exists():
        if root.exists() and any(not p.name.endswith(".tmp") for p in root.iterdir()):
            raise UserError(
                f"{root} is not empty and holds no simulated data set;"
                " choose another folder"
            )
        return False
    files.claim(
        marker,
        _marker(config),
        "a data set of another simulation config",
        ignore=("finished",),
    )
    return files.read_json(marker, {"finished": bool})["finished"]


def _marker(config: SimulationConfig) -> dict[str, Any]:
    """What an unfinished data set says of itself; the fingerprint has the version."""
    return {
        "config": json.loads(config.to_json()),
        "finished": False,
        "fingerprint": config.fingerprint(),
    }


def _cameras(
    config: SimulationConfig,
) -> tuple[CameraCalibration, CameraCalibration] | tuple[()]:
    """Left and right camera, or none."""
    if not config.image_width:
        return ()
    size = config.image_width, config.image_height
    return stereo_calibration(config.lidar_to_radar_m, *size)


def _write_common(
    root: pathlib.Path, config: SimulationConfig, source: SceneSource
) -> None:
    """Splits, sensor axes, camera calibrations."""
    names: dict[str, list[tuple[int, str]]] = {"train": [], "test": []}
    for number in source.numbers:
        for spec in source.frames(number):
            names[spec.split].append((number, spec.name))
    kradar_write.write_splits(root / "split", **names)
    if config.grid != "kradar":
        kradar_write.write_grid(root, config.make_grid())
    for index, calibration in enumerate(_cameras(config)):
        path = root / "calib" / "common" / f"cam_front{index}.yml"
        files.write_text(path, calibration.to_kradar_text())


def _write_frames(
    root: pathlib.Path,
    config: SimulationConfig,
    source: SceneSource,
    num_threads: int,
    progress: bool,
) -> None:
    """Every frame that is not there yet; next sequences start before one has ended."""
    total = sum(len(source.frames(n)) for n in source.numbers)
    bar = tqdm(total=total, unit="frame", desc="simulate", disable=not progress)
    num_threads = max(num_threads, 1)
    running: set[concurrent.futures.Future[None]] = set()

    def wait(at_most: int) -> None:
        nonlocal running
        while len(running) > at_most:
            done, running = concurrent.futures.wait(
                running, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for future in done:
                future.result()
                bar.update()

    with bar, concurrent.futures.ThreadPoolExecutor(num_threads) as pool:
        try:
            for number in source.numbers:
                writer = _SequenceWriter(root / str(number), config, source, number)
                bar.update(len(source.frames(number)) - len(writer.missing))
                for spec in writer.missing:
                    running.add(pool.submit(writer.write, spec))
                    wait(2 * num_threads)
            wait(0)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class _SequenceWriter:
    """Writes one sequence into a folder; makes its simulator if frames are missing.

    Attributes:
        missing: Frames without a label file.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        config: SimulationConfig,
        source: SceneSource,
        number: int,
    ) -> None:
        self.folder, self.config = folder, config
        self.labels = folder / "info_label_v2_1"
        specs = source.frames(number)
        kradar_write.write_description(
            folder / "description.txt", *source.conditions(number)
        )
        radar_idx, lidar_idx, *_ = specs[0].indices
        kradar_write.write_calibration(
            folder / "info_calib" / "calib_radar_lidar.txt",
            radar_idx - lidar_idx,
            *config.lidar_to_radar_m[:2],
        )
        there = {path.stem for path in self.labels.glob("*.txt")}
        self.missing = [spec for spec in specs if spec.name not in there]
        if not self.missing:
            return
        sequence, seed = source.make(number), config.seed
        self.simulator = SequenceSimulator(
            sequence, config.make_grid(), config.make_parameters(), seed
        )
        if pair := _cameras(config):
            self.renderer = CameraRenderer(
                sequence,
                pair,
                seed,
                cover_lens=config.cover_lens,
                content=config.camera_content,
            )

    def write(self, spec: FrameSpec) -> None:
        """One frame: radar, image, then labels."""
        config, simulator = self.config, self.simulator
        radar_idx, _, camera_idx, *_ = spec.indices
        frame = simulator.sequence.frame(spec.scene_idx)
        given = simulator.radar_input(frame)
        output = simulator.run(given, config.output)
        if config.output == "tesseract":
            path = self.folder / "radar_tesseract" / f"tesseract_{radar_idx:05d}.mat"
            kradar_write.write_tesseract(path, output)
        else:
            name = f"DERA_tesseract_{radar_idx:05d}.npy"
            with files.atomic_write(self.folder / "DERA_tesseract" / name) as file:
                np.save(file, np.moveaxis(output, -1, 0))  # [D+E, R, A]
        if config.image_width:
            path = self.folder / "cam-front" / f"cam-front_{camera_idx:05d}.png"
            with files.atomic_write(path) as file:
                write_png(file, self.renderer.render(frame))
        labels = simulator.labels(
            frame, given, config.lidar_to_radar_m, config.label_distance_m
        )
        path = self.labels / f"{spec.name}.txt"
        kradar_write.write_labels(path, spec.indices, spec.timestamp_s, labels)


def write_png(file: IO[bytes], image: np.ndarray) -> None:
    """PNG, fast rather than small."""
    Image.fromarray(image).save(file, format="PNG", compress_level=1)
