"""Meshes and placements, on eight fake CPU devices."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from radejax.core.errors import UserError
from radejax.training import sharding


def test_put_batch_splits_the_leading_axis() -> None:
    mesh = sharding.make_mesh(4)
    batch = {"x": np.arange(24.0).reshape(8, 3), "i": np.arange(8)}
    placed = sharding.put_batch(batch, mesh)
    chex.assert_trees_all_equal(placed, batch)
    assert [s.data.shape for s in placed["x"].addressable_shards] == [(2, 3)] * 4


def test_fsdp_splits_the_widest_axis_that_divides() -> None:
    mesh = sharding.make_mesh(4)
    state = {
        "kernel": jax.ShapeDtypeStruct((3, 3, 128, 256), jnp.float32),
        "bias": jax.ShapeDtypeStruct((256,), jnp.float32),
        "odd": jax.ShapeDtypeStruct((333, 333), jnp.float32),
    }
    placed = sharding.state_sharding(state, mesh, "fsdp")
    assert placed["kernel"].spec == PartitionSpec(None, None, None, "data")
    assert placed["bias"].spec == placed["odd"].spec == PartitionSpec()
    whole = sharding.state_sharding(state, mesh, "replicated")
    assert {s.spec for s in whole.values()} == {PartitionSpec()}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sharding.make_mesh(9), "asked for 9 devices, this machine has 8"),
        (
            lambda: sharding.check_batch_size(6, sharding.make_mesh(4)),
            "batch_size=6 does not divide over 4 devices.* 4 or 8",
        ),
        (
            lambda: sharding.check_batch_size(8, sharding.make_mesh(4), "b", 4),
            "b=8 does not divide over 4 devices .*accumulation_steps=4; .*example 16",
        ),
        (
            lambda: sharding.check_batch_size(8, sharding.make_mesh(4), "b", 0),
            "gradient_accumulation_steps must be at least 1, got 0",
        ),
        pytest.param(
            lambda: sharding.state_sharding({}, sharding.make_mesh(1), "sharded"),
            "'replicated' or 'fsdp', got 'sharded'",
            marks=pytest.mark.wrong_types,
        ),
    ],
)
def test_wrong_use_says_what_would_do(call: object, message: str) -> None:
    with pytest.raises(UserError, match=message):
        call()
