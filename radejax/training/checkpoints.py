"""Checkpoints of a run: state, position in the data, configuration and metrics.

Written by orbax: in the background, to a temporary folder that gets its final name
only when whole. A checkpoint that does not restore is set aside with a warning and
the one before is used.
"""

from __future__ import annotations

import logging
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any

import grain
import jax
import orbax.checkpoint as ocp

from radejax.errors import DataError, UserError
from radejax.files import is_no_space

_log = logging.getLogger(__name__)


class Checkpoints:
    """The checkpoints of one work folder.

    Args:
        folder: Made if missing.
        max_to_keep: The newest few are kept; None keeps all.
        best_metric: Also keep the checkpoint with the highest value of this metric.
        read_only: For evaluation: nothing is written or cleaned up.
    """

    def __init__(
        self,
        folder: str | pathlib.Path,
        *,
        max_to_keep: int | None = 2,
        best_metric: str | None = None,
        read_only: bool = False,
    ) -> None:
        self.folder = pathlib.Path(folder).absolute()
        self._best_metric = best_metric
        options = ocp.CheckpointManagerOptions(
            max_to_keep=None if read_only else max_to_keep,
            best_fn=(lambda m: m[best_metric]) if best_metric else None,
            keep_checkpoints_without_metrics=True,
            create=not read_only,
            cleanup_tmp_directories=not read_only,
            read_only=read_only,
            enable_async_checkpointing=not read_only,
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)

    def steps(self) -> list[int]:
        """Steps of the finished checkpoints, oldest first."""
        self._manager.reload()
        return sorted(self._manager.all_steps())

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
            metrics: Of an evaluation at this step.

        Raises:
            UserError: The disk is full. Earlier checkpoints stay intact.
        """
        if step in self._manager.all_steps():
            return
        try:
            self._manager.save(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(state),
                    data=grain.checkpoint.CheckpointSave(data_iterator),
                    info=ocp.args.JsonSave(dict(info)),
                ),
                metrics=dict(metrics) if metrics else None,
            )
        except OSError as error:
            raise _disk_full(error, self.folder) from error

    def wait(self) -> None:
        """Returns when everything that was started is on disk.

        Raises:
            UserError: The disk is full.
        """
        try:
            self._manager.wait_until_finished()
        except OSError as error:
            raise _disk_full(error, self.folder) from error

    def restore(self, state: Any, data_iterator: Any) -> int | None:
        """Restores the newest checkpoint that is whole.

        Args:
            state: Pytree of `jax.ShapeDtypeStruct` with the shardings wanted, which
                need not be those that were saved.
            data_iterator: Set to the position that was saved.

        Returns:
            `(state, step)`, or None where there is no checkpoint.

        Raises:
            DataError: There are checkpoints, and none restores.
        """
        steps = self.steps()
        for step in reversed(steps):
            try:
                restored = self._manager.restore(
                    step,
                    args=ocp.args.Composite(
                        state=ocp.args.StandardRestore(state),
                        data=grain.checkpoint.CheckpointRestore(data_iterator),
                    ),
                )
            # Whatever a damaged file makes orbax, tensorstore or json raise.
            except Exception as error:
                reason = str(error).strip().split("\n")[0]
                _log.warning("checkpoint %d does not restore: %s", step, reason)
                self._set_aside(step)
                continue
            return restored["state"], step
        if steps:
            raise DataError(
                f"none of the checkpoints {steps} in {self.folder} restores"
            )
        return None

    def restore_variables(self, step: int | None = None) -> tuple[Any, dict, int]:
        """State and configuration alone, as saved, for inference.

        Args:
            step: The newest if None.

        Returns:
            State as nested dictionaries of arrays, the `info` saved with it, the step.

        Raises:
            FileNotFoundError: No checkpoint, or not that step.
        """
        steps = self.steps()
        if not steps:
            raise FileNotFoundError(f"no checkpoint in {self.folder}")
        step = steps[-1] if step is None else step
        if step not in steps:
            raise FileNotFoundError(
                f"no checkpoint of step {step} in {self.folder}; there are {steps}"
            )
        restored = self._manager.restore(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardRestore(), info=ocp.args.JsonRestore()
            ),
        )
        return restored["state"], restored["info"], step

    def _set_aside(self, step: int) -> None:
        """Renames a damaged checkpoint so that it can be looked at and saved anew."""
        damaged = self.folder / str(step)
        target = self.folder.with_name(self.folder.name + "_damaged") / str(step)
        if target.exists():
            shutil.rmtree(target)
        target.parent.mkdir(exist_ok=True)
        damaged.rename(target)
        _log.warning("moved it to %s", target)
        self._manager.reload()

    def close(self) -> None:
        """Waits for what is under way and releases the folder."""
        self.wait()
        self._manager.close()

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def abstract_state(state: Any, sharding: Any) -> Any:
    """Shapes, dtypes and wanted shardings of a state, to restore into."""
    return jax.tree.map(
        lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), state, sharding
    )


def _disk_full(error: OSError, folder: pathlib.Path) -> Exception:
    if is_no_space(error):
        free = shutil.disk_usage(folder).free
        return UserError(
            f"no space left for a checkpoint in {folder} ({free / 2**20:.0f} MiB free); "
            "earlier checkpoints are intact, free some and run the same command again"
        )
    return error
