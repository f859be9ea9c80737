"""ONNX files of a detector, for ONNX Runtime and TensorRT; written by jax2onnx."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from radejax.core.errors import UserError
from radejax.data.encoding import to_float
from radejax.geometry.camera import Camera
from radejax.inference.detector import Detector

NETWORK_FILE = "network.onnx"
DETECTOR_FILE = "detector.onnx"
INPUTS = ("projection", "image")
SETTINGS = {"score_threshold": (), "nms_iou": (), "roi": (6,)}
MAPS = ("heatmap_logits", "box_params")
DETECTIONS = ("boxes", "scores", "classes", "is_valid", "num_truncated")


def onnx_files(
    detector: Detector, variables: Mapping[str, Any], inputs: Sequence[Any]
) -> dict[str, bytes]:
    """The network, and network, decoding and rotated NMS, by file name.

    Args:
        detector: Gives the functions.
        variables: Of the model; they become constants of the files.
        inputs: Shapes of one batch: projection, and for a radar-camera model image and
            a dictionary of the camera's fields.

    Raises:
        UserError: jax2onnx is not installed.
    """
    try:
        from jax2onnx import to_onnx
    except ModuleNotFoundError as error:
        raise UserError(
            'format "onnx" needs jax2onnx: pip install "radejax[onnx]"'
        ) from error

    projection, *rest = inputs
    image, fields = rest if rest else (None, {})
    shapes = [projection, *([image] if rest else []), *fields.values()]
    names = [*INPUTS[: len(inputs)], *(f"camera_{name}" for name in fields)]
    function = detector.detect_function()

    def split(arrays: Sequence[jax.Array]) -> tuple[Any, ...]:
        if not rest:
            return (arrays[0],)
        return (
            arrays[0],
            arrays[1],
            Camera(**dict(zip(fields, arrays[2:], strict=True))),
        )

    def network(*arrays: jax.Array) -> list[jax.Array]:
        frames, *camera = split(arrays)
        maps = detector.model.apply(variables, to_float(frames), *camera, train=False)
        return [getattr(maps, name) for name in MAPS]

    def program(*arrays: jax.Array) -> list[jax.Array]:
        settings, arrays = arrays[-len(SETTINGS) :], arrays[: -len(SETTINGS)]
        frames, image, camera = (*split(arrays), None, None)[:3]
        found = function(
            variables, frames, image, camera, *settings, is_tesseract=False
        )
        return [getattr(found, name) for name in DETECTIONS]

    settings = [jax.ShapeDtypeStruct(s, jnp.float32) for s in SETTINGS.values()]
    wanted = {
        NETWORK_FILE: (network, shapes, names, MAPS),
        DETECTOR_FILE: (program, shapes + settings, [*names, *SETTINGS], DETECTIONS),
    }
    log = logging.getLogger("onnx_ir")
    level = log.level
    log.setLevel(logging.ERROR)  # it warns of every shape that it is not told
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Explicitly requested dtype float64")
            return {
                name: to_onnx(
                    function, shapes, input_names=given, output_names=list(results)
                ).SerializeToString()
                for name, (function, shapes, given, results) in wanted.items()
            }
    finally:
        log.setLevel(level)
