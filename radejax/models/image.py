"""From pictures as recorded to what an image backbone expects.

Normalisation happens here, inside the jitted model: frames travel as uint8.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Real

from radejax.core.errors import UserError

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def normalize(
    image: Real[jax.Array, "B H W 3"], *, standardize: bool = True
) -> Float[jax.Array, "B H W 3"]:
    """Colours to the scale that ImageNet-trained backbones expect.

    Args:
        image: `[B, H, W, 3]` RGB: uint8 in 0..255, or floats, which are taken as
            normalised already and returned as they are.
        standardize: Subtract ImageNet's mean and divide by its deviation. The
            released DinoRADE only scales to [0, 1] for its ResNet.

    Returns:
        `[B, H, W, 3]` float32, or the given floats.
    """
    if jnp.issubdtype(image.dtype, jnp.floating):
        return image
    scaled = image.astype(jnp.float32) / 255.0
    if not standardize:
        return scaled
    mean, std = (
        np.array(v, np.float32).reshape(1, 1, 1, 3)
        for v in (IMAGENET_MEAN, IMAGENET_STD)
    )
    return (scaled - mean) / std


def check_image(shape: tuple[int, ...], patch_size: int) -> tuple[int, int]:
    """Rows and columns of patches in images of a shape.

    Raises:
        UserError: It is no batch of colour images, or height or width is not a
            multiple of the patch size.
    """
    if len(shape) != 4 or shape[-1] != 3:
        raise UserError(
            f"images must be [B, H, W, 3] with colours last, got shape {tuple(shape)}"
        )
    height, width = shape[1:3]
    if height % patch_size or width % patch_size or 0 in (height, width):
        raise UserError(
            f"image is {height} x {width} pixels; height and width must be multiples "
            f"of the patch size {patch_size} (K-Radar's left front image: 720 x 1280)"
        )
    return height // patch_size, width // patch_size
