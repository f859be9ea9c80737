"""Fusion of the radar map with camera features at the projections of the radar queries.

References:
    DinoRADE, sections 3.3 to 3.5. Where the released code differs from the paper, the
    options `weighting`, `gate` and `out_of_view` select either.
"""

from __future__ import annotations

from typing import Literal, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float, Real

from radejax.core.errors import BELOW_ONE, SIZE, check_options, integer, one_of
from radejax.core.structures import Array
from radejax.models import lifting
from radejax.models.deformable_attention import DeformableAttention
from radejax.models.heads import DilatedNeck
from radejax.models.layers import Dense, Map, Part
from radejax.models.lifting import OutOfViewRule, ReferencePoints, WeightingKind

GateKind = Literal["channel", "bin"]


class Fusion(Part):
    """Weighted lifting, deformable attention to the camera map, and gated sum with the radar.

    Attributes:
        num_heads: Number of attention heads.
        num_points: Samples per head and query.
        num_elevation: Number E of elevation segments.
        weighting: Network for the elevation weights, "mlp" (paper), "cnn" (released code)
            or "off"; see `WeightingNetwork`.
        gate: "channel" predicts a weight of the radar for every channel of a bin, as in
            the paper. "bin" predicts one weight of the camera per bin, as in the released
            code.
        out_of_view: Treatment of queries outside the image. "drop" excludes them from the
            mean over a bin's queries, and a bin without valid queries keeps its radar
            feature. "official" sets them to zero, but they still sample the image border
            and enter the mean.
        necks: Whether to apply a dilated neck to each map before the attention. The
            released settings have these necks, and the paper's 31 M parameters include
            them.
        dropout: Dropout rate of the fused map.
        num_groups: Groups of the necks' normalizations.
        chunk_size: Bins per chunk of the attention; 0 selects a default for the platform.
        remat: Recompute the necks in the backward pass instead of storing their blocks.
    """

    num_heads: int = 4
    num_points: int = 4
    num_elevation: int = 10
    weighting: WeightingKind = "mlp"
    gate: GateKind = "channel"
    out_of_view: OutOfViewRule = "drop"
    necks: bool = True
    dropout: float = 0.1
    chunk_size: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        ranges = {
            **dict.fromkeys(("num_heads", "num_points", "num_elevation"), SIZE),
            "chunk_size": integer(0, 1 << 16),
            "weighting": one_of(*get_args(WeightingKind)),
            "gate": one_of(*get_args(GateKind)),
            "out_of_view": one_of(*get_args(OutOfViewRule)),
            "dropout": BELOW_ONE,
        }
        check_options(vars(self), "config.model.fusion", ranges)

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
        if self.necks:
            radar = self._neck("radar_neck")(radar)
        dropout = nn.Dropout(self.dropout, deterministic=not train)
        if camera is None or reference is None:
            return dropout(radar)
        if self.necks:
            camera = self._neck("camera_neck")(camera)
        weights = lifting.WeightingNetwork(
            self.num_elevation, self.weighting, dtype=self.dtype, name="weighting"
        )(elevation)  # [B, R, A, E]
        scale = weights * reference.is_valid
        mean = lifting.query_weights(jnp.asarray(reference.is_valid), self.out_of_view)

        def per_bin(x: Real[Array, "_ R A ..."]) -> Real[jax.Array, "_ bins ..."]:
            return jnp.asarray(x).reshape(x.shape[0], r * a, *x.shape[3:])

        counts = self.num_heads, self.num_points, self.chunk_size
        attention = DeformableAttention(c, *counts, dtype=self.dtype, name="attention")
        points, means = per_bin(reference.points), per_bin(mean)
        seen = attention(per_bin(radar), per_bin(scale), points, means, camera)
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
        if self.gate == "bin":
            x = nn.relu(Dense(c // 2, dtype=self.dtype, name="gate_hidden")(x))
            return nn.sigmoid(Dense(1, dtype=self.dtype, name="gate_out")(x))
        x = nn.relu(Dense(c, dtype=self.dtype, name="gate_hidden")(x))
        return 1 - nn.sigmoid(Dense(c, dtype=self.dtype, name="gate_out")(x))
