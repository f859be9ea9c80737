import io
import zipfile

import numpy as np
import pytest

from radejax.core.archives import read_member, read_npy, read_npz, read_safetensors
from radejax.core.errors import DataError


def npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize(
    "array",
    [
        np.arange(24.0).reshape(2, 3, 4),
        np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        np.array(["Sedan", "Bus or Truck"]),
        np.zeros((0, 7)),
        np.float32(3),
    ],
)
def test_arrays_are_what_was_written(tmp_path, array):
    (tmp_path / "a.npy").write_bytes(npy(array))
    np.savez(tmp_path / "a.npz", first=array, second=np.arange(3))
    found = read_npz(tmp_path / "a.npz")
    assert list(found) == ["first", "second"]
    for one in (read_npy(tmp_path / "a.npy"), found["first"]):
        np.testing.assert_array_equal(one, array)
        assert one.dtype == array.dtype


def test_a_shape_that_is_not_the_files_is_named(tmp_path):
    content = npy(np.zeros(4)).replace(b"(4,), }            ", b"(400000000000,), }  ")
    (tmp_path / "a.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("first.npy", content)
    (tmp_path / "b.npy").write_bytes(npy(np.zeros(4)) + b"more")
    readers = {"a.npy": read_npy, "b.npy": read_npy, "a.npz": read_npz}
    for name, reader in readers.items():
        with pytest.raises(DataError, match=f"{name}: corrupted"):
            reader(tmp_path / name)


@pytest.mark.parametrize("reader", [read_npy, read_npz])
def test_every_truncation_and_flip_is_read_or_named(tmp_path, reader):
    path = tmp_path / f"a.{reader.__name__[-3:]}"
    {read_npy: np.save, read_npz: np.savez_compressed}[reader](path, np.arange(6.0))
    content = path.read_bytes()
    num_named = 0
    for place in range(len(content)):
        flipped = content[:place] + bytes([content[place] ^ 64]) + content[place + 1 :]
        for damaged in (flipped, content[:place]):
            path.write_bytes(damaged)
            try:
                reader(path)
            except DataError as error:
                assert str(path) in str(error)  # noqa: PT017
                num_named += 1
    assert num_named >= len(content)


def test_members_that_are_not_read(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb", bytes(1 << 20))
    with zipfile.ZipFile(path) as archive:
        assert read_member(archive, "bomb", max_bytes=1 << 20) == bytes(1 << 20)
        with pytest.raises(DataError, match="1048576 bytes, expected at most 1000"):
            read_member(archive, "bomb", max_bytes=1000)
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(content)
    with zipfile.ZipFile(path) as archive, pytest.raises(DataError, match="encrypted"):
        read_member(archive, "bomb", max_bytes=1 << 20)


def test_a_pointer_in_place_of_weights(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    with pytest.raises(DataError, match=r"model\.safetensors: a pointer of Git LFS"):
        read_safetensors(path)
