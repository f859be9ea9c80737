from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.losses import gwd as G

# The released code has NaN or finite but wrong gradients here (see losses_make.py).
NO_REFERENCE_GRADIENT = {
    "both_square",
    "identical_square",
    "rotated_90",
    "zero_size",
    "zero_yaw_vector",
}
NO_SQRT_GRADIENT = NO_REFERENCE_GRADIENT | {"identical", "nearly_identical"}
COLUMN = {"none": "none", "sqrt": "sqrt", "log1p": "log"}

distance = jax.jit(G.gwd)
loss = jax.jit(G.gwd_loss, static_argnames="transform")


@jax.jit
def distance_and_grad(a, b):
    values, pull = jax.vjp(lambda a: G.gwd(a, b), a)
    return values, pull(jnp.ones_like(values))[0]


@partial(jax.jit, static_argnames="transform")
def loss_grad(a, b, transform="sqrt"):
    """Gradients of every pair's loss with respect to its first box."""
    return jax.grad(lambda a: G.gwd_loss(a, b, transform=transform).sum())(a)


@pytest.fixture(scope="module")
def pairs(golden):
    return dict(np.load(golden / "losses_gwd.npz"))


def rows(pairs, excluded=()):
    return ~np.isin(pairs["kind"], list(excluded))


def scale(pairs):
    """Size of the terms whose difference the distance is."""
    offset = pairs["pred"][:, :2] - pairs["gt"][:, :2]
    roots = pairs["sigma_pred_f64"] ** 2 + pairs["sigma_gt_f64"] ** 2
    return roots.sum((1, 2)) + (offset**2).sum(1)


def box(x=0.0, y=0.0, length=4.0, width=2.0, yaw=0.0):
    return np.array([x, y, 0, length, width, 1.5, np.sin(yaw), np.cos(yaw)], np.float32)


def random_boxes(rng, count):
    boxes = rng.normal(0, 2, (count, 8))
    boxes[:, 3:6] = rng.uniform(0.3, 9, (count, 3))
    yaw = rng.uniform(-np.pi, np.pi, count)
    boxes[:, 6], boxes[:, 7] = np.sin(yaw), np.cos(yaw)
    return boxes


def test_by_hand():
    # Shifted by (3, 4); half lengths 2 and 3 along one axis; widths exchanged.
    assert float(distance(box(), box(3, 4))) == 25
    np.testing.assert_allclose(distance(box(), box(length=6)), 1, rtol=1e-6)
    turned = box(yaw=np.pi / 2)
    np.testing.assert_allclose(distance(box(), turned), 2, rtol=1e-6)


def test_distance_of_the_released_code(pairs):
    found = distance(pairs["pred"], pairs["gt"])
    error = np.abs(found - pairs["gwd_f64"]) / scale(pairs).clip(1e-6)
    assert error.max() < 1e-6


@pytest.mark.parametrize("transform", COLUMN)
def test_loss_of_the_released_code(pairs, transform):
    found = loss(pairs["pred"], pairs["gt"], transform=transform)
    expected = pairs[f"loss_{COLUMN[transform]}_f64"]
    reference_is_nan = ~np.isfinite(expected)
    assert reference_is_nan.sum() <= 10
    np.testing.assert_allclose(
        found[~reference_is_nan], expected[~reference_is_nan], atol=2e-6
    )
    np.testing.assert_allclose(found[reference_is_nan], 1 - 1 / 1.65, atol=1e-5)


@pytest.mark.parametrize("transform", [None, *COLUMN])
def test_gradient_of_the_released_code(pairs, transform):
    if transform is None:
        _, grad = distance_and_grad(pairs["pred"], pairs["gt"])
        expected = pairs["gwd_grad_f64"]
    else:
        grad = loss_grad(pairs["pred"], pairs["gt"], transform)
        expected = pairs[f"grad_{COLUMN[transform]}_f64"]
    assert np.isfinite(grad).all()
    kept = rows(
        pairs, NO_SQRT_GRADIENT if transform == "sqrt" else NO_REFERENCE_GRADIENT
    )
    tolerance = 2e-5 * np.maximum(np.abs(expected).max(1, keepdims=True), 1)
    assert (np.abs(grad - expected) < tolerance)[kept].all()


def test_closed_form_gradient_where_the_released_one_is_wrong(pairs):
    _, grad = distance_and_grad(pairs["pred"], pairs["gt"])
    expected = pairs["gwd_closed_form_grad_f64"]
    kept = rows(pairs, ("zero_size", "zero_yaw_vector"))
    size = np.maximum(np.abs(expected[kept]).max(1, keepdims=True), 1)
    np.testing.assert_array_less(np.abs(grad[kept] - expected[kept]) / size, 2e-5)


numbers = st.tuples(
    st.floats(-20, 20, width=32),
    st.floats(-20, 20, width=32),
    st.floats(0.25, 12, width=32),
    st.floats(0.25, 4, width=32),
    st.sampled_from([0.0, np.pi / 2, 1.0]) | st.floats(-3, 3, width=32),
)


@settings(deadline=None, max_examples=60)
@given(numbers, numbers)
def test_symmetric_and_not_negative(a, b):
    a, b = box(*a), box(*b)
    forth, back = distance(a, b), distance(b, a)
    assert forth >= 0
    np.testing.assert_allclose(forth, back, rtol=1e-5, atol=1e-10)


@settings(deadline=None, max_examples=60)
@given(numbers)
def test_exactly_zero_at_identity_with_zero_gradient(a):
    a = box(*a)
    value, grad = distance_and_grad(a, a)
    assert value == 0
    np.testing.assert_array_equal(grad, 0)
    np.testing.assert_allclose(loss(a, a), 1 - 1 / 1.65, rtol=1e-6)


@settings(deadline=None, max_examples=60)
@given(numbers, numbers, st.floats(-3, 3), st.floats(-20, 20))
def test_unchanged_by_a_common_rigid_motion(a, b, turn, shift):
    def moved(x, y, length, width, yaw):
        cos, sin = np.cos(turn), np.sin(turn)
        x, y = x * cos - y * sin + shift, x * sin + y * cos - shift
        return box(x, y, length, width, yaw + turn)

    before, after = distance(box(*a), box(*b)), distance(moved(*a), moved(*b))
    np.testing.assert_allclose(after, before, rtol=1e-4, atol=1e-3)


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
    [
        ("none", jnp.float32),
        ("sqrt", jnp.float32),
        ("sqrt", jnp.bfloat16),
        ("log1p", jnp.float32),
    ],
)
def test_degenerate_boxes_give_finite_values_and_gradients(transform, dtype):
    a, b = np.broadcast_arrays(DEGENERATE[:, None], DEGENERATE[None])
    a, b = jnp.asarray(a, dtype), jnp.asarray(b, dtype)
    values = loss(a, b, transform=transform)
    assert values.shape == (10, 10)
    assert values.dtype == jnp.float32
    assert np.isfinite(values).all()
    assert (values >= 1 - 1 / 1.65 - 1e-6).all()
    grads = np.asarray(loss_grad(a, b, transform), np.float32)
    assert np.isfinite(grads).all()


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda a: G.gwd(a[..., :7], a), r"must be \[..., 8\], got \(2, 7\)"),
        (lambda a: G.gwd_loss(a, a, transform="log"), "transform is 'log', expected"),
    ],
)
def test_bad_arguments_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call(jnp.ones((2, 8)))
