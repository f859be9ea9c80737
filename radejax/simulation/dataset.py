"""Writes simulated sequences in K-Radar's folders and file formats.

Frames are written one by one. The label file of a frame is written last, so a frame is
complete if its label file exists. A killed run can be resumed and gives the same bytes.
Worker processes create scenes and images, and the main process computes the radar data on
its device.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import itertools
import json
import logging
import os
import pathlib
import pickle
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from PIL import Image
from tqdm import tqdm

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.workers import default_workers, process_pool
from radejax.data.kradar import write as kradar_write
from radejax.data.kradar.folders import SIMULATION_MARKER
from radejax.data.kradar.labels import Label
from radejax.geometry.camera import CameraCalibration
from radejax.simulation.camera.renderer import CameraRenderer, stereo_calibration
from radejax.simulation.config import SimulationOptions
from radejax.simulation.radar import tensor
from radejax.simulation.simulator import (
    FrameSpec,
    RadarInput,
    SceneSource,
    SequenceSimulator,
    make_source,
)

_LABELS = "info_label_v2_1"
_PNG_BYTES_PER_PIXEL = 0.3  # 0.13 to 0.47 measured
_FEW_FRAMES = 100  # simulated before worker processes would have started

_T = TypeVar("_T")

_log = logging.getLogger(__name__)


def simulate_dataset(
    options: SimulationOptions,
    root: str | os.PathLike,
    *,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Simulates a dataset into `root`, or finishes or reuses an existing dataset.

    Args:
        options: Options of the dataset.
        root: Folder of the dataset, which is created if it does not exist.
        num_workers: Number of processes that create scenes and render images. 0 uses only
            this process. None uses as many as CPUs and memory allow, or only this process
            for few frames.
        progress: Whether to show a progress bar.

    Returns:
        `root` as a path. The folder contains a complete K-Radar tree: tesseracts or
        projections, front images, labels (v2.1), calibration and description of each
        sequence, the splits, the camera calibrations and, for a grid other than
        K-Radar's, `radar_grid.json`.

    Raises:
        UserError: `root` contains other files or a dataset of other options, the disk is full,
            or a worker was killed.
    """
    root = files.as_path(root)
    if _is_finished(root, options):
        _log.info("Simulated dataset %s is complete: reused.", root)
        return root
    source = make_source(options)
    num_frames, size = expected_size(options, source)
    _log.info("%s: %d frames, about %.2g GB", root, num_frames, size / 1e9)
    content = _marker(options)
    with files.disk_full(root / SIMULATION_MARKER):
        files.write_json(root / SIMULATION_MARKER, content)
        files.remove_stale(root)
        writer = Writer(root, options, source)
        writer.write_common()
        writer.write_frames(num_workers, progress)
        files.write_json(root / SIMULATION_MARKER, content | {"finished": True})
    return root


def expected_size(options: SimulationOptions, source: SceneSource) -> tuple[int, float]:
    """Returns the number of frames of a dataset and its approximate size in bytes."""
    grid = options.make_grid()
    is_whole = options.output == "tesseract"
    numbers = np.prod(grid.shape_drea if is_whole else grid.projection_shape)
    pixels = 2 * options.image_width * options.image_height
    frames = sum(len(source.frames(number)) for number in source.numbers)
    return frames, frames * (4.0 * numbers + _PNG_BYTES_PER_PIXEL * pixels)


def _is_finished(root: pathlib.Path, options: SimulationOptions) -> bool:
    """Returns True if `root` contains the complete dataset of these options.

    Raises:
        UserError: `root` is a file, or contains other files or a dataset of other options.
    """
    if root.exists() and not root.is_dir():
        raise UserError(f"{root} is a file, expected a folder for the dataset")
    marker = root / SIMULATION_MARKER
    if not marker.exists():
        if root.exists() and any(not p.name.endswith(".tmp") for p in root.iterdir()):
            raise UserError(
                f"{root} is not empty and holds no simulated dataset;"
                " choose another folder"
            )
        return False
    what = "a dataset of another simulation config"
    files.claim(marker, _marker(options), what, ignore=("finished",))
    return files.read_object(marker, "finished")["finished"] is True


def _marker(options: SimulationOptions) -> dict[str, Any]:
    """Returns the content of the marker file of an unfinished dataset."""
    return {
        "config": json.loads(options.to_json()),
        "finished": False,
        "fingerprint": options.fingerprint(),
    }


class Writer:
    """Writes the files of a dataset; worker processes have a copy that prepares frames."""

    def __init__(
        self, root: pathlib.Path, options: SimulationOptions, source: SceneSource
    ) -> None:
        self.root, self.options, self.source = root, options, source
        self.grid, self.parameters = options.make_grid(), options.make_parameters()
        self.cameras: tuple[CameraCalibration, ...] = ()  # left and right
        if options.image_width:
            size = options.image_width, options.image_height
            self.cameras = stereo_calibration(options.radar_from_lidar_m, *size)

    def write_common(self) -> None:
        """Writes the splits, the sensor axes and the camera calibrations."""
        names: dict[str, list[tuple[int, str]]] = {"train": [], "test": []}
        for number in self.source.numbers:
            for spec in self.source.frames(number):
                names[spec.split].append((number, spec.name))
        kradar_write.write_splits(self.root / "split", **names)
        if self.options.grid != "kradar":
            kradar_write.write_grid(self.root, self.grid)
        for index, calibration in enumerate(self.cameras):
            path = self.root / "calib" / "common" / f"cam_front{index}.yml"
            files.write_text(path, calibration.to_kradar_text())

    def write_frames(self, num_workers: int | None, progress: bool) -> None:
        """Writes every frame that does not exist yet."""
        missing = list(self._missing())
        total = sum(len(self.source.frames(n)) for n in self.source.numbers)
        if num_workers is None:
            is_small = len(missing) <= _FEW_FRAMES
            num_workers = 0 if is_small else default_workers()
        compute = functools.partial(
            tensor.simulate,
            grid=self.grid,
            parameters=self.parameters,
            output=self.options.output,
        )
        with (
            tqdm(None, "simulate", total, unit="frame", disable=not progress) as bar,
            contextlib.closing(self._prepared(num_workers, missing)) as frames,
        ):
            bar.update(total - len(missing))
            computed = (
                (number, spec, compute(*given.arrays), labels)
                for number, spec, given, labels in frames
            )
            # The device computes the next frame while this one is written.
            for frame in _started_ahead(computed, 1):
                self.write_frame(*frame)
                bar.update()

    def _missing(self) -> Iterator[tuple[int, FrameSpec]]:
        """Yields the frames without a label file, and writes the files of each sequence.

        These files are the description and the calibration.
        """
        for number in self.source.numbers:
            folder, specs = self.root / str(number), self.source.frames(number)
            conditions = self.source.conditions(number)
            kradar_write.write_description(folder / "description.txt", *conditions)
            radar_idx, lidar_idx, *_ = specs[0].indices
            path = folder / "info_calib" / "calib_radar_lidar.txt"
            shift_m = self.options.radar_from_lidar_m[:2]
            kradar_write.write_calibration(path, radar_idx - lidar_idx, *shift_m)
            there = {path.stem for path in (folder / _LABELS).glob("*.txt")}
            yield from ((number, spec) for spec in specs if spec.name not in there)

    def write_frame(
        self, number: int, spec: FrameSpec, output: jax.Array, labels: list[Label]
    ) -> None:
        """Writes the radar data of one frame, then its labels."""
        folder, index = self.root / str(number), spec.indices[0]
        if self.options.output == "tesseract":
            path = folder / "radar_tesseract" / f"tesseract_{index:05d}.mat"
            tesseract = np.asarray(output).transpose(tensor.TESSERACT_OF_ROWS)
            kradar_write.write_tesseract(path, tesseract)
        else:
            path = folder / "DERA_tesseract" / f"DERA_tesseract_{index:05d}.npy"
            with files.atomic_write(path) as file:
                np.save(file, np.moveaxis(np.asarray(output), -1, 0))  # [D+E, R, A]
        path = folder / _LABELS / f"{spec.name}.txt"
        kradar_write.write_labels(path, spec.indices, spec.timestamp_s, labels)

    def prepare(self, number: int, spec: FrameSpec) -> tuple[RadarInput, list[Label]]:
        """Computes radar input and labels of one frame and writes its image."""
        options, camera_idx = self.options, spec.indices[2]
        simulator, renderer = self._sequence(number)
        frame = simulator.sequence.frame(spec.scene_idx)
        if renderer:
            name = f"cam-front_{camera_idx:05d}.png"
            path = self.root / str(number) / "cam-front" / name
            with files.atomic_write(path) as file:
                image = Image.fromarray(renderer.render(frame))
                image.save(file, format="PNG", compress_level=1)  # for speed
        given = simulator.radar_input(frame)
        labels = simulator.labels(
            frame, given, options.radar_from_lidar_m, options.label_distance_m
        )
        return given, labels

    @functools.cached_property
    def _sequence(self) -> Callable[[int], tuple[SequenceSimulator, Any]]:
        """Function that makes simulator and renderer by sequence number, with a cache."""
        return functools.lru_cache(maxsize=2)(self._make)

    def _make(self, number: int) -> tuple[SequenceSimulator, CameraRenderer | None]:
        options, sequence = self.options, self.source.make(number)
        simulator = SequenceSimulator(
            sequence, self.grid, self.parameters, options.seed
        )
        if not self.cameras:
            return simulator, None
        cover_lens, mode = options.cover_lens, options.camera_mode
        renderer = CameraRenderer(
            sequence, self.cameras, options.seed, cover_lens=cover_lens, mode=mode
        )
        return simulator, renderer

    def _prepared(
        self, num_workers: int, missing: Sequence[tuple[int, FrameSpec]]
    ) -> Generator[tuple[int, FrameSpec, RadarInput, list[Label]], None, None]:
        """Yields the sequence number, frame, radar input and labels of each frame, in order.

        The generator starts `num_workers` processes, or uses this process if it is 0.
        Closing the generator ends the processes.
        """
        if not num_workers:
            for frame in missing:
                yield (*frame, *self.prepare(*frame))
            return
        with process_pool(num_workers, _start_worker, self) as submit:
            started = ((frame, submit(_prepare_in_worker, *frame)) for frame in missing)
            for frame, future in _started_ahead(started, 2 * num_workers):
                path = pathlib.Path(future.result())
                given, labels = pickle.loads(path.read_bytes())
                path.unlink()
                yield (*frame, given, labels)


def _started_ahead(items: Iterator[_T], count: int) -> Iterator[_T]:
    """Yields each item after the next `count` items have been taken from the iterator.

    Taking an item starts its computation.
    """
    waiting = collections.deque(itertools.islice(items, count))
    while waiting:
        waiting.extend(itertools.islice(items, 1))
        yield waiting.popleft()


_writer: Any = None


def _start_worker(writer: Writer) -> None:
    """Sets up a worker process, which uses the CPU as the parent uses the accelerator."""
    global _writer
    jax.config.update("jax_platforms", "cpu")
    _writer = writer


def _prepare_in_worker(number: int, spec: FrameSpec) -> str:
    """Prepares one frame, writes the result to a file and returns the path of the file.

    The result itself is too large to be returned by a worker.
    """
    path = _writer.root / f".{number}_{spec.name}.tmp"
    path.write_bytes(pickle.dumps(_writer.prepare(number, spec)))
    return str(path)
