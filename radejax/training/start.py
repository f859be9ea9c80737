"""What a start of a training begins with: the state, and the step that is compiled."""

from __future__ import annotations

import collections
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn
import jax
import numpy as np
import optax

from radejax.core.errors import UserError
from radejax.core.structures import Batch
from radejax.data.encoding import model_inputs
from radejax.geometry.radar_grid import RadarGrid
from radejax.training import sharding
from radejax.training.checkpoints import Checkpoints, abstract_state
from radejax.training.state import (
    TrainState,
    create_state,
    make_optimizer,
    make_schedule,
    with_pretrained,
)
from radejax.training.step import Metrics, make_train_step

_STEPS_IN_FLIGHT = 2  # more would only pile up batches in memory


def optimizer_of(options: Any, num_steps: int) -> optax.GradientTransformation:
    """The optimizer with its learning rate, from the fields of `config.train`."""
    schedule = make_schedule(
        learning_rate=options.learning_rate,
        final_learning_rate=options.final_learning_rate,
        num_steps=num_steps,
        warmup_steps=options.warmup_steps,
    )
    return make_optimizer(
        schedule,
        weight_decay=options.weight_decay,
        gradient_clip_norm=options.gradient_clip_norm,
    )


def initial(
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    options: Any,
    seed: int,
    loader: Any,
    variables: Mapping[str, Any] | None,
    pretrained: Mapping[str, Any] | None,
) -> Callable[[], TrainState]:
    """A function that makes the state before the first step, to be compiled.

    What is given need not be drawn. The function is a tree of its arrays: handed to a
    compiled function, they are arguments and no constants of the program. The arguments
    are those of `loop.train`.
    """

    def init(batch: Batch, variables: Any, pretrained: Any) -> TrainState:
        if variables is None:
            keys = jax.random.split(jax.random.key(seed))
            rngs = {"params": keys[0], "dropout": keys[1]}
            variables = model.init(rngs, *model_inputs(batch), train=False)
        if pretrained is not None:
            variables = with_pretrained(variables, pretrained)
        return create_state(
            variables,
            optimizer,
            batch_size=options.batch_size,
            use_ema=options.ema_decay is not None,
            is_frozen=getattr(model, "is_frozen", None),
        )

    # NumPy arrays: the same on every process, and so on every device.
    given = jax.tree.map(np.asarray, (variables, pretrained))
    return jax.tree_util.Partial(init, _first_batch(loader), *given)


def _first_batch(loader: Any) -> Batch:
    """One empty frame of the right shapes, without moving the iterator on."""
    position = loader.get_state()
    batch = next(loader)
    loader.set_state(position)
    return jax.tree.map(lambda x: np.zeros((1, *x.shape[1:]), x.dtype), batch)


def restore(
    checkpoints: Checkpoints,
    loader: Any,
    init: Callable[[], TrainState],
    mesh: jax.sharding.Mesh,
    parameter_sharding: sharding.ParameterSharding,
    info: Mapping[str, Any],
) -> tuple[TrainState, int]:
    """State and step of the newest checkpoint, or those before the first step.

    The loader is set to where it was.

    Args:
        checkpoints: Of the run.
        loader: Checkpointable iterator.
        init: From `initial`.
        mesh: Devices that the state is placed on.
        parameter_sharding: See `sharding.state_sharding`.
        info: What is to be saved; "same" must be what was saved.

    Raises:
        UserError: The run would continue with other data or frozen weights.
        DataError: No checkpoint restores.
    """
    abstract = jax.eval_shape(init)
    placement = sharding.state_sharding(abstract, mesh, parameter_sharding)
    # Frozen parameters are not in a checkpoint: they come from where they came from.
    saved = abstract_state(abstract, placement).replace(frozen={})
    state, found, step = checkpoints.restore(saved, loader) or (None, {}, 0)
    _check_same(found.get("same", {}), info.get("same", {}), checkpoints.folder.parent)
    if state is not None and not abstract.frozen:
        return state, step
    # Compiled in half the time where LLVM does it: drawing runs once, and hundreds of
    # random generators take long to optimise; the numbers are the same.
    is_cpu = mesh.devices.flat[0].platform == "cpu"
    drawn = jax.jit(
        lambda init: init(),
        out_shardings=placement,
        compiler_options={"xla_backend_optimization_level": 1} if is_cpu else {},
    )(init)
    return drawn if state is None else state.replace(frozen=drawn.frozen), step


def _check_same(
    found: Mapping[str, Any], given: Mapping[str, Any], workdir: pathlib.Path
) -> None:
    """`UserError` where a run would continue with other data or frozen weights."""
    differing = [
        f"{name}: {found[name]} there, {given.get(name)} now"
        for name in found
        if found[name] != given.get(name)
    ]
    if differing:
        raise UserError(
            f"the run in {workdir} was trained with something else: "
            f"{'; '.join(differing)}. Give the same, or another --workdir"
        )


def compile_step(
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    grid: RadarGrid,
    state: TrainState,
    mesh: jax.sharding.Mesh,
    options: Any,
    loss: Mapping[str, Any],
    seed: int,
) -> Callable[[TrainState, Batch], tuple[TrainState, Metrics]]:
    """The step of a run, for states placed as this one, which it takes apart.

    It returns before it is computed, as long as not too many are under way.
    """
    whole = sharding.replicated(mesh)
    placement = jax.tree.map(lambda x: x.sharding, state)
    step = make_train_step(
        model,
        optimizer,
        grid,
        loss=dict(loss),
        num_accumulate=options.num_accumulate,
        ema_decay=options.ema_decay,
    )
    step = jax.jit(step, donate_argnums=0, out_shardings=(placement, whole))
    rng = jax.jit(jax.random.key, out_shardings=whole)(np.uint32(seed + 1))
    in_flight: collections.deque[Metrics] = collections.deque()

    def limited(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        with jax.transfer_guard("disallow"):
            state, metrics = step(state, batch, rng)
        in_flight.append(metrics)
        if len(in_flight) > _STEPS_IN_FLIGHT:
            jax.block_until_ready(in_flight.popleft())
        return state, metrics

    return limited
