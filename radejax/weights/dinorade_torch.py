"""Official DinoRADE checkpoints (PyTorch) to Flax. torch is not needed.

The released code names its tensors `rad_backbone.*`, `rad_neck.*`, `head.*` (as
RADE-Net's), `image_neck.*`, `fusion.*` and `image_backbone.*`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from typing import Any

from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.models.dinorade import DinoRade
from radejax.models.lifting import LiftingAxes
from radejax.models.radenet import FIELDS as RADAR_FIELDS
from radejax.models.radenet import RadeNet
from radejax.models.vit import ViT
from radejax.weights import dinov3_hf, radenet_torch, resnet_torch
from radejax.weights.state_dict import StateDictReader, read_state_dict, to_numpy

_RADAR_PARTS = {"rad_backbone.": "backbone.", "rad_neck.": "neck.", "head.": "head."}
_FUSION_FIELDS = ("num_heads", "dropout", "chunk_size", "out_of_view")
_UNUSED = (r"fusion\.output_proj\.",)  # built by the released code, never called


def load(
    state_dict_or_path: Mapping[str, Any] | PathLike,
    *,
    dinov3: PathLike | None = None,
    **model_overrides: Any,
) -> tuple[DinoRade, dict[str, Any]]:
    """Model and variables from an official checkpoint, with the released geometry.

    Project with `CameraCalibration.from_kradar(file,
    radar_from_lidar_m=OFFICIAL_OFFSET_M).camera("pinhole")`, see
    `radejax.models.lifting`. Maps stay on the padded grid, which for official weights
    is `RadarGrid.kradar().padded(8, "stretched")`.

    Args:
        state_dict_or_path: Tensors by name, or a file: `.pth`, `.pt`, `.npz` or
            `.safetensors`; may be nested, and names may have a prefix.
        dinov3: Folder with the image backbone, if the checkpoint has none. Without
            either the model can be applied to embedded images only.
        **model_overrides: Fields of the radar branch (`RadeNet`), or `num_heads`,
            `dropout`, `chunk_size`, `invalid` of the fusion.

    Returns:
        The model, and `{"params": ..., "batch_stats": ...}` in float32.

    Raises:
        FileNotFoundError: There is no such file.
        UserError: An override is unknown.
        DataError: Tensors are missing, unexpected or mis-shaped; all are listed.
    """
    content, source = read_state_dict(state_dict_or_path)
    tensors = _find(content, source)
    known = set(RADAR_FIELDS) | set(_FUSION_FIELDS)
    if unknown := sorted(set(model_overrides) - known):
        raise UserError(f"unknown model fields {unknown}; available: {sorted(known)}")
    problems: list[str] = []
    radar, params = _load_radar(tensors, model_overrides, problems)
    rest = {
        name: value
        for name, value in tensors.items()
        if not name.startswith(tuple(_RADAR_PARTS))
    }
    reader = StateDictReader(without_lora(rest), source)
    fusion = fusion_fields(rest, model_overrides)
    params["image_fusion"] = read_fusion(reader, fusion)
    vit, image_params, stats = read_image(reader, rest)
    params.update(image_params)
    try:
        reader.finish(ignored=_UNUSED)
    except DataError as error:
        problems.append(str(error))
    if problems:
        raise DataError("; ".join(problems))
    if dinov3 is not None:
        vit, variables = dinov3_hf.load(dinov3)
        params["image_backbone"] = variables["params"]
    model = DinoRade(
        radar=radar,
        vit=vit,
        fusion=fusion,
        query_grid=LiftingAxes.official(),
        # The released code feeds its ResNet colours in [0, 1].
        standardize_image=vit is not None,
    )
    return model, {"params": params, "batch_stats": {"image_neck": stats}}


# Radar -------------------------------------------------------------------------------


def _load_radar(
    tensors: Mapping[str, Any], overrides: Mapping[str, Any], problems: list[str]
) -> tuple[RadeNet, dict[str, Any]]:
    """Radar branch through RADE-Net's loader, whose complaints are gathered."""
    renamed = {
        ours + name.removeprefix(theirs): value
        for theirs, ours in _RADAR_PARTS.items()
        for name, value in tensors.items()
        if name.startswith(theirs)
    }
    fields = {k: v for k, v in overrides.items() if k in RADAR_FIELDS}
    try:
        model, variables = radenet_torch.load(renamed, **fields)
    except DataError as error:
        problems.append(f"radar branch (rad_backbone, rad_neck, head): {error}")
        return RadeNet(5), {}
    return model, dict(variables["params"])


# Fusion ------------------------------------------------------------------------------


def fusion_fields(
    tensors: Mapping[str, Any], overrides: Mapping[str, Any]
) -> dict[str, Any]:
    """Settings that names and shapes show; the rest as released."""
    heads = overrides.get("num_heads", 4)
    logits = tensors.get("fusion.deform_attn.attention_weights.bias")
    samples = 4 * heads if logits is None else logits.shape[0]
    has_weights = any(n.startswith("fusion.weighting_network.") for n in tensors)
    fields = {
        "num_heads": heads,
        "num_points": samples // heads,
        "num_elevation": 10,
        "weighting": "cnn" if has_weights else "off",
        "gate": "bin",
        "out_of_view": "official",
        "necks": any(n.startswith("fusion.rad_neck.") for n in tensors),
        "dropout": 0.1,
        "chunk_size": 0,
    }
    return fields | {k: v for k, v in overrides.items() if k in _FUSION_FIELDS}


def read_fusion(reader: StateDictReader, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of `Fusion` with the given fields."""
    width, samples = 128, fields["num_heads"] * fields["num_points"]
    sizes = {"sampling_offsets": 2 * samples, "attention_weights": samples}
    sizes |= {"value_proj": width, "output_proj": width}
    params = {
        "attention": {
            name: reader.linear(f"fusion.deform_attn.{name}", width, size)
            for name, size in sizes.items()
        },
        "gate_hidden": reader.linear("fusion.fusion_gate.0", 2 * width, width // 2),
        "gate_out": reader.linear("fusion.fusion_gate.2", width // 2, 1),
    }
    if fields["weighting"] == "cnn":
        params["weighting"] = _read_weighting(reader, fields["num_elevation"])
    if fields["necks"]:
        params["radar_neck"] = _read_neck(reader, "fusion.rad_neck", width)
        params["camera_neck"] = _read_neck(reader, "fusion.cam_neck", width)
    return params


def _read_weighting(reader: StateDictReader, num_elevation: int) -> dict[str, Any]:
    prefix, widths = "fusion.weighting_network", (37, 32, 64, 32)
    params = {}
    for i, (size_in, size_out) in enumerate(itertools.pairwise(widths), 1):
        at = 3 * (i - 1)  # convolution, normalisation, ReLU
        params[f"conv_{i}"] = reader.conv(f"{prefix}.{at}", size_in, size_out, 3)
        params[f"norm_{i}"] = reader.norm(f"{prefix}.{at + 1}", size_out)
    out = reader.conv(f"{prefix}.9", widths[-1], num_elevation, 1)
    params["out"] = {"kernel": out["kernel"][0, 0], "bias": out["bias"]}
    return params


def _read_neck(reader: StateDictReader, prefix: str, width: int) -> dict[str, Any]:
    """A dilated neck of `radejax.models.neck`."""
    params = {}
    for i in range(3):
        name = f"{prefix}.neck.{i}"
        params[f"block_{i + 1}"] = {
            "conv_1": {
                "conv": reader.conv(f"{name}.conv1.conv", width, width, 3),
                "norm": reader.norm(f"{name}.conv1.gn", width),
            },
            "conv_2": reader.conv(f"{name}.conv2", width, width, 3),
            "norm": reader.norm(f"{name}.gn", width),
        }
    return params


# Image -------------------------------------------------------------------------------


def read_image(
    reader: StateDictReader, tensors: Mapping[str, Any]
) -> tuple[ViT | None, dict[str, Any], dict[str, Any]]:
    """Backbone's model (None: ResNet), parameters, statistics of the neck."""
    if any(n.startswith("image_backbone.frozen_layers.") for n in tensors):
        return None, *_read_resnet(reader)
    width = 128
    weight = tensors.get("image_neck.channel_proj.weight")
    channels = 384 if weight is None else weight.shape[1]
    names = {"up_1": "fpn_layer1", "up_2": "fpn_layer2", "refine": "refine"}
    neck = {"proj": reader.linear("image_neck.channel_proj", channels, width)}
    stats = {}
    for ours, theirs in names.items():
        name = f"image_neck.{theirs}"
        read = reader.conv if ours == "refine" else reader.conv_transpose
        neck[ours] = read(f"{name}.0", width, width, 3 if ours == "refine" else 4)
        neck[f"{ours}_norm"] = reader.norm(f"{name}.1", width)
        stats[f"{ours}_norm"] = reader.running(f"{name}.1", width)
    params = {"image_neck": neck}
    vit = ViT()
    backbone = {
        match[1]: reader.give_away(name)
        for name in reader.names
        if (match := _BACKBONE.match(name))
    }
    if backbone:
        vit = _infer_vit(backbone)
        params["image_backbone"] = dinov3_hf.to_params(vit, backbone, "image_backbone")
    return vit, params, stats


_BACKBONE = re.compile(r"image_backbone\.(?:base_model\.model\.)?(?:model\.)?(.*)")


def _infer_vit(tensors: Mapping[str, Any]) -> ViT:
    patch = tensors.get("embeddings.patch_embeddings.weight")
    layers = [int(m[1]) for n in tensors if (m := re.match(r"layer\.(\d+)\.", n))]
    up = tensors.get("layer.0.mlp.up_proj.weight")
    if patch is None or up is None or not layers:
        raise DataError("image_backbone: not the tensors of a DINOv3 ViT")
    registers = tensors.get("embeddings.register_tokens")
    gated = "layer.0.mlp.gate_proj.weight" in tensors
    return ViT(
        hidden_size=patch.shape[0],
        num_layers=max(layers) + 1,
        num_heads=patch.shape[0] // 64,  # all DINOv3 models have heads of 64 channels
        mlp_dim=up.shape[0],
        patch_size=patch.shape[2],
        num_registers=0 if registers is None else registers.shape[1],
        gated_mlp=gated,
        activation="silu" if gated else "gelu",
    )


def _read_resnet(reader: StateDictReader) -> tuple[dict[str, Any], dict[str, Any]]:
    # Positions in the released Sequential: stem, its norm, ReLU, pooling, stages.
    names = tuple(f"image_backbone.frozen_layers.{i}" for i in (0, 1, 4, 5, 6))
    trunk = resnet_torch.read_trunk(reader, names)
    neck, stats = resnet_torch.read_last_stage(reader, "image_backbone.layer4")
    neck["proj"] = reader.conv(
        "image_backbone.projection", 2048, 128, 1, use_bias=False
    )
    return {"image_backbone": trunk, "image_neck": neck}, stats


_LORA = re.compile(r"(.*)\.lora_([AB])\.[^.]+\.weight$")


def without_lora(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Adds low-rank adapters (PEFT) to the weights they adapt.

    The released settings have rank and alpha 16, hence a factor of 1; they also never
    train them, which leaves B at zero.
    """
    merged: dict[str, Any] = {}
    pairs: dict[str, dict[str, Any]] = {}
    for name, value in tensors.items():
        if match := _LORA.match(name):
            pairs.setdefault(match[1], {})[match[2]] = to_numpy(value)
        else:
            merged[name.replace(".base_layer.", ".")] = value
    for name, pair in pairs.items():
        weight = f"{name}.weight"
        if weight not in merged or set(pair) != {"A", "B"}:
            raise DataError(f"{name}: an adapter without both halves and a weight")
        merged[weight] = to_numpy(merged[weight]) + pair["B"] @ pair["A"]
    return merged


# Files -------------------------------------------------------------------------------


def is_dinorade(content: Any) -> bool:
    """Whether a state dict, or a checkpoint that holds one, is DinoRADE's."""
    if not isinstance(content, Mapping):
        return False
    return any(
        (isinstance(name, str) and "rad_backbone." in name) or is_dinorade(value)
        for name, value in content.items()
    )


def _find(content: Any, source: str) -> dict[str, Any]:
    """The DinoRADE state dict in a checkpoint, without prefixes of its names."""
    if isinstance(content, Mapping):
        for name in content:
            if isinstance(name, str) and "rad_backbone." in name:
                prefix = name[: name.index("rad_backbone.")]
                return {str(k).removeprefix(prefix): v for k, v in content.items()}
        for value in content.values():
            if isinstance(value, Mapping):
                try:
                    return _find(value, source)
                except DataError:
                    continue
    raise DataError(f"{source} has no DinoRADE state dict (no tensor rad_backbone.*)")
