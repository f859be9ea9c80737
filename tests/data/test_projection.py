import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from radejax.core.errors import DataError, UserError
from radejax.core.structures import to_float
from radejax.data.projection import (
    ENCODINGS,
    PROBLEMS,
    decode,
    encode,
    find_invalid,
    find_problem,
    linear_power,
    project_jax,
    project_tensor,
    stack_frames,
    to_log_scale,
    unstack_frames,
)

SHAPE = (4, 6, 3, 5)  # D, R, E, A


def project_released(tesseract):
    """Released formula: logarithm of every bin, transpose, two maxima."""
    level = (10 * np.log10(tesseract + 1e-10) + 1.2) / 184.3
    level = np.transpose(level, (1, 3, 2, 0))  # [R, A, E, D]
    return np.concatenate([level.max(axis=2), level.max(axis=3)], axis=-1)


def random_power(seed=0, dtype=np.float32, shape=SHAPE):
    """Powers over 18 decades, zeros among them."""
    rng = np.random.default_rng(seed)
    power = 10 ** rng.uniform(-3, 15, shape)
    power[rng.random(shape) < 0.1] = 0.0
    return power.astype(dtype)


LAYOUTS = {
    "C": np.ascontiguousarray,
    "column-major": np.asfortranarray,
    "strided": lambda t: np.repeat(t, 2, axis=3)[..., ::2],
    "permuted": lambda t: t.transpose(1, 3, 0, 2).copy().transpose(2, 0, 3, 1),
    "big-endian": lambda t: t.astype(t.dtype.newbyteorder(">")),
    "read-only": lambda t: np.frombuffer(t.tobytes(), t.dtype).reshape(t.shape),
}


def test_levels_worked_out_by_hand():
    # 10 log10(p) + 1.2 over 184.3.
    power = np.array([1.0, 1e6, 10**18.31, 0.0])
    wanted = [1.2 / 184.3, 61.2 / 184.3, 184.3 / 184.3, -98.8 / 184.3]
    np.testing.assert_allclose(to_log_scale(power), wanted, atol=1e-12)


def test_channels_are_doppler_then_elevation():
    tesseract = np.full(SHAPE, 1.0)
    tesseract[2, 4, 1, 3] = 1e6  # Doppler 2, range 4, elevation 1, azimuth 3
    projection = project_tensor(tesseract)
    assert projection.shape == (6, 5, 7)
    strong = np.argwhere(projection > 0.1)
    np.testing.assert_array_equal(strong, [[4, 3, 2], [4, 3, 4 + 1]])


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_equals_the_plain_formula(layout, dtype):
    tesseract = LAYOUTS[layout](random_power(dtype=dtype))
    wanted = project_released(random_power(dtype=dtype).astype(np.float64))
    found = project_tensor(tesseract)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, wanted, atol=1e-6, rtol=0)
    if dtype == np.float64:  # computed in double precision, then rounded once
        np.testing.assert_array_equal(found, wanted.astype(np.float32))
    for other in (np.float16, np.uint8, np.int32, np.uint64):
        whole = LAYOUTS[layout](np.arange(np.prod(SHAPE)).reshape(SHAPE).astype(other))
        wanted = project_released(whole.astype(np.float64))
        np.testing.assert_allclose(project_tensor(whole), wanted, atol=1e-6)


@settings(deadline=None, max_examples=50)
@given(
    cells=st.lists(
        st.tuples(
            *(st.integers(0, n - 1) for n in SHAPE),
            st.sampled_from([0.0, -0.0, -1.0, -1e-30, 1e-12, 3e38, np.inf, np.nan]),
        ),
        max_size=4,
    ),
    layout=st.sampled_from(["C", "column-major"]),
)
def test_odd_numbers_are_reduced_as_floats_are(cells, layout):
    tesseract = random_power(dtype=np.float32) * 0 - 0.5
    tesseract[::2] = 1.0
    for *cell, value in cells:
        tesseract[tuple(cell)] = value
    with np.errstate(invalid="ignore"):
        found = project_tensor(LAYOUTS[layout](tesseract))
        tesseract[tesseract < 0] = np.nan  # as its logarithm
        maxima = [tesseract.max(2).transpose(1, 2, 0), tesseract.max(0).swapaxes(1, 2)]
        wanted = to_log_scale(np.concatenate(maxima, -1))
    np.testing.assert_array_equal(found, wanted)


def test_jax_on_one_frame_and_on_batches():
    frames = np.stack([random_power(seed) for seed in range(3)])
    wanted = np.stack([project_tensor(frame) for frame in frames])
    one = project_jax(jnp.asarray(frames[0]))
    np.testing.assert_allclose(one, wanted[0], atol=1e-6, rtol=0)
    many = project_jax(jnp.asarray(frames))
    assert many.dtype == jnp.float32
    np.testing.assert_allclose(many, wanted, atol=1e-6, rtol=0)


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    "tesseract",
    [np.ones((2, 3, 4)), np.ones((2, 0, 3, 4)), np.ones(SHAPE, complex), "text"],
)
def test_what_is_no_tesseract(tesseract):
    with pytest.raises(UserError, match=r"a tesseract is a real array \[Doppler,"):
        project_tensor(tesseract)


# Half a step of the type below 1.
MAX_ERROR = {"float16": 2.0**-12, "uint8": 0.5 / 255, "float32": 2.0**-25}


@settings(deadline=None, max_examples=50)
@given(
    levels=hnp.arrays(np.float32, 7, elements=st.floats(0, 1, width=32)),
    encoding=st.sampled_from(ENCODINGS),
)
def test_error_is_what_is_stated(levels, encoding):
    stored = encode(levels, encoding)
    assert stored.dtype == encoding
    error = np.abs(decode(stored).astype(np.float64) - levels).max()
    assert error <= MAX_ERROR[encoding] * (1 + 1e-3)
    clipped = encode(np.array([-0.2, 0.5, 1.3], np.float32), "uint8")
    assert clipped.tolist() == [0, 128, 255]  # 127.5 to even


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_device_and_host_decode_alike(encoding):
    levels = np.linspace(0, 1, 300, dtype=np.float32)
    stored = encode(levels, encoding)
    found = jax.jit(to_float)(jnp.asarray(stored))
    assert found.dtype == jnp.float32
    chex.assert_trees_all_close(found, decode(stored), rtol=1e-6, atol=0)


def _image(kind):
    """One range-azimuth image of a single look in a unit."""
    power = np.random.default_rng(0).exponential(1e5, (64, 50, 2))
    power[20:24, 10:14] *= 1e4
    return {
        "power": power,
        "averaged_power": power.mean(-1),
        "amplitude": np.sqrt(power),
        "db": 10 * np.log10(power),
        "steps": np.rint(20 * np.log10(power)).astype(np.uint8),
    }[kind]


@pytest.mark.parametrize(
    "kind", ["power", "averaged_power", "amplitude", "db", "steps"]
)
def test_units_are_converted_to_power(kind):
    unit, step = ("db", 0.5) if kind == "steps" else (kind, 0.0)
    power = linear_power(_image(kind), unit, "a.npy", db_per_step=step)
    expected = _image("averaged_power" if kind == "averaged_power" else "power")
    assert power.dtype == np.float32
    np.testing.assert_allclose(power, expected, rtol=0.07 if step else 1e-4)


@pytest.mark.parametrize(
    ("kind", "unit", "message"),
    [
        ("amplitude", "power", r"by [34]\.\d dB .* as if values were 'amplitude'"),
        ("power", "amplitude", r"by 1[56]\.\d dB .* as if values were 'power'"),
    ],
)
def test_values_of_another_unit_are_refused(kind, unit, message):
    with pytest.raises(DataError, match=f"'{unit}': noise rises {message}"):
        linear_power(_image(kind), unit, "a.npy")


def test_ranges_may_be_another_axis():
    values = _image("amplitude").swapaxes(0, 1)
    far = values * np.geomspace(1e3, 1, 64)[:, None]  # noise that differs in range
    with pytest.raises(DataError, match=r"noise rises by [34]\.\d dB"):
        linear_power(far, "power", "a.npy", range_axis=1)


def test_problems_of_files_and_in_programs_are_the_same():
    """The number of the problem, for the host, a tensor and its projection."""
    rng = np.random.default_rng(0)
    power = 10 ** rng.uniform(-3, 15, SHAPE)
    negative, one_nan, empty = power.copy(), power.copy(), power.copy()
    negative[0, 0, 0, 0], one_nan[0, 0, 0, 0] = -1.0, np.nan
    empty[..., :1] = 0.0
    decibels = rng.uniform(1.1, 299.0, SHAPE)
    cases = [(None, power), (0, negative), (0, one_nan), (1, empty)]
    for number, tensor in [*cases, (2, np.full(SHAPE, 7.0)), (3, decibels)]:
        tensor = tensor.astype(np.float32)
        projection = np.asarray(project_jax(tensor))
        beams = projection[..., SHAPE[0] :].max(axis=0)
        expected = None if number is None else PROBLEMS[number]
        assert find_problem(beams, float(tensor[..., 0].min())) == expected
        forms = [(tensor, True)]
        if tensor is not negative and number != 0:  # maxima are not the smallest values
            forms.append((projection, False))
        for frame, are_tensors in forms:
            found = find_invalid(jnp.asarray(frame[None]), are_tensors=are_tensors)
            first = [i for i, mask in enumerate(found) if mask[0]][:1]
            assert first == ([] if number is None else [number])


def test_stacked_frames_are_separated():
    frames = np.random.default_rng(0).random((3, 2, 6, 5, 7))  # T, B, R, A, D+E
    stacked = stack_frames(list(frames), 4)
    found = unstack_frames(stacked, 3, 4)
    np.testing.assert_array_equal(found, np.moveaxis(frames, 0, 1))
    for num_doppler in (0, 7):  # a radar without Doppler or elevation
        found = unstack_frames(stack_frames(list(frames), num_doppler), 3, num_doppler)
        np.testing.assert_array_equal(found, np.moveaxis(frames, 0, 1))
