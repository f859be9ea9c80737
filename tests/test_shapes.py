"""`pytest --shapes` rejects arrays that do not match annotations."""

import importlib
import sys
import types
from collections.abc import Callable

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from . import shapes

Checked = Callable[[str], types.ModuleType]


@pytest.fixture
def checked(monkeypatch: pytest.MonkeyPatch) -> Checked:
    """Import a module again with its annotations checked."""

    def load(name: str) -> types.ModuleType:
        room, _, last = name.rpartition(".")
        monkeypatch.setattr(importlib.import_module(room), last, None, raising=False)
        monkeypatch.delitem(sys.modules, name, raising=False)
        with shapes.install():
            return importlib.import_module(name)

    return load


@pytest.fixture
def boxes(checked: Checked) -> types.ModuleType:
    return checked("radejax.geometry.boxes")


def test_a_wrong_shape_is_rejected_by_name(boxes: types.ModuleType) -> None:
    with pytest.raises(TypeCheckError, match="parameter 'boxes'"):
        boxes.boxes8_from_7(np.zeros((2, 8)))


def test_a_wrong_result_is_rejected(
    boxes: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(boxes, "_checked", lambda boxes, width: boxes[..., 1:])
    with pytest.raises(TypeCheckError, match="return value"):
        boxes.boxes8_from_7(np.zeros((2, 8))[:, :7])


def test_a_field_of_a_wrong_shape_is_rejected_by_name(checked: Checked) -> None:
    scene = checked("radejax.simulation.world.scene")
    flat, kind = np.zeros(2), np.zeros(2, int)
    assert scene.Reflectors(np.zeros((2, 3)), flat, flat, kind).kind is kind
    with pytest.raises(TypeCheckError, match="parameter 'kind'"):
        scene.Reflectors(np.zeros((2, 3)), flat, flat, kind[:1])
