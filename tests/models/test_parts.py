"""The parts of a model, seen while it is traced."""

from typing import Any

import jax
import pytest

from radejax.models.parts import Call, calls_of

from .. import small_models as small


def _calls(kind: str, depth: int = 1) -> tuple[dict[str, Call], Any]:
    """Of a small detector on one frame, and the variables; nothing is computed."""
    detector = small.detector(kind)
    inputs: list[Any] = [small.projections(1)]
    if kind == "camera":
        camera = small.calibration().camera()
        inputs += [small.images(1), small.stack_cameras([camera])]
    calls: dict[str, Call] = {}

    def run(*inputs: Any) -> Any:
        found = calls_of(lambda: detector.model.apply(*inputs), depth)
        _check_chain(found, kind)
        calls.update(found)
        return {name: (call.args, call.output) for name, call in found.items()}

    shapes = jax.eval_shape(run, detector.variables, *inputs)
    for name, call in calls.items():
        own = {"params": detector.variables["params"][name.split("/")[0]]}
        if depth == 1 and kind == "radar":  # a part alone, with its own variables
            args, output = shapes[name]
            assert jax.eval_shape(call.module.apply, own, *args) == output
    return calls, shapes


def _check_chain(calls: dict[str, Call], kind: str) -> None:
    """Each part gets the very array that the one before returned."""
    before_neck = "image_fusion" if kind == "camera" else "backbone"
    assert calls["neck"].args[0] is calls[before_neck].output
    assert calls["heads"].args[0] is calls["neck"].output
    if kind == "camera":
        assert calls["image_fusion"].args[0] is calls["backbone"].output
        assert calls["image_fusion"].args[2] is calls["image_neck"].output


@pytest.mark.parametrize("kind", ["radar", "camera"])
def test_parts_are_called_in_turn_with_what_the_one_before_returned(kind: str) -> None:
    calls, shapes = _calls(kind)
    image = ["image_backbone", "image_neck"] * (kind == "camera")
    fusion = ["image_fusion"] * (kind == "camera")
    assert list(calls) == [*image, "backbone", *fusion, "neck", "heads"]
    assert shapes["neck"][1].shape == (1, 16, 16, 8)
    assert shapes["heads"][1].heatmap_logits.shape == (1, 16, 16, 5)


def test_depth_says_how_deep_to_look() -> None:
    calls, shapes = _calls("radar", 2)
    assert {"backbone", "backbone/encoder_1", "heads/box"} < set(calls)
    assert shapes["backbone/encoder_2"][1].shape == (1, 8, 8, 8)
