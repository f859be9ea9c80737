"""Checkpoints by themselves: what is kept, what is refused."""

import pathlib
import subprocess
from collections.abc import Iterator
from typing import Any

import grain
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.errors import DataError, DiskFullError
from radejax.training import distributed
from radejax.training.checkpoints import Checkpoints, abstract_state


def _iterator() -> Any:
    dataset = grain.MapDataset.range(10).repeat(None)
    return iter(dataset.to_iter_dataset(grain.ReadOptions(num_threads=0)))


def _state(value: float) -> dict[str, Any]:
    moments = {"w": jnp.full((4, 2), -value)}
    return {
        "params": {"w": jnp.full((4, 2), value)},
        "opt_state": [moments],
        "ema_params": None,
        "step": jnp.int32(value),
    }


def _abstract() -> Any:
    mesh = distributed.make_mesh(1)
    state = _state(0.0)
    return abstract_state(
        state, jax.tree.map(lambda _: distributed.replicated(mesh), state)
    )


def _save(folder: pathlib.Path, steps: int, **options: Any) -> None:
    iterator = _iterator()
    with Checkpoints(folder, **options) as checkpoints:
        for step in range(1, steps + 1):
            next(iterator)
            checkpoints.save(step, _state(float(step)), iterator, info={"step": step})


def test_state_position_and_info_come_back(tmp_path: pathlib.Path) -> None:
    _save(tmp_path, 3)
    iterator = _iterator()
    with Checkpoints(tmp_path) as checkpoints:
        state, info, step = checkpoints.restore(_abstract(), iterator)
        assert checkpoints.steps() == [2, 3]
    assert info["step"] == step == 3
    np.testing.assert_array_equal(state["params"]["w"], 3.0)
    np.testing.assert_array_equal(state["opt_state"][0]["w"], -3.0)
    assert next(iterator) == 3
    with Checkpoints(tmp_path, read_only=True) as checkpoints:
        state, info, step = checkpoints.restore_variables(2)
    assert (info["step"], step) == (2, 2)
    np.testing.assert_array_equal(state["params"]["w"], 2.0)
    # The optimizer's moments, twice the size of the parameters, are not read.
    assert set(state) == {"params", "ema_params", "model_state"}
    assert state["ema_params"] is None


def test_the_best_is_kept(tmp_path: pathlib.Path) -> None:
    iterator = _iterator()
    metrics = {2: {"best": 5.0}, 4: {"best": 3.0}}
    with Checkpoints(tmp_path, max_to_keep=1) as checkpoints:
        for step in range(1, 6):
            checkpoints.save(
                step, _state(step), iterator, info={}, metrics=metrics.get(step)
            )
            checkpoints.wait()
        assert checkpoints.steps() == [2, 5]
        assert checkpoints.best_step() == 2
    with (
        Checkpoints(tmp_path / "other") as checkpoints,
        pytest.raises(FileNotFoundError, match="was evaluated: train with"),
    ):
        checkpoints.best_step()


def test_nothing_to_restore(tmp_path: pathlib.Path) -> None:
    with Checkpoints(tmp_path / "new") as checkpoints:
        assert checkpoints.restore(_abstract(), _iterator()) is None
    with (
        Checkpoints(tmp_path / "new", read_only=True) as checkpoints,
        pytest.raises(FileNotFoundError, match="no checkpoint in"),
    ):
        checkpoints.restore_variables()


def test_a_step_that_is_not_there_lists_those_that_are(tmp_path: pathlib.Path) -> None:
    _save(tmp_path, 3)
    with (
        Checkpoints(tmp_path, read_only=True) as checkpoints,
        pytest.raises(FileNotFoundError, match=r"step 7 .*there are \[2, 3\]"),
    ):
        checkpoints.restore_variables(7)


def test_all_damaged_is_an_error_not_a_fresh_start(tmp_path: pathlib.Path) -> None:
    folder = tmp_path / "checkpoints"
    _save(folder, 2)
    for path in folder.rglob("*"):
        if path.is_file() and "state" in path.parts:
            path.write_bytes(b"")
    for _ in range(2):  # nor is it one at the second try
        with (
            Checkpoints(folder) as checkpoints,
            pytest.raises(DataError, match=r"none of the checkpoints \[1, 2\]"),
        ):
            checkpoints.restore(_abstract(), _iterator())
    assert sorted(p.name for p in folder.iterdir()) == ["1", "2"]


def test_a_half_written_folder_is_not_a_checkpoint(tmp_path: pathlib.Path) -> None:
    _save(tmp_path, 2)
    half = tmp_path / "3.orbax-checkpoint-tmp-123" / "state"
    half.mkdir(parents=True)
    (half / "array").write_bytes(b"half")
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.steps() == [1, 2]
        assert checkpoints.restore(_abstract(), _iterator())[2] == 2


@pytest.fixture
def small_disk(tmp_path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A file system of 3 MiB; needs the rights to mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(folder)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("cannot mount a small file system here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


# The error ends Orbax's event loop while other files of the checkpoint are still being
# written; TensorStore then reports each of them to a loop that is closed.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_is_one_clear_error_and_earlier_checkpoints_stay(
    small_disk: pathlib.Path,
) -> None:
    # Random bits do not compress: 1 MiB a checkpoint.
    values = np.random.default_rng(0).random((8, 2**15), np.float32)

    def state(step: int) -> dict[str, jax.Array]:
        return {"w": jnp.asarray(values * step), "step": jnp.int32(step)}

    iterator, folder = _iterator(), small_disk / "checkpoints"
    checkpoints = Checkpoints(folder, max_to_keep=None)

    def fill() -> None:
        for step in range(1, 99):
            checkpoints.save(step, state(step), iterator, info={})
            checkpoints.wait()

    with pytest.raises(DiskFullError, match=r"no space left for a checkpoint .*intact"):
        fill()
    whole = distributed.replicated(distributed.make_mesh(1))
    with Checkpoints(folder) as intact:
        wanted = abstract_state(state(1), {"w": whole, "step": whole})
        restored, _, step = intact.restore(wanted, _iterator())
    assert step >= 2
    np.testing.assert_array_equal(restored["w"], values * step)
