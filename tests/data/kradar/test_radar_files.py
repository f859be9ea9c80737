"""Radar files in folders."""

import pytest

from radejax.core.errors import UserError
from radejax.data.kradar.radar_files import find_frames, key_of


def test_every_frame_is_found_once_and_its_projection_preferred(tmp_path, monkeypatch):
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
    found = find_frames([tmp_path])
    assert sorted(path.relative_to(tmp_path).as_posix() for path in found) == [
        "5/DERA_tesseract/DERA_tesseract_00034.npy",
        "5/radar_tesseract/tesseract_00033.mat",
        "6/radar_tesseract/tesseract_00033.mat",
    ]
    assert sorted(map(key_of, found)) == ["5/00033", "5/00034", "6/00033"]
    # Sequences and weather select frames.
    for sequence, weather in (("5", "fog"), ("6", "rain")):
        (tmp_path / sequence / "description.txt").write_text(f"urban,day,{weather}\n")
    assert [key_of(path) for path in find_frames([tmp_path], (6, 9))] == ["6/00033"]
    assert len(find_frames([tmp_path], weather=("fog",))) == 2
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"no frames for .*, 5, rain:"):
        find_frames([tmp_path], (5,), ("rain",))
    with pytest.raises(UserError, match=r"looked for tesseract_\*"):
        find_frames([tmp_path / "empty"])
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        find_frames([tmp_path / "gone"])


def test_frames_of_one_name_in_other_folders_are_all_found(tmp_path):
    for drive in ("drive1", "drive2"):
        (tmp_path / drive).mkdir()
        (tmp_path / drive / "tesseract_00001.mat").touch()
    files = sorted(tmp_path.glob("*/*.mat"))
    assert find_frames([tmp_path]) == find_frames(files) == files
