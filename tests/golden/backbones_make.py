"""Seeded weights and inputs of the golden numbers for image backbones of all sources.

`backbones.npz` holds, per source, the names and shapes of a tiny model's tensors as its file has
them, and the features that the original code computed from seeded weights and images on a CPU:
Hugging Face transformers 5.24.0, timm 1.0.31, Meta's DINOv3 (facebookresearch/dinov3, commit
6876159) and torch 2.13.0. It also holds torch's bicubic resampling. Weights and images are not
stored: they follow from names and seeds as in `dinorade_make.py`. This file of commit a8ba2f18
also runs the original code.
"""

import pathlib

import numpy as np

from radejax.config import load_module

HERE = pathlib.Path(__file__).parent
SEEDS = load_module(HERE / "dinorade_make.py")


def tensors(listing: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """The seeded tensors of a file with these names and shapes."""
    found = {name: SEEDS.seeded_tensor(name, tuple(s)) for name, s in listing.items()}
    for name, value in found.items():
        if name == "rope_embed.periods":  # a function of the model's size
            found[name] = np.float32(100 ** (np.arange(value.size) / value.size))
        if name.endswith("bias_mask"):  # no bias of the key
            found[name] = np.repeat(np.float32([1, 0, 1]), value.size // 3)
    return found


def image(height: int, width: int) -> np.ndarray:
    """A normalized image [1, 3, H, W]."""
    return SEEDS.normal_input(height * width, (1, 3, height, width))
