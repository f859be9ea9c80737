"""Tests of radejax.models.deformable_attention."""

import functools
import json

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models import deformable_attention as attention
from radejax.models.deformable_attention import DeformableAttention

from .plain_attention import plain_attention

MODULES = ("module_two_levels", "module_box_reference")


@pytest.fixture(scope="module")
def case_of(golden):
    """Function from a reference case's name to its settings and arrays."""
    file = np.load(golden / "dinorade_deform_attn.npz")
    info = json.loads(str(file["info"]))

    def case(name):
        prefix = f"{name}__"
        keys = [k for k in file.files if k.startswith(prefix)]
        return info[name], {k.removeprefix(prefix): file[k] for k in keys}

    return case


def close_to_maximum(actual, desired, tolerance):
    np.testing.assert_allclose(actual, desired, atol=tolerance * np.abs(desired).max())


def test_samples_by_hand():
    # One head, one channel, one query: a 2 x 3 map with values 0..5.
    value = jnp.arange(6.0).reshape(1, 6, 1, 1)
    places = {
        (0.5, 0.5): 2.5,  # the middle: half way between 1 and 4
        (0.5 / 3, 0.25): 0.0,  # center of the first pixel
        (0.0, 0.25): 0.0,  # left edge: half of pixel 0, half outside
        (1.0, 0.75): 2.5,  # right edge: half of pixel 5
        (-1e9, 1e9): 0.0,  # far outside
        (np.inf, 0.5): 0.0,
        (np.nan, np.nan): 0.0,
    }
    n = len(places)
    out = attention.lifted_attention(
        value.reshape(1, 2, 3, 1, 1),
        jnp.zeros((1, n, 1, 1, 2)),
        jnp.zeros((1, n, 1, 1)),
        attention.Queries(
            jnp.ones((1, n, 1)),
            jnp.asarray(list(places)).reshape(1, n, 1, 2),
            jnp.full((1, n, 1), 2.0),
        ),
        jnp.zeros((1, 1, 2)),
        jnp.zeros((1, 1)),
        chunk_size=4,
    )
    expected = [2 * v for v in places.values()]
    np.testing.assert_allclose(out.reshape(n), expected, atol=1e-6)


@pytest.mark.parametrize("name", MODULES)
def test_reference_module_and_gradients(case_of, name, make):
    info, case = case_of(name)
    sizes = [tuple(s) for s in info["shapes_hw"]]
    counts = info["n_heads"], info["n_points"]
    params = {}
    for key, tensor in make.seeded_state_dict(info["tensors"]).items():
        layer, kind = key.split(".")
        entry = {"kernel": tensor.T} if kind == "weight" else {"bias": tensor}
        params.setdefault(layer, {}).update(entry)
    is_valid = jnp.asarray(~case["padding_mask"]) if info["padding_mask"] else None

    def apply(params, query, points, value):
        out, *_ = plain_attention(params, query, points, value, sizes, counts, is_valid)
        return out

    inputs = (params, case["query"], case["reference_points"], case["input_flatten"])

    @jax.jit
    def run(inputs, cotangent):
        out, pull = jax.vjp(apply, *inputs)
        return out, pull(cotangent)

    out, grads = run(inputs, case["cotangent"])
    np.testing.assert_allclose(out, case["output"], atol=1e-5)
    names = ("grad_query", "grad_reference_points", "grad_input")
    for grad, key in zip(grads[1:], names, strict=True):
        close_to_maximum(grad, case[key], 1e-5)
    for layer, grad in grads[0].items():
        close_to_maximum(grad["kernel"].T, case[f"grad_param__{layer}.weight"], 1e-5)
        close_to_maximum(grad["bias"], case[f"grad_param__{layer}.bias"], 1e-5)
    _, locations, weights = plain_attention(*inputs, sizes, counts, is_valid)
    np.testing.assert_allclose(locations, case["sampling_locations"], atol=1e-5)
    np.testing.assert_allclose(weights, case["attention_weights"], atol=1e-5)


def test_initial_offsets_form_rings(released):
    expected = released("deform_attn")["initial_bias__d128_l1_h4_p8"]
    module = DeformableAttention(128, 4, 8)
    shapes = (1, 1, 128), (1, 1, 1), (1, 1, 1, 2), (1, 1, 1), (1, 2, 2, 128)
    params = jax.jit(module.init)(jax.random.key(0), *map(jnp.zeros, shapes))["params"]
    np.testing.assert_allclose(params["sampling_offsets"]["bias"], expected, atol=1e-5)
    for name in ("sampling_offsets", "attention_weights"):
        assert not params[name]["kernel"].any()
    assert params["value_proj"]["kernel"].any()


# The lifted form ---------------------------------------------------------------------

B, N, E, C, H, W = 2, 13, 4, 16, 5, 7


def lifted_case(shared_geometry, seed=0):
    rng = np.random.default_rng(seed)
    module = DeformableAttention(C, 4, 3, chunk_size=5, dtype=jnp.float64)
    batch = 1 if shared_geometry else B
    inputs = {
        "feature": rng.standard_normal((B, N, C)),
        "scale": rng.random((B, N, E)) * (rng.random((B, N, E)) > 0.3),
        "reference": rng.uniform(-0.1, 1.1, (batch, N, E, 2)),
        "query_weights": rng.random((batch, N, E)) * (rng.random((batch, N, E)) > 0.2),
        "value": rng.standard_normal((B, H, W, C)),
    }
    inputs = {k: jnp.asarray(v) for k, v in inputs.items()}
    return module, random_params(rng, module), inputs, rng.standard_normal((B, N, C))


def random_params(rng, module):
    samples = module.num_heads * module.num_points
    sizes = {"sampling_offsets": 2 * samples, "attention_weights": samples}
    sizes |= {"value_proj": C, "output_proj": C}
    return {
        "params": {
            name: {
                "kernel": jnp.asarray(0.5 * rng.standard_normal((C, size))),
                "bias": jnp.asarray(0.5 * rng.standard_normal(size)),
            }
            for name, size in sizes.items()
        }
    }


def through_plain_form(module, params, inputs):
    query = inputs["scale"][..., None] * inputs["feature"][:, :, None]
    points = jnp.broadcast_to(inputs["reference"], (B, N, E, 2))
    out, *_ = plain_attention(
        params["params"],
        query.reshape(B, N * E, C),
        points.reshape(B, N * E, 1, 2),
        inputs["value"].reshape(B, H * W, C),
        [(H, W)],
        (module.num_heads, module.num_points),
    )
    weights = inputs["query_weights"][..., None]
    return (out.reshape(B, N, E, C) * weights).sum(2)


@functools.partial(jax.jit, static_argnums=0)
def through_lifted_form(module, params, inputs):
    return module.apply(params, **inputs)


@pytest.mark.parametrize("shared_geometry", [True, False])
def test_lifted_form_equals_the_plain_one(shared_geometry):
    # In double precision: in single, samples near a pixel center may fall on another
    # side in the two forms, and their gradients differ.
    with jax.enable_x64():
        module, params, inputs, cotangent = lifted_case(shared_geometry)

        def run(form, params, inputs, cotangent):
            out, pull = jax.vjp(lambda *a: form(module, *a), params, inputs)
            return out, pull(cotangent)

        compiled = jax.jit(run, static_argnums=0)
        plain = compiled(through_plain_form, params, inputs, cotangent)
        lifted = compiled(through_lifted_form, params, inputs, cotangent)
        chex.assert_trees_all_close(lifted, plain, rtol=0, atol=1e-11)
        # So that the comparison means something: every gradient is at work.
        sizes = jax.tree.map(lambda g: float(jnp.abs(g).max()), plain[1])
        assert min(jax.tree.leaves(sizes)) > 0.1


def test_lifted_form_depends_on_the_precision_and_not_on_the_chunk():
    with jax.enable_x64():
        module, params, inputs, _ = lifted_case(False)
        exact = through_lifted_form(module, params, inputs)
        for size in (1, 13, 100):
            found = through_lifted_form(module.copy(chunk_size=size), params, inputs)
            np.testing.assert_allclose(found, exact, atol=1e-13)
    narrow = jax.tree.map(lambda x: np.asarray(x, np.float32), (params, inputs))
    for dtype, tolerance in ((jnp.float32, 1e-5), (jnp.bfloat16, 0.1)):
        out = through_lifted_form(module.copy(dtype=dtype), *narrow)
        assert out.dtype == dtype
        np.testing.assert_allclose(np.asarray(out, np.float32), exact, atol=tolerance)
