"""DINOv3 weights as Hugging Face distributes them, to Flax and back, without torch.

The weights are gated and their license restricts passing them on: download them
yourself, and keep them out of checkpoints that are published.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy

from radejax.core import files
from radejax.core.archives import read_safetensors
from radejax.core.errors import UserError, require
from radejax.core.files import PathLike
from radejax.models.vit import ViT
from radejax.weights.convert import from_torch, shapes_of, to_numpy, to_torch

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
    "layerscale_value": "layer_scale",
}
"""Our name of each field of Hugging Face's config."""


def _constants(gated_mlp: bool) -> dict[str, Any]:
    """Fields that are the same in all published models, or follow from the MLP."""
    return {
        "rope_theta": 100.0,
        "layer_norm_eps": 1e-5,
        "proj_bias": True,
        "mlp_bias": True,
        "hidden_act": "silu" if gated_mlp else "gelu",
    }


_LAYER_NAMES = {
    "norm_1": "norm1",
    "norm_2": "norm2",
    "scale_1": "layer_scale1.lambda1",
    "scale_2": "layer_scale2.lambda1",
    "query": "attention.q_proj",
    "key": "attention.k_proj",
    "value": "attention.v_proj",
    "out": "attention.o_proj",
    "up": "mlp.up_proj",
    "gate": "mlp.gate_proj",
    "down": "mlp.down_proj",
}
_TOKENS = ("embeddings.cls_token", "embeddings.register_tokens")


def load(folder: PathLike) -> tuple[ViT, dict[str, Any]]:
    """Model and variables from a folder with `config.json` and `model.safetensors`.

    Args:
        folder: For instance a download of `facebook/dinov3-vits16-pretrain-lvd1689m`.

    Returns:
        The model, and `{"params": ...}` with float32 arrays. Applied to normalized
        images it gives transformers' `last_hidden_state`.

    Raises:
        FileNotFoundError: The folder or one of its files is missing.
        DataError: A file is corrupted, or tensors are missing, unexpected or of another
            shape; all are listed.
        UserError: The folder holds another kind of model.
    """
    folder = pathlib.Path(folder)
    missing = [n for n in (CONFIG_FILE, WEIGHTS_FILE) if not (folder / n).is_file()]
    if missing:
        raise FileNotFoundError(
            f"{folder} lacks {' and '.join(missing)}: expected a DINOv3 model folder"
            " as downloaded from Hugging Face"
        )
    config = files.read_object(folder / CONFIG_FILE)
    try:
        model = model_from_config(config)
    except UserError as error:
        raise UserError(f"{folder / CONFIG_FILE}: {error}") from None
    path = folder / WEIGHTS_FILE
    return model, {"params": to_params(model, read_safetensors(path), str(path))}


def save(model: ViT, params: Mapping[str, Any], folder: PathLike) -> None:
    """Writes a model as a folder that `load`, and transformers, read.

    Args:
        model: Its fields go into `config.json`.
        params: Its parameters, as of `load(folder)[1]["params"]`.
        folder: Made if missing; files in it are replaced.
    """
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    config = {theirs: getattr(model, ours) for theirs, ours in _FIELDS.items()}
    biases = zip(("query", "key", "value"), model.qkv_bias, strict=True)
    config |= {f"{name}_bias": bias for name, bias in biases}
    config |= _constants(model.gated_mlp)
    config |= {"model_type": "dinov3_vit", "architectures": ["DINOv3ViTModel"]}
    files.write_json(folder / CONFIG_FILE, config)
    content = safetensors.numpy.save(to_tensors(model, params), {"format": "pt"})
    with files.atomic_write(folder / WEIGHTS_FILE) as file:
        file.write(content)


def model_from_config(config: Mapping[str, Any]) -> ViT:
    """The model that a Hugging Face `config.json` describes.

    Raises:
        UserError: It is not a DINOv3 ViT, a field is missing, of a wrong type, out of
            range or not supported.
    """
    kind = config.get("model_type")
    require(kind == "dinov3_vit", "model_type", kind, "'dinov3_vit'")
    constants = _constants(config.get("use_gated_mlp") is True)
    if missing := sorted({*_FIELDS, *constants} - set(config)):
        raise UserError(f"DINOv3 config lacks {', '.join(missing)}")
    defaults = {field.name: field.default for field in dataclasses.fields(ViT)}
    fields = {ours: config[theirs] for theirs, ours in _FIELDS.items()}
    for theirs, ours in _FIELDS.items():
        value, kind = fields[ours], type(defaults[ours])
        fits = type(value) is kind
        if kind is float:
            fits = type(value) in (int, float) and 0 < value < float("inf")
        require(fits, theirs, value, f"{kind.__name__}, such as {defaults[ours]}")
    for name, value in constants.items():
        require(config[name] == value, name, config[name], f"{value!r}")
    fields["qkv_bias"] = tuple(
        bool(config.get(f"{name}_bias", default))
        for name, default in (("query", True), ("key", False), ("value", True))
    )
    return ViT(**fields)  # checks ranges


def image_fields(model: ViT) -> dict[str, Any]:
    """Fields of `config.model.image` that a backbone has."""
    names = ["hidden_size", "num_layers", "num_heads", "mlp_dim", "patch_size"]
    names += ["num_registers", "gated_mlp"]
    return {name: getattr(model, name) for name in names}


def module_names(part: str = "") -> dict[str, str]:
    """Hugging Face's module by module of ours, for `convert`.

    Args:
        part: Of a detector that the model is: "image_backbone".
    """
    names = {"prefix_tokens": _TOKENS[0], "norm": "norm"}
    names["patch_embed"] = "embeddings.patch_embeddings"
    names |= {f"layers/{ours}": f"layer.{{}}.{x}" for ours, x in _LAYER_NAMES.items()}
    return {
        f"{part}/{k}".strip("/"): f"{part}.{v}".strip(".") for k, v in names.items()
    }


def with_prefix_tokens(tensors: Mapping[str, Any], part: str = "") -> dict[str, Any]:
    """With the register tokens behind the class token, as one tensor."""
    first, second = (f"{part}.{name}".strip(".") for name in _TOKENS)
    if not {first, second} <= set(tensors):
        return dict(tensors)
    tokens = [to_numpy(tensors[name]) for name in (first, second)]
    rest = {name: value for name, value in tensors.items() if name != second}
    if [x.ndim for x in tokens] != [3, 3] or tokens[0].shape[2] != tokens[1].shape[2]:
        return rest  # which `from_torch` refuses
    return rest | {first: np.concatenate(tokens, 1)}


def to_params(
    model: ViT, tensors: Mapping[str, Any], source: str = "state dict"
) -> dict[str, Any]:
    """Parameters of `model` from DINOv3 tensors by name.

    Raises:
        DataError: Tensors are missing, unexpected or of another shape; all are listed.
    """
    # transformers 5 saves some models with a prefix.
    tensors = {name.removeprefix("model."): t for name, t in tensors.items()}
    tensors = with_prefix_tokens(tensors)
    # The mask token is used in pretraining only.
    ignored = r"embeddings\.mask_token$"
    return from_torch(module_names(), _shapes(model), tensors, source, ignored)[
        "params"
    ]


def to_tensors(model: ViT, params: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """DINOv3 tensors by name of the parameters of `model`: inverse of `to_params`."""
    size, params = model.patch_size, dict(params)
    patches = dict(params["patch_embed"])
    patches["kernel"] = np.reshape(patches["kernel"], (size, size, 3, -1))
    tensors = to_torch(module_names(), {"params": params | {"patch_embed": patches}})
    tokens = tensors[_TOKENS[0]]
    tensors[_TOKENS[0]] = np.ascontiguousarray(tokens[:, :1])
    if model.num_registers:
        tensors[_TOKENS[1]] = np.ascontiguousarray(tokens[:, 1:])
    mask = np.zeros((1, 1, model.hidden_size), np.float32)
    return tensors | {"embeddings.mask_token": mask}


def _shapes(model: ViT) -> dict[str, tuple[int, ...]]:
    image = jax.ShapeDtypeStruct(
        (1, model.patch_size, model.patch_size, 3), jnp.float32
    )
    return shapes_of(jax.eval_shape(model.init, jax.random.key(0), image))
