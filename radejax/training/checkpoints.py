"""Checkpoints of a run: state, position in the data, configuration and metrics.

Written by orbax: in the background, to a temporary folder that gets its final name
only when whole, with checksums that are verified when it is restored. Where the newest
does not restore, training uses the one before and sets those after it aside with a
warning; whoever reads for inference is told which one is whole.
"""

from __future__ import annotations

import contextlib
import logging
import pathlib
import shutil
from collections.abc import Iterator, Mapping
from typing import Any

import grain
import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies

from radejax.core import files
from radejax.core.errors import DataError, one_line
from radejax.training import checksums, processes, sharding

_log = logging.getLogger(__name__)

BEST = "best"
"""Name of the metric that decides which checkpoint is best; higher is better."""

_METRICS = "metrics"
_DAMAGED_TEXT = (ValueError, TypeError, LookupError, RecursionError)

_VARIABLES = ("params", "ema_params", "model_state")

_NO_NEWS = (
    "tracked_metric",  # most checkpoints are not evaluated
    "read_only",  # as asked for
    "read only",
    "Metadata file does not exist",  # of a kind that we do not write
)


def _is_worth_telling(record: logging.LogRecord) -> bool:
    """False for orbax's warnings of what is meant to be, and of what we say ourselves."""
    if record.exc_info and record.exc_info[1] and files.is_no_space(record.exc_info[1]):
        return False  # with the traceback of each of its threads
    return not any(text in str(record.msg) for text in _NO_NEWS)


def _best_of(metrics: Mapping[str, float]) -> float:
    return metrics[BEST]


def _which_is_damaged(folder: pathlib.Path, error: Exception) -> str:
    """What to tell of a folder whose steps orbax cannot list."""
    damaged = []
    for found in ocp.path.step.standard_name_format().find_all(folder):
        try:
            _ = found.commit_timestamp
        except _DAMAGED_TEXT:
            damaged.append(found.step)
    names = ", ".join(map(str, sorted(damaged)))
    return (
        f"{folder}: the file _CHECKPOINT_METADATA of checkpoint {names} is damaged "
        f"({one_line(error)}); move that folder away, the others stay usable"
    )


class _Manager(ocp.CheckpointManager):
    """Orbax's, for which a checkpoint with damaged metrics was not evaluated.

    Attributes:
        damaged: Its step, and what is wrong.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.damaged: dict[int, str] = {}
        super().__init__(*args, **kwargs)

    def metrics(self, step: int) -> Any:
        """Overrides orbax's, which its other methods ask."""
        try:
            found = super().metrics(step)
            if found is not None:
                float(found[BEST])
                saved = checksums.read(pathlib.Path(self.directory, f"{step}")) or {}
                if _METRICS in saved:
                    sums = {_METRICS: checksums.of_values(found)}
                    checksums.check(sums, saved, "part")
        # What damaged text makes json and the lines above raise.
        except _DAMAGED_TEXT as error:
            if step not in self.damaged:
                _log.warning(
                    "the metrics of checkpoint %d are damaged: it counts as not evaluated",
                    step,
                )
            self.damaged[step] = str(error).strip().split("\n")[0]
            return None
        return found


class Checkpoints:
    """The checkpoints of one work folder, to be used in a `with` block.

    Args:
        folder: Made if missing.
        max_to_keep: The newest few are kept, and the best; None keeps all.
        read_only: For evaluation: nothing is written or cleaned up.

    Raises:
        DataError: The file that describes a step is damaged; names it.
    """

    def __init__(
        self,
        folder: str | pathlib.Path,
        *,
        max_to_keep: int | None = 2,
        read_only: bool = False,
    ) -> None:
        self.folder = pathlib.Path(folder).absolute()
        newest = policies.LatestN(n=max_to_keep)
        best = policies.BestN(
            get_metric_fn=_best_of, n=1, keep_checkpoints_without_metrics=False
        )
        kept = policies.AnyPreservationPolicy([newest, best])
        logging.getLogger("absl").addFilter(_is_worth_telling)
        options = ocp.CheckpointManagerOptions(
            preservation_policy=None if read_only else kept,
            best_fn=_best_of,
            create=not read_only,
            cleanup_tmp_directories=not read_only,
            read_only=read_only,
            enable_async_checkpointing=not read_only,
        )
        try:
            self._manager = _Manager(self.folder, options=options)
        # Orbax reads what describes each step before it knows any of them.
        except _DAMAGED_TEXT as error:
            raise DataError(_which_is_damaged(self.folder, error)) from None

    def steps(self) -> list[int]:
        """Steps of the finished checkpoints, oldest first."""
        self._manager.reload()
        return sorted(self._manager.all_steps())

    def best_step(self) -> int:
        """Step of the checkpoint with the highest metric `BEST`.

        Raises:
            FileNotFoundError: None was evaluated.
            DataError: Metrics are damaged: the best one is not known.
        """
        for step in self.steps():
            if reason := self._manager.damaged.get(step):
                raise DataError(
                    f"{self.folder}: the metrics of checkpoint {step} are damaged "
                    f"({reason}), which one is best is not known: name a step"
                )
        best = self._manager.best_step()
        if best is None:
            raise FileNotFoundError(
                f"no checkpoint in {self.folder} was evaluated: train with "
                "--config.train.evaluate_every_epochs=1 to have a best one"
            )
        return best

    def save(
        self,
        step: int,
        state: Any,
        data_iterator: Any,
        *,
        info: Mapping[str, Any],
        metrics: Mapping[str, float] | None = None,
    ) -> None:
        """Starts to save; returns as soon as the arrays are copied.

        Args:
            step: Name of the checkpoint; one that exists is left as it is.
            state: Pytree of arrays.
            data_iterator: The grain iterator whose next batch belongs to `step`.
            info: Plain values: configuration, versions.
            metrics: Of an evaluation at this step; `BEST` is one of them.

        Raises:
            DiskFullError: Earlier checkpoints stay intact.
        """
        if step in self._manager.all_steps():
            return
        sums = {
            "state": checksums.of_arrays(state),
            "info": checksums.of_values(dict(info)),
            "data": checksums.of_values(data_iterator.get_state()),
        }
        if metrics:
            sums[_METRICS] = checksums.of_values(dict(metrics))
        with self._told_if_full():
            self._manager.save(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(state),
                    data=grain.checkpoint.CheckpointSave(data_iterator),
                    info=ocp.args.JsonSave(dict(info)),
                    checksums=ocp.args.JsonSave(sums),
                ),
                metrics=dict(metrics) if metrics else None,
            )

    def wait(self) -> None:
        """Returns when everything that was started is on disk.

        Raises:
            DiskFullError: Earlier checkpoints stay intact.
        """
        with self._told_if_full():
            self._manager.wait_until_finished()

    @contextlib.contextmanager
    def _told_if_full(self) -> Iterator[None]:
        try:
            yield
        except Exception:
            free = shutil.disk_usage(self.folder).free / 2**20
            message = (
                f"no space left for a checkpoint in {self.folder} ({free:.0f} MiB "
                "free); earlier checkpoints are intact, free some and run the same "
                "command again"
            )
            with files.disk_full(self.folder, message):
                raise

    def restore(
        self, state: Any, data_iterator: Any
    ) -> tuple[Any, dict[str, Any], int] | None:
        """Restores the newest checkpoint that is whole.

        Newer ones are set aside, to be looked at; they will be saved anew.

        Args:
            state: Pytree of `jax.ShapeDtypeStruct` with the shardings wanted, which
                need not be those that were saved.
            data_iterator: Set to the position that was saved.

        Returns:
            State, the `info` saved with it, and step; None where there is no checkpoint.

        Raises:
            DataError: There are checkpoints, and none restores; they stay as they are.
        """
        failed: list[int] = []
        steps = self.steps()
        for step in reversed(steps):
            restored, reason = None, "another process could not read it"
            try:
                restored = self._manager.restore(
                    step,
                    args=ocp.args.Composite(
                        state=ocp.args.StandardRestore(state),
                        info=ocp.args.JsonRestore(),
                    ),
                )
                self._verify(step, restored["state"], restored["info"])
                self._restore_position(step, data_iterator)
            # Whatever a damaged file makes orbax, tensorstore or json raise.
            except Exception as error:
                restored, reason = None, str(error).strip().split("\n")[0]
            if processes.all_agree(restored is not None) and restored is not None:
                for damaged in failed:
                    self._set_aside(damaged)
                return restored["state"], restored["info"], step
            _log.warning("checkpoint %d does not restore: %s", step, reason)
            failed.append(step)
        if steps:
            raise DataError(
                f"none of the checkpoints {steps} in {self.folder} restores; move that "
                "folder away to train from the start"
            )
        return None

    def restore_variables(self, step: int | None = None) -> tuple[Any, dict, int]:
        """What inference needs of a state, and the configuration, as saved.

        Args:
            step: The newest if None.

        Returns:
            `params`, `ema_params` and `model_state` as nested dictionaries of NumPy
            arrays, the `info` saved with them, the step.

        Raises:
            FileNotFoundError: No checkpoint, or not that step.
            DataError: It is damaged; names the newest that is whole.
        """
        steps = self.steps()
        if not steps:
            raise FileNotFoundError(f"no checkpoint in {self.folder}")
        step = steps[-1] if step is None else step
        if step not in steps:
            raise FileNotFoundError(
                f"no checkpoint of step {step} in {self.folder}; there are {steps}"
            )
        try:
            return *self._read_variables(step), step
        # Whatever a damaged file makes orbax, tensorstore or json raise.
        except Exception as error:
            reason = str(error).strip().split("\n")[0]
            whole = self._newest_whole([older for older in steps if older != step])
            mend = (
                "no other one is whole" if whole is None else f"step {whole} is whole"
            )
            raise DataError(
                f"checkpoint {step} in {self.folder} is damaged ({reason}); {mend}"
            ) from error

    def _newest_whole(self, steps: list[int]) -> int | None:
        """The last of some steps whose variables can be read."""
        for step in reversed(steps):
            with contextlib.suppress(Exception):  # as damaged as the one asked for
                self._read_variables(step)
                return step
        return None

    def _read_variables(self, step: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Variables as NumPy arrays and `info` of a checkpoint that is there."""
        with ocp.PyTreeCheckpointer() as reader:
            folder = self.folder / str(step) / "state"
            saved = reader.metadata(folder).item_metadata.tree
        # Whole on whatever devices there are; the optimizer's moments are not read.
        whole = sharding.replicated(sharding.make_mesh())
        wanted = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=whole),
            {name: saved[name] for name in _VARIABLES if name in saved},
        )
        found = self._manager.restore(
            step,
            args=ocp.args.Composite(
                state=ocp.args.PyTreeRestore(
                    wanted,
                    restore_args=ocp.checkpoint_utils.construct_restore_args(wanted),
                    partial_restore=True,
                ),
                info=ocp.args.JsonRestore(),
            ),
        )
        self._verify(step, found["state"], found["info"])
        state = {name: found["state"].get(name) for name in _VARIABLES}
        return jax.tree.map(np.asarray, state), found["info"]

    def _verify(self, step: int, state: Any, info: Mapping[str, Any]) -> None:
        """`DataError` if what was restored is not what was saved."""
        saved = checksums.read(self.folder / str(step))
        if saved is not None:
            checksums.check(checksums.of_arrays(state), saved["state"], "array")
            checksums.check({"info": checksums.of_values(info)}, saved, "part")

    def _restore_position(self, step: int, data_iterator: Any) -> None:
        """Sets the iterator to where it was, with any number of processes then and now.

        All processes share each batch and stand at the same place, so that the file
        of the first one is right for all.
        """
        folder = self.folder / str(step) / "data"
        saved = sorted(folder.glob("process_0-of-*.json"))
        if not saved:
            raise FileNotFoundError(f"no position in the data in {folder}")
        position = files.read_json(saved[0])
        known = checksums.read(self.folder / str(step))
        if known is not None:
            checksums.check({"data": checksums.of_values(position)}, known, "part")
        data_iterator.set_state(position)

    def _set_aside(self, step: int) -> None:
        """Renames a damaged checkpoint so that it can be looked at and saved anew."""
        target = self.folder.with_name(self.folder.name + "_damaged") / str(step)
        if processes.is_main():
            if target.exists():
                shutil.rmtree(target)
            target.parent.mkdir(exist_ok=True)
            (self.folder / str(step)).rename(target)
            _log.warning("moved it to %s", target)
        processes.all_agree(True)  # the others wait until it is gone
        self._manager.reload()

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self.wait()
        self._manager.close()


def abstract_state(state: Any, sharding: Any) -> Any:
    """Shapes, dtypes and wanted shardings of a state, to restore into."""
    return jax.tree.map(
        lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), state, sharding
    )
