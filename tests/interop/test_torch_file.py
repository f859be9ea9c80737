"""Tests of `radejax.interop.torch_file`."""

import io
import pickle
import zipfile

import numpy as np
import pytest

from radejax.core.errors import DataError
from radejax.interop import torch_file


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
    assert isinstance(content["a"], torch_file.Opaque)
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
        ({"shape": (2, 30)}, "reaches outside its storage"),
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
