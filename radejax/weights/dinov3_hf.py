"""DINOv3 weights as Hugging Face distributes them, to Flax and back, without torch.

The weights are gated and their licence restricts passing them on: download them
yourself, and keep them out of checkpoints that are published.
"""

from __future__ import annotations

import pathlib
import re
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import safetensors.numpy

from radejax.core import files
from radejax.core.archives import read_safetensors
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.models.vit import ViT
from radejax.weights.state_dict import StateDictReader

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"

_LAYER = re.compile(r"layer\.\d+\.")
_PREFIX = "model."  # transformers 5 saves some models with it
_FIELDS = {
    "hidden_size": "hidden_size",
    "num_hidden_layers": "num_layers",
    "num_attention_heads": "num_heads",
    "intermediate_size": "mlp_dim",
    "patch_size": "patch_size",
    "num_register_tokens": "num_registers",
    "rope_theta": "rope_theta",
    "layer_norm_eps": "epsilon",
    "use_gated_mlp": "gated_mlp",
    "hidden_act": "activation",
    "proj_bias": "proj_bias",
    "mlp_bias": "mlp_bias",
    "layerscale_value": "layer_scale",
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

_SIZES = (
    "hidden_size",
    "num_hidden_layers",
    "num_attention_heads",
    "intermediate_size",
    "patch_size",
    "num_register_tokens",
)
_FLAGS = ("use_gated_mlp", "proj_bias", "mlp_bias")
_NUMBERS = ("rope_theta", "layer_norm_eps", "layerscale_value")
_MOST = 65536  # of any size: the largest DINOv3 has an mlp of 8192


def load(folder: PathLike, **model_overrides: Any) -> tuple[ViT, dict[str, Any]]:
    """Model and variables from a folder with `config.json` and `model.safetensors`.

    Args:
        folder: For instance a download of `facebook/dinov3-vits16-pretrain-lvd1689m`.
        **model_overrides: Fields of `ViT` that do not change the weights, such as
            `dtype`, `attention`, `remat`.

    Returns:
        The model, and `{"params": ...}` with float32 arrays. Applied to normalised
        images it gives transformers' `last_hidden_state`.

    Raises:
        FileNotFoundError: The folder or one of its files is missing.
        DataError: A file is damaged, or tensors are missing, unexpected or
            mis-shaped; all are listed.
        UserError: The folder holds another kind of model, or an override is unknown.
    """
    folder = pathlib.Path(folder)
    missing = [n for n in (CONFIG_FILE, WEIGHTS_FILE) if not (folder / n).is_file()]
    if missing:
        raise FileNotFoundError(
            f"{folder} lacks {' and '.join(missing)}: expected a DINOv3 model folder"
            " as downloaded from Hugging Face"
        )
    config = files.read_json(folder / CONFIG_FILE, dict[str, Any])
    model = model_from_config(config, **model_overrides)
    path = folder / WEIGHTS_FILE
    return model, {"params": to_params(model, read_safetensors(path), str(path))}


def save(model: ViT, params: Mapping[str, Any], folder: str | pathlib.Path) -> None:
    """Writes a model as a folder that `load`, and transformers, read.

    Args:
        model: Says what the parameters belong to.
        params: Its parameters, as of `load(folder)[1]["params"]`.
        folder: Made if missing; files in it are replaced.
    """
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    config = {theirs: getattr(model, ours) for theirs, ours in _FIELDS.items()}
    biases = zip(("query", "key", "value"), model.qkv_bias, strict=True)
    config |= {f"{name}_bias": bias for name, bias in biases}
    config |= {"model_type": "dinov3_vit", "architectures": ["DINOv3ViTModel"]}
    files.write_json(folder / CONFIG_FILE, config)
    content = safetensors.numpy.save(to_tensors(model, params), {"format": "pt"})
    with files.atomic_write(folder / WEIGHTS_FILE) as file:
        file.write(content)


def model_from_config(config: Mapping[str, Any], **model_overrides: Any) -> ViT:
    """The model a Hugging Face `config.json` describes.

    Raises:
        UserError: It is not a DINOv3 ViT, a field is missing, of a wrong type, out of
            range or not supported, or an override is unknown.
    """
    if config.get("model_type") != "dinov3_vit":
        raise UserError(
            f"model_type is {config.get('model_type')!r}, expected 'dinov3_vit'"
        )
    if missing := sorted(set(_FIELDS) - set(config)):
        raise UserError(f"DINOv3 config lacks {', '.join(missing)}")
    _check_values(config)
    if config["hidden_act"] not in ("gelu", "silu"):
        raise UserError(
            f"hidden_act is {config['hidden_act']!r}, expected 'gelu' or 'silu'"
        )
    fields = {ours: config[theirs] for theirs, ours in _FIELDS.items()}
    fields["qkv_bias"] = tuple(
        bool(config.get(f"{name}_bias", default))
        for name, default in (("query", True), ("key", False), ("value", True))
    )
    known = set(ViT.__dataclass_fields__) - {"parent", "name"}
    if unknown := sorted(set(model_overrides) - known):
        raise UserError(f"unknown ViT fields {unknown}; available: {sorted(known)}")
    return ViT(**(fields | model_overrides))


def _check_values(config: Mapping[str, Any]) -> None:
    """`UserError` for a value of a wrong type or out of range."""
    for name in _FIELDS:
        value, least = config[name], 0 if name == "num_register_tokens" else 1
        if name in _SIZES:
            fits = type(value) is int and least <= value <= _MOST
            expected = f"an integer from {least} to {_MOST}"
        elif name in _FLAGS:
            fits, expected = isinstance(value, bool), "true or false"
        elif name in _NUMBERS:
            fits = type(value) in (int, float) and 0 < value < float("inf")
            expected = "a finite number above 0"
        else:
            continue
        if not fits:
            raise UserError(f"DINOv3 config: {name} is {value!r}, expected {expected}")
    channels, heads = config["hidden_size"], config["num_attention_heads"]
    if channels % heads or (channels // heads) % 4:
        raise UserError(
            f"DINOv3 config: hidden_size is {channels} and num_attention_heads {heads}, "
            "expected heads of a multiple of 4 channels"
        )


def to_params(
    model: ViT, tensors: Mapping[str, Any], source: str = "state dict"
) -> dict[str, Any]:
    """Parameters of `model` from DINOv3 tensors by name.

    Raises:
        DataError: There are more or fewer layers than the model has; tensors are
            missing, unexpected or mis-shaped; all are listed.
    """
    tensors = {name.removeprefix(_PREFIX): t for name, t in tensors.items()}
    num_layers = len({n.split(".")[1] for n in tensors if _LAYER.match(n)})
    if num_layers != model.num_layers:
        raise DataError(
            f"{source}: has {num_layers} layers, expected {model.num_layers}, as "
            f"num_hidden_layers of {CONFIG_FILE} says"
        )
    reader = StateDictReader(tensors, source)
    channels = model.hidden_size
    patches = reader.conv(
        "embeddings.patch_embeddings", 3, channels, model.patch_size
    )  # kernel [patch, patch, 3, C]: rows, columns, colours, as patches are flattened
    patches["kernel"] = patches["kernel"].reshape(-1, channels)
    prefix = [
        reader.take(f"embeddings.{name}", (1, count, channels))
        for name, count in (
            ("cls_token", 1),
            ("register_tokens", model.num_registers),
        )
        if count or f"embeddings.{name}" in reader
    ]
    layers = [_layer(reader, model, f"layer.{i}.") for i in range(model.num_layers)]
    params = {
        "prefix_tokens": np.concatenate(prefix, 1),
        "patch_embed": patches,
        "layers": jax.tree.map(lambda *leaves: np.stack(leaves), *layers),
        "norm": reader.norm("norm", channels),
    }
    # The mask token serves pretraining only.
    reader.finish(ignored=(r"embeddings\.mask_token$",))
    return params


def to_tensors(model: ViT, params: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """DINOv3 tensors by name of the parameters of `model`: inverse of `to_params`."""
    params = jax.tree.map(np.asarray, dict(params))
    channels, size = model.hidden_size, model.patch_size
    tensors = {"embeddings.mask_token": np.zeros((1, 1, channels), np.float32)}
    tensors["embeddings.cls_token"] = params["prefix_tokens"][:, :1]
    if model.num_registers:
        tensors["embeddings.register_tokens"] = params["prefix_tokens"][:, 1:]

    def put(name: str, part: Mapping[str, np.ndarray]) -> None:
        for field, array in part.items():
            is_bias = field == "bias"
            tensors[f"{name}.{'bias' if is_bias else 'weight'}"] = array.T

    patches = dict(params["patch_embed"])
    kernel = patches.pop("kernel").reshape(size, size, 3, channels)
    put("embeddings.patch_embeddings", patches)
    tensors["embeddings.patch_embeddings.weight"] = kernel.transpose(3, 2, 0, 1)
    put("norm", params["norm"])
    for index in range(model.num_layers):
        layer = jax.tree.map(lambda x, i=index: x[i], params["layers"])
        for ours, part in layer.items():
            name = f"layer.{index}.{_LAYER_NAMES[ours]}"
            if ours.startswith("scale"):
                tensors[name] = part
            else:
                put(name, part)
    return {name: np.ascontiguousarray(array) for name, array in tensors.items()}


def _layer(reader: StateDictReader, model: ViT, prefix: str) -> dict[str, Any]:
    channels, hidden = model.hidden_size, model.mlp_dim

    def name(ours: str) -> str:
        return prefix + _LAYER_NAMES[ours]

    def linear(ours: str, size_in: int, size_out: int, bias: bool) -> dict[str, Any]:
        return reader.linear(name(ours), size_in, size_out, use_bias=bias)

    layer: dict[str, Any] = {}
    for ours in ("norm_1", "norm_2"):
        layer[ours] = reader.norm(name(ours), channels)
    for ours in ("scale_1", "scale_2"):
        layer[ours] = reader.take(name(ours), (channels,))
    layer["out"] = linear("out", channels, channels, model.proj_bias)
    layer["up"] = linear("up", channels, hidden, model.mlp_bias)
    layer["down"] = linear("down", hidden, channels, model.mlp_bias)
    for ours, bias in zip(("query", "key", "value"), model.qkv_bias, strict=True):
        layer[ours] = linear(ours, channels, channels, bias)
    if model.gated_mlp:
        layer["gate"] = linear("gate", channels, hidden, model.mlp_bias)
    return layer
