"""Finding frames in folders and naming their results."""

import pathlib

import pytest

from radejax.detect_files import find_frames, output_name
from radejax.errors import UserError


@pytest.fixture
def root(tmp_path: pathlib.Path) -> pathlib.Path:
    for name in (
        "5/radar_tesseract/tesseract_00033.mat",
        "5/radar_tesseract/tesseract_00034.mat",
        "5/DERA_tesseract/DERA_tesseract_00034.npy",
        "5/info_label/00033_00001.txt",
        "6/radar_tesseract/tesseract_00033.mat",
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


def test_every_frame_is_found_once_and_its_projection_preferred(
    root: pathlib.Path,
) -> None:
    found = [path.relative_to(root).as_posix() for path in find_frames([root])]
    assert sorted(found) == [
        "5/DERA_tesseract/DERA_tesseract_00034.npy",
        "5/radar_tesseract/tesseract_00033.mat",
        "6/radar_tesseract/tesseract_00033.mat",
    ]
    assert find_frames([root, root / "5"]) == find_frames([root])


def test_names_of_results_are_unique_among_sequences(root: pathlib.Path) -> None:
    names = [output_name(path) for path in find_frames([root])]
    assert sorted(names) == [
        "5_tesseract_00033",
        "5_tesseract_00034",
        "6_tesseract_00033",
    ]


def test_nothing_found_and_nothing_there(tmp_path: pathlib.Path) -> None:
    with pytest.raises(UserError, match=r"no frames in .* looked for tesseract_\*"):
        find_frames([tmp_path])
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        find_frames([tmp_path / "gone"])
