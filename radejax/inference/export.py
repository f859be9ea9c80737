"""Export of models to folders: StableHLO and ONNX programs, and Hugging Face models.

The programs run without radejax. Folders of all formats contain `config.json` and
`model.safetensors`, which `load_model` reads. docs/deploy.md explains how to use each format.
"""

from __future__ import annotations

import dataclasses
import logging
import pathlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.export  # not a part of `import jax`
import jax.numpy as jnp
from flax import traverse_util

from radejax.core import files
from radejax.core.errors import UserError, require
from radejax.core.structures import to_float
from radejax.geometry.camera import Camera
from radejax.inference import exported_loader
from radejax.inference.detector import SETTINGS, Detector, placeholder
from radejax.inference.saved import save_model
from radejax.models.dinorade import IMAGE_BACKBONE

PLATFORMS = ("cpu", "cuda", "tpu")
KNOWN_PLATFORMS = (*PLATFORMS, "rocm")
FORMATS = ("stablehlo", "onnx", "huggingface")
PROGRAM_FILE = "detector.stablehlo"

CHUNK_SIZE = 1024
"""Default chunk size of the deformable attention in ONNX files, in bins."""

RESULTS = ("boxes", "scores", "classes", "is_valid", "num_truncated")

_README = """---
library_name: radejax
pipeline_tag: object-detection
tags: [radar, 4d-radar, 3d-object-detection, k-radar, jax, flax]
---

# {name}: 3D object detection in 4D radar tensors

- Classes: {classes}
- Input: projections [B, {shape}]; docs/deploy.md of radejax describes inputs, outputs and
  files
- Use: `radejax.Detector.from_workdir(folder)`
- Left out: {left_out}
- {origin}
"""
_LEFT_OUT = (
    "the frozen DINOv3 weights, whose license restricts redistribution: download them "
    "from their owner and pass `image_backbone=FOLDER`"
)
_SIMULATED = "Trained on simulated data only: no use on frames of a real radar"
_MEASURED = (
    "Check the license of the training data before publishing (K-Radar: CC BY-NC-ND)"
)


def export(
    detector: Detector,
    folder: str | pathlib.Path,
    *,
    kind: str = "stablehlo",
    platforms: Sequence[str] = PLATFORMS,
    with_backbone: bool = False,
    batch_size: int | None = None,
    half: bool = False,
) -> dict[str, Any]:
    """Write a folder with the model; existing files of the same names are replaced.

    Args:
        detector: Detector to export. Its thresholds and region of interest become the
            defaults.
        folder: Folder, which is created if missing.
        kind: Format of the folder. All formats contain the weights, the config and a
            model card, and "huggingface" contains only these. "stablehlo" adds the program
            and `load.py`, which needs only jax, flatbuffers and numpy. "onnx" adds the
            network, and the network with decoding and NMS, for one batch size.
        platforms: Platforms of the StableHLO program, from `KNOWN_PLATFORMS`.
        with_backbone: Keep the weights of the image transformer, see `save_model`.
        batch_size: Number of frames per call; None means any number with StableHLO, and 1
            with ONNX.
        half: Store the weights as float16; only with "huggingface".

    Returns:
        "bytes", the size of all files in the folder, and "left_out", the names of the
        variables that were not written.

    Raises:
        UserError: The kind or a platform is unknown, jax2onnx is not installed for ONNX,
            the image transformer is to be kept for ONNX, or `half` is given for a program,
            which takes float32 weights.
    """
    require(kind in FORMATS, "format", kind, f"one of {FORMATS}")
    is_known = set(platforms) <= set(KNOWN_PLATFORMS)
    require(is_known, "platforms", platforms, f"some of {KNOWN_PLATFORMS}")
    if half and kind != "huggingface":
        raise UserError("--half is only supported with --format huggingface")
    folder = files.as_path(folder)
    programs: dict[str, bytes] = {}
    if kind == "stablehlo":
        programs[PROGRAM_FILE] = _stablehlo(
            detector, platforms, batch_size, with_backbone
        )
    elif kind == "onnx":
        programs = _onnx_files(detector, batch_size or 1, with_backbone)
    content = save_model(
        detector.saved,
        folder,
        with_backbone=with_backbone,
        half=half,
        programs=programs,
    )
    if kind == "stablehlo":
        loader = pathlib.Path(exported_loader.__file__)
        files.write_text(folder / "load.py", loader.read_text())
    files.write_text(folder / "README.md", _readme(detector, content["left_out"]))
    return {
        "bytes": sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()),
        "left_out": content["left_out"],
    }


def _readme(detector: Detector, left_out: Sequence[str]) -> str:
    """Return the text of the model card, which refers to docs/deploy.md for details."""
    config = detector.saved.config
    is_simulated = (config.get("simulation") or {}).get("scenes") == "procedural"
    return _README.format(
        name={"radenet": "RADE-Net", "dinorade": "DinoRADE"}[config.model.name],
        classes=", ".join(detector.classes),
        shape=", ".join(map(str, detector.grid.projection_shape)),
        left_out=_LEFT_OUT if left_out else "nothing",
        origin=_SIMULATED if is_simulated else _MEASURED,
    )


# Programs ----------------------------------------------------------------------------


def _array(*shape: Any, dtype: Any = jnp.float32) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


def _exported(
    detector: Detector, batch: Any, with_backbone: bool
) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """Return the variables of a program and the shapes of its inputs.

    The inputs are projections and, for a radar-camera model, images and a dictionary of
    the camera's fields. Without the image transformer, the images are embedded ones.
    """
    variables = {name: dict(tree) for name, tree in detector.variables.items()}
    projection = _array(batch, *detector.grid.projection_shape)
    if not detector.takes_camera:
        return variables, (projection,)
    model = detector.model
    image, camera = jax.tree.map(
        lambda x: _array(batch, *x.shape[1:], dtype=x.dtype), placeholder(1, model)
    )
    if not (with_backbone or model.vit is None):
        variables["params"].pop(IMAGE_BACKBONE, None)
        image = _array(batch, *model.feature_shape)
    return variables, (projection, image, vars(camera))


def _detect(
    detector: Detector, variables: Any, inputs: Sequence[Any], settings: Sequence[Any]
) -> dict[str, jax.Array]:
    """Run the detector on inputs in the shapes of `_exported`, for both program formats."""
    projection, *rest = inputs
    image, camera = (rest[0], Camera(**rest[1])) if rest else (None, None)
    given = dict(zip(SETTINGS, settings, strict=True))
    function = detector.detect_function()
    found = function(variables, projection, image, camera, given)
    return {name: getattr(found, name) for name in RESULTS}


def _stablehlo(
    detector: Detector,
    platforms: Sequence[str],
    batch_size: int | None,
    with_backbone: bool,
) -> bytes:
    """Return the serialized program from weights, inputs and settings to detections.

    The result of the program is a dictionary of arrays. The batch size is symbolic if
    `batch_size` is None. Without the backbone, the images are embedded ones.
    """
    batch = batch_size or jax.export.symbolic_shape("b")[0]
    variables, inputs = _exported(detector, batch, with_backbone)
    flat = traverse_util.flatten_dict(variables, sep="/")

    def program(weights: Any, inputs: Any, *settings: Any) -> dict[str, jax.Array]:
        tree = traverse_util.unflatten_dict(weights, sep="/")
        return _detect(detector, tree, inputs, settings)

    weights = {name: _array(*x.shape) for name, x in flat.items()}
    settings = [_array(*shape) for shape in SETTINGS.values()]
    exported = jax.export.export(jax.jit(program), platforms=tuple(platforms))(
        weights, inputs, *settings
    )
    return bytes(exported.serialize())


def _onnx_files(
    detector: Detector, batch_size: int, with_backbone: bool
) -> dict[str, bytes]:
    """Return the contents of the ONNX files by name.

    `network.onnx` contains the network, and `detector.onnx` also decoding and rotated NMS.

    Raises:
        UserError: jax2onnx is not installed, or the image transformer is to be kept.
    """
    if with_backbone and getattr(detector.model, "vit", None) is not None:
        raise UserError(
            "the image backbone cannot be exported to ONNX: drop --with-backbone and "
            "feed precomputed embeddings (docs/deploy.md)"
        )
    try:
        from jax2onnx import to_onnx
    except ModuleNotFoundError as error:
        raise UserError(
            'format "onnx" needs jax2onnx: pip install "radejax[onnx]"'
        ) from error

    # With a fixed chunk size, the program does not choose by platform, which jax2onnx
    # cannot convert.
    if detector.takes_camera:
        config = detector.saved.config.copy_and_resolve_references()
        config.model.fusion.chunk_size = config.model.fusion.chunk_size or CHUNK_SIZE
        detector = Detector(dataclasses.replace(detector.saved, config=config))
    variables, shapes = _exported(detector, batch_size, with_backbone)
    leaves, tree = jax.tree.flatten(shapes)
    names = ["projection", "image"][: len(shapes)]
    names += [f"camera_{name}" for name in sorted(shapes[2])] if shapes[2:] else []

    def network(*arrays: jax.Array) -> list[jax.Array]:
        projection, *rest = jax.tree.unflatten(tree, arrays)
        camera = [rest[0], Camera(**rest[1])] if rest else []
        inputs = to_float(projection), *camera
        maps: Any = detector.model.apply(variables, *inputs, train=False)
        return [maps.heatmap_logits, maps.box_params]

    def program(*arrays: jax.Array) -> list[jax.Array]:
        inputs = jax.tree.unflatten(tree, arrays[: len(leaves)])
        found = _detect(detector, variables, inputs, arrays[len(leaves) :])
        return list(found.values())

    def convert(function: Any, extra: Mapping[str, Any], results: Any) -> bytes:
        given = leaves + [_array(*shape) for shape in extra.values()]
        outputs = list(results)
        model = to_onnx(
            function, given, input_names=[*names, *extra], output_names=outputs
        )
        return model.SerializeToString()

    # onnx_ir warns of every shape that is not static.
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Explicitly requested dtype float64")
        return {
            "network.onnx": convert(network, {}, ("heatmap_logits", "box_params")),
            "detector.onnx": convert(program, SETTINGS, RESULTS),
        }
