"""A checkpoint that is not what was saved is found, whatever of it is damaged."""

import gc
import pathlib
import random
import shutil
from collections.abc import Iterator
from typing import Any

import grain
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.errors import DataError
from radejax.training import checksums, sharding
from radejax.training.checkpoints import Checkpoints, abstract_state

# Restoring of damaged files ends orbax's event loop while others are still read.
pytestmark = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)

WEIGHTS = np.random.default_rng(0).random((16, 4), np.float32)


@pytest.fixture(autouse=True)
def what_orbax_left_is_collected() -> Iterator[None]:
    """Here, where its complaints are expected, and not in another file's test."""
    yield
    gc.collect()


def _iterator() -> Any:
    dataset = grain.MapDataset.range(1000).repeat(None)
    return iter(dataset.to_iter_dataset(grain.ReadOptions(num_threads=0)))


def _state(step: int) -> dict[str, Any]:
    return {
        "params": {"w": jnp.asarray(WEIGHTS * step)},
        "opt_state": [{"w": jnp.asarray(-WEIGHTS * step)}],
        "step": jnp.int32(step),
    }


def _abstract() -> Any:
    whole, state = sharding.replicated(sharding.make_mesh(1)), _state(0)
    return abstract_state(state, jax.tree.map(lambda _: whole, state))


@pytest.fixture
def folder(tmp_path: pathlib.Path) -> pathlib.Path:
    """Checkpoints of steps 1, 2 and 3."""
    iterator = _iterator()
    with Checkpoints(tmp_path / "checkpoints", max_to_keep=None) as checkpoints:
        for step in (1, 2, 3):
            next(iterator)
            checkpoints.save(step, _state(step), iterator, info={"config": {"a": 1.5}})
    return tmp_path / "checkpoints"


def _read(folder: pathlib.Path, step: int | None = None) -> tuple[Any, dict, int]:
    with Checkpoints(folder, read_only=True) as checkpoints:
        return checkpoints.restore_variables(step)


def _files(folder: pathlib.Path) -> list[pathlib.Path]:
    return [path for path in sorted(folder.rglob("*")) if path.is_file()]


# Of each file, one bit at a time; the many are some thousand, each restored twice.
@pytest.mark.parametrize("flips", [5, pytest.param(150, marks=pytest.mark.slow)])
@pytest.mark.timeout(3000)
def test_a_flipped_bit_anywhere_is_found_or_does_no_harm(
    folder: pathlib.Path, flips: int
) -> None:
    draw, messages, num_set_aside = random.Random(0), [], 0
    whole = folder.with_name("whole")
    shutil.copytree(folder, whole)
    for path in _files(folder / "3"):
        content = path.read_bytes()
        for _ in range(flips if content else 0):
            bit = draw.randrange(8 * len(content))
            damaged = bytearray(content)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            try:
                state, info, step = _read(folder)
            except DataError as error:
                messages.append(str(error))
            else:
                assert (info, step) == ({"config": {"a": 1.5}}, 3)
                np.testing.assert_array_equal(state["params"]["w"], WEIGHTS * 3)
            iterator = _iterator()
            with Checkpoints(folder, max_to_keep=None) as checkpoints:
                state, info, step = checkpoints.restore(_abstract(), iterator)
            assert info == {"config": {"a": 1.5}}
            assert int(state["step"]) == step == next(iterator)
            np.testing.assert_array_equal(state["params"]["w"], WEIGHTS * step)
            np.testing.assert_array_equal(state["opt_state"][0]["w"], -WEIGHTS * step)
            if step != 3:
                num_set_aside += 1
                shutil.rmtree(folder)  # what was damaged was set aside
                shutil.copytree(whole, folder)
        path.write_bytes(content)
    assert min(len(messages), num_set_aside) > 3 * flips
    for message in messages:
        assert message.startswith(f"checkpoint 3 in {folder} is damaged (")
        assert message.endswith("); step 2 is whole")


def test_whole_files_with_other_weights_are_found(folder: pathlib.Path) -> None:
    shutil.rmtree(folder / "3" / "state")
    shutil.copytree(folder / "2" / "state", folder / "3" / "state")
    with pytest.raises(DataError, match=r"3 .* \(array params/w is not what was saved"):
        _read(folder)
    with Checkpoints(folder, max_to_keep=None) as checkpoints:
        assert checkpoints.restore(_abstract(), _iterator())[2] == 2


def test_every_bit_and_every_order_has_its_checksum() -> None:
    values = np.zeros((3, 5), np.float32)
    sums = {checksums.of_arrays([values])["0"]}
    for element in range(15):
        for bit in range(32):
            other = values.copy()
            other.reshape(-1).view(np.uint32)[element] ^= np.uint32(1 << bit)
            sums.add(checksums.of_arrays([other])["0"])
    assert len(sums) == 15 * 32 + 1
    assert checksums.of_arrays([WEIGHTS]) != checksums.of_arrays([WEIGHTS[::-1].copy()])


def test_the_checksum_does_not_depend_on_the_placement() -> None:
    mesh = sharding.make_mesh()
    split = jax.sharding.NamedSharding(
        mesh, jax.sharding.PartitionSpec(mesh.axis_names[0])
    )
    assert mesh.size > 1
    state = {
        "w": WEIGHTS,
        "half": WEIGHTS.astype(jnp.bfloat16),
        "b": WEIGHTS > 0.5,
        "n": np.arange(16, dtype=np.int32),
    }
    placed = jax.tree.map(lambda x: jax.device_put(x, split), state)
    assert checksums.of_arrays(placed) == checksums.of_arrays(state)


def test_checkpoints_without_checksums_still_load(folder: pathlib.Path) -> None:
    shutil.rmtree(folder / "3" / "checksums")
    assert _read(folder)[2] == 3
    with Checkpoints(folder, max_to_keep=None) as checkpoints:
        assert checkpoints.restore(_abstract(), _iterator())[2] == 3


@pytest.mark.parametrize(
    "name", ["state/_METADATA", "state/_sharding", "info/metadata", "state", ""]
)
def test_reading_a_damaged_one_names_the_one_that_is_whole(
    folder: pathlib.Path, name: str
) -> None:
    shutil.rmtree(folder / "2" / "state")
    path = folder / "3" / name
    if path.is_dir():
        shutil.rmtree(path)
        (folder / "3").mkdir(exist_ok=True)
    else:
        path.write_bytes(b"{")
    with pytest.raises(DataError) as raised:
        _read(folder)
    assert str(raised.value).startswith(f"checkpoint 3 in {folder} is damaged (")
    assert str(raised.value).endswith("); step 1 is whole")
    assert "\n" not in str(raised.value)
    assert _read(folder, 1)[2] == 1
    shutil.rmtree(folder / "1" / "state")
    with pytest.raises(DataError, match="no other one is whole"):
        _read(folder)


def test_an_empty_folder_with_the_name_of_a_step(folder: pathlib.Path) -> None:
    (folder / "99").mkdir()
    with pytest.raises(DataError, match=r"checkpoint 99 .*; step 3 is whole"):
        _read(folder)
