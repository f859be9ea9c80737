"""Fusion of the radar map with camera features at the projections of the radar queries.

References:
    DinoRADE, sections 3.3 to 3.5. Where the authors' code differs from the paper, the
    options `weighting`, `gate` and `out_of_view` select either.
"""

from __future__ import annotations

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float, Real

from radejax.core.structures import Array
from radejax.models import lifting
from radejax.models.deformable_attention import DeformableAttention
from radejax.models.heads import DilatedNeck
from radejax.models.layers import Dense, Map, Part
from radejax.models.lifting import ReferencePoints
from radejax.models.options import FusionOptions


class Fusion(Part):
    """Weighted lifting, deformable attention to the camera map, and gated sum with the radar.

    Attributes:
        options: Options of the fusion.
        num_groups: Groups of the necks' normalizations.
        remat: Recompute the necks in the backward pass instead of storing their blocks.
    """

    options: FusionOptions

    @nn.compact
    def __call__(
        self,
        radar: Map,
        elevation: Float[jax.Array, "B R A D"],
        camera: Float[jax.Array, "B h w C"] | None,
        reference: ReferencePoints | None,
        *,
        train: bool = False,
    ) -> Map:
        """Fuses radar and camera maps.

        The weight of the camera in the fused map, averaged over channels, is sown as
        the intermediate "camera_share" `[B, R, A]`.

        Args:
            radar: `[B, R, A, C]` features of the radar backbone.
            elevation: `[B, R, A, D]` elevation channels of the projection.
            camera: `[B, h, w, C]` camera map, or None to use the radar only.
            reference: Reference points of the R x A x E queries, or None to use the radar
                only.
            train: Whether to apply dropout, which needs the "dropout" random stream.

        Returns:
            `[B, R, A, C]` fused map.
        """
        b, r, a, c = radar.shape
        options = self.options
        if options.necks:
            radar = self._neck("radar_neck")(radar)
        dropout: Callable[[Map], Map] = nn.Dropout(
            options.dropout, deterministic=not train
        )
        if camera is None or reference is None:
            return dropout(radar)
        if options.necks:
            camera = self._neck("camera_neck")(camera)
        weights = lifting.WeightingNetwork(
            options.num_elevation, options.weighting, dtype=self.dtype, name="weighting"
        )(elevation)  # [B, R, A, E]
        scale = weights * reference.is_valid
        mean = lifting.query_weights(
            jnp.asarray(reference.is_valid), options.out_of_view
        )

        def per_bin(x: Real[Array, "_ R A ..."]) -> Real[jax.Array, "_ bins ..."]:
            return jnp.asarray(x).reshape(x.shape[0], r * a, *x.shape[3:])

        counts = options.num_heads, options.num_points, options.chunk_size
        attention = DeformableAttention(c, *counts, dtype=self.dtype, name="attention")
        points = per_bin(reference.points)
        seen = attention(per_bin(radar), per_bin(scale), points, per_bin(mean), camera)
        seen = seen.reshape(b, r, a, c)
        share = self._camera_share(radar, seen)
        has_camera = mean.sum(-1, keepdims=True) > 0  # bins with queries in the mean
        if reference.has_image is not None:
            has_camera &= jnp.asarray(reference.has_image)[:, None, None, None]
        share = share * has_camera.astype(share.dtype)
        self.sow("intermediates", "camera_share", share.mean(-1))
        return dropout(share * seen + (1 - share) * radar)

    def _neck(self, name: str) -> DilatedNeck:
        return DilatedNeck(
            num_groups=self.num_groups, dtype=self.dtype, remat=self.remat, name=name
        )

    def _camera_share(self, radar: Map, seen: Map) -> Float[jax.Array, "B R A #C"]:
        """Returns the weight of the camera per bin, for every channel or for all together."""
        c = radar.shape[-1]
        x = jnp.concatenate([radar, seen], -1)
        if self.options.gate == "bin":
            x = nn.relu(Dense(c // 2, dtype=self.dtype, name="gate_hidden")(x))
            return nn.sigmoid(Dense(1, dtype=self.dtype, name="gate_out")(x))
        x = nn.relu(Dense(c, dtype=self.dtype, name="gate_hidden")(x))
        return 1 - nn.sigmoid(Dense(c, dtype=self.dtype, name="gate_out")(x))
