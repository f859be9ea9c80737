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
PLATFORMS = ("cuda", "tpu")
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


@pytest.mark.slow
def test_programs_for_accelerators_lack_the_loops_for_cpus(facts: Any) -> None:
    """Only loops over cache-sized blocks are particular to CPUs."""
    assert facts("radar", "train_step", "cpu")["ops"]["while"] > 0
    assert facts("radar", "train_step", "cuda")["ops"]["while"] == 0


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


@pytest.mark.parametrize("platform", PLATFORMS)
def test_simulated_rows_are_made_together(
    programs: types.ModuleType, platform: str
) -> None:
    function, arguments = programs.simulator(GRID, num_scatterers=8)
    text = programs.text_of(function, arguments, platform)
    found = programs.facts(text)
    assert not found["types"] & {"f64", "i64", "ui64"}
    assert not found["calls"]
    assert "tensor<64x3x2x2x62xf32>" in text  # [rows, E, D, 2, A]
    alone = programs.text_of(function, arguments, "cpu")
    assert "tensor<64x3x2x2x62xf32>" not in alone


@pytest.mark.slow
def test_work_is_what_the_compiler_counts(programs: types.ModuleType) -> None:
    """Operations of a radar detector, without loops that the compiler counts once."""
    widths = {"widths": (32, 32), "decoder_width": 32}
    config = small_models.radar_config().replace(model=widths)
    function, arguments = programs.detector(config, GRID, 1)
    found = programs.work(function, arguments, "cuda")
    ours = sum(flops * times for _, _, flops, _, times in found)
    theirs = jax.jit(function).trace(*arguments).lower(lowering_platforms=("cuda",))
    assert ours == pytest.approx(theirs.cost_analysis()["flops"], rel=0.1)
    # Every iteration of a loop is counted.
    step = lambda x, _: (x @ x, None)  # noqa: E731
    loop = lambda x: jax.lax.scan(step, x, None, length=5)[0]  # noqa: E731
    looped = programs.work(loop, (programs.shape_of(8, 8),), "cuda")
    assert [(f, times) for _, _, f, _, times in looped] == [(2 * 8**3, 5)]
    least = programs.least_seconds(looped, "H100")
    assert least == pytest.approx(5 * 3 * 256 / 3.35e12)
