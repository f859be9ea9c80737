"""Writes simulated sequences in K-Radar's folders and file formats.

Frames are written one by one. The label file of a frame is written last, so a frame is
complete if its label file exists. A killed run can be resumed and gives the same bytes.
Worker processes create scenes and images, and the main process computes the radar data on
its device.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import hashlib
import itertools
import json
import logging
import pathlib
import pickle
from collections.abc import Callable, Generator, Iterator
from typing import TypeVar

import jax
import numpy as np
from PIL import Image
from tqdm import tqdm

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.workers import default_workers, end_rerun, process_pool
from radejax.data.kradar import motion
from radejax.data.kradar import write as kradar_write
from radejax.data.kradar.folders import SIMULATION_MARKER
from radejax.data.kradar.labels import Label
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

_Simulators = tuple[SequenceSimulator, CameraRenderer | None]
_T = TypeVar("_T")

_log = logging.getLogger(__name__)


def simulate_dataset(
    options: SimulationOptions,
    root: files.PathLike,
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
        projections, front images, labels (v2.1), calibration, motion and description of
        each sequence, the splits, the camera calibrations and, for a grid other than
        K-Radar's, `radar_grid.json`.

    Raises:
        UserError: `root` contains other files or a dataset of other options, the disk is full,
            or a worker was killed.
        DataError: The dataset was finished and files of it are missing.
    """
    end_rerun()
    root = files.as_path(root)
    if _is_finished(root, options):
        _log.info("Simulated dataset %s is complete: reused.", root)
        return root
    source = make_source(options)
    total, size = expected_size(options, source)
    _log.info("%s: %d frames, about %.2g GB", root, total, size / 1e9)
    content = _marker(options)
    with files.disk_full(root / SIMULATION_MARKER):
        files.write_json(root / SIMULATION_MARKER, content)
        files.remove_stale(root)
        writer = Writer(root, options, source)
        missing = writer.write_common()
        if num_workers is None:
            is_small = len(missing) <= _FEW_FRAMES
            num_workers = 0 if is_small else default_workers()
        with tqdm(None, "simulate", total, unit="frame", disable=not progress) as bar:
            bar.update(total - len(missing))
            writer.write_frames(missing, num_workers, bar)
        files.write_json(root / SIMULATION_MARKER, content | {"finished": _count(root)})
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
        DataError: The dataset was finished and files of it are missing.
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
    finished = files.read_object(marker, "finished")["finished"]
    if not isinstance(finished, dict):
        return finished is True
    there = _count(root)
    # All radar data may have been deleted after `preprocess`, or be a reduced release.
    has_radar = any("tesseract" in name for name in there)
    for name, count in finished.items():
        found = there.get(name, 0 if has_radar or "tesseract" not in name else count)
        if found < count:
            raise DataError(
                f"{root} is not complete: {name} has {found} of {count} files; copy it "
                "again, or delete the dataset to simulate it again"
            )
    return True


def _count(root: pathlib.Path) -> dict[str, int]:
    """Returns the number of files in every folder of a dataset."""
    patterns = ("[0-9]*", "[0-9]*/*", "split", "calib/*")
    folders = (p for pattern in patterns for p in root.glob(pattern) if p.is_dir())
    return {
        str(folder.relative_to(root)): len(list(folder.glob("[!.]*.*")))
        for folder in sorted(folders)
    }


def _marker(options: SimulationOptions) -> files.JsonObject:
    """Returns the content of the marker file of an unfinished dataset."""
    content: files.JsonObject = {
        "config": json.loads(options.to_json()),
        "finished": False,
        "fingerprint": options.fingerprint(),
    }
    if options.is_own:  # the file may have changed
        scenes = files.read_text(options.scenes).encode()
        content["scenes_sha256"] = hashlib.sha256(scenes).hexdigest()
    return content


@dataclasses.dataclass
class Writer:
    """Writes the files of a dataset; worker processes have a copy that prepares frames."""

    root: pathlib.Path
    options: SimulationOptions
    source: SceneSource

    def write_common(self) -> list[FrameSpec]:
        """Writes everything but frames, and returns the frames without a label file."""
        missing: list[FrameSpec] = []
        names: dict[str, list[tuple[int, str]]] = {"train": [], "test": []}
        for number in self.source.numbers:
            folder = self.root / str(number)
            specs = self.source.frames(number)
            conditions = self.source.conditions(number)
            kradar_write.write_description(folder / "description.txt", *conditions)
            radar_idx, lidar_idx, *_ = specs[0].indices
            path = folder / "info_calib" / "calib_radar_lidar.txt"
            shift_m = self.options.radar_from_lidar_m[:2]
            kradar_write.write_calibration(path, radar_idx - lidar_idx, *shift_m)
            there = {path.stem for path in (folder / _LABELS).glob("*.txt")}
            missing += [spec for spec in specs if spec.name not in there]
            for spec in specs:
                names[spec.split].append((number, spec.name))
            if not (folder / "info_motion" / "objects.csv").is_file():
                self._write_motion(folder / "info_motion", specs)
        kradar_write.write_splits(self.root / "split", **names)
        if self.options.grid != "kradar":
            kradar_write.write_grid(self.root, self.options.make_grid())
        if self.options.image_width:
            for index, calibration in enumerate(stereo_calibration(self.options)):
                path = self.root / "calib" / "common" / f"cam_front{index}.yml"
                files.write_text(path, calibration.to_kradar_text())
        return missing

    def _write_motion(self, folder: pathlib.Path, specs: list[FrameSpec]) -> None:
        """Writes the motion of the ego vehicle and of the labeled objects."""
        sequence = self.source.make(specs[0].sequence)
        tracks = sequence.tracks
        ego = [motion.EGO_HEADER]
        objects = [motion.OBJECT_HEADER]
        for spec in specs:
            frame = sequence.frame(spec.scene_idx, self.options.label_distance_m)
            moved = frame.ego_velocity_mps[0], frame.ego_yaw_rate_radps
            numbers = spec.timestamp_s, *sequence.ego_pose[spec.scene_idx], *moved
            ego.append(",".join([spec.name, *(f"{x:.6f}" for x in numbers)]))
            speed = np.linalg.norm(frame.velocity_mps, axis=1)
            columns = (*frame.relative_velocity_mps.T, speed)
            for n, *motion_mps in zip(frame.track, *columns, strict=True):
                if (track_id := tracks.track_id[n]) >= 0:
                    identity = f"{spec.name},{tracks.label_cls[n]},{track_id}"
                    objects.append(
                        ",".join([identity, *map("{:.6f}".format, motion_mps)])
                    )
        files.write_text(folder / "ego.csv", "\n".join([*ego, ""]))
        files.write_text(folder / "objects.csv", "\n".join([*objects, ""]))

    def write_frames(
        self, missing: list[FrameSpec], num_workers: int, bar: tqdm
    ) -> None:
        """Writes the missing frames, and advances a progress bar."""
        compute = functools.partial(
            tensor.simulate,
            grid=self.options.make_grid(),
            parameters=self.options.radar.make_parameters(),
            output=self.options.output,
        )
        with contextlib.closing(self._prepared(num_workers, missing)) as frames:
            computed = (
                (spec, compute(*given.arrays), labels) for spec, given, labels in frames
            )
            # The device computes the next frame while this one is written.
            for frame in _started_ahead(computed, 1):
                self.write_frame(*frame)
                bar.update()

    def write_frame(
        self, spec: FrameSpec, output: jax.Array, labels: list[Label]
    ) -> None:
        """Writes the radar data of one frame, then its labels."""
        folder = self.root / str(spec.sequence)
        index = spec.indices[0]
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

    def prepare(self, spec: FrameSpec) -> tuple[RadarInput, list[Label]]:
        """Computes radar input and labels of one frame and writes its image."""
        simulator, renderer = self._sequence(spec.sequence)
        frame = simulator.sequence.frame(spec.scene_idx)
        if renderer:
            name = f"cam-front_{spec.indices[2]:05d}.png"
            path = self.root / str(spec.sequence) / "cam-front" / name
            with files.atomic_write(path) as file:
                image = Image.fromarray(renderer.render(frame))
                image.save(file, format="PNG", compress_level=1)  # for speed
        given = simulator.radar_input(frame)
        return given, simulator.labels(frame, given)

    @functools.cached_property
    def _sequence(self) -> Callable[[int], _Simulators]:
        """Function that makes simulator and renderer by sequence number, with a cache."""
        return functools.lru_cache(maxsize=2)(self._make)

    def _make(self, number: int) -> _Simulators:
        sequence = self.source.make(number)
        is_shown = self.options.image_width > 0
        renderer = CameraRenderer(sequence, self.options) if is_shown else None
        return SequenceSimulator(sequence, self.options), renderer

    def _prepared(
        self, num_workers: int, missing: list[FrameSpec]
    ) -> Generator[tuple[FrameSpec, RadarInput, list[Label]], None, None]:
        """Yields each frame with its radar input and labels, in order.

        The generator starts `num_workers` processes, or uses this process if it is 0.
        Closing the generator ends the processes.
        """
        if not num_workers:
            yield from ((spec, *self.prepare(spec)) for spec in missing)
            return
        with process_pool(num_workers, _start_worker, self) as submit:
            started = ((spec, submit(_prepare_in_worker, spec)) for spec in missing)
            for spec, future in _started_ahead(started, 2 * num_workers):
                path = pathlib.Path(future.result())
                prepared = pickle.loads(path.read_bytes())
                path.unlink()
                yield (spec, *prepared)


def _started_ahead(items: Iterator[_T], count: int) -> Iterator[_T]:
    """Yields each item after the next `count` items have been taken from the iterator.

    Taking an item starts its computation.
    """
    waiting = collections.deque(itertools.islice(items, count))
    while waiting:
        waiting.extend(itertools.islice(items, 1))
        yield waiting.popleft()


_writer: Writer


def _start_worker(writer: Writer) -> None:
    """Sets up a worker process."""
    global _writer
    _writer = writer


def _prepare_in_worker(spec: FrameSpec) -> str:
    """Prepares one frame, writes the result to a file and returns the path of the file.

    The result itself is too large to be returned by a worker.
    """
    path = files.temporary_path(_writer.root / f"{spec.sequence}_{spec.name}")
    path.write_bytes(pickle.dumps(_writer.prepare(spec)))
    return str(path)
