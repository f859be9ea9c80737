"""DinoRADE from its config, checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_type_hints

from radejax.core.errors import UserError
from radejax.models import radenet
from radejax.models.dinorade import DinoRade
from radejax.models.fusion import Fusion
from radejax.models.lifting import MARGIN_PX, LiftingAxes
from radejax.models.resnet import STRIDE
from radejax.models.vit import ViT

FUSION_FIELDS = radenet.own_fields(Fusion, without=("num_groups", "dtype", "remat"))
"""Fields of `config.model.fusion`."""

IMAGE_FIELDS = (
    "kind",
    "size",
    "freeze",
    "standardize",
    "hidden_size",
    "num_layers",
    "num_heads",
    "mlp_dim",
    "patch_size",
    "num_registers",
    "gated_mlp",
    "layer_scale",
    "attention",
    "resnet_width",
)
"""Fields of `config.model.image`."""

AXES_FIELDS = ("range_m", "azimuth_deg", "elevation_deg")
"""Fields of `config.model.query_grid`."""

FIELDS = (*radenet.FIELDS, "image", "fusion", "query_grid")
"""Fields of a model config beside `name`."""

_VIT, _FUSION, _AXES = map(get_type_hints, (ViT, Fusion, LiftingAxes))
_IMAGE = {
    "kind": Literal["vit", "resnet50"],
    "size": tuple[int, int],
    "freeze": bool,
    "standardize": bool,
    "resnet_width": int,
}
HINTS = radenet.HINTS | {
    "image": {name: (_VIT | _IMAGE)[name] for name in IMAGE_FIELDS},
    "fusion": {name: _FUSION[name] for name in FUSION_FIELDS},
    "query_grid": {name: _AXES[name] for name in AXES_FIELDS},
}
"""What the fields may be."""


def from_config(config: Mapping[str, Any]) -> DinoRade:
    """DinoRADE as a config describes it.

    Args:
        config: Exactly the keys `name` and `FIELDS`; RADE-Net's keys describe the radar
            branch, `image`, `fusion` and `query_grid` are mappings with exactly their fields.

    Raises:
        UserError: A key is missing or unknown, or a value is not possible.
    """
    fields = radenet.BEFORE | {k: config[k] for k in config if k != "name"}
    radenet.check_keys(fields, FIELDS, "model")
    sections = {
        "image": IMAGE_FIELDS,
        "fusion": FUSION_FIELDS,
        "query_grid": AXES_FIELDS,
    }
    for name, keys in sections.items():
        fields[name] = dict(_section(fields, name, keys))
    fields = radenet.check_values(fields, HINTS)
    image, fusion, axes = (fields[name] for name in sections)
    if image["kind"] == "resnet50" and not image["freeze"]:
        raise UserError(
            "config.model.image.freeze is False, but the ResNet's first stages have "
            "fixed batch statistics and are not to be trained (its last stage is)"
        )
    radar = {k: fields[k] for k in radenet.FIELDS}
    model = DinoRade(
        radar=radenet.from_config({"name": "radenet"} | radar),
        vit=_vit(image) if image["kind"] == "vit" else None,
        fusion=fusion,
        query_grid=LiftingAxes(
            **{k: (float(axes[k][0]), float(axes[k][1])) for k in AXES_FIELDS},
            num_elevation=fusion["num_elevation"],
        ),
        image_size=image["size"],
        freeze=image["freeze"],
        resnet_width=image["resnet_width"],
        standardize_image=image["standardize"],
    )
    _check_sizes(model)
    return model


def _section(
    fields: Mapping[str, Any], name: str, keys: tuple[str, ...]
) -> Mapping[str, Any]:
    section = fields[name]
    if not isinstance(section, Mapping) and not hasattr(section, "keys"):
        raise UserError(f"config.model.{name} must be a mapping, got {section!r}")
    radenet.check_keys(dict(section), keys, f"model.{name}")
    return section


def _vit(image: Mapping[str, Any]) -> ViT:
    names = ["hidden_size", "num_layers", "num_heads", "mlp_dim", "patch_size"]
    names += ["num_registers", "gated_mlp", "layer_scale", "attention"]
    activation = "silu" if image["gated_mlp"] else "gelu"
    return ViT(**{n: image[n] for n in names}, activation=activation)


def _check_sizes(model: DinoRade) -> None:
    sizes = {f"fusion.{k}": v for k, v in model.fusion.items() if _FUSION[k] is int}
    sizes |= {"image.resnet_width": model.resnet_width}
    if model.vit is not None:
        names = (name for name in IMAGE_FIELDS if _VIT.get(name) is int)
        sizes |= {f"image.{name}": getattr(model.vit, name) for name in names}
    for name, size in sizes.items():
        least = int(name not in ("fusion.chunk_size", "image.num_registers"))
        if not least <= size <= 1 << 16:
            raise UserError(
                f"config.model.{name} is {size}, expected {least} to {1 << 16}"
            )
    stride = STRIDE if model.vit is None else model.vit.patch_size
    if any(n < stride or n % stride for n in model.image_size):
        raise UserError(
            f"config.model.image.size is {model.image_size}; height and width must be "
            f"multiples of {stride}"
        )
    if model.vit is not None:
        heads, hidden = model.vit.num_heads, model.vit.hidden_size
        if hidden % heads or (hidden // heads) % 4:
            raise UserError(
                f"config.model.image: {hidden} channels in {heads} heads; each head "
                "needs a multiple of 4"
            )
    if (
        model.fusion["out_of_view"] == "official"
        and model.image_size[1] <= 2 * MARGIN_PX
    ):
        raise UserError(
            f"config.model.fusion.out_of_view='official' leaves out {MARGIN_PX} pixels left "
            f"and right, but config.model.image.size is {model.image_size}"
        )
    width, heads = model.radar.decoder_width, model.fusion["num_heads"]
    if width % heads:
        raise UserError(
            f"config.model: fusion.num_heads = {heads} does not divide decoder_width = "
            f"{width}"
        )
