import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.geometry import boxes as B

CAR = np.array([10.0, 2.0, 1.0, 4.0, 2.0, 1.5, np.pi / 2])


def test_corners_by_hand():
    # Heading left (+y): front is +y, the left side is -x.
    expected = [[9, 4], [9, 0], [11, 0], [11, 4]]
    np.testing.assert_allclose(B.bev_corners(CAR), expected, atol=1e-12)
    cube = B.corners(CAR)
    np.testing.assert_allclose(cube[:4, :2], expected, atol=1e-12)
    np.testing.assert_allclose(cube[4:, :2], expected, atol=1e-12)
    np.testing.assert_allclose(cube[:, 2], [0.25] * 4 + [1.75] * 4)


@settings(deadline=None, max_examples=50)
@given(
    st.lists(st.floats(-50, 50), min_size=3, max_size=3),
    st.floats(-np.pi + 1e-9, np.pi),
    st.floats(0.1, 3),
)
def test_yaw_vector_round_trip(center, yaw, length):
    box = np.array([*center, 4.0, 2.0, 1.5, yaw])
    eight = B.boxes8_from_7(box)
    np.testing.assert_allclose(B.boxes7_from_8(eight), box, atol=1e-12)
    eight[6:] *= length
    np.testing.assert_allclose(B.boxes7_from_8(eight), box, atol=1e-12)
    assert B.boxes7_from_8(np.zeros(8))[6] == 0


def test_corners_of_both_forms_agree_in_jax_and_numpy():
    boxes = np.random.default_rng(0).normal(size=(2, 3, 7)).astype(np.float32)
    on_host = B.corners(boxes)
    assert isinstance(on_host, np.ndarray)
    both = jax.jit(lambda x: (B.corners(x), B.corners(B.boxes8_from_7(x))))(boxes)
    for corners in both:
        np.testing.assert_allclose(corners, on_host, atol=2e-6)
