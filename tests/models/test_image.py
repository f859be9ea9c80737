"""Tests of radejax.models.image."""

import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.models import image as image_lib


def test_bytes_become_standardised_colours():
    image = jnp.asarray([[[[0, 255, 51]]]], jnp.uint8)
    expected = [-0.485 / 0.229, (1 - 0.456) / 0.224, (0.2 - 0.406) / 0.225]
    np.testing.assert_allclose(image_lib.normalize(image)[0, 0, 0], expected, rtol=1e-6)
    scaled = image_lib.normalize(image, standardize=False)
    np.testing.assert_allclose(scaled[0, 0, 0], [0, 1, 0.2], rtol=1e-6)


def test_floats_are_normalised_already():
    image = jnp.full((1, 2, 2, 3), 0.3)
    assert image_lib.normalize(image) is image


def test_grid_of_patches():
    assert image_lib.check_image((2, 720, 1280, 3), 16) == (45, 80)
    with pytest.raises(UserError, match="700 x 1280 pixels"):
        image_lib.check_image((2, 700, 1280, 3), 16)
    with pytest.raises(UserError, match="colours last"):
        image_lib.check_image((2, 3, 720, 1280), 16)
