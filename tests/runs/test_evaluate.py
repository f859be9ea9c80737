"""What is done to the frames of a run before it is evaluated."""

import dataclasses
import pathlib
from types import SimpleNamespace
from typing import Any

import pytest

from radejax.core.errors import UserError
from radejax.data.kradar.frame import Frame
from radejax.runs import evaluate
from radejax.runs.evaluate import with_images_exchanged


def _frames(paths: list[str | None]) -> list[Frame]:
    blank = {field.name: None for field in dataclasses.fields(Frame)}
    return [
        Frame(
            **blank | {"name": str(i), "camera_path": p, "camera_calibration_path": p}
        )
        for i, p in enumerate(paths)
    ]


def test_every_frame_sees_another_ones_image() -> None:
    paths = ["a", "b", None, "c", "d", "e"]
    exchanged = with_images_exchanged(_frames(paths), seed=3)
    found = [frame.camera_path for frame in exchanged]
    assert [frame.name for frame in exchanged] == list("012345")
    assert sorted(filter(None, found)) == ["a", "b", "c", "d", "e"]
    assert found[2] is None
    assert all(a != b for a, b in zip(found, paths, strict=True) if b is not None)
    assert found == [frame.camera_calibration_path for frame in exchanged]

    def again(seed: int) -> list[str | None]:
        frames = with_images_exchanged(_frames(paths), seed)
        return [frame.camera_path for frame in frames]

    assert found == again(3)
    assert any(found != again(seed) for seed in range(4, 8))


def test_images_of_fewer_than_two_frames_cannot_be_exchanged() -> None:
    with pytest.raises(UserError, match="1 frames have an image: none to exchange"):
        with_images_exchanged(_frames(["a", None]), seed=0)


@pytest.mark.parametrize(
    ("choosing", "split", "step", "folder", "remark"),
    [
        ("test", "test", "best", "evaluation", "chosen on the test split"),
        ("test", "test", None, "evaluation", ""),
        ("validation", "test", "best", "evaluation", ""),
        ("validation", "validation", None, "evaluation_validation", ""),
        ("validation", "all", "best", "evaluation", "chosen on the validation split"),
    ],
)
def test_numbers_on_what_chose_the_checkpoint_are_marked(
    choosing: str,
    split: str,
    step: str | None,
    folder: str,
    remark: str,
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    written: dict[str, Any] = {}
    data = SimpleNamespace(choosing_split=choosing)
    loaded = SimpleNamespace(model=None, variables=None, step=3)
    monkeypatch.setattr(evaluate, "load", lambda *_, **__: loaded)
    monkeypatch.setattr(evaluate, "data_of_run", lambda *_: (None, data))
    monkeypatch.setattr(evaluate, "evaluate", lambda *_, **named: written.update(named))
    evaluate.evaluate_run(tmp_path, step=step, split=split)
    assert written["out"] == tmp_path / folder
    assert written["remark"] == (f" ({remark})" if remark else "")
    assert ("may not be reported" in caplog.text) == bool(remark)
