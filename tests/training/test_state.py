"""Schedule and optimizer against numbers worked out by hand and torch's AdamW rule."""

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.training.options import TrainOptions
from radejax.training.step import (
    check_patterns,
    create_state,
    make_optimizer,
    make_schedule,
    merge_variables,
    split_parameters,
)


def _schedule(steps_per_epoch, num_epochs=1, **fields):
    rates = {"learning_rate": 1e-3, "final_learning_rate": 1e-4, "schedule": "cosine"}
    rates |= {"warmup_steps": 0, "num_epochs": num_epochs}
    return make_schedule(TrainOptions(**rates | fields), steps_per_epoch)


CYCLIC = {"schedule": "cyclic_cosine", "final_learning_rate": 1e-5}
_warm_up_of_cycles = _schedule(10, 6, warmup_steps=4, **CYCLIC)


@pytest.mark.parametrize(
    ("schedule", "steps", "rates"),
    [
        (_schedule(100), (0, 50, 100, 150), (1e-3, 5.5e-4, 1e-4, 1e-4)),
        (_schedule(50, 2, warmup_steps=10), (0, 5, 10, 55), (0, 5e-4, 1e-3, 5.5e-4)),
        (_schedule(50, 1, max_steps=100), (0, 50, 100), (1e-3, 5.5e-4, 1e-4)),
        (_schedule(10, 6, max_steps=20, **CYCLIC), (0, 10, 20), (1e-3, 1e-5, 1e-3)),
        (_warm_up_of_cycles, (0, 2, 4, 14, 24), (0, 5e-4, 1e-3, 1e-5, 1e-3)),
    ],
)
def test_rates_by_step(schedule, steps, rates):
    np.testing.assert_allclose([float(schedule(x)) for x in steps], rates, rtol=1e-5)


def _torch_recursion(peak, floor, period, steps):
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
@pytest.mark.parametrize("steps_per_epoch", [1, 2, 7, 1745])
def test_cyclic_cosine_is_torchs_recursion_at_every_step(steps_per_epoch):
    num_steps = 11 * steps_per_epoch
    schedule = _schedule(steps_per_epoch, 11, **CYCLIC)
    rates = np.asarray(jax.jit(schedule)(jnp.arange(num_steps)))
    assert rates.dtype == np.float32
    expected = _torch_recursion(1e-3, 1e-5, steps_per_epoch, num_steps)
    np.testing.assert_allclose(rates, expected, rtol=5e-7)
    floors = np.flatnonzero(rates == np.float32(1e-5))
    np.testing.assert_array_equal(floors % (2 * steps_per_epoch), steps_per_epoch)
    assert len(floors) == 5


def test_accumulated_steps_update_once_with_the_mean_and_at_the_rate_of_their_step():
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


def test_first_step_is_adamw_with_torch_defaults():
    optimizer = make_optimizer(TrainOptions(), lambda _: 1e-3)
    params = {"kernel": jnp.array([2.0, -3.0]), "bias": jnp.array([0.5])}
    grads = {"kernel": jnp.array([0.1, 4.0]), "bias": jnp.array([-1.0])}
    updates, _ = optimizer.update(grads, optimizer.init(params), params)

    def expected(p, g):
        # Bias-corrected moments of one step are g and g^2; decay is on every parameter.
        return -1e-3 * (g / (np.abs(g) + 1e-8) + 0.01 * p)

    wanted = jax.tree.map(expected, params, grads)
    chex.assert_trees_all_close(updates, wanted, rtol=1e-5)


class WithFrozenPart(nn.Module):
    def is_frozen(self, path):
        return path.startswith("vit/")


def test_frozen_parameters_have_no_optimizer_state_and_no_average():
    optimizer = make_optimizer(TrainOptions(weight_decay=0.1), lambda _: 1e-3)
    params = {
        "vit": {"kernel": jnp.ones((7, 5))},
        "head": {"kernel": jnp.ones((3,)), "fixed": jnp.ones((2,))},
    }
    state = create_state(
        {"params": params, "batch_stats": {"mean": jnp.zeros(2)}},
        optimizer,
        use_ema=True,
        model=WithFrozenPart(),
        freeze=("head/fix*",),
    )
    assert jax.tree.leaves(jax.tree.map(jnp.shape, state.params)) == [3]
    for part in (state.opt_state, state.ema_params):
        assert {x.shape for x in jax.tree.leaves(part)} <= {(3,), ()}
    chex.assert_trees_all_equal(state.eval_variables["params"], params)
    averaged = state.replace(ema_params=jax.tree.map(lambda x: 5 * x, state.ema_params))
    found = averaged.eval_variables
    assert found["params"]["head"]["kernel"][0] == 5.0
    assert found["params"]["head"]["fixed"][0] == 1.0
    assert "batch_stats" in found


def test_patterns_are_of_parameters_or_of_whole_parts():
    params = {"backbone": {"encoder_1": 1, "decoder_1": 2}, "image": {"w": 3}}
    parts = {"backbone": {"encoder_1": 1}, "image": {"w": 3}}
    for patterns, frozen in (
        ((), {}),
        (("backbone",), {"backbone": params["backbone"]}),
        (("backbone/enc*", "image/w"), parts),
    ):
        parts = split_parameters(params, WithFrozenPart(), patterns)
        assert parts[1] == frozen
        assert merge_variables(*parts) == params


PARAMS = {"backbone": {"w": 1}, "image": {"w": 3}}


def _optimizer_of(name):
    return make_optimizer(TrainOptions(optimizer=name), lambda _: 1e-3)


def _schedule_of(name):
    return make_schedule(TrainOptions(num_epochs=1, schedule=name), 5)


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: _optimizer_of("lion"), "is 'lion', expected adamw or module:function"),
        (lambda: _schedule_of("linear"), "expected cosine or cyclic_cosine or module"),
        (lambda: _schedule(50, 2, warmup_steps=100), "steps is 100, expected less"),
        (
            lambda: check_patterns(PARAMS, ("neck*",)),
            r"'neck\*', .*: backbone/w, image/w$",
        ),
    ],
)
def test_wrong_options_are_named(call, message):
    with pytest.raises(UserError, match=message):
        call()


def test_pretrained_parts_replace_their_like():
    proj = {"kernel": np.ones((3, 8)), "bias": np.zeros(8)}
    variables = {"params": {"image_neck": {"proj": proj}, "heads": {}}}
    part = {"params": {"image_neck": {"proj": {"bias": np.full(8, 7.0)}, "new": 1}}}
    merged = merge_variables(variables, part)
    assert (merged["params"]["image_neck"]["proj"]["bias"] == 7).all()
    assert merged["params"]["image_neck"]["proj"]["kernel"] is proj["kernel"]
    assert merged["params"]["image_neck"]["new"] == 1
    wrong = {"params": {"image_neck": {"proj": {"bias": np.zeros(9)}}}}
    with pytest.raises(UserError, match=r"params/image_neck/proj/bias is \(9,\)"):
        merge_variables(variables, wrong)
