"""Draws both networks with the shapes that their modules take and return.

    python docs/images/networks.py

writes docs/images/radenet.png and docs/images/dinorade.png. Shapes, channels and numbers of
parameters are read from the models of configs/radenet.py and configs/dinorade.py while they
are traced (`flax.linen.intercept_methods`); only the positions are written here.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from sheet import Block, Point, Sheet

from radejax import models
from radejax.config import load_config
from radejax.data.cameras import no_images
from radejax.geometry.radar_grid import RadarGrid

ROOT = pathlib.Path(__file__).resolve().parents[2]
DATA, RADAR, ATTENTION, CAMERA, HEADS = (
    "#4C566A",
    "#2F7F86",
    "#B58A2B",
    "#A84A5B",
    "#3E6990",
)


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

    def count(self, name: str) -> str:
        """Parameters of a part in millions."""
        return f"{self.parameters[name] / 1e6:.2f} M parameters"

    @property
    def num_levels(self) -> int:
        """Levels of the encoder."""
        return sum(name.startswith("backbone/encoder_") for name in self.calls)


def _size(shape: Sequence[int]) -> str:
    """Without the batch: "256 x 112 x 128"."""
    return " × ".join(map(str, shape[1:]))


# RADE-Net ----------------------------------------------------------------------------


def radenet(net: Network) -> Sheet:
    """Encoder down the left, skips through CBAM, decoder up the right, neck, heads."""
    sheet = Sheet(15.0, 6.9)
    levels = net.num_levels
    rows = [5.6 - 1.35 * level for level in range(levels + 1)]
    x_encoder, x_cbam, x_decoder = 5.0, 7.15, 9.3
    options = net.model.options
    doppler, elevation = options.doppler_bins, options.elevation_bins
    grid = RadarGrid.kradar()
    tesseract = sheet.block(
        1.05, rows[0], 1.7, 1.0, title="4D radar tensor", color=DATA,
        lines=(_size((0, *grid.shape_drea)), "Doppler, range,", "elevation, azimuth"),
    )  # fmt: skip
    projection = sheet.block(
        2.95, rows[0], 1.6, 1.0, title="Projection", color=DATA,
        lines=(
            _size(net.inputs[0].shape),
            f"max over elevation: {doppler}",
            f"max over Doppler: {elevation}",
        ),
    )  # fmt: skip
    sheet.arrow(tesseract.right, projection.left)
    before, start = projection.right, "backbone/start"
    first = [f"padded {net.taken('backbone')}"]
    first += [f"{net.kinds[start]} to {net.given(start)}"] if start in net.calls else []
    encoders = []
    for level, y in enumerate(rows[:-1], 1):
        name = f"backbone/encoder_{level}"
        lines = [*(first if level == 1 else ()), net.given(name)]
        size = 1.75, 0.95 if level == 1 else 0.62
        block = sheet.block(
            x_encoder, y, *size, title=f"Encoder {level}", lines=lines, color=RADAR
        )
        if level == 1:
            sheet.arrow(before, block.left)
        else:
            sheet.arrow(encoders[-1].bottom, block.top)
        encoders.append(block)
    last = max(n for n in net.calls if n.startswith("backbone/bottleneck_"))
    bottleneck = sheet.block(
        x_cbam, rows[-1], 1.9, 0.62, title="Bottleneck", lines=[net.given(last)],
        color=RADAR,
    )  # fmt: skip
    corner = (x_encoder, rows[-1])
    sheet.arrow(encoders[-1].bottom, corner, bottleneck.left)
    sheet.notes.append((x_encoder + 0.1, rows[-1] + 0.48, "max pooling 2 × 2"))
    before, way = bottleneck.right, [(x_decoder, rows[-1])]
    for number in range(1, levels + 1):
        y, skip = rows[levels - number], encoders[levels - number]
        decoder = sheet.block(
            x_decoder, y, 1.75, 0.8, title=f"Decoder {number}", color=RADAR,
            lines=(
                f"from {net.taken(f'backbone/decoder_{number}')}",
                f"to {net.given(f'backbone/decoder_{number}')}",
            ),
        )  # fmt: skip
        if f"backbone/cbam_{number}" in net.calls:
            cbam = sheet.block(
                x_cbam, y, 1.7, 0.62, title="CBAM", color=ATTENTION,
                lines=["channel and spatial"],
            )  # fmt: skip
            sheet.arrow(skip.right, cbam.left)
            sheet.arrow(cbam.right, decoder.left)
        else:
            sheet.arrow(skip.right, decoder.left)
        sheet.arrow(before, *way, decoder.bottom)
        before, way = decoder.top, []
    sheet.notes.append((x_decoder + 0.1, rows[-1] + 0.48, "upsampling 2 × 2"))
    _neck_and_heads(sheet, net, decoder.right, x=11.35, y=rows[0])
    sheet.notes.append(
        (
            0.2,
            0.55,
            f"Backbone {net.count('backbone')}, neck {net.count('neck')}, heads "
            f"{net.count('heads')}. Shapes: range × azimuth × channels, from "
            "configs/radenet.py.\nEncoder, bottleneck and decoder: two 3 × 3 "
            "convolutions with group normalization and SiLU, and a residual.",
        )
    )
    return sheet


def _neck_and_heads(
    sheet: Sheet, net: Network, start: Point, *, x: float, y: float
) -> None:
    """Neck, heads and decoding, which both networks share."""
    blocks = [n for n in net.calls if n.startswith("neck/block_")]
    neck = sheet.block(
        x, y, 1.55, 0.95, title="Neck", color=RADAR,
        lines=(f"{len(blocks)} dilated residual", "blocks", net.given("neck")),
    )  # fmt: skip
    sheet.arrow(start, neck.left)
    maps = net.calls["heads"][1]
    heads = [
        ("Heatmap", maps.heatmap_logits, 0),
        ("Box parameters", maps.box_params, 1),
    ]
    found = sheet.block(
        x + 2.35, y - 2.7, 1.6, 0.8, title="Detections", color=DATA,
        lines=("3 × 3 peaks,", "rotated NMS"),
    )  # fmt: skip
    bins = _size(net.inputs[0].shape[:3])
    cropped = [f"cropped to {bins}"] if net.model.options.crop_output else []
    for title, shape, row in heads:
        y_head = y - 1.35 * row
        head = sheet.block(
            x + 2.35, y_head, 1.6, 0.8, title=title, color=HEADS,
            lines=[_size(shape.shape), *cropped],
        )  # fmt: skip
        fork = x + 1.15
        sheet.arrow(neck.right, (fork, y), (fork, y_head), head.left)
        if row:
            sheet.arrow(head.bottom, found.top)
        else:
            side = x + 3.4
            sheet.arrow(head.right, (side, y_head), (side, found.y), found.right)


# DinoRADE ----------------------------------------------------------------------------


def dinorade(net: Network) -> Sheet:
    """Radar branch above, camera branch below, deformable attention between them."""
    sheet = Sheet(16.4, 6.9)
    top, middle, low = 5.85, 3.85, 1.75
    padded = net.taken("backbone")
    projection = sheet.block(
        1.05, top, 1.7, 0.8, title="Projection", color=DATA,
        lines=(_size(net.inputs[0].shape), f"padded {padded}"),
    )  # fmt: skip
    backbone = sheet.block(
        3.45, top, 1.85, 0.95, title="Backbone", color=RADAR,
        lines=("RADE-Net's, dual stem", net.given("backbone"), net.count("backbone")),
    )  # fmt: skip
    radar_neck = sheet.block(
        5.85, top, 1.75, 0.62, title="Radar neck", color=RADAR,
        lines=[net.given("image_fusion/radar_neck")],
    )  # fmt: skip
    sheet.arrow(projection.right, backbone.left)
    sheet.arrow(backbone.right, radar_neck.left)
    weighting = sheet.block(
        3.45, middle, 1.85, 0.8, title="Elevation weights", color=ATTENTION,
        lines=(
            f"from {net.taken('image_fusion/weighting')}",
            f"to {net.given('image_fusion/weighting')}",
        ),
    )  # fmt: skip
    sheet.arrow(projection.bottom, (projection.x, middle), weighting.left)
    rows = net.calls["image_fusion"][0][3].is_valid.shape
    points = sheet.block(
        3.45, 2.6, 1.85, 0.8, title="Reference points", color=CAMERA,
        lines=(_size(rows), "from the calibration"),
    )  # fmt: skip
    camera = sheet.block(
        1.05, 2.6, 1.7, 0.62, title="Calibration", color=DATA,
        lines=["of each sequence"],
    )  # fmt: skip
    sheet.arrow(camera.right, points.left)
    image = sheet.block(
        1.05, 1.3, 1.7, 0.62, title="Image", lines=[_size(net.inputs[1].shape)],
        color=DATA,
    )  # fmt: skip
    vit = sheet.block(
        3.45, 1.3, 1.85, 0.95, title="ViT, frozen", color=CAMERA,
        lines=(
            "DINOv3 ViT-S/16",
            f"patches {net.taken('image_neck')}",
            net.count("image_backbone"),
        ),
    )  # fmt: skip
    neck = sheet.block(
        5.85, 1.3, 1.75, 0.95, title="Camera neck", color=CAMERA,
        lines=("two upsampling stages", net.given("image_neck"), net.count("image_neck")),
    )  # fmt: skip
    dilated = sheet.block(
        5.85, 2.6, 1.75, 0.8, title="Dilated neck", color=CAMERA,
        lines=("before the attention", net.given("image_fusion/camera_neck")),
    )  # fmt: skip
    sheet.arrow(image.right, vit.left)
    sheet.arrow(vit.right, neck.left)
    sheet.arrow(neck.top, dilated.bottom)
    return _fusion(
        sheet, net, radar_neck, weighting, points, dilated, (top, middle, low)
    )


def _fusion(
    sheet: Sheet,
    net: Network,
    radar: Block,
    weighting: Block,
    points: Block,
    camera: Block,
    rows: tuple[float, float, float],
) -> Sheet:
    """From queries and camera map to detections."""
    top, middle, _ = rows
    fusion = net.model.options.fusion
    attention = sheet.block(
        8.35, middle, 2.0, 1.15, title="Deformable attention", color=ATTENTION,
        lines=(
            f"{_size(net.calls['image_fusion'][0][3].is_valid.shape)} queries",
            f"{fusion.num_heads} heads, {fusion.num_points} points each",
            "mean over elevation",
        ),
    )  # fmt: skip
    sheet.arrow(weighting.right, attention.left)
    between = points.y + 0.62
    sheet.arrow(points.top, (points.x, between), (7.0, between), (7.0, middle - 0.25),
                (attention.left[0], middle - 0.25))  # fmt: skip
    sheet.arrow(camera.right, (attention.x, camera.y), attention.bottom)
    sheet.arrow(radar.right, (attention.x - 0.3, top), (attention.x - 0.3, top - 0.3),
                (attention.x - 0.3, attention.top[1]))  # fmt: skip
    gate = sheet.block(
        10.75, top, 1.7, 0.95, title="Gate", color=ATTENTION,
        lines=("weight of the camera", "per bin and channel", net.given("image_fusion")),
    )  # fmt: skip
    sheet.arrow((attention.x - 0.3, top), gate.left)
    sheet.arrow(attention.right, (gate.x, middle), gate.bottom)
    _neck_and_heads(sheet, net, gate.right, x=12.75, y=top)
    sheet.notes.append(
        (
            6.95,
            0.75,
            f"Fusion {net.count('image_fusion')}, neck {net.count('neck')}, heads "
            f"{net.count('heads')}.\nShapes: range × azimuth (× elevation) × channels; "
            "camera: height × width × channels;\nfrom configs/dinorade.py.",
        )
    )
    return sheet


SHEETS = {
    "radenet": ("configs/radenet.py", radenet),
    "dinorade": ("configs/dinorade.py", dinorade),
}


def main() -> None:
    """Draw both figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "docs" / "images")
    out = parser.parse_args().out
    for name, (config, lay_out) in SHEETS.items():
        lay_out(Network.of(config)).draw().savefig(out / f"{name}.png")


if __name__ == "__main__":
    main()
