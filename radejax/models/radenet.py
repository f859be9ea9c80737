"""RADE-Net: from radar projections to heatmap and box parameters.

References:
    Leitgeb et al., RADE-Net; architecture as in the released code.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal, get_type_hints

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from radejax.core import schema
from radejax.core.errors import DataError, UserError
from radejax.core.structures import DetectionMaps
from radejax.models.backbone import BACKBONES
from radejax.models.cbam import CBAMKind
from radejax.models.heads import HEADS, Heads
from radejax.models.neck import NECKS

DTYPES = ("float32", "bfloat16")

REMAT = ("none", "blocks", "full")
"""What the backward pass computes again instead of keeping: nothing, the inside of each
block, or also all but the ends of backbone, neck and heads."""


class RadeNet(nn.Module):
    """Radar-only detector: backbone, neck and two heads.

    Maps are zero-padded at the far and right end to a multiple of `pad_multiple`;
    the output keeps the padding unless `crop_output`.

    Attributes:
        num_classes: Channels of the heatmap.
        doppler_bins: First channels of the projection.
        elevation_bins: Remaining channels of the projection.
        widths: Channels of the encoder levels, finest first.
        decoder_width: Channels of the last decoder stage, neck and heads.
        num_groups: Groups of every normalisation; must divide every width.
        cbam: "official", "paper" or None; see `radejax.models.cbam.CBAM`.
        input_stem: Encode Doppler and elevation apart first.
        backbone, neck, heads: Of `BACKBONES`, `NECKS` and `HEADS`.
        pad_multiple: Multiple of 2 ** len(widths).
        crop_output: Cut the maps back to the projection's bins.
        dtype: "float32" or "bfloat16", of the computation; outputs are float32.
        remat: One of `REMAT`: less memory, more time, the same gradients.
        heatmap_prior: Confidence of an untrained model; see `radejax.models.heads.Heads`.
        input_center: Taken off the projection; 0 as in the paper. Noise is about 0.545.
        input_scale: What that is multiplied with; 1 as in the paper. An echo 10 dB above
            the noise is 0.054 above it: at 25 it is 1.4, of the order layers expect.
    """

    num_classes: int
    doppler_bins: int = 64
    elevation_bins: int = 37
    widths: tuple[int, ...] = (128, 256, 512)
    decoder_width: int = 128
    num_groups: int = 32
    cbam: CBAMKind | None = "official"
    input_stem: bool = False
    backbone: str = "unet"
    neck: str = "dilated"
    heads: str = "expanded"
    pad_multiple: int = 8
    crop_output: bool = False
    dtype: str = "float32"
    remat: str = "none"
    heatmap_prior: float = 0.5
    input_center: float = 0.0
    input_scale: float = 1.0

    @nn.compact
    def __call__(
        self, projection: Float[jax.Array, "B R A DE"], train: bool = False
    ) -> DetectionMaps:
        """Predicts from projections.

        Args:
            projection: `[B, R, A, D+E]` as `radejax.data.projection.project` makes
                them, Doppler channels first; any float dtype.
            train: Has no effect; for the signature that all models share.

        Returns:
            Maps on the padded bins, or on the projection's if `crop_output`.
        """
        del train
        x = padded_input(projection, self)
        backbone, neck, heads = radar_parts(self)
        maps = heads(name="heads")(neck(name="neck")(backbone(name="backbone")(x)))
        return cropped_output(maps, projection, self)


def radar_parts(radar: RadeNet) -> tuple[Callable[..., nn.Module], ...]:
    """What makes backbone, neck and heads, which DinoRADE has as well."""
    check_choices(radar)
    stage = nn.remat if radar.remat == "full" else lambda module: module
    shared = {
        "num_groups": radar.num_groups,
        "dtype": jnp.dtype(radar.dtype),
        "remat": radar.remat != "none",
    }
    backbone = functools.partial(
        stage(BACKBONES[radar.backbone]),
        doppler_bins=radar.doppler_bins,
        widths=radar.widths,
        decoder_width=radar.decoder_width,
        cbam=radar.cbam,
        input_stem=radar.input_stem,
        **shared,
    )
    neck = functools.partial(stage(NECKS[radar.neck]), **shared)
    heads = functools.partial(
        stage(Heads),
        num_classes=radar.num_classes,
        kind=radar.heads,
        heatmap_prior=radar.heatmap_prior,
        **shared,
    )
    return backbone, neck, heads


def check_choices(radar: RadeNet) -> None:
    """`UserError` for a choice by name that there is not; names those that there are."""
    for field, choices in _CHOICES.items():
        if (found := getattr(radar, field)) not in choices:
            raise UserError(
                f"config.model.{field} is {found!r}, expected one of {tuple(choices)}"
            )


def padded_input(
    projection: Float[jax.Array, "B R A DE"], radar: RadeNet
) -> Float[jax.Array, "B Rp Ap DE"]:
    """The projection less `input_center`, scaled, in the dtype of the computation, padded.

    Raises:
        UserError: It is not a batch of projections of the model's channels.
    """
    channels = radar.doppler_bins + radar.elevation_bins
    if projection.ndim != 4 or projection.shape[-1] != channels:
        raise UserError(
            f"projection must be [B, R, A, {channels}] with {radar.doppler_bins} "
            f"Doppler and {radar.elevation_bins} elevation channels, got "
            f"{projection.shape}"
        )
    if (radar.input_center, radar.input_scale) != (0.0, 1.0):
        # Before the cast: bfloat16 has steps of 0.7 dB at the noise's 0.545.
        projection = projection.astype(jnp.float32) - radar.input_center
        projection = projection * radar.input_scale
    dtype = jnp.dtype(radar.dtype)
    return pad_to_multiple(projection.astype(dtype), radar.pad_multiple)


def cropped_output(
    maps: DetectionMaps, projection: Float[jax.Array, "B R A DE"], radar: RadeNet
) -> DetectionMaps:
    """The maps, on the projection's bins if `crop_output`."""
    if not radar.crop_output:
        return maps
    r, a = projection.shape[1:3]
    return jax.tree.map(lambda m: m[:, :r, :a], maps)


def pad_to_multiple(
    x: Float[jax.Array, "B R A C"], multiple: int
) -> Float[jax.Array, "B Rp Ap C"]:
    """Zero-pads range and azimuth at their ends to a multiple."""
    pad_range, pad_azimuth = (-x.shape[1] % multiple, -x.shape[2] % multiple)
    return jnp.pad(x, ((0, 0), (0, pad_range), (0, pad_azimuth), (0, 0)))


def own_fields(
    module: type[nn.Module], without: tuple[str, ...] = ()
) -> tuple[str, ...]:
    """Attributes that a module's class declares itself, less some of them."""
    left_out = {"parent", "name", *without}
    names = (field.name for field in dataclasses.fields(module))
    return tuple(name for name in names if name not in left_out)


FIELDS = own_fields(RadeNet)
"""Fields of a model config beside `name`."""

BEFORE: dict[str, Any] = {"backbone": "unet", "input_center": 0.0, "input_scale": 1.0}
"""Fields that configs of earlier versions are without, as they were then."""

_CHOICES: dict[str, Collection[Any]] = {
    "cbam": ("official", "paper", None),
    "backbone": BACKBONES,
    "neck": NECKS,
    "heads": HEADS,
    "dtype": DTYPES,
    "remat": REMAT,
}
HINTS = {k: hint for k, hint in get_type_hints(RadeNet).items() if k in FIELDS} | {
    "cbam": Literal["official", "paper", "off"] | None,
    "dtype": Literal[DTYPES],
    "remat": Literal[REMAT] | bool,  # True and False in earlier versions
}
"""What the fields may be."""

_MOST = 1 << 16  # channels, groups, classes


def from_config(config: Mapping[str, Any]) -> RadeNet:
    """RADE-Net as a config describes it.

    Args:
        config: Exactly the keys `name` and `FIELDS`. `cbam` may be "off" for None.

    Raises:
        UserError: A key is missing or unknown, or a value is not possible.
    """
    fields = BEFORE | {k: config[k] for k in config if k != "name"}
    check_keys(fields, FIELDS, "model")
    fields = check_values(fields, HINTS)
    if fields["cbam"] == "off":
        fields["cbam"] = None
    if isinstance(fields["remat"], bool):
        fields["remat"] = "blocks" if fields["remat"] else "none"  # of 0.1
    model = RadeNet(**fields)
    check_choices(model)
    _check_sizes(model)
    return model


def check_keys(
    fields: Mapping[str, Any], expected: tuple[str, ...], section: str
) -> None:
    """Raises `UserError` naming keys of a config section that are too many or few."""
    unknown = sorted(set(fields) - set(expected))
    missing = sorted(set(expected) - set(fields))
    problems = [f"unknown {unknown}"] * bool(unknown)
    problems += [f"missing {missing}"] * bool(missing)
    if problems:
        raise UserError(
            f"config.{section} has {' and '.join(problems)}; its keys are "
            f"{sorted(expected)}"
        )


def check_values(fields: Mapping[str, Any], hints: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of `config.model`; `UserError` for one that is of another type."""
    try:
        return schema.check(fields, dict(hints), "", "config.model")
    except DataError as error:
        raise UserError(str(error)) from None


def _check_sizes(model: RadeNet) -> None:
    names = ("num_classes", "doppler_bins", "elevation_bins", "num_groups")
    for name in names:
        if not 1 <= getattr(model, name) <= _MOST:
            raise UserError(
                f"config.model.{name} is {getattr(model, name)}, expected 1 to {_MOST}"
            )
    if not 0.0 < model.heatmap_prior < 1.0:
        raise UserError(
            f"config.model.heatmap_prior is {model.heatmap_prior}, expected a "
            "probability between 0 and 1"
        )
    if model.input_scale <= 0:
        raise UserError(
            f"config.model.input_scale is {model.input_scale}, expected a number above 0"
        )
    stride = 2 ** len(model.widths)
    if not 1 <= model.pad_multiple <= _MOST or model.pad_multiple % stride:
        raise UserError(
            f"config.model.pad_multiple is {model.pad_multiple}; {len(model.widths)} "
            f"levels need a multiple of {stride}"
        )
    widths = {f"widths[{i}]": width for i, width in enumerate(model.widths)}
    widths["decoder_width"] = model.decoder_width
    if model.heads == "default":
        widths["decoder_width / 2 (default heads)"] = min(64, model.decoder_width // 2)
    if model.input_stem:
        widths["widths[0] / 2 (input stem)"] = model.widths[0] // 2
    for name, width in widths.items():
        if not 1 <= width <= _MOST or width % model.num_groups:
            raise UserError(
                f"config.model: {name} = {width} is not a multiple of "
                f"num_groups = {model.num_groups} up to {_MOST}"
            )
