"""Programs that are lowered for GPU and TPU without compiling them."""

import functools
import pathlib
import types
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from radejax.config import load_module
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.deformable_attention import DeformableAttention
from tests import small_models

ROOT = pathlib.Path(__file__).resolve().parents[1]
TOKENS = 2 * 3 + 5
"""Of the small ViT: patches, class and registers."""

# Maps large enough for the code paths that only a CPU takes.
GRID = RadarGrid.reduced(
    num_doppler=2, num_range=96, num_elevation=3, num_azimuth=62, max_range_m=90.0
)


@pytest.fixture(scope="module")
def programs() -> types.ModuleType:
    """Module that lowers every program, `benchmarks/programs.py`."""
    return load_module(ROOT / "benchmarks" / "programs.py")


@pytest.fixture(scope="module")
def facts(programs: types.ModuleType) -> Any:
    """Function from kind, task and platform to the facts from the program's text."""

    @functools.cache
    def read(kind: str, task: str, platform: str) -> dict[str, Any]:
        config = getattr(small_models, f"{kind}_config")()
        config = config.replace(model={"dtype": "bfloat16"})
        function, arguments = getattr(programs, task)(config, GRID, 2)
        return programs.facts(programs.text_of(function, arguments, platform))

    return read


CASES = [
    ("radar", "train_step", "cuda"),
    ("radar", "train_step", "tpu"),
    ("camera", "detector", "cuda"),
    ("camera", "train_step", "tpu"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "task", "platform"), CASES)
def test_accelerators_get_lean_programs(
    facts: Any, kind: str, task: str, platform: str
) -> None:
    found = facts(kind, task, platform)
    assert not found["types"] & {"f64", "i64", "complex"}
    # JAX counts the random numbers of dropout in 64 bits, and splits the counter in two.
    has_dropout = (kind, task) == ("camera", "train_step")
    assert found["wide"] == ({"iota_2x32_shape"} if has_dropout else set())
    assert not found["calls"]  # neither the host nor a library outside of XLA
    assert set(found["convolutions"]) == {"bf16"}
    # Channels stay innermost throughout, except for the heads of the ViT's tokens.
    assert [shape for shape in found["turned"] if f"x{TOKENS}" not in shape] == []


def test_bins_are_sampled_in_large_steps(programs: types.ModuleType) -> None:
    """This holds wherever the program is exported: one exported on a CPU runs on a GPU."""
    bins, shape = 4096, programs.shape_of
    module = DeformableAttention(8, num_heads=2, num_points=2)
    arguments = (
        shape(1, bins, 8),
        shape(1, bins, 3),
        shape(1, bins, 3, 2),
        shape(1, bins, 3),
        shape(1, 6, 8, 8),
    )
    variables = jax.eval_shape(module.init, jax.random.key(0), *arguments)

    def loss(variables: Any, *arguments: Any) -> jax.Array:
        return jnp.square(module.apply(variables, *arguments)).sum()

    gradient = jax.value_and_grad(loss)
    for platform, chunk in (("cpu", 448), ("cuda", bins)):
        text = programs.text_of(gradient, (variables, *arguments), platform)
        sampled = f"tensor<{chunk}x3x2x4x"  # [bins, E, P, 4]
        assert sampled in text, platform
