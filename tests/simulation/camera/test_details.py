"""Windows, wheels and lights lie on their faces and inside their boxes."""

from __future__ import annotations

import numpy as np
import pytest

from radejax.core.structures import CLASSES
from radejax.simulation.camera import details, shapes


def test_rectangle_on_a_slanted_face_by_hand():
    # A face 4 wide below, 2 wide above, 2 high: at half height it reaches from 0.5 to 3.5.
    face = np.array([[[0.0, 0, 0], [4, 0, 0], [3, 0, 2], [1, 0, 2]]])
    found = details.on_faces(face, np.array([[0.0, 0.5]]), np.array([[0.5, 1.0]]))
    expected = [[0.5, 0, 1], [2.0, 0, 1], [2.0, 0, 2], [1.0, 0, 2]]
    np.testing.assert_allclose(found[0], expected)


@pytest.mark.parametrize("cls", CLASSES)
def test_details_stay_in_the_box(cls):
    corners = shapes.blocks_of(cls)
    for detail in details.DETAILS[cls]:
        face = corners[detail.block][shapes._VERTICES[detail.face]][None]
        quad = details.on_faces(face, np.array([detail.u]), np.array([detail.v]))
        assert np.abs(quad).max() <= 1.0 + 2e-2, detail
