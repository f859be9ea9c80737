"""Checkpoints of a run: state, position in the data, configuration and metrics.

Orbax writes each checkpoint in the background to a temporary folder, which gets its final
name when it is complete. Checksums of the arrays are saved with the checkpoint and verified
when it is restored.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import hashlib
import json
import logging
import pathlib
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, TypeVar

import jax
import numpy as np
from absl import logging as absl_logging
from jax.experimental import multihost_utils
from jax.typing import ArrayLike
from jaxtyping import PyTree

from radejax.core import devices, files
from radejax.core.errors import DataError, one_line
from radejax.core.files import JsonObject
from radejax.core.orbax_import import keep_root_logger, ocp, policies
from radejax.core.structures import Batch

if TYPE_CHECKING:  # inference reads checkpoints without the data pipeline
    import grain

_log = logging.getLogger(__name__)

T = TypeVar("T")

_BEST = "best"  # name of the metric that decides which checkpoint is best
_VARIABLES = ("params", "ema_params", "model_state", "frozen")


@contextlib.contextmanager
def _without_orbax_log() -> Iterator[None]:
    """Hides what orbax logs while a block runs, as it raises its errors too.

    The root logger is not configured either.
    """

    def is_of_others(record: logging.LogRecord) -> bool:
        return "orbax" not in record.pathname

    log = absl_logging.get_absl_logger()
    log.addFilter(is_of_others)
    try:
        with keep_root_logger():
            yield
    finally:
        log.removeFilter(is_of_others)


class Checkpoints:
    """The checkpoints of one workdir, to be used in a `with` statement.

    Args:
        folder: Folder of the checkpoints. It is created if missing, unless `read_only`.
        max_to_keep: Number of the newest checkpoints that are kept in addition to the
            best one; None keeps all.
        read_only: Do not write or clean up anything, for evaluation.

    Raises:
        DataError: The files that describe the steps are corrupted.
    """

    @_without_orbax_log()
    def __init__(
        self,
        folder: str | pathlib.Path,
        *,
        max_to_keep: int | None = 2,
        read_only: bool = False,
    ) -> None:
        self.folder = files.as_path(folder).absolute()
        newest = policies.LatestN(n=max_to_keep)
        best = policies.BestN(
            get_metric_fn=_best_of, n=1, keep_checkpoints_without_metrics=False
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=policies.AnyPreservationPolicy([newest, best]),
            best_fn=_best_of,
            create=not read_only,
            cleanup_tmp_directories=not read_only,
            read_only=read_only,
            enable_async_checkpointing=not read_only,
        )
        try:
            self._manager = ocp.CheckpointManager(self.folder, options=options)
        # Orbax reads the description and the metrics of every step when it starts.
        except (ValueError, TypeError, LookupError) as error:
            raise DataError(
                f"{self.folder}: a description or the metrics of a checkpoint are "
                f"corrupted ({one_line(error)}); move that checkpoint away"
            ) from None

    @_without_orbax_log()
    def steps(self) -> list[int]:
        """Returns the steps of the finished checkpoints, oldest first."""
        self._manager.reload()
        return sorted(self._manager.all_steps())

    def best_step(self) -> int:
        """Returns the step of the checkpoint with the highest metric.

        Raises:
            FileNotFoundError: No checkpoint was evaluated.
        """
        best = self._manager.best_step()
        if best is None:
            raise FileNotFoundError(
                f"no checkpoint in {self.folder} was evaluated: train with "
                "--config.train.evaluate_every_epochs=1 to have a best one"
            )
        return best

    @_without_orbax_log()
    def save(
        self,
        step: int,
        state: PyTree,
        data_iterator: grain.DatasetIterator[Batch],
        *,
        info: Mapping[str, object],
        best: float | None = None,
    ) -> None:
        """Starts to save a checkpoint, and returns as soon as the arrays are copied.

        Args:
            step: Step of the state, which names the checkpoint. It must not be below
                the steps of the existing checkpoints; nothing is saved if there is one of
                this step.
            state: Pytree of arrays.
            data_iterator: Grain iterator whose next batch belongs to `step`. All
                processes share each batch and are at the same position.
            info: Plain values such as the configuration and versions.
            best: Metric of this step that selects the best checkpoint; higher is better.

        Raises:
            DiskFullError: No space is left on the disk; earlier checkpoints stay intact.
        """
        if step == self._manager.latest_step():
            return
        description: JsonObject = {
            "info": dict(info),
            "position": data_iterator.get_state(),
            "checksums": array_checksums(state),
        }
        description["sha256"] = _text_checksum(description)
        text = ocp.args.JsonSave(description)
        args = ocp.args.Composite(state=ocp.args.PyTreeSave(state), description=text)
        metrics = None if best is None else {_BEST: best}
        with files.disk_full(self.folder):
            self._manager.save(step, args=args, metrics=metrics)

    @_without_orbax_log()
    def wait(self) -> None:
        """Waits until all started checkpoints are on disk.

        Raises:
            DiskFullError: No space is left on the disk; earlier checkpoints stay intact.
        """
        with files.disk_full(self.folder):
            self._manager.wait_until_finished()

    def restore(
        self, state: T, data_iterator: grain.DatasetIterator[Batch]
    ) -> tuple[T, JsonObject, int] | None:
        """Restores the newest checkpoint that is intact.

        Newer, corrupted checkpoints are moved to a folder next to this one with a warning.

        Args:
            state: Pytree of `jax.ShapeDtypeStruct` with the wanted shardings, which may
                differ from those at the time of saving.
            data_iterator: Iterator that is set to the saved position.

        Returns:
            The state, the `info` saved with it, and the step; None if there are no
            checkpoints.

        Raises:
            DataError: There are checkpoints, but none is intact. They are not moved.
        """
        steps = devices.list_of_main(self.steps())
        for step in reversed(steps):
            found = self._read_on_all(step, state)
            if found is not None:
                newer = [other for other in steps if other > step]
                devices.main_only(functools.partial(self._move_away, newer))
                self._manager.reload()
                restored, description = found
                data_iterator.set_state(description["position"])
                return restored, description["info"], step
        if steps:
            raise DataError(
                f"none of the checkpoints {steps} in {self.folder} restores; move that "
                "folder away to train from the start"
            )
        return None

    def restore_variables(
        self, step: int | None = None
    ) -> tuple[dict[str, PyTree], JsonObject, int]:
        """Reads the variables of a model without the optimizer state.

        Args:
            step: Step of the checkpoint; the newest if None.

        Returns:
            A dictionary with `params`, `ema_params`, `model_state` and `frozen` as
            nested dictionaries of NumPy arrays, or None where the checkpoint has none;
            the `info` saved with them; and the step.

        Raises:
            FileNotFoundError: There is no checkpoint, or none of that step.
            DataError: The checkpoint is corrupted.
        """
        steps = self.steps()
        if not steps:
            raise FileNotFoundError(f"no checkpoint in {self.folder}")
        step = steps[-1] if step is None else step
        if step not in steps:
            raise FileNotFoundError(
                f"no checkpoint of step {step} in {self.folder}; there are {steps}"
            )
        found = self._read(step)
        self._verify(step, found)
        variables, description = found
        return {n: variables.get(n) for n in _VARIABLES}, description["info"], step

    def _read_on_all(self, step: int, state: T) -> tuple[T, JsonObject] | None:
        """Returns the result of `_read`; None if the checkpoint is corrupted in a process."""
        found = _on_all(lambda: self._read(step, state))
        if found is None or not _on_all(lambda: self._verify(step, found)):
            return None
        return found

    @_without_orbax_log()
    def _read(self, step: int, state: PyTree = None) -> tuple[PyTree, JsonObject]:
        """Reads the state and the description of a checkpoint.

        It does not wait for other processes, as reading may fail on one of them only.

        Args:
            step: Step of the checkpoint.
            state: Pytree of `jax.ShapeDtypeStruct` to restore; None restores the
                variables of the model as NumPy arrays.

        Raises:
            DataError: The checkpoint is corrupted.
        """
        alone = ocp.options.MultiprocessingOptions(
            primary_host=None, active_processes={jax.process_index()}
        )
        handler = ocp.CompositeCheckpointHandler()
        try:
            if state is None:
                with ocp.PyTreeCheckpointer() as reader:
                    metadata = reader.metadata(self.folder / str(step) / "state")
                tree = metadata.item_metadata.tree
                state = {name: tree[name] for name in _VARIABLES if name in tree}
                numpy = ocp.RestoreArgs(restore_type=np.ndarray)
                restore_args = jax.tree.map(lambda _: numpy, state)
            else:
                restore_args = ocp.checkpoint_utils.construct_restore_args(state)
            arrays = ocp.args.PyTreeRestore(
                state, restore_args=restore_args, partial_restore=True
            )
            text = ocp.args.JsonRestore()
            args = ocp.args.Composite(state=arrays, description=text)
            with ocp.Checkpointer(handler, multiprocessing_options=alone) as reader:
                found = reader.restore(self.folder / str(step), args=args)
            description = found["description"]
            if description.pop("sha256") != _text_checksum(description):
                raise DataError("the checksum of its description differs")
            # orbax returns what was asked for where its metadata lack an array.
            leaves = jax.tree.leaves(found["state"])
            if any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves):
                raise DataError("an array is missing")
        # On corrupted files, orbax, tensorstore and json raise errors of any type.
        except Exception as error:
            raise self._corrupted(step, one_line(error)) from error
        return found["state"], description

    def _verify(self, step: int, found: tuple[PyTree, JsonObject]) -> bool:
        """Compares the checksums of the arrays that `_read` returned; returns True.

        All processes have to call this function.

        Raises:
            DataError: They differ.
        """
        state, description = found
        saved = description["checksums"]
        for name, value in array_checksums(state).items():
            if saved.get(name) != value:
                raise self._corrupted(step, f"the checksum of array {name} differs")
        return True

    def _corrupted(self, step: int, reason: str) -> DataError:
        return DataError(
            f"checkpoint {step} in {self.folder} is corrupted ({reason}); there are "
            f"{self.steps()}"
        )

    def _move_away(self, steps: list[int]) -> None:
        """Renames corrupted checkpoints, so that these steps can be saved again."""
        target = self.folder.with_name(f"{self.folder.name}_corrupted")
        for step in steps:
            shutil.rmtree(target / str(step), ignore_errors=True)
            target.mkdir(exist_ok=True)
            (self.folder / str(step)).rename(target / str(step))
            _log.warning("moved checkpoint %d to %s", step, target)

    def __enter__(self) -> Checkpoints:
        return self

    @_without_orbax_log()
    def __exit__(self, *_: object) -> None:
        self.wait()
        self._manager.close()


def _best_of(metrics: Mapping[str, float]) -> float:
    return metrics[_BEST]


def _on_all(work: Callable[[], T]) -> T | None:
    """Calls a function in all processes.

    Returns:
        The result in this process; None if any process raised `DataError`, of which it
        warns.
    """
    result = None
    try:
        result = work()
    except DataError as error:
        _log.warning("%s", error)
    return result if devices.all_agree(result is not None) else None


# Checksums ---------------------------------------------------------------------------


def array_checksums(tree: PyTree) -> dict[str, int]:
    """Computes the CRC-32 of the bytes of every array of a tree.

    The checksums do not depend on the placement of the arrays over devices and processes.
    All processes have to call this function.

    Returns:
        Checksums by the paths of the arrays, such as "params/conv/bias".
    """
    arrays = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if not getattr(leaf, "is_fully_addressable", True):
            is_whole = leaf.is_fully_replicated
            gather = multihost_utils.process_allgather
            leaf = leaf.addressable_data(0) if is_whole else gather(leaf, tiled=True)
        # Paths of the restored dictionaries are those of the saved dataclasses and lists.
        arrays[jax.tree_util.keystr(path, simple=True, separator="/")] = leaf
    with concurrent.futures.ThreadPoolExecutor() as pool:
        return dict(zip(arrays, pool.map(_checksum, arrays.values()), strict=True))


def _checksum(array: ArrayLike) -> int:
    return zlib.crc32(np.asarray(array).reshape(-1).view(np.uint8).data)


def _text_checksum(values: JsonObject) -> str:
    """Computes the SHA-256 of plain values serialized as JSON."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
