"""Golden numbers for the radar-camera model: where they come from and how to repeat it.

`dinorade_vit.npz`, `dinorade_deform_attn.npz` and `dinorade_geometry.npz` are excerpts
of the project's reference fixtures, which were made by running Hugging Face
transformers 5.23.0 (`DINOv3ViTModel`), the pure-torch deformable attention and the
released fusion code (RADE-Net, commit 9a94d64) on a CPU with torch 2.13.0. Weights and
inputs are not stored: they follow from names and seeds as below.

    python tests/golden/dinorade_make.py PATH_TO_FIXTURES

Tolerances reached on a CPU: ViT 6e-6, deformable attention 1e-6 (gradients 5e-7 of
their maximum), reference points 3e-7.
"""

import json
import pathlib
import sys
import zlib

import numpy as np

SEED = 1234
UNUSED = ("projected_value", "grad_projected_value", "initial_sampling_offsets_bias")
UNUSED += ("grad_locations", "grad_weights", "grad_locations_reliable")


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


def main(fixtures: pathlib.Path, out: pathlib.Path) -> None:
    with np.load(fixtures / "dinov3" / "tiny.npz") as tiny:
        last = tiny["64x96__last_hidden_state"]
        np.savez_compressed(out / "dinorade_vit.npz", last_hidden_state=last)
    info = json.loads((fixtures / "deform_attn" / "deform_attn.json").read_text())
    with np.load(fixtures / "deform_attn" / "deform_attn.npz") as file:
        kept = ("module_two_levels", "module_box_reference")
        names = {k: k.split("__") for k in file.files}
        arrays = {
            k: file[k]
            for k, name in names.items()
            if name[0] in kept and name[-1] not in UNUSED
        }
        info = {k: info[k] for k in kept}
        np.savez_compressed(
            out / "dinorade_deform_attn.npz", info=json.dumps(info), **arrays
        )
    with np.load(fixtures / "dinorade" / "geometry.npz") as file:
        names = ("index", "reference_points_f64", "valid")
        arrays = {k: file[k][::3] for k in names}
    info = json.loads((fixtures / "dinorade" / "dinorade.json").read_text())["geometry"]
    np.savez_compressed(
        out / "dinorade_geometry.npz",
        intrinsics=info["intrinsics"],
        extrinsics=info["extrinsics_3x4"],
        **arrays,
    )


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), pathlib.Path(__file__).parent)
