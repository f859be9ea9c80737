"""Weights and inputs of `models_radenet.npz`: RADE-Net at small widths, computed by PyTorch.

This file of commit a8ba2f18 made it, with torch 2.13.0 and `benchmarks/torch_radenet.py`, whose
network was checked against the released one's outputs. Weights and inputs follow from names and
shapes (`seeded_tensor`), so the file holds outputs and gradients only. Reached by
radejax in float32 on a CPU: 5e-6 on maps, 1e-5 of the largest value on gradients.
"""

import pathlib

import numpy as np

from radejax.config import load_module

HERE = pathlib.Path(__file__).resolve().parent
SEED = 1234

SMALL = {
    "name": "radenet",
    "num_classes": 3,
    "doppler_bins": 8,
    "elevation_bins": 5,
    "widths": (16, 32, 64),
    "decoder_width": 16,
    "num_groups": 8,
    "cbam": "official",
    "input_stem": False,
    "neck": "dilated",
    "heads": "expanded",
    "pad_multiple": 8,
    "crop_output": False,
    "dtype": "float32",
    "remat": "none",
    "heatmap_prior": 0.5,
    "backbone": "unet",
    "input_center": 0.0,
    "input_scale": 1.0,
}
"""A model config with every part, small enough for a test."""

VARIANTS = {
    "model": {},
    "base": {"cbam": "off", "neck": "plain", "heads": "default"},
    "stem": {"input_stem": True},
    "expand": {"decoder_width": 32},
    "paper": {"cbam": "paper"},
}

# Multiples of 8 on no axis: the model pads.
INPUT_SHAPE = (2, 21, 14, 13)

# An odd step: the network's last layer computes even and odd rows with different weights.
ROW_STEP = 3

GRADIENTS = (
    "backbone.start_conv.weight",
    "backbone.upsample_2.upsample.weight",
    "backbone.cbam_1.channel_attention.fc1.weight",
    "backbone.cbam_3.spatial_attention.convolution.weight",
    "neck.neck.2.conv1.conv.weight",
    "head.reg_head.head.1.weight",
)


seeded_tensor = load_module(HERE / "dinorade_make.py").seeded_tensor


def seeded_state(shapes):
    """State dict for a mapping from names to shapes."""
    return {name: seeded_tensor(name, shape) for name, shape in shapes.items()}


def small_input():
    """`INPUT_SHAPE`, channels last."""
    return np.random.default_rng(SEED).random(INPUT_SHAPE, np.float32)


def cotangents(shapes):
    """What outputs of these shapes are multiplied with before they are summed."""
    rng = np.random.default_rng(SEED + 1)
    return [rng.standard_normal(shape).astype(np.float32) for shape in shapes]
