"""Tests of `radejax.weights.torch_file`."""

import contextlib
import pickle
import tracemalloc
import zipfile

import numpy as np
import pytest

from radejax.core.errors import DataError
from radejax.weights import torch_file

from ..torch_files import pickle_tensor, pickle_text, write_zip


@pytest.fixture
def torchs_file(released, tmp_path):
    """Function from the name of a file that torch wrote to its path."""

    def write(name):
        path = tmp_path / f"{name}.pth"
        path.write_bytes(released("torch_files")[name].tobytes())
        return path

    return write


def test_reads_torchs_files_exactly(released, torchs_file):
    nested = torch_file.read(torchs_file("nested_checkpoint"))
    assert nested["epoch"] == 3
    mixed = torch_file.read(torchs_file("mixed_dtypes"))
    files = {"channel_attention": nested["model"], "mixed_dtypes": mixed}
    for name, found in files.items():
        expected = released(f"torch_expected/{name}")
        assert found.keys() == expected.keys()
        for key, value in found.items():
            assert value.dtype == expected[key].dtype
            np.testing.assert_array_equal(value, expected[key], strict=True)


class Attack:
    """Would create a file when unpickled in the usual way."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def test_runs_no_code(tmp_path):
    witness = tmp_path / "witness"
    write_zip(tmp_path / "x.pth", pickle.dumps({"a": Attack(str(witness))}, protocol=2))
    with pytest.raises(DataError, match=r"x\.pth: holds .*open, which is not read"):
        torch_file.read(tmp_path / "x.pth")
    assert not witness.exists()


def tensor(size=6, shape=(2, 3), strides=(3, 1), offset=0, storage="FloatStorage"):
    """A pickled `{"a": tensor}` with any numbers in it."""
    body = pickle_tensor("0", size, shape, strides, offset, storage)
    return b"\x80\x02}" + pickle_text("a") + body + b"s."


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"offset": 1}, "reaches outside its storage"),
        ({"shape": (2, -3)}, "not sizes"),
        ({"shape": (2, 30)}, r"tensor \(2, 30\) reaches outside its storage \(6,\)"),
        ({"size": 7}, "has 24 bytes for 7 float32"),
        ({"storage": "QInt8Storage"}, "QInt8Storage, which is not read"),
    ],
)
def test_corrupted_tensors_are_rejected(tmp_path, changes, message):
    data = np.arange(6, dtype="<f4").tobytes()
    write_zip(tmp_path / "x.pth", tensor(**changes), **{"0": data})
    with pytest.raises(DataError, match=rf"x\.pth: .*{message}"):
        torch_file.read(tmp_path / "x.pth")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "starts with b''"),
        (b"hello", "expected a zip archive of torch 1.6"),
        (b"PK\x03\x04garbage", "corrupted"),
    ],
)
def test_other_files_are_rejected(tmp_path, content, message):
    path = tmp_path / "x.pth"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"x\.pth: .*{message}"):
        torch_file.read(path)


def test_what_is_no_state_dict_names_the_way_to_write_one(torchs_file, tmp_path):
    before_torch_1_6 = torchs_file("channel_attention_legacy")
    other_class, number = tmp_path / "class.pth", tmp_path / "number.pth"
    write_zip(other_class, pickle.dumps({"config": Attack, "lr": 0.1}, protocol=2))
    write_zip(number, pickle.dumps(np.float64(1), protocol=2))
    for path in (before_torch_1_6, other_class, number):
        with pytest.raises(DataError, match=r"torch\.save"):
            torch_file.read(path)


@contextlib.contextmanager
def at_most(size):
    """The block takes so many bytes."""
    tracemalloc.start()
    yield
    assert tracemalloc.get_traced_memory()[1] < size
    tracemalloc.stop()


def opcodes(*parts):
    return b"\x80\x02" + b"".join(parts) + b"."


DOUBLED = b"".join(  # each tuple has the one before it twice
    b"q" + bytes([i]) + b"h" + bytes([i]) + b"\x86" for i in range(60)
)
REBUILD = b"ctorch._utils\n_rebuild_tensor_v2\n"


@pytest.mark.parametrize(
    "pickled",
    [
        opcodes(b"}N", DOUBLED, b"K\x01s"),  # a key whose hash takes 2**60 steps
        opcodes(b"}(N", DOUBLED, b"K\x01u"),
        opcodes(REBUILD, b"(NNNNNNNNNtR"),
        opcodes(REBUILD, b"(]K\x00)))tR"),  # a list as a storage
        b"\x80\x02",
    ],
)
def test_malformed_pickles_are_rejected_at_once(tmp_path, pickled):
    path = tmp_path / "x.pth"
    write_zip(path, pickled, **{"0": bytes(24)})
    with at_most(64 << 20), pytest.raises(DataError, match=r"x\.pth: "):
        torch_file.read(path)


def test_deflated_members_are_limited(tmp_path):
    path = tmp_path / "x.pth"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x/data.pkl", tensor())
        archive.writestr("x/data/0", bytes(1 << 24))
    with pytest.raises(DataError, match="x/data/0: 16777216 bytes, expected"):
        torch_file.read(path)


def test_a_pickle_cannot_change_what_it_calls(tmp_path):
    state = b"N}X\x0c\x00\x00\x00__defaults__K\x01\x85s\x86b"  # (None, {...}), BUILD
    defaults = torch_file._rebuild_tensor.__defaults__
    write_zip(tmp_path / "x.pth", opcodes(REBUILD, state))
    torch_file.read(tmp_path / "x.pth")
    assert torch_file._rebuild_tensor.__defaults__ == defaults
