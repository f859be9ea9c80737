"""Options of the detectors and of their parts: `config.model` and its sections."""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Annotated, Literal, Self

import numpy as np
import pydantic
from annotated_types import Ge, Gt, Le, Lt, MinLen
from flax.core import freeze
from jaxtyping import Float

from radejax.core.errors import require
from radejax.core.options import BelowOne, Options, Positive, Size, find_part
from radejax.core.structures import BOX_FIELDS, CLASSES, Array
from radejax.geometry.radar_grid import RadarGrid, is_uniform, values_at
from radejax.models.backbone import BACKBONES, CBAMS, Backbone, SkipAttention
from radejax.models.heads import HEADS, NECKS, Head, Neck
from radejax.models.image import STRIDE

AttentionKind = Literal["auto", "blocked", "xla", "cudnn"]
WeightingKind = Literal["mlp", "cnn", "off"]
OutOfViewRule = Literal["drop", "official"]
Bins = Annotated[int, Ge(0), Le(1 << 16)]
Axis = Annotated[tuple[float, ...], MinLen(2)]

_TAKEN = {"heatmap", "box", "frame", "cls", "score", "probability", *BOX_FIELDS}
"""Names of heads, and columns of boxes."""

MARGIN_PX = 280
"""Columns at the left and right border that `out_of_view="official"` treats as out of view.

They are a remnant of square crops of images 1280 pixels wide.
"""


class RadeNetOptions(Options, section="config.model"):
    """Options of `RadeNet`."""

    name: str = "radenet"
    """Architecture: radenet, dinorade or module:Class of a class derived from either."""
    num_classes: Size = len(CLASSES)
    """Number of classes, the channels of the heatmap; must equal the length of `classes`."""
    doppler_bins: Bins = 64
    """Doppler bins of the radar, the first channels of a projection; 0 without Doppler."""
    elevation_bins: Bins = 37
    """Elevation bins of the radar, the channels that follow; 0 without elevation."""
    widths: Annotated[tuple[Size, ...], MinLen(1)] = (128, 256, 512)
    """Channels of the encoder levels, finest first."""
    decoder_width: Size = 128
    """Channels of the last decoder stage, neck and heads."""
    num_groups: Size = 32
    """Groups of every group normalization; must divide every width."""
    cbam: str = "official"
    """Attention on the skip connections: official (the released block), paper (attention
    only), off or module:Class."""
    input_stem: bool = False
    """Separate convolutions for Doppler and elevation channels at the input."""
    backbone: str = "unet"
    """unet or module:Class."""
    neck: str = "dilated"
    """dilated, plain or module:Class."""
    heads: str = "expanded"
    """expanded, default or module:Class."""
    pad_multiple: Size = 8
    """Maps are padded to a multiple of this, itself a multiple of 2 to the power of the number
    of encoder levels."""
    crop_output: bool = True
    """Crop the padded output to the bins of the projection."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Dtype of the computation. Parameters and outputs are float32."""
    remat: Literal["none", "blocks", "full"] = "none"
    """Activations that the backward pass recomputes to save memory: none, blocks (all but
    those between blocks) or full (all but those between backbone, neck and heads)."""
    heatmap_prior: Annotated[float, Gt(0), Lt(1)] = 0.5
    """Score that an untrained model predicts, between 0 and 1; 0.5 in the authors' code. A
    lower value (0.1 in CenterNet) suits mostly empty scenes."""
    input_center: float = 0.0
    """Subtracted from the projection; 0 in the paper. Noise is about 0.63."""
    input_scale: Positive = 1.0
    """Multiplied with the projection after the subtraction, above 0; 1 in the paper. An echo
    10 dB above the noise differs from it by 0.054, and with a factor of 20 by 1.1, which is a
    usual magnitude of a network's input."""
    beam_azimuth_deg: Axis | None = None
    """Azimuth of the first bin and the step, or of all bins, in degrees, positive to the right (see
    `azimuth_axis_deg`). The heads then predict offsets and yaws relative to the direction of the
    beam, for radars that scan 360 degrees: convolutions do not know the azimuth that they would
    need for the usual yaws. None: relative to the vehicle, as in the paper."""
    outputs: Annotated[
        Mapping[str, Size],
        pydantic.AfterValidator(freeze),
        pydantic.PlainSerializer(dict),
    ] = freeze({})
    """Further outputs per bin, by name, and their channels, such as {"velocity": 2}. Each
    has a head of its own."""

    @pydantic.model_validator(mode="after")
    def _check_radenet(self) -> Self:
        find_part(self.backbone, "config.model.backbone", BACKBONES, Backbone)
        find_part(self.cbam, "config.model.cbam", CBAMS, SkipAttention)
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
            require(is_multiple, f"config.model.{name}", width, expected)
        expected = f"names other than {', '.join(sorted(_TAKEN))}"
        is_new = _TAKEN.isdisjoint(self.outputs)
        require(is_new, "config.model.outputs", dict(self.outputs), expected)
        return self


class ViTOptions(Options, section="config.model.image"):
    """Options of `ViT`. The defaults are DINOv3 ViT-S/16."""

    hidden_size: Size = 384
    """Channels of the transformer, a multiple of 4 times `num_heads`."""
    num_layers: Size = 12
    """Layers of the transformer."""
    num_heads: Size = 6
    """Attention heads of the transformer."""
    mlp_dim: Size = 1536
    """Hidden channels of its MLPs."""
    patch_size: Size = 16
    """Pixels per patch and axis."""
    num_registers: Bins = 4
    """Register tokens, which are learned in addition to the class token."""
    gated_mlp: bool = False
    """SwiGLU MLPs, as in the larger DINOv3 models, instead of GELU."""
    layer_scale: float = 1.0
    """Initial value of the learned scales of the residual branches; DINOv3's come with the
    weights."""
    position_grid: Annotated[int, Ge(0), Le(1 << 10)] = 0
    """Patches per axis of DINOv2's learned position embedding, which is interpolated to the
    patches of the image; 0: DINOv3's rotary embedding. The epsilon of the normalizations is
    that of the same model."""
    attention: AttentionKind = "auto"
    """Implementation of the attention: auto, or one of `radejax.models.vit.attend`."""

    @pydantic.model_validator(mode="after")
    def _check_heads(self) -> Self:
        size = self.hidden_size
        expected = f"a multiple of 4 channels for each of {self.num_heads} heads"
        is_multiple = size % (4 * self.num_heads) == 0
        require(is_multiple, "config.model.image.hidden_size", size, expected)
        return self

    @property
    def num_prefix(self) -> int:
        """Number of tokens before the first patch."""
        return 1 + self.num_registers

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Returns the rows and columns of patches of an image, rounded half up."""
        size = self.patch_size
        return (height + size // 2) // size, (width + size // 2) // size


class ImageOptions(ViTOptions):
    """Options of the image backbone of `DinoRade`."""

    kind: Literal["vit", "resnet50"] = "vit"
    """vit or resnet50."""
    size: tuple[Size, Size] = (720, 1280)
    """Height and width of the images in pixels. The transformer resizes them to the nearest
    multiples of its patch size; reference points are fractions of height and width, so that
    they also apply to resized images."""
    freeze: bool = True
    """Keep the image backbone fixed."""
    standardize: bool = True
    """Normalize by ImageNet's mean and standard deviation; otherwise scale to [0, 1]."""
    resnet_width: Size = 64
    """Channels of the ResNet's stem; 64 in ResNet-50."""

    @pydantic.model_validator(mode="after")
    def _check_image(self) -> Self:
        is_vit = self.kind == "vit"
        expected = "True for a ResNet, whose first stages have fixed batch statistics"
        is_possible = self.freeze or is_vit
        require(is_possible, "config.model.image.freeze", self.freeze, expected)
        least, step = (self.patch_size, 1) if is_vit else (STRIDE, STRIDE)
        is_possible = all(n >= least and n % step == 0 for n in self.size)
        expected = f"height and width of at least {least} pixels, multiples of {step}"
        require(is_possible, "config.model.image.size", self.size, expected)
        return self

    @property
    def feature_shape(self) -> tuple[int, int, int]:
        """Shape `(h, w, C)` of one image's features."""
        height, width = self.size
        if self.kind == "vit":
            return (*self.grid(height, width), self.hidden_size)
        return height // STRIDE, width // STRIDE, 16 * self.resnet_width


class FusionOptions(Options, section="config.model.fusion"):
    """Options of `Fusion`."""

    num_heads: Size = 4
    """Heads of the deformable attention; must divide `decoder_width`."""
    num_points: Size = 4
    """Sampling points per head and query."""
    num_elevation: Size = 10
    """Queries per bin, at different elevations."""
    weighting: WeightingKind = "mlp"
    """Network for the elevation weights: mlp (paper), cnn (released) or off, see
    `radejax.models.lifting.WeightingNetwork`."""
    gate: Literal["channel", "bin"] = "channel"
    """Gate: channel (a weight of the radar for every channel of a bin, as in the paper) or bin
    (one weight of the camera per bin, as released)."""
    out_of_view: OutOfViewRule = "drop"
    """Queries outside the image: drop excludes them from the mean over a bin's queries, and a
    bin without valid queries keeps its radar feature. official sets them to zero, but they
    still sample the image border and enter the mean."""
    necks: bool = True
    """A dilated neck on each map before the attention. The released settings have these necks,
    and the paper's 31 M parameters include them."""
    dropout: BelowOne = 0.1
    """Dropout rate on the fused map, from 0 to below 1."""
    chunk_size: Bins = 0
    """Bins that are attended at a time; 0: chosen by platform."""


class QueryGridOptions(Options, section="config.model.query_grid"):
    """Axes of the centers of the radar queries in range, azimuth and elevation."""

    range_m: Axis
    """Center of the first query in range and the step, in meters; or the centers of all bins,
    of which there are at least three, if they are not uniform."""
    azimuth_deg: Axis
    """The same in azimuth, in degrees, positive to the right."""
    elevation_deg: tuple[float, float]
    """Start and end in degrees, positive up, of the interval that `fusion.num_elevation`
    segments divide. Use (18, -18) for a tensor whose elevation axis points down; code bases
    disagree about K-Radar's."""

    @classmethod
    def of_grid(cls, grid: RadarGrid) -> Self:
        """Returns axes through the bin centers of the grid, which continue into padding.

        A grid with fewer than two elevations gets those of K-Radar, -18 to 18 degrees.
        """
        elevation = grid.elevation_rad
        if elevation.size < 2:
            elevation = RadarGrid.kradar().elevation_rad
        return cls(
            range_m=_first_and_step(grid.range_m, grid.range_step_m).tolist(),
            azimuth_deg=azimuth_axis_deg(grid),
            elevation_deg=np.rad2deg(elevation[[0, -1]]).tolist(),
        )

    @classmethod
    def official(cls) -> Self:
        """Returns the authors' code's axes, 256 range and 112 azimuth bins in the FOV."""
        return cls(
            range_m=(118 / 256 / 2, 118 / 256),
            azimuth_deg=(-53 + 106 / 112 / 2, 106 / 112),
            elevation_deg=(-18.0, 18.0),
        )

    def centers_ego(
        self,
        num_range: int,
        num_azimuth: int,
        num_elevation: int,
        xp: types.ModuleType = np,
    ) -> Float[Array, "{num_range} {num_azimuth} {num_elevation} 3"]:
        """Returns the query centers `[R, A, E, 3]` in the ego frame in meters.

        They are computed as an outer product of small tables, so that with `jax.numpy` as
        `xp` a compiled program does not contain all centers as a constant. The result is
        float64 for NumPy and float32 for JAX.
        """
        range_m = axis_centers(self.range_m, num_range)
        azimuth = np.deg2rad(axis_centers(self.azimuth_deg, num_azimuth))
        low, high = self.elevation_deg
        part = (np.arange(num_elevation) + 0.5) / num_elevation
        elevation = np.deg2rad(low + (high - low) * part)
        x = np.cos(elevation) * np.cos(azimuth)[:, None]  # [A, E]
        y = -np.cos(elevation) * np.sin(azimuth)[:, None]
        axes = np.broadcast_arrays(x, y, np.sin(elevation))
        dtype = np.float64 if xp is np else np.float32
        unit = xp.asarray(np.stack(axes, -1)[None], dtype)
        centers: Array = xp.asarray(range_m.reshape(-1, 1, 1, 1), dtype) * unit
        return centers


def azimuth_axis_deg(grid: RadarGrid) -> tuple[float, ...]:
    """Returns the first azimuth and the step of a grid in degrees, or all azimuths if they are not
    uniform.

    Examples:
        >>> [round(value, 6) for value in azimuth_axis_deg(RadarGrid.kradar())]
        [-53.0, 1.0]
    """
    azimuth = _first_and_step(grid.azimuth_rad, grid.azimuth_step_rad)
    return tuple(np.rad2deg(azimuth).tolist())


def _first_and_step(axis: Float[np.ndarray, " bins"], step: float) -> np.ndarray:
    """Returns the first center of an axis and its step, or all centers of an uneven axis."""
    return np.array([axis[0], step]) if is_uniform(axis) else axis


def axis_centers(axis: tuple[float, ...], count: int) -> Float[np.ndarray, " {count}"]:
    """Returns the centers of an axis, which continues into padding.

    Args:
        axis: First center and step, or all centers.
        count: Number of centers.

    Examples:
        >>> axis_centers((-2.0, 1.5), 3).tolist(), axis_centers((0.0, 1.0, 4.0), 4).tolist()
        ([-2.0, -0.5, 1.0], [0.0, 1.0, 4.0, 7.0])
    """
    if len(axis) == 2:
        return axis[0] + axis[1] * np.arange(count)
    return values_at(np.array(axis), np.arange(count))


class DinoRadeOptions(RadeNetOptions):
    """Options of `DinoRade`."""

    name: str = "dinorade"
    image: ImageOptions = ImageOptions()
    """The image backbone."""
    fusion: FusionOptions = FusionOptions()
    """Fusion of radar and camera map."""
    query_grid: QueryGridOptions = QueryGridOptions.of_grid(RadarGrid.kradar())
    """Axes of the centers of the radar queries."""

    @pydantic.model_validator(mode="after")
    def _check_camera(self) -> Self:
        size = self.image.size
        expected = (
            f"a width above {2 * MARGIN_PX} for config.model.fusion.out_of_view = "
            f"'official', which leaves out {MARGIN_PX} pixels left and right"
        )
        is_possible = self.fusion.out_of_view == "drop" or size[1] > 2 * MARGIN_PX
        require(is_possible, "config.model.image.size", size, expected)
        kind = self.fusion.weighting
        is_possible = self.elevation_bins > 0 or kind == "off"
        expected = "'off' without elevation channels"
        require(is_possible, "config.model.fusion.weighting", kind, expected)
        heads = self.fusion.num_heads
        width = self.decoder_width
        expected = f"a divisor of decoder_width = {width}"
        require(width % heads == 0, "config.model.fusion.num_heads", heads, expected)
        return self


OFFICIAL_RADENET = RadeNetOptions(crop_output=False)
"""RADE-Net as released."""

OFFICIAL_DINORADE = DinoRadeOptions(
    input_stem=True,
    crop_output=False,
    fusion=FusionOptions(
        num_points=8, weighting="cnn", gate="bin", out_of_view="official"
    ),
    query_grid=QueryGridOptions.official(),
)
"""DinoRADE as released, with its geometry."""
