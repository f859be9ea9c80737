"""Training loop and its start: the state of step 0 or of a checkpoint, and the jitted step."""

from __future__ import annotations

import collections
import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import numpy as np
from flax.typing import VariableDict
from jax.extend.core import ClosedJaxpr
from jax.interpreters import partial_eval
from jax.sharding import Mesh

from radejax.core import devices, files
from radejax.core.errors import UserError
from radejax.core.grain_import import grain
from radejax.core.structures import Batch
from radejax.training.checkpoints import Checkpoints
from radejax.training.hooks import STEPS_IN_FLIGHT, Hook
from radejax.training.step import Metrics, Step, TrainState, run_keys

_log = logging.getLogger(__name__)

PlacedStep = Callable[[TrainState, Batch], tuple[TrainState, Metrics]]


def train(
    state: TrainState,
    step: PlacedStep,
    batches: Iterator[Batch],
    hooks: Sequence[Hook],
    *,
    num_steps: int,
    should_stop: Callable[[], bool] = lambda: False,
) -> TrainState:
    """Trains until a number of steps is reached or a signal arrives.

    Args:
        state: State to start from.
        step: Function that takes one step, see `place_step`. It returns before the
            computation ends.
        batches: Endless iterator.
        hooks: Functions that are called in order after each step.
        num_steps: Number of steps of the whole training, including those of `state`.
        should_stop: Function that is called before each step; the loop ends when it
            returns True.

    Returns:
        The state after the last step that was taken.
    """
    number = int(state.step)
    in_flight: collections.deque[Metrics] = collections.deque()
    while number < num_steps and not should_stop():
        state, metrics = step(state, next(batches))
        number += 1
        in_flight.append(metrics)
        if len(in_flight) > STEPS_IN_FLIGHT:
            jax.block_until_ready(in_flight.popleft())
        for hook in hooks:
            hook(number, state, metrics)
    return state


def place_step(step: Step, state: TrainState, mesh: Mesh, seed: int) -> PlacedStep:
    """Returns the jitted step of a run, which takes the batch of this process.

    Args:
        step: Function that `make_train_step` returned.
        state: State with the shardings of all later ones. The jitted step donates the
            buffers of its input state.
        mesh: Devices of the run.
        seed: Seed of the run.
    """
    whole = devices.replicated(mesh)
    placement = jax.tree.map(lambda x: x.sharding, state)
    jitted: Step = jax.jit(step, donate_argnums=0, out_shardings=(placement, whole))
    loop_key = jax.jit(lambda seed: run_keys(seed)[1], out_shardings=whole)
    rng = loop_key(np.uint32(seed))

    def placed(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        on_devices = devices.put_batch(batch, mesh)
        with _settings_of_debugging():
            return jitted(state, on_devices, rng)

    return placed


@contextlib.contextmanager
def _settings_of_debugging() -> Iterator[None]:
    """Forbids implicit transfers, unless JAX runs operations one at a time for debugging.

    A global `jax_debug_nans` or `jax_debug_infs` is also set in this thread. Otherwise JAX
    0.10 drops it: while it traces the step, it turns the setting off and not on again.
    """
    settings = jax.config.values
    is_nans = settings["jax_debug_nans"]
    is_infs = settings["jax_debug_infs"]
    is_debugging = is_nans or is_infs or settings["jax_disable_jit"]
    transfers = jax.transfer_guard("allow" if is_debugging else "disallow")
    with transfers, jax.debug_nans(is_nans), jax.debug_infs(is_infs):
        yield


def restore_or_initialize(
    checkpoints: Checkpoints,
    batches: grain.DatasetIterator[Batch],
    initial: Callable[[], VariableDict],
    create: Callable[[VariableDict], TrainState],
    mesh: Mesh,
    parameter_sharding: devices.ParameterSharding,
    same: Mapping[str, object],
    external: Sequence[str] = (),
) -> TrainState:
    """Restores the state of the newest checkpoint, or creates the state of step 0.

    Args:
        checkpoints: Checkpoints of the run.
        batches: Iterator that is set to the saved position.
        initial: Function that returns the variables of step 0.
        create: Function that creates the state of step 0 from them.
        mesh: Devices of the run.
        parameter_sharding: See `devices.state_sharding`.
        same: Plain values by name that must equal those in the checkpoint.
        external: Parts of the model whose frozen parameters are not in checkpoints.

    Raises:
        DataError: There are checkpoints, but none can be restored.
        UserError: The run would continue with other data or frozen weights.
    """
    traced, shapes = jax.make_jaxpr(initial, return_shape=True)()
    abstract = jax.eval_shape(create, shapes)
    placement = devices.state_sharding(abstract, mesh, parameter_sharding)
    wanted = jax.tree.map(lambda x, s: x.update(sharding=s), abstract, placement)
    restored = checkpoints.restore(wanted.without(external), batches)
    if restored is None:
        created = jax.jit(create, out_shardings=placement)(_evaluate(traced, shapes))
        # `jax_disable_jit` ignores `out_shardings`.
        state: TrainState = jax.device_put(created, placement)
        return state
    state, info, step = restored
    saved = info.get("same", {})
    if lines := files.differences(saved, {k: same.get(k) for k in saved}, ""):
        raise UserError(
            f"the run in {checkpoints.folder.parent} was trained with something else: "
            f"{'; '.join(lines)}; give the same, or another --workdir"
        )
    _log.info("continuing from step %d", step)
    if missing := [name for name in external if name in abstract.frozen]:
        computed = jax.jit(
            lambda x: {name: create(x).frozen[name] for name in missing},
            out_shardings={name: placement.frozen[name] for name in missing},
        )
        frozen = {**state.frozen, **computed(_evaluate(traced, shapes))}
        state = state.replace(frozen=frozen)
    return state


def empty_batch(batches: grain.DatasetIterator[Batch]) -> Batch:
    """Returns a batch of one empty frame, and keeps the position of the iterator."""
    position = batches.get_state()
    batch = next(batches)
    batches.set_state(position)
    empty: Batch = jax.tree.map(lambda x: np.zeros((1, *x.shape[1:]), x.dtype), batch)
    return empty


def _evaluate(traced: ClosedJaxpr, shapes: VariableDict) -> VariableDict:
    """Returns the results of a traced function as NumPy arrays.

    Only the operations that the results need are executed, one at a time. One program with
    a hundred random generators would be compiled for half as long as a training step, and
    `Module.lazy_init` of Flax takes twice the time with compiled programs on the disk.
    """
    is_result = [True] * len(traced.jaxpr.outvars)
    needed, _ = partial_eval.dce_jaxpr(traced.jaxpr, is_result, instantiate=True)
    leaves = jax.core.eval_jaxpr(needed, traced.consts)
    structure = jax.tree.structure(shapes)
    variables: VariableDict = jax.tree.unflatten(structure, map(np.asarray, leaves))
    return variables
