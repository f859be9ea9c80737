"""Conversion of official DinoRADE checkpoints (PyTorch) to Flax, without torch.

The authors' code names its tensors `rad_backbone.*`, `rad_neck.*`, `head.*` (as in
RADE-Net), `image_neck.*`, `fusion.*` and `image_backbone.*`.
"""

from __future__ import annotations

import math
import re

from flax.typing import Collection, MutableVariableDict

from radejax import models
from radejax.core.errors import DataError, require
from radejax.core.files import JsonObject, PathLike
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.models.options import OFFICIAL_DINORADE, DinoRadeOptions, FusionOptions
from radejax.weights import convert, dinov3_hf, radenet_torch
from radejax.weights.convert import Rules, StateDict
from radejax.weights.image_backbone import RESNET_RULES

PART = "rad_backbone."
"""Start of names by which a DinoRADE state dict is recognized."""

# Modules that the authors' code always creates, even if its forward pass does not use them.
_UNUSED = r"rad_backbone\.cbam_|fusion\.output_proj\."


def read(
    tensors: StateDict,
    source: str,
    dinov3: PathLike | None = None,
    **model_overrides: object,
) -> tuple[DinoRadeOptions, MutableVariableDict]:
    """Returns the options and the variables of tensors by official name.

    The geometry is the released one. The camera is `CameraCalibration.from_kradar(file,
    radar_from_lidar_m=OFFICIAL_OFFSET_M).camera("pinhole")`, see `radejax.models.lifting`.
    The maps include the padding; their grid for weights of the authors' code is
    `RadarGrid.kradar().padded(8, "stretched")`.

    Args:
        tensors: Tensors by official name, see `convert.read_state_dict`.
        source: Name of the tensors in error messages.
        dinov3: Folder of a DINOv3 that replaces the checkpoint's image backbone, if it has
            one. Without any backbone, the model accepts only embedded images.
        **model_overrides: Fields of `config.model` or `config.model.fusion`, which replace
            those inferred from names and shapes and the defaults.

    Returns:
        `config.model`, and `{"params": ..., "batch_stats": ...}` in float32.

    Raises:
        FileNotFoundError: The folder or a file in it is missing.
        UserError: An override is unknown or invalid, `doppler_bins` and `elevation_bins`
            are needed and missing, or the folder contains another kind of model.
        DataError: A file is corrupted, or tensors are missing, unexpected or of another
            shape. The message lists up to 20 of them.
    """
    tensors = without_lora(tensors)
    names = FusionOptions.model_fields
    of_fusion = {k: v for k, v in model_overrides.items() if k in names}
    of_radar = {k: v for k, v in model_overrides.items() if k not in names}
    fields = radenet_torch.infer_fields(tensors, source, of_radar, "rad_")
    fields["fusion"] = infer_fusion(tensors, of_fusion)
    backbone = None
    is_resnet = any(n.startswith("image_backbone.frozen_layers.") for n in tensors)
    is_resnet = is_resnet and dinov3 is None
    if is_resnet:
        # The authors' code only scales the images of its ResNet to [0, 1].
        fields["image"] = {"kind": "resnet50", "standardize": False}
    else:
        fields["image"], backbone = _transformer(tensors, source, dinov3)
        tensors = {k: v for k, v in tensors.items() if not k.startswith(IMAGE_BACKBONE)}
    options = OFFICIAL_DINORADE.replace(**fields)
    shapes = convert.variable_shapes(models.build(options))
    if not is_resnet:
        shapes = {k: s for k, s in shapes.items() if f"/{IMAGE_BACKBONE}/" not in k}
    ours = rules(options.heads, is_resnet)
    variables = convert.from_torch(ours, shapes, tensors, source, _UNUSED)
    if backbone is not None:
        variables["params"][IMAGE_BACKBONE] = backbone
    return options, variables


def _transformer(
    tensors: StateDict, source: str, dinov3: PathLike | None
) -> tuple[dict[str, object], Collection | None]:
    """Returns fields and parameters of the transformer in the folder, else the checkpoint."""
    if dinov3 is not None:
        vit, variables = dinov3_hf.load(dinov3)
        is_dinov3 = not vit.options.position_grid
        require(is_dinov3, str(dinov3), "DINOv2", f"DINOv3 as in {source}")
        return dinov3_hf.image_fields(vit.options), variables["params"]
    # PEFT and transformers add prefixes to the names of the backbone.
    start = re.compile(rf"{IMAGE_BACKBONE}\.(base_model\.model\.)?(model\.)?")
    own = {start.sub("", k): v for k, v in tensors.items() if start.match(k)}
    if not own:
        return {}, None
    vit = dinov3_hf.model_from_tensors(own, source)
    params = dinov3_hf.to_params(vit, own, f"{IMAGE_BACKBONE} of {source}")
    return dinov3_hf.image_fields(vit.options), params


def infer_fusion(tensors: StateDict, overrides: JsonObject) -> JsonObject:
    """Infers fields of `config.model.fusion` from names and shapes, and applies the overrides."""
    has_weights = any(n.startswith("fusion.weighting_network.") for n in tensors)
    has_necks = any(n.startswith("fusion.rad_neck.") for n in tensors)
    fields = {"weighting": "cnn" if has_weights else "off", "necks": has_necks}
    samples = tensors.get("fusion.deform_attn.attention_weights.bias")
    if samples is not None:
        heads = max(overrides.get("num_heads", 4), 1)
        fields["num_points"] = math.prod(samples.shape) // heads
    return fields | dict(overrides)


# Names -------------------------------------------------------------------------------

_FUSION: Rules = (
    (r"^image_fusion/attention/(\w+)/", r"fusion.deform_attn.\1."),
    (r"^image_fusion/gate_hidden/", "fusion.fusion_gate.0."),
    (r"^image_fusion/gate_out/", "fusion.fusion_gate.2."),
    # In torch, convolution, normalization and ReLU have consecutive indices.
    (r"^image_fusion/weighting/", "fusion.weighting_network/"),
    (r"network/conv_(\d)/", lambda m: f"network.{3 * int(m[1]) - 3}."),
    (r"network/norm_(\d)/", lambda m: f"network.{3 * int(m[1]) - 2}."),
    (r"network/out/", "network.9."),
    *radenet_torch.neck_rules("image_fusion/radar_neck", "fusion.rad_neck.neck"),
    *radenet_torch.neck_rules("image_fusion/camera_neck", "fusion.cam_neck.neck"),
)

_CAMERA_NECK: Rules = (
    (r"^image_neck/proj/", "image_neck.channel_proj."),
    (r"^image_neck/up_(\d)/", r"image_neck.fpn_layer\1.0."),
    (r"^image_neck/up_(\d)_norm/", r"image_neck.fpn_layer\1.1."),
    (r"^image_neck/refine/", "image_neck.refine.0."),
    (r"^image_neck/refine_norm/", "image_neck.refine.1."),
)

_RESNET: Rules = (
    *RESNET_RULES,
    # Indices in the released Sequential: stem, its norm, ReLU, pooling, three stages.
    (r"^conv1\.", "image_backbone.frozen_layers.0."),
    (r"^bn1\.", "image_backbone.frozen_layers.1."),
    (r"^layer([123])\.", lambda m: f"image_backbone.frozen_layers.{int(m[1]) + 3}."),
    (r"^layer4\.", "image_backbone.layer4."),
    (r"^image_neck/proj/", "image_backbone.projection."),
)


def rules(heads: str, is_resnet: bool) -> Rules:
    """Returns the rules from modules of `DinoRade` to official names, for `convert`."""
    image = _RESNET if is_resnet else _CAMERA_NECK
    return (*image, *_FUSION, *radenet_torch.rules(heads, "rad_"))


def without_lora(tensors: StateDict) -> StateDict:
    """Merges low-rank adapters (PEFT) into the weights that they adapt: W + B A.

    The factor alpha / rank is 1, because both are 16 in the released settings. These settings
    also never train the adapters, so B is zero.

    Raises:
        DataError: An adapter has no matrix A, B or W, or their shapes do not match.
    """
    own = {k: v for k, v in tensors.items() if ".lora_" not in k}
    merged = {k.replace(".base_layer.", "."): v for k, v in own.items()}
    for module in {n.partition(".lora_")[0] for n in tensors if ".lora_" in n}:
        weight = f"{module}.weight"
        halves = [f"{module}.lora_{half}.default.weight" for half in "BA"]
        try:
            up, down = (convert.to_numpy(tensors[name]) for name in halves)
            merged[weight] = convert.to_numpy(merged[weight]) + up @ down
        except (KeyError, ValueError):
            raise DataError(
                f"{module}: expected an adapter of two halves and the weight they fit"
            ) from None
    return merged
