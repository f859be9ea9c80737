"""Fixtures of the model tests."""

import runpy

import flax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.layers import Upsample
from radejax.weights.convert import to_our_layout, to_torch_layout


@pytest.fixture(scope="session")
def radenet_golden(golden):
    """Names of `tests/golden/models_radenet.py`: seeds, configs, input."""
    return runpy.run_path(golden / "models_radenet.py")


@pytest.fixture(scope="session")
def run_like_torch(radenet_golden):
    """Function that runs a module with seeded weights of given torch names."""

    def run(module, names, x_bchw, **kwargs):
        """`names`: torch module by our path; returns the output, channels first."""
        x = jnp.asarray(x_bchw.transpose(0, 2, 3, 1))
        shapes = jax.eval_shape(module.init, jax.random.key(0), x)["params"]
        root = "upsample_1" if isinstance(module, Upsample) else "module"
        params = {}
        for path, leaf in flax.traverse_util.flatten_dict(shapes).items():
            suffix = "bias" if path[-1] == "bias" else "weight"
            name = ".".join(filter(None, (names["/".join(path[:-1])], suffix)))
            ours = "/".join((root, *path))
            shape = to_torch_layout(ours, np.broadcast_to(0, leaf.shape)).shape
            value = radenet_golden["seeded_tensor"](name, shape)
            params[path] = to_our_layout(ours, value)
        params = flax.traverse_util.unflatten_dict(params)
        y = jax.jit(module.apply)({"params": params}, x, **kwargs)
        return np.asarray(y).transpose(0, 3, 1, 2)[:, ::8]

    return run


@pytest.fixture(scope="session")
def module_case(released):
    """Function from a block's name to its input and every eighth channel of its output."""
    outputs = released("modules")
    streams = {
        "channel_attention": (31, (2, 64, 12, 10)),
        "channel_attention_small": (32, (1, 8, 6, 5)),
        "spatial_attention": (33, (2, 64, 12, 10)),
        "cbam_block": (34, (2, 64, 12, 10)),
        "double_conv_residual": (35, (1, 32, 12, 10)),
        "residual_block_dil1": (36, (1, 64, 12, 10)),
        "residual_block_dil2": (36, (1, 64, 12, 10)),
        "residual_block_dil3": (36, (1, 64, 12, 10)),
        "upsample": (37, (1, 32, 5, 7)),
        "input_stem": (38, (1, 101, 8, 6)),
    }

    def case(name):
        stream, shape = streams[name]
        rng = np.random.default_rng([1234, stream])
        x = rng.standard_normal(shape).astype(np.float32)
        return x, outputs[name]

    return case
