"""RADE-Net, which predicts a heatmap and box parameters from radar projections.

References:
    Leitgeb et al., RADE-Net. The architecture is that of the authors' code.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from radejax.core.errors import UserError
from radejax.core.options import find_part
from radejax.core.structures import DetectionMaps
from radejax.models.backbone import BACKBONES
from radejax.models.heads import NECKS, Heads
from radejax.models.layers import Map, Part
from radejax.models.options import RadeNetOptions, axis_centers

Projection = Float[jax.Array, "B R A DE"]
PartT = TypeVar("PartT", bound=Part)


class RadeNet(nn.Module):
    """Radar-only detector with a backbone, a neck and two heads.

    Projections are zero-padded at the far and right end to a multiple of `pad_multiple`.
    The output includes the padding unless `crop_output` is True.

    Attributes:
        options: Options of the model.
        num_frames: Number of frames whose channels form the input, see
            `radejax.data.projection.stack_frames`.
    """

    options: RadeNetOptions
    num_frames: int = 1

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
        options = self.options
        doppler = self.num_frames * options.doppler_bins
        elevation = self.num_frames * options.elevation_bins
        channels = doppler + elevation
        if projection.ndim != 4 or projection.shape[-1] != channels:
            raise UserError(
                f"projection must be [B, R, A, {channels}] with {doppler} Doppler and "
                f"{elevation} elevation channels, got {projection.shape}"
            )
        if (options.input_center, options.input_scale) != (0.0, 1.0):
            # This precedes the cast, because bfloat16 has steps of 0.7 dB near the noise.
            projection = projection.astype(jnp.float32) - options.input_center
            projection = projection * options.input_scale
        r, a = (-n % options.pad_multiple for n in projection.shape[1:3])
        padding = ((0, 0), (0, r), (0, a), (0, 0))
        return jnp.pad(projection.astype(options.dtype), padding)

    def _features(self, padded: Projection) -> Map:
        """Applies the backbone."""
        options = self.options
        backbone = find_part(options.backbone, "config.model.backbone", BACKBONES)
        features: Map = self._part(backbone)(
            doppler_bins=self.num_frames * options.doppler_bins,
            widths=options.widths,
            decoder_width=options.decoder_width,
            cbam=options.cbam,
            input_stem=options.input_stem,
            name="backbone",
        )(padded)
        return features

    def _maps(
        self, features: Float[jax.Array, "B Rp Ap C"], projection: Projection
    ) -> DetectionMaps:
        """Applies neck and heads, and crops the maps if `crop_output`."""
        options = self.options
        neck = self._part(find_part(options.neck, "config.model.neck", NECKS))
        heads = self._part(Heads)(
            num_classes=options.num_classes,
            kind=options.heads,
            heatmap_prior=options.heatmap_prior,
            outputs=options.outputs,
            name="heads",
        )
        maps = heads(neck(name="neck")(features))
        if options.beam_azimuth_deg is not None:
            azimuth_deg = axis_centers(options.beam_azimuth_deg, features.shape[2])
            params = vehicle_from_beam(maps.box_params, np.deg2rad(azimuth_deg))
            maps = maps.replace(box_params=params)
        if options.crop_output:
            r, a = projection.shape[1:3]
            maps = jax.tree.map(lambda m: m[:, :r, :a], maps)
        return maps

    def _part(self, kind: type[PartT]) -> Callable[..., PartT]:
        """Returns the constructor of a part with the fields that all parts share."""
        options = self.options
        return functools.partial(
            nn.remat(kind) if options.remat == "full" else kind,
            num_groups=options.num_groups,
            dtype=jnp.dtype(options.dtype),
            remat=options.remat != "none",
        )


def vehicle_from_beam(
    params: Float[jax.Array, "B R A 8"], azimuth_rad: Float[np.ndarray, " A"]
) -> Float[jax.Array, "B R A 8"]:
    """Turns box parameters from the direction of each bin's beam to the vehicle's axes.

    Args:
        params: `[B, R, A, 8]` dx, dy, z, l, w, h, sin yaw, cos yaw, where x is along the beam.
        azimuth_rad: `[A]` azimuths of the beams, positive to the right.

    Returns:
        `[B, R, A, 8]` the same with x forward.

    Examples:
        >>> ahead = jnp.array([1.0, 0, 0, 4, 2, 1, 0, 1]).reshape(1, 1, 1, 8)
        >>> vehicle_from_beam(ahead, np.array([np.pi / 2]))[0, 0, 0].round(3).tolist()
        [0.0, -1.0, 0.0, 4.0, 2.0, 1.0, -1.0, 0.0]
    """
    cos = jnp.asarray(np.cos(azimuth_rad), params.dtype)[None, None]
    sin = jnp.asarray(np.sin(azimuth_rad), params.dtype)[None, None]
    dx, dy, z, length, width, height, sin_yaw, cos_yaw = jnp.moveaxis(params, -1, 0)
    turned = (
        cos * dx + sin * dy,
        cos * dy - sin * dx,
        z,
        length,
        width,
        height,
        cos * sin_yaw - sin * cos_yaw,
        cos * cos_yaw + sin * sin_yaw,
    )
    return jnp.stack(turned, -1)
