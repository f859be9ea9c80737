"""Effects of weather on camera images: haze, rain, snow and a covered lens.

Among K-Radar's 35,000 front images, the DinoRADE paper counts 7,500 partially, 4,800 heavily
and 4,900 fully covered ones, all in bad weather. `AIR` reproduces these numbers if all
sequences of K-Radar are simulated.

References:
    DinoRADE (`docs`), section 5: covered front images in K-Radar.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from PIL import Image, ImageDraw


class Air(NamedTuple):
    """Effects of one kind of weather on an image.

    Attributes:
        extinction_per_m: Extinction coefficient of haze. The contrast decreases with
            `exp(-extinction x distance)`.
        drops: Mean number of streaks or flakes per megapixel.
        is_snow: Whether to draw flakes instead of streaks.
        wetness: Wetness of the road, which darkens it, from 0 to 1.
        white: Amount of snow on the ground, from 0 to 1.
        cover: Probabilities of `LEVELS`.
    """

    extinction_per_m: float
    drops: float = 0.0
    is_snow: bool = False
    wetness: float = 0.0
    white: float = 0.0
    cover: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


AIR = {
    "normal": Air(0.0008),
    "overcast": Air(0.0015),
    "fog": Air(0.03, cover=(0.50, 0.35, 0.10, 0.05)),
    "rain": Air(0.006, 900.0, False, 1.0, cover=(0.17, 0.46, 0.22, 0.15)),
    "sleet": Air(0.01, 1100.0, True, 0.7, 0.25, (0.12, 0.27, 0.28, 0.33)),
    "lightsnow": Air(0.006, 700.0, True, 0.2, 0.5, (0.30, 0.40, 0.18, 0.12)),
    "heavysnow": Air(0.02, 2600.0, True, 0.0, 0.85, (0.06, 0.30, 0.29, 0.35)),
}

LEVELS = ("clear", "partial", "heavy", "full")

BLOCK_FRAMES = 50
"""Number of frames after which the lens cover changes, as by a wiper or wind."""


def cover_level(seed: int, sequence: int, frame: int, weather: str) -> str:
    """Returns the level of lens cover, which is constant in blocks of `BLOCK_FRAMES`."""
    rng = np.random.default_rng([seed, sequence, frame // BLOCK_FRAMES, 13])
    return LEVELS[rng.choice(4, p=AIR[weather].cover)]


def add_precipitation(
    image: Image.Image, air: Air, light: float, rng: Generator
) -> Image.Image:
    """Draws streaks of rain or flakes of snow on an image."""
    width, height = image.size
    count = rng.poisson(air.drops * width * height / 1e6)
    if not count:
        return image
    layer = image.copy()
    draw = ImageDraw.Draw(layer)
    unit = height / 720.0
    brightness = int(80 + 160 * light)
    u, v = rng.uniform(0, width, count), rng.uniform(0, height, count)
    size = np.maximum(rng.exponential(2.2, count) * unit, 0.6)
    for x, y, s in zip(u.tolist(), v.tolist(), size.tolist(), strict=True):
        if air.is_snow:
            draw.ellipse((x - s, y - s, x + s, y + s), fill=(brightness,) * 3)
        else:
            draw.line((x, y, x + 0.25 * s, y + 9.0 * s), fill=(brightness,) * 3)
    return Image.blend(image, layer, 0.75 if air.is_snow else 0.35)


def cover_lens(
    image: Image.Image, level: str, is_snow: bool, light: float, rng: Generator
) -> Image.Image:
    """Adds drops, slush or snow on the lens to an image.

    Args:
        image: Image of the camera with a clear lens.
        level: One of `LEVELS`.
        is_snow: Whether the patches are white instead of clear drops.
        light: Brightness, 1 by day.
        rng: Random generator of the drop positions. Pass one with the same state for all
            frames of a block.
    """
    if level == "clear":
        return image
    veil = Image.new("RGB", image.size, tuple(int(c * light) for c in (205, 208, 212)))
    if level == "full":
        return Image.blend(_blurred(image, 40), veil, 0.88 if is_snow else 0.65)
    is_heavy = level == "heavy"
    mask = _drop_mask(image.size, 0.75 if is_heavy else 0.25, rng)
    strength = (0.6 if is_heavy else 0.35) * (1.0 if is_snow else 0.4)
    soiled = Image.blend(_blurred(image, 24 if is_heavy else 14), veil, strength)
    return Image.composite(soiled, _blurred(image, 3) if is_heavy else image, mask)


def _blurred(image: Image.Image, factor: float) -> Image.Image:
    """Blurs an image by downsampling; `factor` applies to a width of 1280 pixels."""
    width, height = image.size
    factor = max(factor * width / 1280.0, 1.01)
    small = (max(int(width / factor), 2), max(int(height / factor), 2))
    smaller = image.resize(small, Image.Resampling.BOX)
    return smaller.resize(image.size, Image.Resampling.BICUBIC)


def _drop_mask(size: tuple[int, int], share: float, rng: Generator) -> Image.Image:
    """Draws a mask of soft round patches that cover about a fraction of the image."""
    width, height = 160, 90
    mask = Image.new("L", (width, height), 0)
    draw = ImageDraw.Draw(mask)
    for count in range(1, 401):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        radius = rng.uniform(2.0, 9.0) * (1.0 + share)
        draw.ellipse((x - radius, y - radius, x + radius, y + 1.15 * radius), fill=255)
        if count % 8 == 0 and np.asarray(mask).mean() / 255.0 >= share:
            break
    small = mask.resize((width // 2, height // 2), Image.Resampling.BOX)
    return small.resize(size, Image.Resampling.BICUBIC)
