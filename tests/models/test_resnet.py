"""Tests of radejax.models.resnet."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal

from radejax.models import resnet


def convolved(x, kernel, stride):
    """Correlation with zero padding of half the kernel's size, by scipy."""
    out = np.zeros((*x.shape[:3], kernel.shape[-1]))
    for b, i, o in np.ndindex(x.shape[0], *kernel.shape[2:]):
        out[b, :, :, o] += scipy.signal.correlate2d(
            x[b, :, :, i], kernel[:, :, i, o], mode="same"
        )
    return out[:, ::stride, ::stride]


def test_strided_convolution():
    x = np.random.default_rng(0).standard_normal((2, 7, 8, 3)).astype(np.float32)
    for size, stride in ((1, 1), (1, 2), (3, 2), (7, 2)):
        module = resnet.StridedConv(4, size, stride)
        variables = module.init(jax.random.key(0), jnp.asarray(x))
        kernel = np.asarray(variables["params"]["kernel"])
        np.testing.assert_allclose(
            module.apply(variables, jnp.asarray(x)),
            convolved(x, kernel, stride),
            atol=1e-5,
        )


def test_frozen_normalisation_by_its_formula():
    x = np.random.default_rng(0).standard_normal((1, 2, 2, 3)).astype(np.float32)
    params = {
        "scale": np.array([1.0, 2.0, 3.0], np.float32),
        "bias": np.array([0.5, 0.0, -1.0], np.float32),
        "mean": np.array([0.1, -0.2, 0.3], np.float32),
        "var": np.array([1.0, 4.0, 0.25], np.float32),
    }
    expected = (x - params["mean"]) / np.sqrt(params["var"] + 1e-5)
    expected = expected * params["scale"] + params["bias"]
    out = resnet.FrozenBatchNorm().apply({"params": params}, jnp.asarray(x))
    np.testing.assert_allclose(out, expected, atol=1e-6)


def test_bottleneck_by_its_parts():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((1, 5, 6, 4)).astype(np.float32)
    block = resnet.Bottleneck(3, stride=2, is_first=True, frozen=True)
    variables = block.init(jax.random.key(0), jnp.asarray(x), False)
    params = jax.tree.map(
        lambda v: np.abs(v + 0.3 * rng.standard_normal(v.shape)).astype(np.float32),
        variables["params"],
    )

    def part(x, name, stride=1):
        norm = params[f"norm_{name}"]
        y = convolved(x, params[f"conv_{name}"]["kernel"], stride)
        y = (y - norm["mean"]) / np.sqrt(norm["var"] + 1e-5)
        return y * norm["scale"] + norm["bias"]

    y = np.maximum(part(x, "1"), 0)
    y = np.maximum(part(y, "2", 2), 0)
    expected = np.maximum(part(y, "3") + part(x, "shortcut", 2), 0)
    out = block.apply({"params": params}, jnp.asarray(x), False)
    chex.assert_shape(out, (1, 3, 3, 12))
    np.testing.assert_allclose(out, expected, rtol=1e-4, atol=1e-4)


def test_full_size_shapes():
    trunk, neck = resnet.ResNetTrunk(), resnet.ResNetNeck()
    image = jax.ShapeDtypeStruct((1, 720, 1280, 3), jnp.float32)
    variables = jax.eval_shape(trunk.init, jax.random.key(0), image)
    features = jax.eval_shape(trunk.apply, variables, image)
    assert features.shape == (1, 45, 80, 1024)
    has_image = jax.ShapeDtypeStruct((1,), jnp.bool_)
    neck_variables = jax.eval_shape(neck.init, jax.random.key(0), features, has_image)
    out = jax.eval_shape(neck.apply, neck_variables, features, has_image)
    assert out.shape == (1, 23, 40, 128)
    # torchvision's ResNet-50 has 23,508,032 parameters without its classifier.
    sizes = [x.size for x in jax.tree.leaves(variables["params"])]
    sizes += [x.size for x in jax.tree.leaves(neck_variables["params"])]
    statistics = sum(
        x.size
        for path, x in jax.tree_util.tree_leaves_with_path(variables["params"])
        if path[-1].key in ("mean", "var")
    )
    assert sum(sizes) - statistics - 2048 * 128 == 23508032


def test_a_trained_trunk_is_the_frozen_one_of_its_statistics():
    trained, frozen = (
        resnet.ResNetTrunk(4, (1, 2, 1), frozen=f) for f in (False, True)
    )
    image = jax.random.normal(jax.random.key(1), (2, 32, 48, 3))

    @jax.jit
    def both(image):
        variables = trained.init(jax.random.key(0), image)
        _, stats = trained.apply(variables, image, True, mutable=["batch_stats"])
        variables = {**variables, **stats}
        params = resnet.frozen_params(variables)
        expected = trained.apply(variables, image)
        return expected, frozen.apply({"params": params}, image), params

    expected, found, params = both(image)
    chex.assert_shape(found, (2, 2, 3, 64))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert float(jnp.std(found)) > 0
    shapes = jax.eval_shape(frozen.init, jax.random.key(0), image)["params"]
    chex.assert_trees_all_equal_shapes(params, shapes)
    # The statistics are those of the images, not those to start with.
    assert float(jnp.abs(params["stem_norm"]["mean"]).min()) > 0
