"""Conversion of DINOv3 weights between Hugging Face's format and Flax, without torch.

The weights are gated and their license restricts redistribution: every user must download
them, and published checkpoints must not contain them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy

from radejax.core import files
from radejax.core.archives import read_safetensors
from radejax.core.errors import DataError, UserError, require
from radejax.core.files import PathLike
from radejax.models.vit import ViT
from radejax.weights.convert import Rules, from_torch, shapes_of, to_numpy, to_torch

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"

_FIELDS = {
    "hidden_size": "hidden_size",
    "num_hidden_layers": "num_layers",
    "num_attention_heads": "num_heads",
    "intermediate_size": "mlp_dim",
    "patch_size": "patch_size",
    "num_register_tokens": "num_registers",
    "use_gated_mlp": "gated_mlp",
}
"""Attributes of `ViT` by the name of the corresponding field of Hugging Face's config."""


def _constants(gated_mlp: bool) -> dict[str, Any]:
    """Return the fields of Hugging Face's config for which only one value is supported."""
    return {
        "model_type": "dinov3_vit",
        "rope_theta": 100.0,
        "layer_norm_eps": 1e-5,
        "query_bias": True,
        "key_bias": False,
        "value_bias": True,
        "proj_bias": True,
        "mlp_bias": True,
        "use_gated_mlp": gated_mlp,
        "hidden_act": "silu" if gated_mlp else "gelu",
    }


_CLASS, _REGISTERS = "embeddings.cls_token", "embeddings.register_tokens"
_RULES: Rules = (
    (r"^prefix_tokens", _CLASS),
    (r"^patch_embed/", "embeddings.patch_embeddings."),
    (r"^norm/", "norm."),
    (r"^layers/norm_(\d)/", r"layer.{}.norm\1."),
    (r"^layers/scale_(\d)", r"layer.{}.layer_scale\1.lambda1"),
    (
        r"^layers/(query|key|value|out)/",
        lambda m: f"layer.{{}}.attention.{m[1][0]}_proj.",
    ),
    (r"^layers/(up|gate|down)/", r"layer.{}.mlp.\1_proj."),
)
"""Rules from modules of `ViT` to Hugging Face's names, for `convert`."""


def load(folder: PathLike) -> tuple[ViT, dict[str, Any]]:
    """Load model and variables from a folder with `config.json` and `model.safetensors`.

    Args:
        folder: Folder such as a download of `facebook/dinov3-vits16-pretrain-lvd1689m`.

    Returns:
        The model, and `{"params": ...}` with float32 arrays. For normalized images, the model
        computes the `last_hidden_state` of Hugging Face transformers.

    Raises:
        FileNotFoundError: The folder or one of its files is missing.
        DataError: A file is corrupted, or tensors are missing, unexpected or of another
            shape. The message lists up to 20 of them.
        UserError: The folder contains another kind of model.
    """
    folder = files.as_path(folder)
    path = folder / WEIGHTS_FILE
    if path.with_name(f"{WEIGHTS_FILE}.index.json").is_file():
        raise UserError(
            f"{folder} has its weights in several files: load it with transformers and "
            f"write one {WEIGHTS_FILE} with save_pretrained(..., max_shard_size='100GB')"
        )
    missing = [n for n in (CONFIG_FILE, WEIGHTS_FILE) if not (folder / n).is_file()]
    if missing:
        raise FileNotFoundError(
            f"{folder} lacks {' and '.join(missing)}: expected a DINOv3 model folder"
            " as downloaded from Hugging Face"
        )
    config = files.read_object(folder / CONFIG_FILE)
    tensors = read_safetensors(path)
    if any(name.startswith("blocks.") for name in tensors):
        raise UserError(
            f"{path} has the names of timm or of Meta's code (blocks.0...), expected those "
            "of transformers (layer.0...): download the model by facebook, such as "
            "facebook/dinov3-vits16-pretrain-lvd1689m"
        )
    try:
        model = model_from_config(config)
    except UserError as error:
        raise UserError(f"{folder / CONFIG_FILE}: {error}") from None
    return model, {"params": to_params(model, tensors, str(path))}


def save(model: ViT, params: Mapping[str, Any], folder: PathLike) -> None:
    """Write a model to a folder that `load` and Hugging Face transformers can read.

    Args:
        model: Model whose fields are written to `config.json`.
        params: Parameters of the model, such as `load(folder)[1]["params"]`.
        folder: Folder, which is created if necessary. Existing files are replaced.
    """
    folder = files.as_path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    config = {theirs: getattr(model, ours) for theirs, ours in _FIELDS.items()}
    config |= _constants(model.gated_mlp)
    config |= {"architectures": ["DINOv3ViTModel"], "layerscale_value": 1.0}
    files.write_json(folder / CONFIG_FILE, config)
    content = safetensors.numpy.save(to_tensors(model, params), {"format": "pt"})
    with files.atomic_write(folder / WEIGHTS_FILE) as file:
        file.write(content)


def model_from_config(config: Mapping[str, Any]) -> ViT:
    """Create the model that a Hugging Face `config.json` describes.

    Raises:
        UserError: It does not describe a DINOv3 ViT, or a field is missing, of a wrong type,
            out of range or not supported.
    """
    constants = _constants(config.get("use_gated_mlp") is True)
    for name, value in constants.items():
        require(config.get(name) == value, name, config.get(name), f"{value!r}")
    if missing := sorted(set(_FIELDS) - set(config)):
        raise UserError(f"DINOv3 config lacks {', '.join(missing)}")
    return ViT(**{ours: config[theirs] for theirs, ours in _FIELDS.items()})


def model_from_tensors(tensors: Mapping[str, Any], source: str) -> ViT:
    """Create the model whose sizes are those of DINOv3 tensors by name.

    Raises:
        DataError: The tensors are not those of a DINOv3 ViT.
    """
    try:
        hidden, _, patch, _ = tensors["embeddings.patch_embeddings.weight"].shape
        mlp_dim, _ = tensors["layer.0.mlp.up_proj.weight"].shape
        _, num_registers, _ = tensors["embeddings.register_tokens"].shape
    except (KeyError, ValueError):
        raise DataError(f"{source}: not the tensors of a DINOv3 ViT") from None
    layers = {name.split(".")[1] for name in tensors if name.startswith("layer.")}
    return ViT(
        hidden_size=hidden,
        num_layers=len(layers),
        num_heads=hidden // 64,  # 64 channels per head in all but the 7B model
        mlp_dim=mlp_dim,
        patch_size=patch,
        num_registers=num_registers,
        gated_mlp="layer.0.mlp.gate_proj.weight" in tensors,
    )


def image_fields(model: ViT) -> dict[str, Any]:
    """Return the fields of `config.model.image` that describe a backbone."""
    return {name: getattr(model, name) for name in _FIELDS.values()}


def to_params(
    model: ViT, tensors: Mapping[str, Any], source: str = "state dict"
) -> dict[str, Any]:
    """Convert DINOv3 tensors by name to the parameters of `model`.

    Raises:
        DataError: Tensors are missing, unexpected or of another shape. The message lists up
            to 20 of them.
    """
    # transformers 5 adds a prefix to the names of some models.
    tensors = {name.removeprefix("model."): t for name, t in tensors.items()}
    # `from_torch` reports a tensor that is missing or has another shape.
    with contextlib.suppress(KeyError, ValueError):
        tokens = [to_numpy(tensors[name]) for name in (_CLASS, _REGISTERS)]
        tensors[_CLASS] = np.concatenate(tokens, 1)
        del tensors[_REGISTERS]
    # The mask token is only used in pretraining.
    ignored = r"embeddings\.mask_token$"
    return from_torch(_RULES, _shapes(model), tensors, source, ignored)["params"]


def to_tensors(model: ViT, params: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Invert `to_params` and add a mask token of zeros."""
    size, params = model.patch_size, dict(params)
    patches = dict(params["patch_embed"])
    patches["kernel"] = np.reshape(patches["kernel"], (size, size, 3, -1))
    tensors = to_torch(_RULES, {"params": params | {"patch_embed": patches}})
    tokens = tensors[_CLASS]
    tensors[_CLASS] = np.ascontiguousarray(tokens[:, :1])
    if model.num_registers:
        tensors[_REGISTERS] = np.ascontiguousarray(tokens[:, 1:])
    mask = np.zeros((1, 1, model.hidden_size), np.float32)
    return tensors | {"embeddings.mask_token": mask}


def _shapes(model: ViT) -> dict[str, tuple[int, ...]]:
    image = jax.ShapeDtypeStruct(
        (1, model.patch_size, model.patch_size, 3), jnp.float32
    )
    return shapes_of(jax.eval_shape(model.init, jax.random.key(0), image))
