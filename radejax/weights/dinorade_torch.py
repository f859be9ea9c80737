"""Official DinoRADE checkpoints (PyTorch) to Flax. torch is not needed.

The released code names its tensors `rad_backbone.*`, `rad_neck.*`, `head.*` (as
RADE-Net's), `image_neck.*`, `fusion.*` and `image_backbone.*`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, cast

from radejax import models
from radejax.core.config import load_config
from radejax.core.errors import DataError
from radejax.core.files import PathLike
from radejax.models.dinorade import IMAGE_BACKBONE, DinoRade
from radejax.weights import dinov3_hf, radenet_torch
from radejax.weights.convert import (
    from_torch,
    read_state_dict,
    state_dicts,
    to_numpy,
    variable_shapes,
)
from radejax.weights.image_backbone import check_same_vit, resnet_names

PART = "rad_backbone."
"""Start of names by which a state dict of DinoRADE is recognized."""

# In models without CBAM as well; built by the released code and never called; of DINOv3's
# pretraining.
_UNUSED = r"rad_backbone\.cbam_|fusion\.output_proj\.|.*\.mask_token$"


def load(
    state_dict_or_path: Mapping[str, Any] | PathLike,
    *,
    dinov3: PathLike | None = None,
    **model_overrides: Any,
) -> tuple[DinoRade, dict[str, Any]]:
    """Model and variables from an official checkpoint, with the released geometry.

    Project with `CameraCalibration.from_kradar(file,
    radar_from_lidar_m=OFFICIAL_OFFSET_M).camera("pinhole")`, see
    `radejax.models.lifting`. The maps keep the padded grid, which for official weights
    is `RadarGrid.kradar().padded(8, "stretched")`.

    Args:
        state_dict_or_path: Tensors by name, or a file, see `convert.read_state_dict`.
        dinov3: Folder with the image backbone, if the checkpoint has none. Without
            either the model can be applied to embedded images only.
        **model_overrides: Fields of the radar branch (`config.model`) or of the fusion
            (`config.model.fusion`) that names and shapes do not show.

    Returns:
        The model, and `{"params": ..., "batch_stats": ...}` in float32.

    Raises:
        FileNotFoundError: There is no such file.
        UserError: An override is unknown or impossible.
        DataError: Tensors are missing, unexpected or of another shape; all are listed.
    """
    config, variables = read(state_dict_or_path, dinov3=dinov3, **model_overrides)
    return cast(DinoRade, models.build(config)), variables


def read(
    state_dict_or_path: Mapping[str, Any] | PathLike,
    *,
    dinov3: PathLike | None = None,
    **model_overrides: Any,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """`config.model` and variables from an official checkpoint; see `load`."""
    tensors, source = read_state_dict(state_dict_or_path, PART)
    tensors = without_lora(tensors)
    config = load_config("dinorade:official").model.to_dict()
    fusion = config["fusion"]
    radenet_torch.check_overrides(model_overrides, config | fusion)
    of_fusion = {k: v for k, v in model_overrides.items() if k in fusion}
    of_radar = {k: v for k, v in model_overrides.items() if k not in fusion}
    config |= radenet_torch.infer_config(tensors, source, of_radar, "rad_")
    fusion |= infer_fusion(tensors, of_fusion)
    names = radenet_torch.module_names(len(config["widths"]), config["heads"], "rad_")
    names |= fusion_names()
    is_resnet = any(n.startswith("image_backbone.frozen_layers.") for n in tensors)
    if is_resnet and dinov3 is None:
        # The released code feeds its ResNet colors in [0, 1].
        config["image"] |= {"kind": "resnet50", "standardize": False}
        names |= image_branch_names()
    else:
        names |= CAMERA_NECK | dinov3_hf.module_names(IMAGE_BACKBONE)
        tensors = dinov3_hf.with_prefix_tokens(_plain_backbone(tensors), IMAGE_BACKBONE)
    if dinov3 is not None:
        vit, backbone = dinov3_hf.load(dinov3)
        config["image"] |= dinov3_hf.image_fields(vit)
        tensors = {k: v for k, v in tensors.items() if not k.startswith(IMAGE_BACKBONE)}
    elif config["image"]["kind"] == "vit":
        config["image"] |= _infer_vit(tensors, source)
    model = models.build(config)
    shapes = variable_shapes(model)
    if not any(name.startswith(IMAGE_BACKBONE) for name in tensors):
        shapes = {k: s for k, s in shapes.items() if f"/{IMAGE_BACKBONE}/" not in k}
    variables = from_torch(names, shapes, tensors, source, _UNUSED)
    if dinov3 is not None:
        check_same_vit(vit, model.vit, dinov3)
        variables["params"][IMAGE_BACKBONE] = backbone["params"]
    return config, variables


def is_dinorade(content: Any) -> bool:
    """Whether a state dict, or a checkpoint that holds one, is DinoRADE's."""
    return bool(state_dicts(content, PART))


def infer_fusion(
    tensors: Mapping[str, Any], overrides: Mapping[str, Any]
) -> dict[str, Any]:
    """Fields of `config.model.fusion` that names and shapes show, and the overrides."""
    has_weights = any(n.startswith("fusion.weighting_network.") for n in tensors)
    fields = {
        "weighting": "cnn" if has_weights else "off",
        "necks": any(n.startswith("fusion.rad_neck.") for n in tensors),
    }
    samples = tensors.get("fusion.deform_attn.attention_weights.bias")
    if samples is not None:
        heads = max(overrides.get("num_heads", 4), 1)
        fields["num_points"] = math.prod(samples.shape) // heads
    return fields | dict(overrides)


def _infer_vit(tensors: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Fields of `config.model.image` that the backbone's tensors show, if it has any."""
    start = f"{IMAGE_BACKBONE}."
    shapes = {
        name.removeprefix(start): tuple(value.shape)
        for name, value in tensors.items()
        if name.startswith(start)
    }
    if not shapes:
        return {}
    try:
        hidden, _, patch, _ = shapes["embeddings.patch_embeddings.weight"]
        mlp_dim, _ = shapes["layer.0.mlp.up_proj.weight"]
        _, prefix, _ = shapes["embeddings.cls_token"]
    except (KeyError, ValueError):
        raise DataError(
            f"{source}: {start}* are not the tensors of a DINOv3 ViT"
        ) from None
    layers = {name.split(".")[1] for name in shapes if name.startswith("layer.")}
    return {
        "hidden_size": hidden,
        "num_layers": len(layers),
        "num_heads": hidden // 64,  # all DINOv3 models have heads of 64 channels
        "mlp_dim": mlp_dim,
        "patch_size": patch,
        "num_registers": prefix - 1,
        "gated_mlp": "layer.0.mlp.gate_proj.weight" in shapes,
    }


# Names -------------------------------------------------------------------------------

CAMERA_NECK = {"image_neck/proj": "image_neck.channel_proj"}
for _ours, _theirs in (
    ("up_1", "fpn_layer1"),
    ("up_2", "fpn_layer2"),
    ("refine", "refine"),
):
    CAMERA_NECK[f"image_neck/{_ours}"] = f"image_neck.{_theirs}.0"
    CAMERA_NECK[f"image_neck/{_ours}_norm"] = f"image_neck.{_theirs}.1"


def fusion_names() -> dict[str, str]:
    """Torch's module by module of ours, of the fusion."""
    attention = ("sampling_offsets", "attention_weights", "value_proj", "output_proj")
    names = {f"attention/{name}": f"deform_attn.{name}" for name in attention}
    names |= {"gate_hidden": "fusion_gate.0", "gate_out": "fusion_gate.2"}
    for i in (1, 2, 3):  # convolution, normalization, ReLU
        names[f"weighting/conv_{i}"] = f"weighting_network.{3 * i - 3}"
        names[f"weighting/norm_{i}"] = f"weighting_network.{3 * i - 2}"
    names["weighting/out"] = "weighting_network.9"
    names |= radenet_torch.neck_names("radar_neck", "rad_neck.neck")
    names |= radenet_torch.neck_names("camera_neck", "cam_neck.neck")
    return {f"image_fusion/{k}": f"fusion.{v}" for k, v in names.items()}


def image_branch_names() -> dict[str, str]:
    """Torch's module by module of ours, of the image branch with a ResNet-50."""
    # Positions in the released Sequential: stem, its norm, ReLU, pooling, stages.
    conv, norm, *stages = (f"image_backbone.frozen_layers.{i}" for i in (0, 1, 4, 5, 6))
    last = "image_backbone.layer4"
    names = resnet_names(conv, norm, (*stages, last))
    return names | {"image_neck/proj": "image_backbone.projection"}


def _plain_backbone(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Without what PEFT and transformers put before the backbone's own names."""
    start = re.compile(r"image_backbone\.(base_model\.model\.)?(model\.)?")
    return {
        start.sub("image_backbone.", name): value for name, value in tensors.items()
    }


def without_lora(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Adds low-rank adapters (PEFT) to the weights they adapt.

    The released settings have rank and alpha 16, hence a factor of 1; they also never
    train them, which leaves B at zero.
    """
    merged: dict[str, Any] = {}
    pairs: dict[str, dict[str, Any]] = {}
    for name, value in tensors.items():
        if match := re.match(r"(.*)\.lora_([AB])\.[^.]+\.weight$", name):
            pairs.setdefault(match[1], {})[match[2]] = to_numpy(value)
        else:
            merged[name.replace(".base_layer.", ".")] = value
    for name, pair in pairs.items():
        weight = f"{name}.weight"
        try:
            merged[weight] = to_numpy(merged[weight]) + pair["B"] @ pair["A"]
        except (KeyError, ValueError):
            raise DataError(
                f"{name}: expected an adapter of two halves and the weight they fit"
            ) from None
    return merged
