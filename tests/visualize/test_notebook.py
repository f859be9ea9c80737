import base64
import io

import numpy as np
import pytest
from PIL import Image

from radejax.core.errors import UserError
from radejax.visualize.canvas import new_figure
from radejax.visualize.notebook import show


def decoded(picture) -> np.ndarray:
    data = base64.b64decode(picture._repr_mimebundle_()["image/png"])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def test_figure_and_axes_become_png():
    figure = new_figure(1, 0.5)
    figure.set_facecolor("#102030")
    pixels = decoded(show(figure, dpi=40))
    assert pixels.shape == (20, 40, 3)
    assert (pixels == [0x10, 0x20, 0x30]).all()
    assert decoded(show(figure.add_subplot())).shape == (40, 80, 3)


def test_image_arrays_and_files(tmp_path):
    image = np.zeros((4, 6, 3), np.uint8)
    image[1, 2] = 255
    np.testing.assert_array_equal(decoded(show(image)), image)
    path = tmp_path / "a.gif"
    Image.fromarray(image).save(path)
    picture = show(path)
    assert picture.mime_type == "image/gif"
    assert picture.data == path.read_bytes()
    assert "image/gif" in repr(picture)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"a\.mp4"):
        show(tmp_path / "a.mp4")
    with pytest.raises(FileNotFoundError):
        show(tmp_path / "a.png")
