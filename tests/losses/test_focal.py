import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.geometry.radar_grid import RadarGrid
from radejax.losses import focal as F

GRID = RadarGrid.reduced(num_doppler=4, num_range=24, num_elevation=4, num_azimuth=16)
C = 3

_STATIC = ("grid", "num_classes", "sigma_mode", "sigma_bins")
heatmap = jax.jit(F.gaussian_heatmap, static_argnames=_STATIC)


def objects(cells, sizes=((4.0, 2.0),)):
    """Boxes centered near given bins, a little off the bin centers."""
    cells = np.asarray(cells, np.float64)
    ground = GRID.bin_to_ego(cells[:, 0] + 0.2, cells[:, 1] - 0.3)
    boxes = np.zeros((len(cells), 8), np.float32)
    boxes[:, :2] = ground
    boxes[:, 3:5] = np.broadcast_to(sizes, (len(cells), 2))
    boxes[:, 7] = 1
    return boxes


def naive_heatmap(cells, classes, sigmas):
    """The definition, bin by bin and object by object."""
    target = np.zeros((GRID.num_range, GRID.num_azimuth, C))
    for (i0, j0), cls, (sr, sa) in zip(cells, classes, sigmas, strict=True):
        for i in range(GRID.num_range):
            for j in range(GRID.num_azimuth):
                distance = (i - i0) ** 2 / sr**2 + (j - j0) ** 2 / sa**2
                target[i, j, cls] += np.exp(-distance / 2)
    return np.minimum(target, 1)


CELLS = [(3, 4), (10, 9), (10, 10), (23, 15), (12, 0)]
CLASSES = np.array([0, 1, 1, 2, 0])
SIZES = np.array([(4.0, 2), (9, 3), (1, 0.8), (2, 5), (4, 2)])


@pytest.mark.parametrize(
    ("sigma", "sigmas"),
    [
        ("fixed", np.full((5, 2), 1.5)),
        ("adaptive", 0.3 * SIZES.max(1, keepdims=True).repeat(2, 1)),
        ("anisotropic", SIZES / 6),
    ],
)
def test_targets_equal_the_definition(sigma, sigmas):
    """Of two frames, of which the second has a row of padding and a class outside the maps."""
    boxes = np.stack([objects(CELLS, SIZES)] * 2)
    boxes[1, 3] = np.nan
    classes = np.stack([CLASSES] * 2)
    classes[1, 4] = 7
    is_valid = np.ones((2, 5), bool)
    is_valid[1, 3] = False
    options = {"num_classes": C, "sigma_mode": sigma, "sigma_bins": 1.5}
    found = heatmap(boxes, classes, is_valid, GRID, **options)
    for frame, count in zip(found, (5, 3), strict=True):
        expected = naive_heatmap(CELLS[:count], CLASSES[:count], sigmas[:count])
        np.testing.assert_allclose(frame, expected, atol=1e-6)
        is_center = tuple(np.c_[CELLS, CLASSES][:count].T)
        np.testing.assert_array_equal(frame[is_center], 1)
        assert frame.max() == 1


@pytest.mark.parametrize("sigma", ["adaptive", "anisotropic"])
def test_an_object_of_zero_size_is_one_bin(sigma):
    point = objects([(5, 5)], (0.0, 0.0)), np.array([1]), np.array([True])
    found = np.asarray(heatmap(*point, GRID, num_classes=C, sigma_mode=sigma))
    assert found[5, 5, 1] == found.sum() == 1


# Focal loss -----------------------------------------------------------------------


def logit(p):
    return jnp.asarray(np.log(p) - np.log1p(-np.asarray(p, np.float64)))


def naive_focal(p, target):
    p = np.clip(p, 1e-6, 1 - 1e-6)
    hit = -np.log(p) * (1 - p) ** 2
    miss = -np.log(1 - p) * p**2 * (1 - target) ** 4
    return np.where(target == 1, hit, miss)


def test_single_bins_and_gradients_of_the_released_code(golden):
    reference = np.load(golden / "losses_focal.npz")
    p = reference["heatmap"].astype(np.float64)
    with np.errstate(divide="ignore"):
        x = jnp.asarray(np.log(p) - np.log1p(-p), jnp.float32)
    target = jnp.asarray(reference["target"])
    loss = F.focal_loss_per_bin(x, target)
    np.testing.assert_allclose(loss, reference["loss"], rtol=2e-5, atol=1e-11)
    grad = jax.grad(lambda x: F.focal_loss_per_bin(x, target).sum())(x)
    expected = reference["grad"] * p * (1 - p)
    np.testing.assert_allclose(grad, expected, rtol=2e-5, atol=2e-11)
    assert (grad[(p == 0) | (p == 1)] == 0).all()


def test_a_batch_is_divided_by_its_positive_bins_or_all_if_there_are_none():
    rng = np.random.default_rng(0)
    p, target = rng.uniform(0.01, 0.99, (2, 2, 6, 5, 3))
    loss = jax.jit(F.focal_loss)
    mean = naive_focal(p, target).mean()
    np.testing.assert_allclose(loss(logit(p), target), mean, rtol=1e-5)
    target[0, 1, 2, 0] = target[1, 3, 3, 2] = 1
    expected = naive_focal(p, target).sum() / 2
    np.testing.assert_allclose(loss(logit(p), target), expected, rtol=1e-5)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_saturated_logits_stay_finite(dtype):
    x = jnp.array([-200.0, -30, -14, 0, 14, 30, 200], dtype)

    @jax.jit
    @jax.value_and_grad
    def run(x, target):
        return F.focal_loss_per_bin(x, target).sum()

    for t in (0.0, 0.3, 1.0):
        loss, grad = run(x, jnp.full(7, t))
        assert loss.dtype == jnp.float32
        assert np.isfinite(loss)
        assert np.isfinite(np.asarray(grad, np.float32)).all()
