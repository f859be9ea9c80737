"""Tests of `radejax.weights.torch_file`."""

import io
import pickle
import tracemalloc
import zipfile

import numpy as np
import pytest

from radejax.core.errors import DataError
from radejax.weights import torch_file, torch_pickle


def check_equal(actual, expected):
    assert actual.keys() == set(expected.files)
    for name, value in actual.items():
        assert value.dtype == expected[name].dtype
        assert value.shape == expected[name].shape
        np.testing.assert_array_equal(value, expected[name])


@pytest.mark.parametrize(
    ("file", "expected", "key"),
    [
        ("channel_attention", "channel_attention", None),
        ("channel_attention_legacy", "channel_attention", None),
        ("nested_checkpoint", "channel_attention", "model"),
        ("mixed_dtypes", "mixed_dtypes", None),
    ],
)
def test_reads_torchs_files_exactly(shared, file, expected, key):
    folder = shared / "fixtures/torch_files"
    content = torch_file.read(folder / f"{file}.pth")
    if key is not None:
        assert content["epoch"] == 3
        content = content[key]
    check_equal(content, np.load(folder / f"{expected}_expected.npz"))


ARRAYS = {
    "weight": np.arange(6, dtype=np.float32).reshape(2, 3),
    "half": np.array([0.5, -2.0], np.float16),
    "count": np.array(7, np.int64),
    "flags": np.array([True, False]),
    "empty": np.zeros((0, 3), np.float32),
    "transposed": np.arange(6.0).reshape(2, 3).T,
}


def test_reads_what_it_writes(tmp_path):
    torch_file.write(tmp_path / "x.pth", ARRAYS)
    content = torch_file.read(tmp_path / "x.pth")
    assert list(content) == list(ARRAYS)
    for name, value in ARRAYS.items():
        assert content[name].dtype == value.dtype
        np.testing.assert_array_equal(content[name], value)


def test_torch_reads_what_it_writes(tmp_path):
    torch = pytest.importorskip("torch")
    torch_file.write(tmp_path / "x.pth", ARRAYS)
    content = torch.load(tmp_path / "x.pth", weights_only=True)
    for name, value in ARRAYS.items():
        assert content[name].numpy().dtype == value.dtype
        np.testing.assert_array_equal(content[name].numpy(), value)


@pytest.mark.parametrize("is_zip", [True, False])
def test_reads_torchs_own_checkpoints(tmp_path, is_zip):
    torch = pytest.importorskip("torch")
    base = torch.arange(12.0).reshape(3, 4)
    optimizer = torch.optim.AdamW([torch.nn.Parameter(base.clone())])
    checkpoint = {
        "model": {"view": base.T[1:], "bf16": base.to(torch.bfloat16)},
        "optimizer": optimizer.state_dict(),
        "shape": base.shape,
    }
    path = tmp_path / "x.pth"
    torch.save(checkpoint, path, _use_new_zipfile_serialization=is_zip)
    content = torch_file.read(path)
    np.testing.assert_array_equal(content["model"]["view"], base.T[1:])
    np.testing.assert_array_equal(content["model"]["bf16"], base)
    assert content["shape"] == (3, 4)
    assert content["optimizer"]["param_groups"][0]["lr"] == 1e-3


class Attack:
    """Would create a file when unpickled in the usual way."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def zip_with(path, pickled, **members):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x/data.pkl", pickled)
        for name, data in members.items():
            archive.writestr(f"x/data/{name}", data)


def test_runs_no_code(tmp_path):
    witness = tmp_path / "witness"
    pickled = pickle.dumps({"a": Attack(str(witness)), "b": 1}, protocol=2)
    zip_with(tmp_path / "x.pth", pickled)
    content = torch_file.read(tmp_path / "x.pth")
    assert isinstance(content["a"], torch_pickle.Opaque)
    assert content["b"] == 1
    assert not witness.exists()


def test_objects_of_other_classes_are_inert(tmp_path):
    config = pickle.dumps({"config": Attack, "lr": 0.1}, protocol=2)
    zip_with(tmp_path / "x.pth", config)
    assert torch_file.read(tmp_path / "x.pth")["lr"] == 0.1


def tensor_pickle(size=6, offset=0, shape=(2, 3), strides=(3, 1), dtype="FloatStorage"):
    """A pickled tensor with any numbers in it."""
    return b"".join(
        [
            b"\x80\x02}X\x01\x00\x00\x00actorch._utils\n_rebuild_tensor_v2\n((",
            torch_file._pickle_text("storage"),
            f"ctorch\n{dtype}\n".encode(),
            torch_file._pickle_text("0") + torch_file._pickle_text("cpu"),
            torch_file._pickle_int(size) + b"tQ",
            torch_file._pickle_int(offset),
            torch_file._pickle_ints(shape) + torch_file._pickle_ints(strides),
            b"\x89ccollections\nOrderedDict\n)RtRs.",
        ]
    )


def test_tensor_pickle_is_right_when_its_numbers_are(tmp_path):
    data = np.arange(6, dtype="<f4")
    zip_with(tmp_path / "x.pth", tensor_pickle(), **{"0": data.tobytes()})
    expected = data.reshape(2, 3)
    np.testing.assert_array_equal(torch_file.read(tmp_path / "x.pth")["a"], expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"offset": 1}, "reaches outside its storage"),
        ({"strides": (-1, 1)}, "reaches outside its storage"),
        ({"shape": (2, 30)}, r"shape \(2, 30\) of a storage of 6"),
        ({"size": 7}, "has 24 bytes, expected 28"),
        ({"dtype": "QInt8Storage"}, "not supported"),
    ],
)
def test_damaged_tensors_are_refused(tmp_path, changes, message):
    data = np.arange(6, dtype="<f4").tobytes()
    zip_with(tmp_path / "x.pth", tensor_pickle(**changes), **{"0": data})
    with pytest.raises(DataError, match=rf"x\.pth: .*{message}"):
        torch_file.read(tmp_path / "x.pth")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a torch file"),
        (b"hello", "not a torch file"),
        (pickle.dumps([1, 2]), "without torch's magic number"),
        (b"\x80\x02garbage", "damaged"),
        (b"PK\x03\x04garbage", "damaged"),
    ],
)
def test_other_files_are_refused(tmp_path, content, message):
    path = tmp_path / "x.pth"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"x\.pth: .*{message}"):
        torch_file.read(path)


def test_zip_without_a_pickle_is_refused(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.txt", "text")
    (tmp_path / "x.pth").write_bytes(buffer.getvalue())
    with pytest.raises(DataError, match=r"zip archive without data.pkl"):
        torch_file.read(tmp_path / "x.pth")


@pytest.mark.parametrize("cut", [10, 200, 1000, 3000])
def test_cut_files_are_refused(shared, tmp_path, cut):
    for name in ("channel_attention", "channel_attention_legacy"):
        data = (shared / f"fixtures/torch_files/{name}.pth").read_bytes()
        (tmp_path / "x.pth").write_bytes(data[:cut])
        with pytest.raises(DataError, match=r"x\.pth"):
            torch_file.read(tmp_path / "x.pth")


def zeros(size=6):
    return np.zeros(size, np.float32).tobytes()


def opcodes(*parts):
    return b"\x80\x02" + b"".join(parts) + b"."


NESTED = b"]" + b"".join(  # each list has the one before it twice
    b"q" + bytes([i]) + b"0](h" + bytes([i]) + b"h" + bytes([i]) + b"e"
    for i in range(60)
)
DEEP = b"]" * 5000 + b"a" * 4999


@pytest.mark.parametrize(
    ("pickled", "message"),
    [
        (tensor_pickle(6, 0, (1000, 1000, 600), (0, 0, 0)), "of a storage of 6"),
        (opcodes(b"]r\x00\x00\x00\x08"), None),  # a place in the memo, 2**27
        (opcodes(NESTED), "nested more than 64 deep, or more than 100000 values"),
        (opcodes(DEEP), "nested more than 64 deep"),
        (opcodes(b"\x8d", (2**40).to_bytes(8, "little"), b"x"), "damaged torch file"),
        (tensor_pickle(-1), "a storage has -1 values"),
    ],
    ids=["stride", "memo", "shared", "deep", "length", "size"],
)
def test_claims_take_no_memory_and_no_time(tmp_path, pickled, message):
    path = tmp_path / "x.pth"
    zip_with(path, pickled, **{"0": zeros()})
    tracemalloc.start()
    if message is None:
        assert torch_file.read(path) == []
    else:
        with pytest.raises(DataError, match=f"x.pth: .*{message}"):
            torch_file.read(path)
    assert tracemalloc.get_traced_memory()[1] < 64 << 20
    tracemalloc.stop()


def test_one_storage_in_many_tensors_is_limited(tmp_path):
    one = tensor_pickle(1000, 0, (1000,), (1,))[2:-1]
    body = b"(" + one * 50 + b"l."
    zip_with(tmp_path / "x.pth", b"\x80\x02" + body, **{"0": zeros(1000)})
    with pytest.raises(DataError, match="far more bytes than the file"):
        torch_file.read(tmp_path / "x.pth")


def test_deflated_members_are_limited(tmp_path):
    path = tmp_path / "x.pth"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x/data.pkl", tensor_pickle())
        archive.writestr("x/data/0", bytes(1 << 24))
    with pytest.raises(DataError, match="x/data/0: claims 16777216 bytes, expected"):
        torch_file.read(path)


def test_a_pickle_cannot_change_what_it_calls(tmp_path):
    name = b"ctorch._utils\n_rebuild_tensor_v2\n"
    state = b"N}X\x0c\x00\x00\x00__defaults__K\x01\x85s\x86b"  # (None, {...}), BUILD
    zip_with(tmp_path / "x.pth", b"\x80\x02" + name + state + b".")
    torch_file.read(tmp_path / "x.pth")
    assert torch_pickle._rebuild_tensor.__defaults__ is None
    write_and_read = tmp_path / "y.pth"
    torch_file.write(write_and_read, ARRAYS)
    assert torch_file.read(write_and_read).keys() == ARRAYS.keys()
