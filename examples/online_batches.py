"""Training batches that are simulated when they are needed.

The host creates scenes and scatterers, and the accelerator computes the projections of a whole
batch in one call. A batch depends only on the options, the seed and its step, so a run can resume
from its step.
"""

from __future__ import annotations

import concurrent.futures
import functools
import threading

import grain
import jax
import jax.numpy as jnp
import numpy as np

from radejax.core.structures import Batch
from radejax.core.workers import usable_cpus
from radejax.geometry.boxes import boxes8_from_7
from radejax.simulation.config import SimulationOptions
from radejax.simulation.radar import tensor
from radejax.simulation.simulator import RadarInput, SequenceSimulator, make_source

_CACHED_SEQUENCES = 64


class OnlineBatches:
    """Endless iterator of simulated batches.

    Args:
        options: Options of the simulation, whose training sequences are used.
        batch_size: Number of frames per batch.
        max_objects: Number of rows for boxes, N of `Batch`. The nearest objects are kept.
        seed: Seed of the choice of frames and of their noise. Scenes use the options' seed.
        num_threads: Number of threads that compute scatterers, or None for one per CPU.
        start_step: Step of the first batch; to resume, the step that was reached.

    Attributes:
        grid: Axes of the radar.
        step: Step of the next batch; save it to resume.
        num_cut: Number of boxes so far that did not fit into `max_objects`.
    """

    def __init__(
        self,
        options: SimulationOptions,
        *,
        batch_size: int,
        max_objects: int,
        seed: int = 0,
        num_threads: int | None = None,
        start_step: int = 0,
    ) -> None:
        self._options = options
        self.grid = options.make_grid()
        self._parameters = options.radar.make_parameters()
        self._source = make_source(options)
        self._specs = [
            (number, spec)
            for number in self._source.numbers
            for spec in self._source.frames(number)
            if spec.split == "train"
        ]
        self._batch_size, self._max_objects = batch_size, max_objects
        self._seed = seed
        self.step, self.num_cut = start_step, 0
        count = usable_cpus() if num_threads is None else max(num_threads, 1)
        self._pool = concurrent.futures.ThreadPoolExecutor(count)
        self._lock = threading.Lock()
        self._simulator = functools.lru_cache(_CACHED_SEQUENCES)(self._make_simulator)

    def __iter__(self) -> OnlineBatches:
        return self

    def __next__(self) -> Batch:
        """Returns the next batch and increments the step."""
        self.step += 1
        return self.batch(self.step - 1)

    def batch(self, step: int) -> Batch:
        """Returns the batch of any step; it depends only on options, seed and step."""
        rng = np.random.default_rng([self._seed, step])
        chosen = rng.integers(len(self._specs), size=self._batch_size)
        rows = range(self._batch_size)
        frames = self._pool.map(self._frame, chosen.tolist(), [step] * len(rows), rows)
        return self._assemble(list(frames))

    def loader(self) -> grain.DatasetIterator:
        """Returns a prefetching iterator from step 0, whose position can be saved."""
        steps = grain.MapDataset.range(np.iinfo(np.int32).max)
        reading = grain.ReadOptions(num_threads=2, prefetch_buffer_size=2)
        return iter(steps.map(self.batch).to_iter_dataset(reading))

    @property
    def frame_names(self) -> list[str]:
        """Sequence and frame of each index in `Batch.frame`, separated by a slash."""
        return [f"{number}/{spec.name}" for number, spec in self._specs]

    def _make_simulator(self, number: int) -> SequenceSimulator:
        return SequenceSimulator(self._source.make(number), self._options)

    def _frame(self, index: int, step: int, row: int):
        """Returns index, radar input, noise key, boxes `[n, 7]` and classes `[n]` of a frame.

        Boxes are in the radar frame and limited to objects that are visible to the radar.
        """
        number, spec = self._specs[index]
        with self._lock:  # one thread creates a scene, the others reuse it
            simulator = self._simulator(number)
        frame = simulator.sequence.frame(spec.scene_idx)
        given = simulator.radar_input(frame)
        visible = simulator.is_radar_visible(frame, given)
        boxes = frame.boxes[visible].copy()
        boxes[:, 2] -= self._options.radar_from_lidar_m[
            2
        ]  # boxes keep the LiDAR's z, as when labels are read from files
        key = tensor.frame_key(self._seed, step, row)
        return index, given, key, boxes, frame.cls[visible]

    def _assemble(self, frames: list) -> Batch:
        count, capacity = self._max_objects, self._batch_size
        boxes = np.zeros((capacity, count, 8), np.float32)
        boxes[..., 7] = 1.0
        classes = np.zeros((capacity, count), np.int32)
        is_valid = np.zeros((capacity, count), bool)
        for row, (_, _, _, own, cls) in enumerate(frames):
            order = np.argsort(np.hypot(own[:, 0], own[:, 1]), kind="stable")[:count]
            self.num_cut += len(own) - len(order)
            boxes[row, : len(order)] = boxes8_from_7(own[order])
            classes[row, : len(order)] = cls[order]
            is_valid[row, : len(order)] = True
        scatterers, noise, state = _stack([given for _, given, *_ in frames])
        projection = _simulate_batch(
            scatterers,
            noise,
            np.stack([key for _, _, key, *_ in frames]),
            state,
            self.grid,
            self._parameters,
        )
        return Batch(
            projection=projection,
            boxes=jnp.asarray(boxes),
            classes=jnp.asarray(classes),
            is_valid=jnp.asarray(is_valid),
            frame=jnp.asarray([index for index, *_ in frames], jnp.int32),
        )


@functools.partial(jax.jit, static_argnums=(4, 5))
def _simulate_batch(scatterers, noise, keys, state, grid, parameters):
    """Computes the projections `[B, R, A, D+E]` of a batch."""
    one = functools.partial(
        tensor.simulate,
        grid=grid,
        parameters=parameters,
    )
    return jax.vmap(one)(scatterers, noise, keys, state)


def _stack(
    inputs: list[RadarInput],
) -> tuple[tensor.Scatterers, np.ndarray, tensor.SensorState | None]:
    """Stacks inputs, padded to a multiple of 1,024 scatterers to limit recompilation."""
    capacity = max(given.scatterers.range_m.shape[0] for given in inputs)
    capacity = -(-capacity // 1024) * 1024

    def pad(leaf: np.ndarray) -> np.ndarray:
        return np.pad(leaf, [(0, capacity - len(leaf))] + [(0, 0)] * (leaf.ndim - 1))

    scatterers = jax.tree.map(
        lambda *leaves: np.stack([pad(leaf) for leaf in leaves]),
        *[given.scatterers for given in inputs],
    )
    state = jax.tree.map(
        lambda *leaves: np.stack(leaves), *[given.state for given in inputs]
    )
    return scatterers, np.stack([given.noise_power for given in inputs]), state
