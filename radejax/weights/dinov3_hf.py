"""Conversion of DINOv3 and DINOv2 weights to Flax, without torch.

| model | from | path |
|---|---|---|
| DINOv3 | Hugging Face transformers | folder with `config.json` and `model.safetensors` |
| DINOv3 | timm | such a folder, or `model.safetensors` |
| DINOv3 | Meta | `.pth` file |
| DINOv2, with and without registers | Hugging Face transformers | folder |

DINOv3 is also written, in the format of Hugging Face. Its weights are gated and their license
restricts redistribution: every user must download them, and published checkpoints must not
contain them. DINOv2's license is Apache-2.0.
"""

from __future__ import annotations

import contextlib
import math
import pathlib
import re

import jax
import numpy as np
import safetensors.numpy
from flax.typing import Collection, MutableCollection, MutableVariableDict

from radejax.core import files
from radejax.core.errors import DataError, UserError, require
from radejax.core.files import JsonObject, PathLike
from radejax.models.options import ViTOptions
from radejax.models.vit import ViT
from radejax.weights import convert
from radejax.weights.convert import Rules, StateDict, to_numpy

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
"""Fields of `ViTOptions` by the name of the corresponding field of Hugging Face's config."""

_KINDS = r"dinov3_vit|dinov2|dinov2_with_registers|vit_\w+_dinov3(_qkvb)?"
"""Names of models in transformers ("model_type") and, with "vit", in timm ("architecture")."""


def _constants(gated_mlp: bool) -> JsonObject:
    """Returns the fields of Hugging Face's config for which only one value is supported."""
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


_DINOV2_CONSTANTS = {"layer_norm_eps": 1e-6, "qkv_bias": True, "hidden_act": "gelu"}
"""The same for DINOv2, whose SwiGLU has SiLU for any `hidden_act`."""


# Names -------------------------------------------------------------------------------

_CLASS = "embeddings.cls_token"
_REGISTERS = "embeddings.register_tokens"
_POSITIONS = "embeddings.position_embeddings"
_PERIODS = "rope_embed.periods"
_RULES: Rules = (
    (r"^prefix_tokens", _CLASS),
    (r"^position_embedding", _POSITIONS),
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
"""Rules from modules of `ViT` to DINOv3's names in Hugging Face, for `convert`.

The rules below lead from other names to these. A name with `(q|k|v)` stands for several
tensors, into which the tensor is split along its first axis.
"""

_META_AND_TIMM: Rules = (
    (r"^cls_token$", _CLASS),
    (r"^(storage_tokens|reg_token)$", _REGISTERS),
    (r"^patch_embed\.proj\.", "embeddings.patch_embeddings."),
    (r"^blocks\.", "layer."),
    (r"\.attn\.qkv\.", ".attention.(q|k|v)_proj."),
    (r"\.attn\.([qv])_bias$", r".attention.\1_proj.bias"),  # timm
    (r"\.attn\.proj\.", ".attention.o_proj."),
    (r"\.(?:ls|gamma_)(\d)(?:\.gamma)?$", r".layer_scale\1.lambda1"),
    (r"\.(fc1|w2|fc1_x)\.", ".up_proj."),
    (r"\.(w1|fc1_g)\.", ".gate_proj."),
    (r"\.(fc2|w3)\.", ".down_proj."),
)
_DINOV2: Rules = (  # in Hugging Face, where transformers 5 adds "model." to some names
    (r"^(model|encoder)\.", ""),
    (r"^layernorm\.", "norm."),
    (r"\.patch_embeddings\.projection\.", ".patch_embeddings."),
    (r"\.attention\.attention\.([qkv])\w+\.", r".attention.\1_proj."),
    (r"\.attention\.output\.dense\.", ".attention.o_proj."),
    (r"\.weights_in\.", ".(gate|up)_proj."),
    (r"\.weights_out\.", ".down_proj."),
)


def to_hugging_face(tensors: StateDict) -> dict[str, np.ndarray]:
    """Returns the tensors of any source under DINOv3's names in Hugging Face."""
    tensors = dict(tensors)
    if "blocks.0.gamma_1" in tensors and not any(n.endswith("_bias") for n in tensors):
        # Most of timm's models are without the biases, because they are zero.
        for name in [n for n in tensors if n.endswith(".attn.qkv.weight")]:
            zeros = np.zeros(np.shape(tensors[name])[:1], np.float32)
            tensors[name.replace(".weight", ".bias")] = zeros
    renamed = dict[str, np.ndarray]()
    for name, value in tensors.items():
        mask = tensors.get(f"{name}_mask", np.ones(()))
        if mask.shape == value.shape:  # otherwise, the bias of the key is unexpected
            value = to_numpy(value) * to_numpy(mask)
        for pattern, replacement in (*_DINOV2, *_META_AND_TIMM):
            name = re.sub(pattern, replacement, name)
        start, parts, end = (*re.split(r"[()]", name), "", "")[:3]
        names = [f"{start}{part}{end}" for part in parts.split("|")]
        values = np.array_split(np.atleast_1d(to_numpy(value)), len(names))
        renamed |= zip(names, values, strict=True)
    return renamed


# Files -------------------------------------------------------------------------------


def load(folder: PathLike) -> tuple[ViT, MutableVariableDict]:
    """Loads model and variables from a download.

    Args:
        folder: Folder such as a download of `facebook/dinov3-vits16-pretrain-lvd1689m` or
            `facebook/dinov2-small`, or a file of Meta or timm; see the module.

    Returns:
        The model, and `{"params": ...}` with float32 arrays. For normalized images, the model
        computes the `last_hidden_state` of Hugging Face transformers.

    Raises:
        FileNotFoundError: The folder or one of its files is missing.
        DataError: A file is corrupted, or tensors are missing, unexpected or of another
            shape. The message lists up to 20 of them, with DINOv3's names in Hugging Face.
        UserError: The folder contains another kind of model.
    """
    path = files.as_path(folder)
    config: JsonObject = {}
    if not path.is_file():
        config = _read_config(path)
        path = path / WEIGHTS_FILE
    tensors, source = convert.read_state_dict(path, "blocks.0.", "embeddings.")
    model = model_from_tensors(tensors, source)
    if "model_type" in config:
        try:
            model = model_from_config(config, model.options)
        except UserError as error:
            raise UserError(f"{path.with_name(CONFIG_FILE)}: {error}") from None
    return model, {"params": to_params(model, tensors, source)}


def _read_config(folder: pathlib.Path) -> JsonObject:
    """Reads the config of a model of Hugging Face or timm after checking what it describes."""
    if (folder / f"{WEIGHTS_FILE}.index.json").is_file():
        raise UserError(
            f"{folder} has its weights in several files: load it with transformers and "
            f"write one {WEIGHTS_FILE} with save_pretrained(..., max_shard_size='100GB')"
        )
    missing = [n for n in (CONFIG_FILE, WEIGHTS_FILE) if not (folder / n).is_file()]
    if missing:
        raise FileNotFoundError(
            f"{folder} lacks {' and '.join(missing)}: expected a DINOv3 or DINOv2 model "
            "folder as downloaded from Hugging Face"
        )
    config = files.read_object(folder / CONFIG_FILE)
    name = "architecture" if "architecture" in config else "model_type"
    kind = config.get(name)
    is_known = re.fullmatch(_KINDS, str(kind)) is not None
    field = f"{folder / CONFIG_FILE}: {name}"
    require(is_known, field, kind, "a ViT of DINOv3 or DINOv2")
    return config


def save(model: ViT, params: Collection, folder: PathLike) -> None:
    """Writes a model to a folder that `load` and Hugging Face transformers can read.

    Args:
        model: Model whose fields are written to `config.json`.
        params: Parameters of the model, such as `load(folder)[1]["params"]`.
        folder: Folder, which is created if necessary. Existing files are replaced.
    """
    options = model.options
    grid = options.position_grid
    require(not grid, "position_grid", grid, "0, DINOv3")
    folder = files.as_path(folder)
    config = {theirs: getattr(options, ours) for theirs, ours in _FIELDS.items()}
    config |= _constants(options.gated_mlp)
    config |= {"architectures": ["DINOv3ViTModel"], "layerscale_value": 1.0}
    files.write_json(folder / CONFIG_FILE, config)
    content = safetensors.numpy.save(to_tensors(model, params), {"format": "pt"})
    with files.atomic_write(folder / WEIGHTS_FILE) as file:
        file.write(content)


def model_from_config(config: JsonObject, sizes: ViTOptions | None = None) -> ViT:
    """Creates the model that a Hugging Face `config.json` describes.

    Args:
        config: Content of the file.
        sizes: Options whose fields are used where DINOv2's config has none. Not needed for
            DINOv3.

    Raises:
        UserError: It does not describe a DINOv3 or DINOv2 ViT, or a field is missing, of a
            wrong type, out of range or not supported.
    """
    constants = _constants(config.get("use_gated_mlp") is True)
    if sizes is not None and config.get("model_type") != constants["model_type"]:
        constants = _DINOV2_CONSTANTS
    elif missing := sorted(set(_FIELDS) - set(config)):
        raise UserError(f"DINOv3 config lacks {', '.join(missing)}")
    for name, value in constants.items():
        require(config.get(name) == value, name, config.get(name), f"{value!r}")
    fields = {_FIELDS[name]: config[name] for name in _FIELDS if name in config}
    return ViT((sizes or ViTOptions()).replace(**fields))


def model_from_tensors(tensors: StateDict, source: str) -> ViT:
    """Creates the model whose sizes are those of DINOv3 or DINOv2 tensors by name.

    Raises:
        DataError: The tensors are not those of a DINOv3 or DINOv2 ViT.
        UserError: The rotary embedding has other wavelengths, or DINOv2 is from Meta or timm.
    """
    tensors = to_hugging_face(tensors)
    try:
        hidden, _, patch, _ = tensors["embeddings.patch_embeddings.weight"].shape
        mlp_dim, _ = tensors["layer.0.mlp.up_proj.weight"].shape
        none = np.empty((1, 0, hidden))
        _, num_registers, _ = tensors.get(_REGISTERS, none).shape
        _, num_positions, _ = tensors.get(_POSITIONS, none).shape
    except (KeyError, ValueError):
        raise DataError(f"{source}: not the tensors of a DINOv3 ViT") from None
    if "pos_embed" in tensors:
        raise UserError(f"{source}: DINOv2 is read from its Hugging Face folder")
    layers = {name.split(".")[1] for name in tensors if name.startswith("layer.")}
    head_dim = 128 if hidden == 4096 else 64  # 128 in the 7B model
    if (periods := np.ravel(to_numpy(tensors.get(_PERIODS, [])))).size:
        head_dim = 4 * periods.size
        expected = 100.0 ** (np.arange(periods.size) / periods.size)
        if not np.allclose(periods, expected, rtol=0.01):  # may be rounded to bfloat16
            raise UserError(f"{source}: {_PERIODS} are not powers of 100")
    options = ViTOptions(
        hidden_size=hidden,
        num_layers=len(layers),
        num_heads=max(hidden // head_dim, 1),
        mlp_dim=mlp_dim,
        patch_size=patch,
        num_registers=num_registers,
        position_grid=math.isqrt(max(num_positions - 1, 0)),
        gated_mlp="layer.0.mlp.gate_proj.weight" in tensors,
    )
    return ViT(options)


def image_fields(options: ViTOptions) -> dict[str, object]:
    """Returns the fields of `config.model.image` that describe a backbone."""
    return {n: getattr(options, n) for n in (*_FIELDS.values(), "position_grid")}


def to_params(
    model: ViT, tensors: StateDict, source: str = "state dict"
) -> MutableCollection:
    """Converts DINOv3 tensors by name to the parameters of `model`.

    Raises:
        DataError: Tensors are missing, unexpected or of another shape. The message lists up
            to 20 of them.
    """
    tensors = to_hugging_face(tensors)
    # `from_torch` reports a tensor that is missing or has another shape.
    with contextlib.suppress(KeyError, ValueError):
        tokens = [to_numpy(tensors[name]) for name in (_CLASS, _REGISTERS)]
        tensors[_CLASS] = np.concatenate(tokens, 1)
        del tensors[_REGISTERS]
    for name in [name for name in tensors if name.endswith(".k_proj.bias")]:
        if model.options.position_grid or not np.any(tensors[name]):
            del tensors[name]  # it has no effect, see `vit.Block`
    # Only used in pretraining, and checked in `model_from_tensors`.
    ignored = rf"(embeddings\.)?mask_token$|local_cls_norm\.|{_PERIODS}$|.*\.bias_mask$"
    size = model.options.patch_size
    image = np.zeros((1, size, size, 3), np.float32)
    shapes = convert.shapes_of(jax.eval_shape(model.init, jax.random.key(0), image))
    return convert.from_torch(_RULES, shapes, tensors, source, ignored)["params"]


def to_tensors(model: ViT, params: Collection) -> dict[str, np.ndarray]:
    """Inverts `to_params` and adds a mask token of zeros."""
    options = model.options
    size = options.patch_size
    patches = dict(params["patch_embed"])
    patches["kernel"] = np.reshape(patches["kernel"], (size, size, 3, -1))
    tensors = convert.to_torch(_RULES, {"params": {**params, "patch_embed": patches}})
    tokens = tensors[_CLASS]
    tensors[_CLASS] = np.ascontiguousarray(tokens[:, :1])
    if options.num_registers:
        tensors[_REGISTERS] = np.ascontiguousarray(tokens[:, 1:])
    mask = np.zeros((1, 1, options.hidden_size), np.float32)
    return tensors | {"embeddings.mask_token": mask}
