import numpy as np
import pytest
from PIL import Image

from radejax.core.errors import DataError
from radejax.data.images import IMAGE_SIZE, read_left_image


def test_left_half_of_the_stereo_pair(tmp_path):
    height, width = IMAGE_SIZE
    pixels = np.random.default_rng(0).integers(
        0, 255, (height, 2 * width, 3), dtype=np.uint8
    )
    Image.fromarray(pixels).save(tmp_path / "a.png", compress_level=1)
    np.testing.assert_array_equal(
        read_left_image(tmp_path / "a.png"), pixels[:, :width]
    )
    Image.fromarray(pixels[:, :width]).save(tmp_path / "b.png", compress_level=1)
    np.testing.assert_array_equal(
        read_left_image(tmp_path / "b.png"), pixels[:, :width]
    )
    Image.fromarray(pixels[:50, :70]).save(tmp_path / "c.png")
    with pytest.raises(DataError, match=r"c\.png: 70 x 50 pixels, expected 2560 x 720"):
        read_left_image(tmp_path / "c.png")
    content = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"a\.png: damaged image"):
        read_left_image(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"a\.png: damaged image"):
        read_left_image(tmp_path / "a.png")
    Image.new("1", (9000, 1)).save(tmp_path / "a.png")  # few bytes, many pixels
    with pytest.raises(DataError, match=r"a\.png: 9000 x 1 pixels, expected at most"):
        read_left_image(tmp_path / "a.png", resize=True)
    Image.new("L", (4, 4)).save(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:44])
    with pytest.raises(DataError, match=r"a\.png: damaged image"):
        read_left_image(tmp_path / "a.png", resize=True)
