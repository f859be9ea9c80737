"""Pictures in notebooks, without pyplot and its backends."""

from __future__ import annotations

import base64
import io
import os
import pathlib
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from radejax.core.errors import UserError
from radejax.visualize.animate import make_palette, render

_MIME_TYPES = {".png": "image/png", ".gif": "image/gif", ".jpg": "image/jpeg"}


class Picture:
    """What Jupyter shows as an image when it is the last value of a cell.

    Attributes:
        data: The file's bytes.
        mime_type: Such as "image/png".
    """

    def __init__(self, data: bytes, mime_type: str):
        self.data = data
        self.mime_type = mime_type

    def _repr_mimebundle_(self, **_: Any) -> dict[str, str]:
        return {
            self.mime_type: base64.b64encode(self.data).decode(),
            "text/plain": repr(self),
        }

    def __repr__(self) -> str:
        return f"<picture, {self.mime_type}, {len(self.data) / 1024:.0f} KiB>"


def show(
    what: Figure | Axes | np.ndarray | str | os.PathLike, *, dpi: float = 80
) -> Picture:
    """Makes a figure, axes, image array or picture file visible in a notebook.

    Figures become PNG with 256 colours: a third of the size, and notebooks are kept
    with their pictures.

    Args:
        what: A figure; axes, whose figure is meant; `[H, W, 3]` uint8; or the path of a
            PNG, JPEG or GIF.
        dpi: Resolution of a figure, dots per inch.

    Raises:
        UserError: A file of another kind.
        FileNotFoundError: No such file.
    """
    if isinstance(what, str | os.PathLike):
        path = pathlib.Path(what)
        if path.suffix.lower() not in _MIME_TYPES:
            raise UserError(f"cannot show {path.name!r}; kinds: {sorted(_MIME_TYPES)}")
        return Picture(path.read_bytes(), _MIME_TYPES[path.suffix.lower()])
    if isinstance(what, np.ndarray):
        pixels = what
    else:
        figure = what.figure.figure  # the root: axes may lie in a part of it
        figure.set_dpi(dpi)
        pixels = render(figure)
    image = Image.fromarray(pixels)
    image = image.quantize(palette=make_palette(image, 256), dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return Picture(buffer.getvalue(), "image/png")
