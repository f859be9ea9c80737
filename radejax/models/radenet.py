"""RADE-Net, which predicts a heatmap and box parameters from radar projections.

References:
    Leitgeb et al., RADE-Net. The architecture is that of the released code.
"""

from __future__ import annotations

import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from radejax.core import errors
from radejax.core.config import find_part
from radejax.core.errors import UserError, require
from radejax.core.structures import DetectionMaps
from radejax.models.backbone import BACKBONES, Backbone, CBAMKind
from radejax.models.heads import HEADS, NECKS, Head, Heads, Neck
from radejax.models.layers import Map

Projection = Float[jax.Array, "B R A DE"]

REMAT = ("none", "blocks", "full")
"""Which activations are stored; the backward pass recomputes the others.

"none" stores all, "blocks" only those between blocks, and "full" only those between
backbone, neck and heads.
"""


class RadeNet(nn.Module):
    """Radar-only detector with a backbone, a neck and two heads.

    Projections are zero-padded at the far and right end to a multiple of `pad_multiple`.
    The output includes the padding unless `crop_output` is True.

    Attributes:
        num_classes: Channels of the heatmap.
        doppler_bins: Number of Doppler channels, the first of the projection; 0 for none.
        elevation_bins: Number of elevation channels, which follow them; 0 for none.
        widths: Channels of the encoder levels, finest first.
        decoder_width: Channels of the last decoder stage and of the neck.
        num_groups: Groups of every normalization; must divide every width.
        cbam: "official", "paper" or None; see `radejax.models.backbone.CBAM`.
        input_stem: Whether to encode Doppler and elevation separately first.
        backbone, neck, heads: Names in `BACKBONES`, `NECKS` and `HEADS`, or "module:Class".
        pad_multiple: Multiple to which range and azimuth are padded; must be a multiple of
            2 ** len(widths).
        crop_output: Whether to crop the maps to the projection's bins.
        dtype: Dtype of the computation, "float32" or "bfloat16"; outputs are float32.
        remat: One of `REMAT`, to save memory in the backward pass by recomputation.
        heatmap_prior: Score of bins in an untrained model; see `radejax.models.heads.Heads`.
        input_center: Value subtracted from the projection; 0 in the paper. Noise is about
            0.63.
        input_scale: Factor applied after the subtraction; 1 in the paper. An echo 10 dB
            above the noise differs from it by 0.054, and with a factor of 20 by 1.1, which
            is a usual magnitude of a network's input.
        num_frames: Number of frames whose channels form the input, see
            `radejax.data.projection.stack_frames`.
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
    crop_output: bool = True
    dtype: str = "float32"
    remat: str = "none"
    heatmap_prior: float = 0.5
    input_center: float = 0.0
    input_scale: float = 1.0
    num_frames: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = ["num_classes", "decoder_width", "num_groups", "pad_multiple"]
        sizes += ["num_frames"]
        channels = ["doppler_bins", "elevation_bins"]
        ranges = {
            **dict.fromkeys(sizes, errors.SIZE),
            **dict.fromkeys(channels, errors.integer(0, 1 << 16)),
            "widths": (
                lambda widths: len(widths) > 0 and all(map(errors.SIZE[0], widths)),
                "one or several integers of at least 1",
            ),
            "cbam": errors.one_of("official", "paper", None),
            "dtype": errors.one_of("float32", "bfloat16"),
            "remat": errors.one_of(*REMAT),
            "heatmap_prior": (lambda prior: 0 < prior < 1, "a number in (0, 1)"),
            "input_center": (math.isfinite, "a finite number"),
            "input_scale": errors.POSITIVE,
        }
        errors.check_options(vars(self), "config.model", ranges)
        find_part(self.backbone, "config.model.backbone", BACKBONES, Backbone)
        find_part(self.neck, "config.model.neck", NECKS, Neck)
        find_part(self.heads, "config.model.heads", HEADS, Head)
        least = "above 0 if config.model.doppler_bins is 0"
        is_some = self.doppler_bins + self.elevation_bins > 0
        require(is_some, "config.model.elevation_bins", self.elevation_bins, least)
        stride = 2 ** len(self.widths)
        expected = f"a multiple of {stride} for {len(self.widths)} levels"
        is_whole = self.pad_multiple % stride == 0
        require(is_whole, "config.model.pad_multiple", self.pad_multiple, expected)
        widths = {f"widths[{i}]": width for i, width in enumerate(self.widths)}
        widths["decoder_width"] = self.decoder_width
        if self.heads == "default":
            half = min(64, self.decoder_width // 2)
            widths["decoder_width / 2 (default heads)"] = half
        if self.input_stem:
            widths["widths[0] / 2 (input stem)"] = self.widths[0] // 2
        expected = f"a multiple of num_groups = {self.num_groups}"
        for name, width in widths.items():
            is_multiple = width > 0 and width % self.num_groups == 0
            require(is_multiple, f"config.model: {name}", width, expected)

    @nn.compact
    def __call__(self, projection: Projection, *, train: bool = False) -> DetectionMaps:
        """Predicts detection maps from projections.

        Args:
            projection: `[B, R, A, D+E]` projections from `radejax.data.projection`, with
                the Doppler channels first, in any float dtype; for several frames as
                `stack_frames` returns them.
            train: Has no effect; all models have this argument.

        Returns:
            Maps on the padded bins, or on the projection's bins if `crop_output`.

        Raises:
            UserError: The projection is not a batch or has the wrong number of channels.
        """
        features = self._features(self._padded(projection))
        return self._maps(features, projection)

    def _padded(self, projection: Projection) -> Float[jax.Array, "B Rp Ap DE"]:
        """Centers and scales the projection, casts it to the model's dtype and pads it."""
        doppler = self.num_frames * self.doppler_bins
        elevation = self.num_frames * self.elevation_bins
        channels = doppler + elevation
        if projection.ndim != 4 or projection.shape[-1] != channels:
            raise UserError(
                f"projection must be [B, R, A, {channels}] with {doppler} Doppler and "
                f"{elevation} elevation channels, got {projection.shape}"
            )
        if (self.input_center, self.input_scale) != (0.0, 1.0):
            # This precedes the cast, because bfloat16 has steps of 0.7 dB near the noise.
            projection = projection.astype(jnp.float32) - self.input_center
            projection = projection * self.input_scale
        r, a = (-n % self.pad_multiple for n in projection.shape[1:3])
        padding = ((0, 0), (0, r), (0, a), (0, 0))
        return jnp.pad(projection.astype(self.dtype), padding)

    def _features(self, padded: Projection) -> Map:
        """Applies the backbone."""
        backbone = find_part(self.backbone, "config.model.backbone", BACKBONES)
        return self._stage(backbone)(
            doppler_bins=self.num_frames * self.doppler_bins,
            widths=self.widths,
            decoder_width=self.decoder_width,
            cbam=self.cbam,
            input_stem=self.input_stem,
            **self._shared(),
            name="backbone",
        )(padded)

    def _maps(
        self, features: Float[jax.Array, "B Rp Ap C"], projection: Projection
    ) -> DetectionMaps:
        """Applies neck and heads, and crops the maps if `crop_output`."""
        neck = self._stage(find_part(self.neck, "config.model.neck", NECKS))
        heads = self._stage(Heads)(
            num_classes=self.num_classes,
            kind=self.heads,
            heatmap_prior=self.heatmap_prior,
            **self._shared(),
            name="heads",
        )
        maps = heads(neck(**self._shared(), name="neck")(features))
        if not self.crop_output:
            return maps
        r, a = projection.shape[1:3]
        return jax.tree.map(lambda m: m[:, :r, :a], maps)

    def _stage(self, module: Any) -> Any:
        return nn.remat(module) if self.remat == "full" else module

    def _shared(self) -> dict[str, Any]:
        return {
            "num_groups": self.num_groups,
            "dtype": jnp.dtype(self.dtype),
            "remat": self.remat != "none",
        }
