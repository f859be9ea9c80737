"""Checkpoints: what is kept, what is refused, and that all corruption of them is found."""

import gc
import itertools
import json
import pathlib
import random
import shutil
import subprocess

import grain
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core import devices
from radejax.core.errors import DataError, DiskFullError
from radejax.training.checkpoints import Checkpoints, array_checksums

from .. import processes

# Restoring of corrupted files ends orbax's event loop while others are still read.
_UNRAISABLE = "ignore::pytest.PytestUnraisableExceptionWarning"
pytestmark = pytest.mark.filterwarnings(_UNRAISABLE)

WEIGHTS = np.random.default_rng(0).random((16, 4), np.float32)


@pytest.fixture(autouse=True)
def what_orbax_left_is_collected():
    """Here, where its complaints are expected, and not in another file's test."""
    yield
    gc.collect()


def _iterator():
    dataset = grain.MapDataset.range(1000).repeat(None)
    return iter(dataset.to_iter_dataset(grain.ReadOptions(num_threads=0)))


def _state(step):
    return {
        "params": {"w": jnp.asarray(WEIGHTS * step)},
        "opt_state": [{"w": jnp.asarray(-WEIGHTS * step)}],
        "ema_params": None,
        "step": jnp.int32(step),
    }


def _abstract(state=None):
    whole = devices.replicated(devices.make_mesh(1))
    state = _state(0) if state is None else state
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=whole), state
    )


def _restored_step(folder):
    with Checkpoints(folder, max_to_keep=None) as checkpoints:
        return checkpoints.restore(_abstract(), _iterator())[2]


def _read(folder, step=None):
    with Checkpoints(folder, read_only=True) as checkpoints:
        return checkpoints.restore_variables(step)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    iterator, folder = _iterator(), tmp_path_factory.mktemp("saved")
    with Checkpoints(folder, max_to_keep=None) as checkpoints:
        for step in (1, 2, 3):
            next(iterator)
            checkpoints.save(step, _state(step), iterator, info={"config": {"a": 1.5}})
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    """Checkpoints of steps 1, 2 and 3."""
    return shutil.copytree(saved, tmp_path / "checkpoints")


def test_state_position_and_info_come_back(folder):
    iterator = _iterator()
    with Checkpoints(folder) as checkpoints:
        state, info, step = checkpoints.restore(_abstract(), iterator)
    assert (info, step) == ({"config": {"a": 1.5}}, 3)
    np.testing.assert_array_equal(state["params"]["w"], WEIGHTS * 3)
    np.testing.assert_array_equal(state["opt_state"][0]["w"], WEIGHTS * -3)
    assert next(iterator) == 3
    state, info, step = _read(folder, 2)
    assert (info, step) == ({"config": {"a": 1.5}}, 2)
    np.testing.assert_array_equal(state["params"]["w"], WEIGHTS * 2)
    # The optimizer's moments, twice the size of the parameters, are not read.
    assert set(state) == {"params", "ema_params", "model_state", "frozen"}
    assert state["ema_params"] is None
    with pytest.raises(FileNotFoundError, match=r"step 7 .*there are \[1, 2, 3\]"):
        _read(folder, 7)


def test_the_best_is_kept(tmp_path):
    iterator = _iterator()
    metrics = {2: 5.0, 4: 3.0}
    with Checkpoints(tmp_path, max_to_keep=1) as checkpoints:
        for step in range(1, 6):
            best = metrics.get(step)
            checkpoints.save(step, _state(step), iterator, info={}, best=best)
            checkpoints.wait()
        assert checkpoints.steps() == [2, 5]
        assert checkpoints.best_step() == 2
    with (
        Checkpoints(tmp_path / "other") as checkpoints,
        pytest.raises(FileNotFoundError, match="was evaluated: train with"),
    ):
        checkpoints.best_step()


def test_nothing_to_restore(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.restore(_abstract(), _iterator()) is None
    with pytest.raises(FileNotFoundError, match="no checkpoint in"):
        _read(tmp_path)


def test_all_corrupted_is_an_error_not_a_fresh_start(folder):
    for path in folder.rglob("*"):
        if path.is_file() and "state" in path.parts:
            path.write_bytes(b"")
    for _ in range(2):  # nor is it one at the second try
        with pytest.raises(DataError, match=r"none of the checkpoints \[1, 2, 3\]"):
            _restored_step(folder)
    assert sorted(p.name for p in folder.iterdir()) == ["1", "2", "3"]


def test_a_half_written_folder_is_not_a_checkpoint(folder):
    half = folder / "4.orbax-checkpoint-tmp-123" / "state"
    half.mkdir(parents=True)
    (half / "array").write_bytes(b"half")
    assert _restored_step(folder) == 3
    assert not half.exists()


@pytest.fixture
def small_disk(tmp_path):
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


def test_a_full_disk_is_one_clear_error_and_earlier_checkpoints_stay(small_disk):
    # Random bits do not compress: 1 MiB a checkpoint.
    values = np.random.default_rng(0).random((8, 2**15), np.float32)

    def state(step):
        return {"w": jnp.asarray(values * step), "step": jnp.int32(step)}

    iterator, folder = _iterator(), small_disk / "checkpoints"
    checkpoints = Checkpoints(folder, max_to_keep=None)

    def fill():
        for step in range(1, 99):
            checkpoints.save(step, state(step), iterator, info={})
            checkpoints.wait()

    with pytest.raises(DiskFullError, match="no space left"):
        fill()
    with Checkpoints(folder) as intact:
        restored, _, step = intact.restore(_abstract(state(1)), _iterator())
    assert step >= 2
    np.testing.assert_array_equal(restored["w"], values * step)


# Corruption --------------------------------------------------------------------------


@pytest.fixture
def tiny(tmp_path):
    """A checkpoint of few bytes, so that each of its bits has its turn."""
    state = {"params": {"w": jnp.asarray(WEIGHTS[:2, :2])}}
    iterator = _iterator()
    next(iterator)
    with Checkpoints(tmp_path / "checkpoints") as checkpoints:
        checkpoints.save(1, state, iterator, info={"a": 1.5})
    return tmp_path / "checkpoints"


def _bits(folder):
    """All bits of the headers, and a thousand of the rest.

    Headers are what describes the arrays, the position, the configuration and the
    metrics, and the frame of the file with the numbers. The rest are the numbers, and
    what is written and never read: what orbax merged, and the texts "was successful".
    """
    rest = []
    for path in filter(pathlib.Path.is_file, sorted(folder.rglob("*"))):
        bits = [(path, bit) for bit in range(8 * path.stat().st_size)]
        name = path.relative_to(folder).as_posix()
        if "ocdbt.process_0" in name or path.suffix == ".txt":
            rest += bits
        elif path.parent.name == "d":
            rest += bits[8 * 14 : -8 * 4]
            yield from bits[: 8 * 14] + bits[-8 * 4 :]
        else:
            yield from bits
    yield from random.Random(0).sample(rest, 1000)


# All 13,000 take three processor minutes, 15 ms a restore; the suite takes some.
@pytest.mark.parametrize("every", [101, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.timeout(1200)
def test_a_flipped_bit_anywhere_is_found_or_does_no_harm(tiny, every):
    num_found, bits = 0, _bits(tiny)
    state = _abstract({"params": {"w": WEIGHTS[:2, :2]}})
    with Checkpoints(tiny) as writer, Checkpoints(tiny, read_only=True) as reader:
        for number, (path, bit) in enumerate(itertools.islice(bits, 0, None, every)):
            content = bytearray(path.read_bytes())
            content[bit // 8] ^= 1 << bit % 8
            path.write_bytes(content)
            iterator = _iterator()
            try:
                if number % 8:
                    found, info, step = writer.restore(state, iterator)
                    assert next(iterator) == 1
                else:
                    found, info, step = reader.restore_variables()
            except DataError:
                num_found += 1
            else:
                assert (info, step) == ({"a": 1.5}, 1), (path, bit)
                weights = np.asarray(found["params"]["w"])
                assert np.array_equal(weights, WEIGHTS[:2, :2]), (path, bit)
            content[bit // 8] ^= 1 << bit % 8
            path.write_bytes(content)
    assert num_found > 0.3 * number


def test_whole_files_with_other_weights_are_found(folder):
    shutil.rmtree(folder / "3" / "state")
    shutil.copytree(folder / "2" / "state", folder / "3" / "state")
    with pytest.raises(DataError, match=r"3 .*corrupted \(the .* of array params/w"):
        _read(folder)
    assert _restored_step(folder) == 2


def test_the_checksum_does_not_depend_on_the_placement():
    mesh = devices.make_mesh()
    spec = jax.sharding.PartitionSpec(mesh.axis_names[0])
    split = jax.sharding.NamedSharding(mesh, spec)
    assert mesh.size > 1
    state = {
        "w": WEIGHTS,
        "half": WEIGHTS.astype(jnp.bfloat16),
        "b": WEIGHTS > 0.5,
        "n": np.arange(16, dtype=np.int32),
    }
    placed = jax.tree.map(lambda x: jax.device_put(x, split), state)
    assert array_checksums(placed) == array_checksums(state)


@pytest.mark.parametrize(
    "name", ["state/_METADATA", "state/_sharding", "description/metadata", ""]
)
def test_a_corrupted_checkpoint_is_named_and_an_earlier_one_restored(folder, name):
    shutil.rmtree(folder / "2" / "state")
    path = folder / "3" / name
    if path.is_dir():
        shutil.rmtree(path)
        (folder / "3").mkdir(exist_ok=True)
    else:
        path.write_bytes(b"{")
    with pytest.raises(DataError) as raised:
        _read(folder)
    assert str(raised.value).startswith(f"checkpoint 3 in {folder} is corrupted (")
    assert str(raised.value).endswith("); there are [1, 2, 3]")
    assert "\n" not in str(raised.value)
    assert _read(folder, 1)[2] == 1
    # A state with known shardings is restored without the file of shardings.
    newest = 3 if name == "state/_sharding" else 1
    assert _restored_step(folder) == newest
    with Checkpoints(folder, read_only=True) as checkpoints:
        assert checkpoints.steps()[-1] == newest


def test_a_corrupted_description_is_an_error(folder):
    path = folder / "2" / "_CHECKPOINT_METADATA"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"custom_metadata": 1.5}))
    for read_only in (True, False):
        with pytest.raises(DataError, match=r"description .* corrupted \(Obj"):
            Checkpoints(folder, read_only=read_only)
    shutil.move(folder / "2", folder.with_name("2"))
    with Checkpoints(folder) as checkpoints:
        assert checkpoints.steps() == [1, 3]


# Several processes -------------------------------------------------------------------

# Restores from a folder per process one array that all devices hold and one that is split.
RESTORE = (
    processes.JOIN
    + """
import grain
import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from radejax.training.checkpoints import Checkpoints

mesh = devices.make_mesh()
iterator = iter(grain.MapDataset.range(1000).repeat(None).to_iter_dataset())
state = {
    name: jax.ShapeDtypeStruct((16, 4), np.float32, sharding=NamedSharding(mesh, spec))
    for name, spec in {"whole": PartitionSpec(), "split": PartitionSpec("data")}.items()
}
with Checkpoints(sys.argv[1 + index], max_to_keep=None) as checkpoints:
    restored, info, step = checkpoints.restore(state, iterator)
shards = [restored[name].addressable_data(0) for name in ("whole", "split")]
print([step, *(len(shard) for shard in shards), *(float(s.sum()) for s in shards)])
"""
)


def test_processes_that_see_different_checkpoints_restore_the_same_one(tmp_path):
    mine, other, iterator = tmp_path / "mine", tmp_path / "other", _iterator()
    with Checkpoints(mine, max_to_keep=None) as checkpoints:
        for step in (1, 2, 3):
            state = {"whole": WEIGHTS * step, "split": WEIGHTS * -step}
            state = jax.tree.map(jnp.asarray, state)
            checkpoints.save(step, state, iterator, info={})
    shutil.copytree(mine, other)
    shutil.rmtree(other / "3")  # the listing of the second process is out of date
    for path in (other / "2" / "state").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    started = processes.start(2, "-c", RESTORE, str(mine), str(other))
    outputs = processes.outputs_of(started, timeout_s=60)
    assert [p.returncode for p in started] == [0, 0], "\n".join(outputs)
    for output, rows in zip(outputs, (slice(0, 8), slice(8, 16)), strict=True):
        found = json.loads(output.splitlines()[-1])
        assert found[:3] == [1, 16, 8]
        sums = [WEIGHTS.sum(), -WEIGHTS[rows].sum()]
        np.testing.assert_allclose(found[3:], sums, 1e-5)
    assert [path.name for path in mine.iterdir()] == ["1"]
    moved = tmp_path / "mine_corrupted"
    assert sorted(path.name for path in moved.iterdir()) == ["2", "3"]
