from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.losses import gwd as G

# The authors' code has NaN or finite but wrong gradients here.
NOTHING = {"zero_size", "zero_yaw_vector"}
NO_REFERENCE_GRADIENT = NOTHING | {"both_square", "identical_square", "rotated_90"}
NO_SQRT_GRADIENT = NO_REFERENCE_GRADIENT | {"identical", "nearly_identical"}
COLUMN = {"none": "none", "sqrt": "sqrt", "log1p": "log"}

distance = jax.jit(G.gwd)


@jax.jit
def distance_and_grad(a, b):
    """Distances of corresponding boxes, and their gradients with respect to the first."""
    values, pull = jax.vjp(lambda a: G.gwd(a, b), a)
    return values, pull(jnp.ones_like(values))[0]


@partial(jax.jit, static_argnames="transform")
def loss_and_grad(a, b, transform="sqrt"):
    values, pull = jax.vjp(lambda a: G.gwd_loss(a, b, transform=transform), a)
    return values, pull(jnp.ones_like(values))[0]


@pytest.fixture(scope="module")
def pairs(golden):
    return dict(np.load(golden / "losses_gwd.npz"))


def box(x=0.0, y=0.0, length=4.0, width=2.0, yaw=0.0):
    return np.array([x, y, 0, length, width, 1.5, np.sin(yaw), np.cos(yaw)], np.float32)


def test_by_hand():
    # Shifted by (3, 4); half lengths 2 and 3 along one axis; widths exchanged.
    assert float(distance(box(), box(3, 4))) == 25
    np.testing.assert_allclose(distance(box(), box(length=6)), 1, rtol=1e-6)
    turned = box(yaw=np.pi / 2)
    np.testing.assert_allclose(distance(box(), turned), 2, rtol=1e-6)


def check_grad(found, expected, is_kept):
    assert np.isfinite(found).all()
    tolerance = 2e-5 * np.maximum(np.abs(expected).max(1, keepdims=True), 1)
    assert (np.abs(found - expected) < tolerance)[is_kept].all()


def test_distance_of_the_released_code(pairs):
    """The closed form is the gradient where the released one is wrong."""
    found, grad = distance_and_grad(pairs["pred"], pairs["gt"])
    offset = pairs["pred"][:, :2] - pairs["gt"][:, :2]
    roots = pairs["sigma_pred_f64"] ** 2 + pairs["sigma_gt_f64"] ** 2
    terms = roots.sum((1, 2)) + (offset**2).sum(1)  # whose difference it is
    error = np.abs(found - pairs["gwd_f64"]) / terms.clip(1e-6)
    assert error.max() < 1e-6
    names = {"gwd_grad_f64": NO_REFERENCE_GRADIENT, "gwd_closed_form_grad_f64": NOTHING}
    for name, excluded in names.items():
        check_grad(grad, pairs[name], ~np.isin(pairs["kind"], list(excluded)))


@pytest.mark.parametrize("transform", COLUMN)
def test_loss_of_the_released_code(pairs, transform):
    found, grad = loss_and_grad(pairs["pred"], pairs["gt"], transform)
    expected = pairs[f"loss_{COLUMN[transform]}_f64"]
    is_finite = np.isfinite(expected)
    assert (~is_finite).sum() <= 10
    np.testing.assert_allclose(found[is_finite], expected[is_finite], atol=2e-6)
    np.testing.assert_allclose(found[~is_finite], 1 - 1 / 1.65, atol=1e-5)
    excluded = NO_SQRT_GRADIENT if transform == "sqrt" else NO_REFERENCE_GRADIENT
    is_kept = ~np.isin(pairs["kind"], list(excluded))
    check_grad(grad, pairs[f"grad_{COLUMN[transform]}_f64"], is_kept)


numbers = st.tuples(
    st.floats(-20, 20, width=32),
    st.floats(-20, 20, width=32),
    st.floats(0.25, 12, width=32),
    st.floats(0.25, 4, width=32),
    st.sampled_from([0.0, np.pi / 2, 1.0]) | st.floats(-3, 3, width=32),
)


@settings(deadline=None, max_examples=60)
@given(numbers, numbers, st.floats(-3, 3), st.floats(-20, 20))
def test_laws(a, b, turn, shift):
    """Symmetric, not negative, unchanged by a common rigid motion, exactly 0 at identity."""

    def moved(x, y, length, width, yaw):
        cos, sin = np.cos(turn), np.sin(turn)
        x, y = x * cos - y * sin + shift, x * sin + y * cos - shift
        return box(x, y, length, width, yaw + turn)

    there, back = distance(box(*a), box(*b)), distance(box(*b), box(*a))
    assert there >= 0
    np.testing.assert_allclose(back, there, rtol=1e-5, atol=1e-10)
    after = distance(moved(*a), moved(*b))
    np.testing.assert_allclose(after, there, rtol=1e-4, atol=1e-3)
    value, grad = distance_and_grad(box(*a), box(*a))
    assert value == 0
    np.testing.assert_array_equal(grad, 0)


DEGENERATE = np.array(
    [
        [0, 0, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 0, 1],
        [0, 0, 0, 4, 0, 1, 0, 1],
        [0, 0, 0, 0, 2, 1, 1, 0],
        [0, 0, 0, -4, 2, 1, 0, 1],
        [0, 0, 0, -4, -2, 1, 0, 1],
        [0, 0, 0, 2, 2, 1, 0.6, 0.8],
        [0, 0, 0, 4, 2, 1, 0, 0],
        [0, 0, 0, 1e-4, 1e-4, 1, 0, 1],
        [1e4, -1e4, 0, 500, 300, 1, 3, 4],
    ]
)


@pytest.mark.parametrize(
    ("transform", "dtype"),
    [("none", "float32"), ("sqrt", "bfloat16"), ("log1p", "float32")],
)
def test_degenerate_boxes_give_finite_values_and_gradients(transform, dtype):
    a, b = np.broadcast_arrays(DEGENERATE[:, None], DEGENERATE[None])
    a, b = jnp.asarray(a, dtype), jnp.asarray(b, dtype)
    values, grads = loss_and_grad(a, b, transform)
    assert values.shape == (10, 10)
    assert values.dtype == jnp.float32
    assert np.isfinite(values).all()
    assert (values >= 1 - 1 / 1.65 - 1e-6).all()
    assert np.isfinite(np.asarray(grads, np.float32)).all()
