"""Writes simulated sequences as a K-Radar tree that no reader can tell from the real.

Frames are written one by one, the label file last: a frame is there when its label
file is. A killed run goes on where it stopped and ends with the same bytes. Scenes and
images are Python and made by worker processes, the radar's part by this one's device.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import json
import logging
import os
import pathlib
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any

import jax
import numpy as np
from PIL import Image
from tqdm import tqdm

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.workers import process_pool
from radejax.data.kradar import write as kradar_write
from radejax.data.kradar.folders import SIMULATION_MARKER
from radejax.data.kradar.labels import Label
from radejax.geometry.camera import CameraCalibration
from radejax.simulation.camera.renderer import CameraRenderer, stereo_calibration
from radejax.simulation.config import SimulationConfig, default_config
from radejax.simulation.scene_sources import FrameSpec, SceneSource, make_source
from radejax.simulation.simulator import RadarInput, SequenceSimulator, radar_frame

__all__ = ["default_config", "simulate_dataset"]

_LABELS = "info_label_v2_1"
_PNG_BYTES_PER_PIXEL = 0.3  # 0.13 to 0.47 measured
_FEW_FRAMES = 100  # done before worker processes have started
_TESSERACTS_AT_A_TIME = 2  # on the device or on their way to disk: 260 MB each

_Prepare = Callable[[int, FrameSpec], tuple[RadarInput, list[Label]]]

_log = logging.getLogger(__name__)


def simulate_dataset(
    config: Mapping[str, Any],
    root: str | os.PathLike,
    *,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Simulates a data set into `root`, or finishes or reuses the one that is there.

    Args:
        config: Plain values as `default_config` returns (a mapping or ConfigDict).
        root: Folder of the data set; made if missing.
        num_workers: Processes that make scenes and draw images; 0: this one; None: one a
            core, or for few frames this one.
        progress: Show a progress bar.

    Returns:
        `root` as a path, with a complete K-Radar tree in it: per sequence tesseracts,
        front images, labels (v2.1), calibration and description; splits, camera
        calibrations and, for a grid other than K-Radar's, `radar_grid.json`.

    Raises:
        UserError: A config value is wrong, `root` holds something else or a data set
            of another config, the disk is full, or a worker was killed.
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
        _write_frames(root, checked, source, num_workers, progress)
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
    num_workers: int | None,
    progress: bool,
) -> None:
    """Every frame that is not there yet; next sequences start before one has ended."""
    missing = list(_missing(root, config, source))
    total = sum(len(source.frames(n)) for n in source.numbers)
    bar = tqdm(total=total, unit="frame", desc="simulate", disable=not progress)
    bar.update(total - len(missing))
    if num_workers is None:
        num_workers = (os.cpu_count() or 1) if len(missing) > _FEW_FRAMES else 0
    # Threads wait for workers and the device alike.
    num_threads = num_workers + _TESSERACTS_AT_A_TIME
    is_large = config.output == "tesseract"
    turn = threading.Semaphore(_TESSERACTS_AT_A_TIME if is_large else num_threads)
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

    with (
        bar,
        _prepare_by(num_workers, root, config, source) as prepare,
        concurrent.futures.ThreadPoolExecutor(num_threads) as pool,
    ):
        try:
            for number, spec in missing:
                running.add(
                    pool.submit(_write_frame, root, config, number, spec, prepare, turn)
                )
                wait(2 * num_threads)
            wait(0)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _missing(
    root: pathlib.Path, config: SimulationConfig, source: SceneSource
) -> Iterator[tuple[int, FrameSpec]]:
    """Sequence and frame without a label file; writes what a sequence has once."""
    for number in source.numbers:
        folder, specs = root / str(number), source.frames(number)
        kradar_write.write_description(
            folder / "description.txt", *source.conditions(number)
        )
        radar_idx, lidar_idx, *_ = specs[0].indices
        kradar_write.write_calibration(
            folder / "info_calib" / "calib_radar_lidar.txt",
            radar_idx - lidar_idx,
            *config.lidar_to_radar_m[:2],
        )
        there = {path.stem for path in (folder / _LABELS).glob("*.txt")}
        yield from ((number, spec) for spec in specs if spec.name not in there)


def _write_frame(
    root: pathlib.Path,
    config: SimulationConfig,
    number: int,
    spec: FrameSpec,
    prepare: _Prepare,
    turn: threading.Semaphore,
) -> None:
    """One frame: image, radar, then labels."""
    given, labels = prepare(number, spec)
    folder = root / str(number)
    with turn:
        _write_radar(folder, config, spec.indices[0], given)
    path = folder / _LABELS / f"{spec.name}.txt"
    kradar_write.write_labels(path, spec.indices, spec.timestamp_s, labels)


def _write_radar(
    folder: pathlib.Path, config: SimulationConfig, number: int, given: RadarInput
) -> None:
    grid, parameters = config.make_grid(), config.make_parameters()
    output = radar_frame(given, grid, parameters, config.output)
    if config.output == "tesseract":
        path = folder / "radar_tesseract" / f"tesseract_{number:05d}.mat"
        kradar_write.write_tesseract(path, output)
        return
    path = folder / "DERA_tesseract" / f"DERA_tesseract_{number:05d}.npy"
    with files.atomic_write(path) as file:
        np.save(file, np.moveaxis(output, -1, 0))  # [D+E, R, A]


class _Scenes:
    """Makes what a frame has but for the radar's part, and writes its image."""

    def __init__(
        self, root: pathlib.Path, config: SimulationConfig, source: SceneSource
    ) -> None:
        self._root, self._config, self._source = root, config, source
        # Threads may ask for frames of the sequence before.
        self._sequence = functools.lru_cache(maxsize=8)(self._make)

    def prepare(self, number: int, spec: FrameSpec) -> tuple[RadarInput, list[Label]]:
        """Radar input and labels of a frame; its image is written."""
        config, camera_idx = self._config, spec.indices[2]
        simulator, renderer = self._sequence(number)
        frame = simulator.sequence.frame(spec.scene_idx)
        if renderer:
            name = f"cam-front_{camera_idx:05d}.png"
            path = self._root / str(number) / "cam-front" / name
            with files.atomic_write(path) as file:
                write_png(file, renderer.render(frame))
        given = simulator.radar_input(frame)
        labels = simulator.labels(
            frame, given, config.lidar_to_radar_m, config.label_distance_m
        )
        return given, labels

    def _make(self, number: int) -> tuple[SequenceSimulator, CameraRenderer | None]:
        config, sequence = self._config, self._source.make(number)
        grid, parameters = config.make_grid(), config.make_parameters()
        simulator = SequenceSimulator(sequence, grid, parameters, config.seed)
        pair = _cameras(config)
        if not pair:
            return simulator, None
        return simulator, CameraRenderer(
            sequence,
            pair,
            config.seed,
            cover_lens=config.cover_lens,
            content=config.camera_content,
        )


@contextlib.contextmanager
def _prepare_by(num_workers: int, *of_scenes: Any) -> Iterator[_Prepare]:
    """`_Scenes.prepare`, by worker processes if there are to be any."""
    if not num_workers:
        yield _Scenes(*of_scenes).prepare
        return
    with process_pool(num_workers, _start_worker, *of_scenes) as submit:
        yield lambda *frame: submit(_prepare_in_worker, *frame).result()


_scenes: Any = None


def _start_worker(*of_scenes: Any) -> None:
    """The device is the parent's: this process has none."""
    global _scenes
    jax.config.update("jax_platforms", "cpu")
    _scenes = _Scenes(*of_scenes)


def _prepare_in_worker(number: int, spec: FrameSpec) -> tuple[RadarInput, list[Label]]:
    return _scenes.prepare(number, spec)


def write_png(file: IO[bytes], image: np.ndarray) -> None:
    """PNG, fast rather than small."""
    Image.fromarray(image).save(file, format="PNG", compress_level=1)
