"""`pytest --shapes` refuses arrays of other shapes than annotations say."""

import importlib
import sys
import types

import numpy as np
import pytest
from jaxtyping import TypeCheckError

import radejax.geometry

from . import shapes


@pytest.fixture
def boxes(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """`radejax.geometry.boxes`, imported once more, with its annotations checked."""
    monkeypatch.setattr(radejax.geometry, "boxes", None, raising=False)
    monkeypatch.delitem(sys.modules, "radejax.geometry.boxes", raising=False)
    with shapes.install():
        return importlib.import_module("radejax.geometry.boxes")


def test_fitting_arrays_pass(boxes: types.ModuleType) -> None:
    shifted = boxes.transform_boxes(np.zeros((2, 7)), [1, 2, 3], yaw_rad=0)
    assert shifted[0].tolist() == [1, 2, 3, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("shape", "shift", "parameter"),
    [((2, 8), np.zeros(3), "boxes"), ((2, 7), np.zeros(2), "translation_m")],
)
def test_a_wrong_shape_is_refused_by_name(
    boxes: types.ModuleType, shape: tuple[int, ...], shift: np.ndarray, parameter: str
) -> None:
    with pytest.raises(TypeCheckError, match=f"parameter '{parameter}'"):
        boxes.transform_boxes(np.zeros(shape), shift)


def test_a_wrong_result_is_refused(
    boxes: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(boxes, "_checked", lambda boxes, width: boxes[..., 1:])
    with pytest.raises(TypeCheckError, match="return value"):
        boxes.boxes8_from_7(np.zeros((2, 8))[:, :7])
