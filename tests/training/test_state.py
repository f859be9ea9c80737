"""Schedule and optimizer against numbers worked out by hand and torch's AdamW rule."""

from types import SimpleNamespace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.training.options import TrainOptions
from radejax.training.step import (
    check_patterns,
    create_state,
    freezing,
    make_optimizer,
    make_schedule,
    merge_parameters,
    split_parameters,
    with_pretrained,
)


def _schedule(steps_per_epoch: int, num_epochs: int = 1, **fields: Any) -> Any:
    rates = {"learning_rate": 1e-3, "final_learning_rate": 1e-4, "schedule": "cosine"}
    train = TrainOptions(
        **rates | {"warmup_steps": 0, "num_epochs": num_epochs} | fields
    )
    return make_schedule(train, steps_per_epoch)


CYCLIC = {"schedule": "cyclic_cosine", "final_learning_rate": 1e-5}


@pytest.mark.parametrize(
    ("schedule", "steps", "rates"),
    [
        (_schedule(100), (0, 50, 100, 150), (1e-3, 5.5e-4, 1e-4, 1e-4)),
        (
            _schedule(50, 2, warmup_steps=10),
            (0, 5, 10, 55, 100),
            (0, 5e-4, 1e-3, 5.5e-4, 1e-4),
        ),
        (_schedule(50, 9, max_steps=100), (0, 50, 100), (1e-3, 5.5e-4, 1e-4)),
        (_schedule(50, 1, max_steps=100), (0, 50, 100), (1e-3, 5.5e-4, 1e-4)),
        (_schedule(10, 6, max_steps=20, **CYCLIC), (0, 10, 20), (1e-3, 1e-5, 1e-3)),
        (
            _schedule(10, 6, warmup_steps=4, **CYCLIC),
            (0, 2, 4, 14, 24),
            (0, 5e-4, 1e-3, 1e-5, 1e-3),
        ),
    ],
)
def test_rates_by_step(schedule: Any, steps: tuple, rates: tuple) -> None:
    np.testing.assert_allclose([float(schedule(x)) for x in steps], rates, rtol=1e-5)


def _torch_recursion(peak: float, floor: float, period: int, steps: int) -> np.ndarray:
    """`CosineAnnealingLR.get_lr` of torch, stepped `steps` times, in float64."""
    rates = [peak]
    for epoch in range(1, steps):
        rate = rates[-1]
        if (epoch - 1 - period) % (2 * period) == 0:
            rate += (peak - floor) * (1 - np.cos(np.pi / period)) / 2
        else:
            now, before = (1 + np.cos(np.pi * e / period) for e in (epoch, epoch - 1))
            rate = now / before * (rate - floor) + floor
        rates.append(rate)
    return np.array(rates)


# One batch an epoch, odd and even numbers, those of K-Radar in both recipes.
@pytest.mark.parametrize("steps_per_epoch", [1, 2, 3, 7, 10, 1745, 2909])
def test_cyclic_cosine_is_torchs_recursion_at_every_step(steps_per_epoch: int) -> None:
    num_steps = 11 * steps_per_epoch
    schedule = _schedule(steps_per_epoch, 11, **CYCLIC)
    rates = np.asarray(jax.jit(schedule)(jnp.arange(num_steps)))
    assert rates.dtype == np.float32
    expected = _torch_recursion(1e-3, 1e-5, steps_per_epoch, num_steps)
    np.testing.assert_allclose(rates, expected, rtol=5e-7)
    floors = np.flatnonzero(rates == np.float32(1e-5))
    np.testing.assert_array_equal(floors % (2 * steps_per_epoch), steps_per_epoch)
    assert len(floors) == 5


def test_warm_up_longer_than_the_training_is_rejected() -> None:
    with pytest.raises(
        UserError, match=r"warmup_steps is 100, expected less than the 100"
    ):
        _schedule(50, 2, warmup_steps=100)


def test_accumulated_steps_update_once_with_the_mean_and_at_the_rate_of_their_step() -> (
    None
):
    rates = jnp.array([0.0, 1e-3, 2e-3, 3e-3])
    params, grads = {"w": jnp.array([2.0])}, [jnp.array([1.0]), jnp.array([3.0])]
    train = TrainOptions(weight_decay=0.1, gradient_accumulation_steps=2)
    accumulating = make_optimizer(train, lambda step: rates[step])
    state = accumulating.init(params)
    for i in range(4):
        updates, state = accumulating.update({"w": grads[i % 2]}, state, params)
        assert (updates["w"][0] == 0) == (i != 3)  # the first update has a rate of 0
    once = make_optimizer(TrainOptions(weight_decay=0.1), lambda step: rates[2 * step])
    expected = once.init(params)
    for _ in range(2):
        wanted, expected = once.update({"w": jnp.array([2.0])}, expected, params)
    chex.assert_trees_all_close(updates, wanted, rtol=1e-6)


def test_first_step_is_adamw_with_torch_defaults() -> None:
    optimizer = make_optimizer(TrainOptions(), lambda _: 1e-3)
    params = {"kernel": jnp.array([2.0, -3.0]), "bias": jnp.array([0.5])}
    grads = {"kernel": jnp.array([0.1, 4.0]), "bias": jnp.array([-1.0])}
    updates, _ = optimizer.update(grads, optimizer.init(params), params)

    def expected(p: np.ndarray, g: np.ndarray) -> np.ndarray:
        # Bias-corrected moments of one step are g and g^2; decay is on every parameter.
        return -1e-3 * (g / (np.abs(g) + 1e-8) + 0.01 * p)

    chex.assert_trees_all_close(
        updates, jax.tree.map(expected, params, grads), rtol=1e-5
    )


def test_frozen_parameters_have_no_update_and_no_optimizer_state() -> None:
    optimizer = make_optimizer(TrainOptions(weight_decay=0.1), lambda _: 1e-3)
    params = {
        "vit": {"kernel": jnp.ones((7, 5))},
        "head": {"kernel": jnp.ones((3,)), "fixed": jnp.ones((2,))},
    }
    state = create_state(
        {"params": params},
        optimizer,
        use_ema=True,
        is_frozen=lambda name: name.startswith("vit/") or name == "head/fixed",
    )
    assert jax.tree.leaves(jax.tree.map(jnp.shape, state.params)) == [3]
    for part in (state.opt_state, state.ema_params):
        assert {x.shape for x in jax.tree.leaves(part)} <= {(3,), ()}
    chex.assert_trees_all_equal(state.eval_variables["params"], params)
    chex.assert_trees_all_equal(
        merge_parameters(*split_parameters(params, None)), params
    )


@pytest.mark.wrong_types
def test_patterns_freeze_in_addition_to_the_model() -> None:
    params = {"backbone": {"encoder_1": 1, "decoder_1": 2}, "image": {"w": 3}}
    own = SimpleNamespace(is_frozen=lambda path: path.startswith("image/"))
    is_frozen = freezing(own, ("backbone/encoder*",))
    trained, frozen = split_parameters(params, is_frozen)
    assert trained == {"backbone": {"decoder_1": 2}}
    assert frozen == {"backbone": {"encoder_1": 1}, "image": {"w": 3}}
    assert merge_parameters(trained, frozen) == params
    assert split_parameters(params, freezing(SimpleNamespace(), ()))[0] == params
    of_part = freezing(SimpleNamespace(), ("backbone",))
    assert split_parameters(params, of_part)[0] == {"image": {"w": 3}}
    check_patterns(params, ("backbone/*",))
    with pytest.raises(
        UserError,
        match=r"'neck\*', .*: backbone/decoder_1, backbone/encoder_1, image/w$",
    ):
        check_patterns(params, ("image*", "neck*"))
    with pytest.raises(UserError, match="expected patterns that leave parameters"):
        check_patterns(params, ("*",))


def _made(fields: dict[str, str]) -> None:
    train = TrainOptions(num_epochs=1, **fields)
    make_optimizer(train, make_schedule(train, 5))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"optimizer": "lion"},
            "optimizer is 'lion', expected adamw or module:function",
        ),
        (
            {"optimizer": "builtins:print"},
            "expected a function that returns an optax.Grad",
        ),
        ({"optimizer": "optax:no"}, "module 'optax' has no attribute 'no'"),
        ({"schedule": "linear"}, "expected cosine or cyclic_cosine or module:function"),
        (
            {"schedule": "sys:path"},
            "schedule is 'sys:path', expected the name of a func",
        ),
    ],
)
def test_wrong_optimizers_and_schedules_are_named(fields: Any, message: str) -> None:
    with pytest.raises(UserError, match=rf"^config\.train\..*{message}"):
        _made(fields)


def test_eval_variables_are_the_averaged_ones_where_there_are_any() -> None:
    optimizer = make_optimizer(TrainOptions(weight_decay=0.0), lambda _: 1e-3)
    variables = {"params": {"w": jnp.ones(2)}, "batch_stats": {"mean": jnp.zeros(2)}}
    state = create_state(variables, optimizer, use_ema=True)
    state = state.replace(ema_params={"w": jnp.full(2, 5.0)})
    assert state.eval_variables["params"]["w"][0] == 5.0
    assert "batch_stats" in state.eval_variables


def test_pretrained_parts_replace_their_like() -> None:
    proj = {"kernel": np.ones((3, 8)), "bias": np.zeros(8)}
    variables = {"params": {"image_neck": {"proj": proj}, "heads": {}}}
    part = {"params": {"image_neck": {"proj": {"bias": np.full(8, 7.0)}, "new": 1}}}
    merged = with_pretrained(variables, part)
    assert (merged["params"]["image_neck"]["proj"]["bias"] == 7).all()
    assert merged["params"]["image_neck"]["proj"]["kernel"] is proj["kernel"]
    assert merged["params"]["image_neck"]["new"] == 1
    wrong = {"params": {"image_neck": {"proj": {"bias": np.zeros(9)}}}}
    with pytest.raises(UserError, match=r"params/image_neck/proj/bias is \(9,\)"):
        with_pretrained(variables, wrong)
