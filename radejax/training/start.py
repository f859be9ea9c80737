"""What a start of a training begins with: plan, state, and the step that is compiled."""

from __future__ import annotations

import collections
import dataclasses
import functools
import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
import optax
from jax.interpreters import partial_eval

from radejax.core.files import require_same
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

_log = logging.getLogger(__name__)

_STEPS_IN_FLIGHT = 2  # more would only pile up batches in memory


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """What is trained, and how.

    Attributes:
        options: The fields of `train` in `core.config`, as attributes.
        loss: Keyword arguments of `detection_loss`.
        watch: The fields of `watch` in `core.config`, as attributes.
        seed: Of drawn variables and of everything random in a step.
        info: Plain values that each checkpoint carries. Those under "same" are the
            same on every start of a run; "config" is shown by Weights & Biases.
        steps_per_epoch: Batches of one pass over the data.
        pretrained: Part of the variables that takes the place of drawn ones, an image
            backbone's weights for example.
        trace_folder: Writes a trace of the steps `logging.profile_steps` there.
        frame_names: What `Batch.frame` counts, for messages; its numbers if None.
    """

    options: Any
    loss: Mapping[str, Any]
    watch: Any
    seed: int
    info: Mapping[str, Any]
    steps_per_epoch: int
    pretrained: Mapping[str, Any] | None = None
    trace_folder: str = ""
    frame_names: Sequence[str] | None = None

    @property
    def num_steps(self) -> int:
        """Of the whole training."""
        return self.steps_per_epoch * self.options.num_epochs

    @property
    def wandb(self) -> dict[str, Any] | None:
        """What a run at Weights & Biases is named after; None without one."""
        if not self.watch.wandb:
            return None
        config = self.info.get("config", {})
        return {"project": self.watch.wandb_project, "config": dict(config)}

    @property
    def schedule(self) -> optax.Schedule:
        """Learning rate by step."""
        return make_schedule(
            learning_rate=self.options.learning_rate,
            final_learning_rate=self.options.final_learning_rate,
            num_steps=self.num_steps,
            warmup_steps=self.options.warmup_steps,
            kind=self.options.schedule,
            steps_per_epoch=self.steps_per_epoch,
        )

    def optimizer(self) -> optax.GradientTransformation:
        """AdamW with its learning rate by step."""
        return make_optimizer(
            self.schedule,
            weight_decay=self.options.weight_decay,
            gradient_clip_norm=self.options.gradient_clip_norm,
        )


Initial = tuple[Callable[[], Any], Callable[[Any], TrainState]]
"""Gives the variables to start from, and makes the state before the first step of them."""


def initial(
    model: nn.Module,
    variables: Mapping[str, Any] | None,
    loader: Any,
    optimizer: optax.GradientTransformation,
    plan: Plan,
) -> Initial:
    """What a training starts from, still to be drawn unless it is given.

    The first function is a tree of the arrays that were given.
    """

    def to_start_from(batch: Batch, variables: Any, pretrained: Any) -> Any:
        if variables is None:
            keys = jax.random.split(jax.random.key(plan.seed))
            rngs = {"params": keys[0], "dropout": keys[1]}
            variables = model.init(rngs, *model_inputs(batch), train=False)
        if pretrained is not None:
            variables = with_pretrained(variables, pretrained)
        return variables

    create = functools.partial(
        create_state,
        optimizer=optimizer,
        batch_size=plan.options.batch_size,
        use_ema=plan.options.ema_decay is not None,
        is_frozen=getattr(model, "is_frozen", None),
    )
    # NumPy arrays: the same on every process, and so on every device.
    given = jax.tree.map(np.asarray, (variables, plan.pretrained))
    first = _first_batch(loader)
    return jax.tree_util.Partial(to_start_from, first, *given), create


def _traced(function: Callable[[], Any]) -> tuple[Any, Callable[[], Any]]:
    """Shapes of what it returns, and a function that returns it as NumPy arrays.

    It is traced once for both, and done one operation after the other, needless ones not:
    equal operations share a compiled program. In one program each of a hundred random
    generators is compiled on its own, which takes as long as half a training step.
    """
    traced, shape = jax.make_jaxpr(lambda f: f(), return_shape=True)(function)

    def evaluated() -> Any:
        is_result = [True] * len(traced.jaxpr.outvars)
        needed, is_used = partial_eval.dce_jaxpr(traced.jaxpr, is_result)
        given = itertools.compress(jax.tree.leaves(function), is_used)
        leaves = jax.core.eval_jaxpr(needed, traced.consts, *given)
        return jax.tree.unflatten(jax.tree.structure(shape), map(np.asarray, leaves))

    return shape, evaluated


def _first_batch(loader: Any) -> Batch:
    """One empty frame of the right shapes, without moving the iterator on."""
    position = loader.get_state()
    batch = next(loader)
    loader.set_state(position)
    return jax.tree.map(lambda x: np.zeros((1, *x.shape[1:]), x.dtype), batch)


def restore(
    checkpoints: Checkpoints,
    loader: Any,
    init: Initial,
    mesh: jax.sharding.Mesh,
    plan: Plan,
) -> tuple[TrainState, int]:
    """State and step of the newest checkpoint, or those before the first step.

    Args:
        checkpoints: Of the run.
        loader: Checkpointable iterator, which is set to where it was.
        init: From `initial`.
        mesh: Devices that the state is placed on.
        plan: Its `info["same"]` must be what was saved.

    Raises:
        UserError: The run would continue with other data or frozen weights.
        DataError: No checkpoint restores.
    """
    variables, create = init
    shapes, drawn = _traced(variables)
    abstract = jax.eval_shape(create, shapes)
    how = plan.options.parameter_sharding
    placement = sharding.state_sharding(abstract, mesh, how)
    # Frozen parameters are not in a checkpoint: they come from where they came from.
    saved = abstract_state(abstract, placement).replace(frozen={})
    state, info, step = checkpoints.restore(saved, loader) or (None, {}, 0)
    found, given = info.get("same", {}), plan.info.get("same", {})
    require_same(
        found,
        {name: given.get(name) for name in found},
        f"the run in {checkpoints.folder.parent} was trained with something else",
        mend="give the same, or another --workdir",
    )
    if state is not None:
        _log.info("continuing from step %d of %d", step, plan.num_steps)
        if not abstract.frozen:
            return state, step
    new = jax.jit(create, out_shardings=placement)(drawn())
    return new if state is None else state.replace(frozen=new.frozen), step


def compile_step(
    model: nn.Module,
    grid: RadarGrid,
    optimizer: optax.GradientTransformation,
    state: TrainState,
    mesh: jax.sharding.Mesh,
    plan: Plan,
) -> Callable[[TrainState, Batch], tuple[TrainState, Metrics]]:
    """The step of a run, for states placed as this one; it consumes its state.

    It returns before it is computed, unless too many are under way.

    Raises:
        UserError: The batch does not divide over the devices.
    """
    options, whole = plan.options, sharding.replicated(mesh)
    sharding.check_batch_size(
        options.batch_size,
        mesh,
        "train.batch_size",
        options.gradient_accumulation_steps,
    )
    step = make_train_step(
        model,
        optimizer,
        grid,
        loss=dict(plan.loss),
        num_accumulate=options.gradient_accumulation_steps,
        ema_decay=options.ema_decay,
    )
    placement = jax.tree.map(lambda x: x.sharding, state)
    step = jax.jit(step, donate_argnums=0, out_shardings=(placement, whole))
    rng = jax.jit(jax.random.key, out_shardings=whole)(np.uint32(plan.seed + 1))
    in_flight: collections.deque[Metrics] = collections.deque()

    def limited(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        with jax.transfer_guard("disallow"):
            state, metrics = step(state, batch, rng)
        in_flight.append(metrics)
        if len(in_flight) > _STEPS_IN_FLIGHT:
            jax.block_until_ready(in_flight.popleft())
        return state, metrics

    return limited
