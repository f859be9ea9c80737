"""Seeded weights and inputs of the golden numbers for the radar-camera model.

The numbers themselves are in `dinorade_*.npz` and `released.npz`, see README.md.
"""

import json
import pathlib
import zlib

import numpy as np

SEED = 1234


def seeded_tensor(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """A parameter that depends on its name and shape only."""
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    rng = np.random.default_rng([SEED, zlib.crc32(name.encode())])
    if name.endswith("running_var"):
        value = 0.5 + rng.random(shape)
    elif name.endswith("running_mean"):
        value = 0.1 * rng.standard_normal(shape)
    elif len(shape) == 1:
        noise = rng.standard_normal(shape)
        value = 0.05 * noise if name.endswith("bias") else 1 + 0.1 * noise
    else:
        value = rng.standard_normal(shape) * np.sqrt(2 / np.prod(shape[1:]))
    return value.astype(np.float32)


def seeded_state_dict(listing: list[dict]) -> dict[str, np.ndarray]:
    """Tensors of a listing of names and shapes."""
    return {t["name"]: seeded_tensor(t["name"], tuple(t["shape"])) for t in listing}


def normal_input(stream: int, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normal numbers of an input stream."""
    rng = np.random.default_rng([SEED, stream])
    return rng.standard_normal(shape).astype(np.float32)


def uniform_input(stream: int, shape: tuple[int, ...], scale: float) -> np.ndarray:
    """Uniform numbers in [0, scale) of an input stream."""
    rng = np.random.default_rng([SEED, stream])
    return rng.random(shape, dtype=np.float32) * np.float32(scale)


TINY_CONFIG = {
    "model_type": "dinov3_vit",
    "hidden_size": 96,
    "num_hidden_layers": 3,
    "num_attention_heads": 4,
    "intermediate_size": 192,
    "patch_size": 16,
    "num_register_tokens": 4,
    "rope_theta": 100.0,
    "layer_norm_eps": 1e-5,
    "layerscale_value": 1.0,
    "use_gated_mlp": False,
    "hidden_act": "gelu",
    "query_bias": True,
    "key_bias": False,
    "value_bias": True,
    "proj_bias": True,
    "mlp_bias": True,
}
_LAYER = {
    "norm1.weight": (96,),
    "norm1.bias": (96,),
    "attention.q_proj.weight": (96, 96),
    "attention.q_proj.bias": (96,),
    "attention.k_proj.weight": (96, 96),
    "attention.v_proj.weight": (96, 96),
    "attention.v_proj.bias": (96,),
    "attention.o_proj.weight": (96, 96),
    "attention.o_proj.bias": (96,),
    "layer_scale1.lambda1": (96,),
    "norm2.weight": (96,),
    "norm2.bias": (96,),
    "mlp.up_proj.weight": (192, 96),
    "mlp.up_proj.bias": (192,),
    "mlp.down_proj.weight": (96, 192),
    "mlp.down_proj.bias": (96,),
    "layer_scale2.lambda1": (96,),
}
TINY_SHAPES = {
    "embeddings.cls_token": (1, 1, 96),
    "embeddings.mask_token": (1, 1, 96),
    "embeddings.register_tokens": (1, 4, 96),
    "embeddings.patch_embeddings.weight": (96, 3, 16, 16),
    "embeddings.patch_embeddings.bias": (96,),
    **{f"layer.{i}.{k}": s for i in range(3) for k, s in _LAYER.items()},
    "norm.weight": (96,),
    "norm.bias": (96,),
}


def tiny_tensors() -> dict[str, np.ndarray]:
    """Weights of a tiny DINOv3 under Hugging Face's names."""
    return {name: seeded_tensor(name, shape) for name, shape in TINY_SHAPES.items()}


def write_tiny_folder(folder: pathlib.Path) -> pathlib.Path:
    """A tiny DINOv3 as Hugging Face lays it out."""
    import safetensors.numpy

    (folder / "config.json").write_text(json.dumps(TINY_CONFIG))
    safetensors.numpy.save_file(tiny_tensors(), folder / "model.safetensors")
    return folder
