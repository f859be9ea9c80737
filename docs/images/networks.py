"""Draws both networks with the shapes that their modules take and return.

Shapes, channels and numbers of parameters are read from the models of configs/radenet.py and
configs/dinorade.py while they are traced (`flax.linen.intercept_methods`); only the positions are
written here.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from sheet import Block, Sheet

from radejax import models
from radejax.config import load_config
from radejax.data.cameras import no_images
from radejax.geometry.radar_grid import RadarGrid

ROOT = pathlib.Path(__file__).resolve().parents[2]
# White text has a contrast of at least 4.5:1 on each.
DATA, RADAR, ATTENTION, CAMERA, HEADS = (
    "#4C566A",
    "#2A767D",
    "#85621A",
    "#A84A5B",
    "#3E6990",
)
COLUMNS = (89.0, 280.0, 470.0, 661.0)  # centers in a page of 750 pixels


# Shapes of the models -----------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Network:
    """A network that was traced with one frame.

    Attributes:
        model: The module.
        inputs: Shapes of what it was called with.
        calls: Shapes that its parts were called with and returned, by name.
        parameters: How many every part of the first level has.
        kinds: Class of every part, by name.
    """

    model: Any
    inputs: tuple[Any, ...]
    calls: Mapping[str, tuple[Any, Any]]
    parameters: Mapping[str, int]
    kinds: Mapping[str, str]

    @classmethod
    def of(cls, config_path: str) -> Network:
        """The network of a config on K-Radar's sensor; nothing is computed."""
        config, grid = load_config(str(ROOT / config_path)), RadarGrid.kradar()
        model = models.build(config.model)
        inputs: tuple[Any, ...] = (np.zeros((1, *grid.projection_shape), np.float32),)
        if models.has_camera(model):
            inputs += no_images(1, model.options.image.size)
        kinds: dict[str, str] = {}

        def run(*inputs: Any) -> Any:
            calls: dict[str, tuple[Any, Any]] = {}

            def record(call: Any, args: Any, kwargs: Any, context: Any) -> Any:
                output = call(*args, **kwargs)
                path = context.module.path
                if context.method_name == "__call__" and 1 <= len(path) <= 2:
                    calls["/".join(path)] = (args, output)
                    kinds["/".join(path)] = type(context.module).__name__
                return output

            with nn.intercept_methods(record):
                return model.init(jax.random.key(0), *inputs), calls

        variables, calls = jax.eval_shape(run, *inputs)
        sizes = {
            name: sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))
            for name, tree in variables["params"].items()
        }
        return cls(model, inputs, calls, sizes, kinds)

    def taken(self, name: str) -> str:
        """Shape of a part's first argument."""
        return _size(self.calls[name][0][0].shape)

    def given(self, name: str) -> str:
        """Shape of what a part returns."""
        return _size(self.calls[name][1].shape)

    def count(self, *names: str) -> str:
        """Parameters of some parts in millions."""
        return f"{sum(self.parameters[name] for name in names) / 1e6:.1f} M"

    @property
    def num_levels(self) -> int:
        """Levels of the encoder."""
        return sum(name.startswith("backbone/encoder_") for name in self.calls)


def _size(shape: Sequence[int]) -> str:
    """Without the batch: "256 x 112 x 128"."""
    return " × ".join(map(str, shape[1:]))


# RADE-Net ----------------------------------------------------------------------------


def radenet(net: Network) -> Sheet:
    """Encoder down the left, skips through CBAM, decoder up, neck and heads on the right."""
    sheet = Sheet(
        750, 546, "RADE-Net: a radar tensor passes two projections, an encoder, skip "
        "connections with CBAM, a decoder, a neck and two heads, and becomes detections."
    )  # fmt: skip
    options, grid = net.model.options, RadarGrid.kradar()
    rows = [232.0 + 92.0 * level for level in range(net.num_levels + 1)]
    x_encoder, x_cbam, x_decoder, x_heads = COLUMNS
    tensor = sheet.block(
        x_encoder, 38, title="4D radar tensor", color=DATA,
        lines=(_size((0, *grid.shape_drea)), "Doppler, range, elev., az."),
    )  # fmt: skip
    projection = sheet.block(
        x_encoder, 128, title="Projections", color=DATA, height=82,
        lines=(
            _size(net.inputs[0].shape),
            f"{options.doppler_bins}: max over elevation",
            f"{options.elevation_bins}: max over Doppler",
        ),
    )  # fmt: skip
    sheet.arrow(tensor.bottom, projection.top)
    before, encoders = projection, []
    for level, y in enumerate(rows[:-1], 1):
        name = f"backbone/encoder_{level}"
        lines = [f"padded {net.taken('backbone')}"] if level == 1 else []
        encoder = sheet.block(
            x_encoder, y, title=f"Encoder {level}", color=RADAR,
            lines=[*lines, f"to {net.given(name)}"],
        )  # fmt: skip
        sheet.arrow(before.bottom, encoder.top)
        encoders.append(encoder)
        before = encoder
    last = max(n for n in net.calls if n.startswith("backbone/bottleneck_"))
    bottleneck = sheet.block(
        x_cbam, rows[-1], title="Bottleneck", lines=[net.given(last)], color=RADAR
    )
    sheet.arrow(before.bottom, (x_encoder, rows[-1]), bottleneck.left)
    below, way = bottleneck.right, [(x_decoder, rows[-1])]
    for number in range(1, net.num_levels + 1):
        y, skip = rows[net.num_levels - number], encoders[net.num_levels - number]
        name = f"backbone/decoder_{number}"
        decoder = sheet.block(
            x_decoder, y, title=f"Decoder {number}", color=RADAR,
            lines=(f"from {net.taken(name)}", f"to {net.given(name)}"),
        )  # fmt: skip
        if f"backbone/cbam_{number}" in net.calls:
            cbam = sheet.block(
                x_cbam, y, title="CBAM", color=ATTENTION, lines=["channel and spatial"]
            )
            sheet.arrow(skip.right, cbam.left)
            sheet.arrow(cbam.right, decoder.left)
        else:
            sheet.arrow(skip.right, decoder.left)
        sheet.arrow(below, *way, decoder.bottom)
        below, way = decoder.top, []
    neck = _neck_and_heads(sheet, net, rows[0])
    sheet.arrow(decoder.right, neck.left)
    sheet.block(
        (x_cbam + x_heads) / 2, 83, width=549, height=156, color=DATA,
        title=f"RADE-Net: {net.count(*net.parameters)} parameters, all trained",
        lines=(
            f"backbone {net.count('backbone')}, neck {net.count('neck')}, "
            f"heads {net.count('heads')}",
            "",
            "Shapes: range × azimuth × channels, of configs/radenet.py.",
            "Encoders and decoders have one block, the bottleneck has two: two 3 × 3",
            "convolutions with group normalization and SiLU, and a residual. Another",
            "3 × 3 convolution precedes encoder 1.",
            "Max pooling 2 × 2 between encoders, upsampling 2 × 2 before decoders.",
        ),
    )  # fmt: skip
    return sheet


def _neck_and_heads(sheet: Sheet, net: Network, y: float) -> Block:
    """Neck, heads and decoding, which both networks share, downwards; returns the neck."""
    x = COLUMNS[-1]
    num_blocks = sum(name.startswith("neck/block_") for name in net.calls)
    neck = sheet.block(
        x, y, title="Neck", color=RADAR,
        lines=(f"{num_blocks} dilated residual blocks", net.given("neck")),
    )  # fmt: skip
    maps = net.calls["heads"][1]
    bins = _size(net.inputs[0].shape[:3])
    cropped = [f"cropped to {bins}"] if net.model.options.crop_output else []
    heads = sheet.block(
        x, y + 100, title="Heads", color=HEADS, height=82,
        lines=(
            f"heatmap {_size(maps.heatmap_logits.shape)}",
            f"boxes {_size(maps.box_params.shape)}",
            *cropped,
        ),
    )  # fmt: skip
    found = sheet.block(
        x, y + 200, title="Detections", color=DATA,
        lines=("3 × 3 peaks,", "rotated NMS"),
    )  # fmt: skip
    sheet.arrow(neck.bottom, heads.top)
    sheet.arrow(heads.bottom, found.top)
    return neck


# DinoRADE ----------------------------------------------------------------------------


def dinorade(net: Network) -> Sheet:
    """Radar branch above, camera branch below, deformable attention between them."""
    sheet = Sheet(
        750, 520, "DinoRADE: radar queries sample the features of a frozen image backbone "
        "by deformable attention, and a gate mixes the result with the radar features."
    )  # fmt: skip
    top, middle, low, bottom = 48.0, 150.0, 250.0, 350.0
    left, second, third, right = COLUMNS
    projection = sheet.block(
        left, top, title="Projections", color=DATA,
        lines=(_size(net.inputs[0].shape), f"padded {net.taken('backbone')}"),
    )  # fmt: skip
    backbone = sheet.block(
        second, top, title="Backbone", color=RADAR, height=82,
        lines=(
            "RADE-Net's, two stems",
            net.given("backbone"),
            f"{net.count('backbone')} parameters",
        ),
    )  # fmt: skip
    radar_neck = sheet.block(
        third, top, title="Radar neck", color=RADAR,
        lines=[net.given("image_fusion/radar_neck")],
    )  # fmt: skip
    sheet.arrow(projection.right, backbone.left)
    sheet.arrow(backbone.right, radar_neck.left)
    weighting = sheet.block(
        second, middle, title="Elevation weights", color=ATTENTION,
        lines=(
            f"from {net.taken('image_fusion/weighting')}",
            f"to {net.given('image_fusion/weighting')}",
        ),
    )  # fmt: skip
    sheet.arrow(projection.bottom, (left, middle), weighting.left)
    queries = _size(net.calls["image_fusion"][0][3].is_valid.shape)
    calibration = sheet.block(
        left, low, title="Calibration", color=DATA, lines=["of each sequence"]
    )
    points = sheet.block(
        second, low, title="Reference points", color=CAMERA,
        lines=(queries, "in the image"),
    )  # fmt: skip
    sheet.arrow(calibration.right, points.left)
    image = sheet.block(
        left, bottom, title="Image", lines=[_size(net.inputs[1].shape)], color=DATA
    )
    is_frozen = net.model.options.image.freeze
    vit = sheet.block(
        second, bottom, title="DINOv3 ViT-S", color=CAMERA, height=82,
        is_frozen=is_frozen,
        lines=(
            "frozen" if is_frozen else "trained",
            f"patches {net.taken('image_neck')}",
            f"{net.count('image_backbone')} parameters",
        ),
    )  # fmt: skip
    neck = sheet.block(
        third, bottom, title="Camera neck", color=CAMERA, height=82,
        lines=(
            "two upsampling stages",
            net.given("image_neck"),
            f"{net.count('image_neck')} parameters",
        ),
    )  # fmt: skip
    dilated = sheet.block(
        third, low, title="Dilated neck", color=CAMERA,
        lines=(net.given("image_fusion/camera_neck"),),
    )  # fmt: skip
    sheet.arrow(image.right, vit.left)
    sheet.arrow(vit.right, neck.left)
    sheet.arrow(neck.top, dilated.bottom)
    fusion = net.model.options.fusion
    attention = sheet.block(
        third, middle, title="Deformable attention", color=ATTENTION, height=82,
        lines=(
            f"{queries} queries",
            f"{fusion.num_heads} heads, {fusion.num_points} points each",
            "mean over elevation",
        ),
    )  # fmt: skip
    sheet.arrow(radar_neck.bottom, attention.top)
    sheet.arrow(weighting.right, attention.left)
    sheet.arrow(dilated.top, attention.bottom)
    between = (second + third) / 2
    entry = middle + 26
    sheet.arrow(
        points.right, (between, low), (between, entry), (attention.left[0], entry)
    )
    gate = sheet.block(
        right, top, title="Gate", color=ATTENTION, height=82,
        lines=("Γ: weight of the radar", "per bin and channel", net.given("image_fusion")),
    )  # fmt: skip
    sheet.arrow(radar_neck.right, gate.left)
    between = (third + right) / 2
    entry = top + 26
    sheet.arrow(
        attention.right, (between, middle), (between, entry), (gate.left[0], entry)
    )
    head_neck = _neck_and_heads(sheet, net, middle)
    sheet.arrow(gate.bottom, head_neck.top)
    return _totals(sheet, net)


def _totals(sheet: Sheet, net: Network) -> Sheet:
    """Adds the numbers of trained and frozen parameters below DinoRADE."""
    frozen = ["image_backbone"] if net.model.options.image.freeze else []
    trained = [name for name in net.parameters if name not in frozen]
    total = f"DinoRADE: {net.count(*trained)} parameters trained"
    sheet.block(
        375, 460, width=740, height=96, color=DATA,
        title=total + (f", {net.count(*frozen)} frozen" if frozen else ""),
        lines=(
            f"of the trained: backbone {net.count('backbone')}, fusion "
            f"{net.count('image_fusion')}, camera neck {net.count('image_neck')},",
            f"neck {net.count('neck')}, heads {net.count('heads')}",
            "Shapes: range × azimuth (× elevation) × channels; camera: height × width × "
            "channels; of configs/dinorade.py.",
        ),
    )  # fmt: skip
    return sheet


SHEETS = {
    "radenet": ("configs/radenet.py", radenet),
    "dinorade": ("configs/dinorade.py", dinorade),
}


def draw(out: pathlib.Path) -> None:
    """Write radenet.svg and dinorade.svg into a folder."""
    for name, (config, lay_out) in SHEETS.items():
        text = lay_out(Network.of(config)).svg()
        (out / f"{name}.svg").write_text(text, encoding="utf-8")
