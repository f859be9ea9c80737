"""Front images of frames, read as the models and the drawings want them."""

from __future__ import annotations

import io
import pathlib

import numpy as np
from jaxtyping import UInt8

from radejax.core.errors import DataError
from radejax.data.dataset import LabelledFrame
from radejax.geometry.camera import CameraCalibration

_MAX_SIDE, _MAX_PIXELS = 8192, 1 << 25

IMAGE_SIZE = (720, 1280)
"""Height and width of the left half of K-Radar's 2560 x 720 stereo images."""


def read_left_image(
    path: pathlib.Path, size: tuple[int, int] = IMAGE_SIZE, *, resize: bool = False
) -> UInt8[np.ndarray, "H W 3"]:
    """Left half of a front image (a stereo pair, or left only).

    Args:
        path: Of the picture file. More than twice as wide as high: a stereo pair.
        size: Height and width of the result.
        resize: Bring other sizes to `size`, averaging where they are larger.

    Raises:
        DataError: The file is damaged, or of another size and not `resize`.
    """
    from PIL import Image

    height, width = size
    try:
        # From memory: of a file, a chunk that claims 4 GB is asked for whole.
        with Image.open(io.BytesIO(path.read_bytes())) as file:
            found = file.size
            if max(found) > _MAX_SIDE or found[0] * found[1] > _MAX_PIXELS:
                raise DataError(
                    f"{path}: {found[0]} x {found[1]} pixels, expected at most "
                    f"{_MAX_SIDE} in each direction and {_MAX_PIXELS} in all"
                )
            if not resize and found not in ((2 * width, height), (width, height)):
                raise DataError(
                    f"{path}: {found[0]} x {found[1]} pixels, expected "
                    f"{2 * width} x {height} (stereo) or {width} x {height}"
                )
            is_pair = found[0] > 2 * found[1] if resize else found[0] == 2 * width
            left = (0, 0, found[0] // 2 if is_pair else found[0], found[1])
            image = file.convert("RGB").crop(left)
            if image.size != (width, height):
                image = image.resize((width, height), Image.Resampling.BOX)
            return np.asarray(image)
    except DataError:
        raise
    except Exception as error:  # Pillow's decoders raise nearly anything on damage
        raise DataError(f"{path}: damaged image ({error})") from None


def front_view(
    frame: LabelledFrame,
) -> tuple[UInt8[np.ndarray, "H W 3"] | None, CameraCalibration | None]:
    """Left front image of a frame and its calibration, to draw.

    Images of another size than the calibration's are resized to it. None where there is
    none.

    Raises:
        DataError: A file is damaged.
    """
    if frame.camera_path is None:
        return None, None
    camera = None
    if frame.camera_calibration_path is not None:
        camera = frame.read_calibration()
    size = IMAGE_SIZE if camera is None else (camera.height, camera.width)
    return read_left_image(frame.camera_path, size, resize=True), camera
