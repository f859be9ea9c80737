"""Models as folders without this package: StableHLO, ONNX, or Hugging Face's files.

All formats hold `config.json` and `model.safetensors`, which
`Detector.from_checkpoint` reads back.
"""

from __future__ import annotations

import pathlib
import shutil
from collections.abc import Mapping, Sequence
from typing import Any

import flatbuffers
import jax
import jax.export  # not a part of `import jax`
import jax.numpy as jnp
from flax import traverse_util
from ml_collections import ConfigDict

from radejax.core import files
from radejax.core.errors import UserError
from radejax.geometry.camera import Camera
from radejax.inference import export_onnx, exported_loader, packed
from radejax.inference.detector import Detector
from radejax.inference.packed import BACKBONE

PLATFORMS = ("cpu", "cuda", "tpu")
KNOWN_PLATFORMS = (*PLATFORMS, "rocm")
FORMATS = ("stablehlo", "onnx", "huggingface")
PROGRAM_FILE = "detector.stablehlo"

CAMERA_SHAPES = {
    "cam_from_ego": (3, 4),
    "intrinsics": (4,),
    "distortion": (5,),
    "max_radius": (),
    "size_px": (2,),
}
"""Float fields of `radejax.geometry.camera.Camera`, beside the bool `is_valid`."""


def export(
    detector: Detector,
    folder: str | pathlib.Path,
    *,
    kind: str = "stablehlo",
    platforms: Sequence[str] = PLATFORMS,
    training_config: ConfigDict | None = None,
    with_backbone: bool = False,
    batch_size: int = 1,
    half: bool = False,
) -> dict[str, Any]:
    """Writes a folder with the model; existing files of the same names are replaced.

    Args:
        detector: What to export, with its thresholds as defaults.
        folder: Made if missing.
        kind: "stablehlo": program, weights and `load.py`, which needs jax and numpy
            alone; "onnx": network, and network with decoding and NMS, for one batch
            size; "huggingface": weights, config and model card.
        platforms: That StableHLO shall run on: of `KNOWN_PLATFORMS`; "gpu" is CUDA.
        training_config: Kept in `config.json`.
        with_backbone: Keep the image transformer's weights, see `write_packed`.
        batch_size: Frames of a call of the ONNX files.
        half: Store float16; "huggingface" alone.

    Returns:
        "kind", "folder", "bytes" and "left_out".

    Raises:
        UserError: An unknown kind or platform; ONNX without jax2onnx; half
            of a program, which takes float32 weights.
    """
    if kind not in FORMATS:
        raise UserError(f"format is {kind!r}, expected one of {FORMATS}")
    if half and kind != "huggingface":
        raise UserError("--half: a program takes float32; give --format huggingface")
    platforms = _checked_platforms(platforms)
    folder = pathlib.Path(folder)
    programs: dict[str, bytes] = {}
    if kind == "stablehlo":
        program = stablehlo(detector, platforms, with_backbone=with_backbone)
        programs = {PROGRAM_FILE: program}
    elif kind == "onnx":
        if detector.takes_camera and detector.model.vit is not None and with_backbone:
            raise UserError(
                "the image transformer does not convert to ONNX: leave --with-backbone, "
                "and give the file embedded images (docs/deploy.md)"
            )
        variables, is_embedded = _exported_variables(detector, with_backbone)
        shapes = _input_shapes(detector, batch_size, is_embedded)
        programs = export_onnx.onnx_files(detector, variables, shapes)
    content = packed.write_packed(
        folder,
        detector,
        training_config=training_config,
        with_backbone=with_backbone,
        half=half,
        programs=programs,
    )
    if kind == "stablehlo":
        _copy_loader(folder)
        text = _program_readme(detector, platforms)
    elif kind == "onnx":
        text = _onnx_readme(detector, batch_size)
    else:
        text = _model_card(detector, content, half)
    files.write_text(folder / "README.md", text)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return {
        "kind": kind,
        "folder": str(folder),
        "bytes": size,
        "left_out": content["left_out"],
    }


def _checked_platforms(platforms: Sequence[str]) -> tuple[str, ...]:
    names = ["cuda" if p.strip() == "gpu" else p.strip() for p in platforms]
    for name in names:
        if name not in KNOWN_PLATFORMS:
            known = ", ".join(KNOWN_PLATFORMS)
            raise UserError(f"platform is {name!r}, expected some of {known}")
    return tuple(dict.fromkeys(names))


def stablehlo(
    detector: Detector,
    platforms: Sequence[str] = PLATFORMS,
    *,
    with_backbone: bool = False,
) -> bytes:
    """The serialised program: weights, inputs, thresholds -> dictionary of arrays.

    Inputs are projections `[B, R, A, D+E]`, and for a radar-camera model also images
    and a dictionary of the camera's fields. B is symbolic. Without the backbone the
    images are embedded ones.

    Raises:
        UserError: Weights that are not float32.
    """
    variables, is_embedded = _exported_variables(detector, with_backbone)
    flat = traverse_util.flatten_dict(variables, sep="/")
    if odd := sorted(name for name, x in flat.items() if x.dtype != jnp.float32):
        raise UserError(f"weights must be float32 to be exported; {odd[0]} is not")
    function = detector.detect_function()

    def program(
        weights: Mapping[str, Any], inputs: tuple[Any, ...], *settings: Any
    ) -> dict[str, jax.Array]:
        projection, *rest = inputs
        image, camera = rest if rest else (None, None)
        if camera is not None:
            camera = Camera(**camera)
        tree = traverse_util.unflatten_dict(weights, sep="/")
        found = function(tree, projection, image, camera, *settings, is_tesseract=False)
        names = ("boxes", "scores", "classes", "is_valid", "num_truncated")
        return {name: getattr(found, name) for name in names}

    (batch,) = jax.export.symbolic_shape("b")

    inputs = _input_shapes(detector, batch, is_embedded)
    weights = {name: _array(*x.shape) for name, x in flat.items()}
    exported = jax.export.export(jax.jit(program), platforms=tuple(platforms))(
        weights, inputs, _array(), _array(), _array(6)
    )
    return bytes(exported.serialize())


def _array(*shape: Any, dtype: Any = jnp.float32) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


def _exported_variables(
    detector: Detector, with_backbone: bool
) -> tuple[dict[str, Any], bool]:
    """What the file holds, and whether its images are embedded ones."""
    variables = {name: dict(tree) for name, tree in detector.variables.items()}
    is_embedded = detector.takes_camera and not (
        with_backbone or detector.model.vit is None
    )
    if is_embedded:
        variables["params"].pop(BACKBONE, None)
    return variables, is_embedded


def _input_shapes(detector: Detector, batch: Any, is_embedded: bool) -> tuple[Any, ...]:
    """Of projections, and for a camera of images and the fields of `Camera`."""
    projection = _array(batch, *detector.grid.projection_shape)
    if not detector.takes_camera:
        return (projection,)
    model = detector.model
    image = _array(batch, *model.image_size, 3, dtype=jnp.uint8)
    if is_embedded:
        image = _array(batch, *model.feature_shape)
    camera = {name: _array(batch, *s) for name, s in CAMERA_SHAPES.items()}
    return projection, image, camera | {"is_valid": _array(batch, dtype=jnp.bool_)}


def _copy_loader(folder: pathlib.Path) -> None:
    """`load.py`, and the pure-Python library that `jax.export` reads files with."""
    files.write_text(
        folder / "load.py", pathlib.Path(exported_loader.__file__).read_text()
    )
    source = pathlib.Path(flatbuffers.__file__).parent
    target = folder / "third_party" / "flatbuffers"
    target.mkdir(parents=True, exist_ok=True)
    for path in source.glob("*.py"):
        shutil.copyfile(path, target / path.name)


def _program_readme(detector: Detector, platforms: Sequence[str]) -> str:
    grid = detector.grid
    shape = ", ".join(map(str, grid.projection_shape))
    return f"""# A radar detector as a program

`detector.stablehlo` goes from radar projections to boxes, network, decoding and rotated
NMS included, for any batch size, on {", ".join(platforms)}. It needs `jax` and `numpy`:

```python
from load import load
detect = load()
found = detect(projection)   # [B, {shape}] float32
```

`found` is a dictionary of arrays with {detector.decode_options["max_detections"]} rows a
frame: `boxes` [B, K, 7] (x, y, z, l, w, h, yaw; metres and radians, x forward, y left, z
up, seen from the radar), `scores` [B, K], `classes` [B, K] (indices into `classes` of
`config.json`), `is_valid` [B, K] (True where a row is a detection) and `num_truncated` [B]
(peaks that found no row). `detect` also takes `score_threshold`, `nms_iou` and `roi`
(x0, x1, y0, y1, z0, z1 in metres).

A projection is the maximum of the power over elevation ({grid.num_doppler} Doppler
channels) and over Doppler ({grid.num_elevation} elevation channels), on a logarithmic
scale: `radejax.data.projection.project`. The sensor's axes are in `config.json` under
`grid`.
{_camera_text(detector)}
| file | content |
|---|---|
| `detector.stablehlo` | the program, written by `jax.export` |
| `model.safetensors` | its weights, float32 |
| `config.json` | model, grid, classes, thresholds, training config |
| `load.py` | the loader |
| `third_party/flatbuffers` | pure Python, Apache-2.0; jax reads the program with it |

`radejax.Detector.from_checkpoint(folder)` reads the same folder.
"""


def _onnx_readme(detector: Detector, batch_size: int) -> str:
    shape = ", ".join(map(str, detector.grid.projection_shape))
    camera = _camera_text(detector)
    if camera:
        camera += (
            "Here each field is an input of its own: `camera_intrinsics` and so on.\n"
        )
    return f"""# A radar detector as ONNX files

| file | from | to |
|---|---|---|
| `network.onnx` | `projection` | `heatmap_logits`, `box_params`: before decoding |
| `detector.onnx` | `projection` and settings | detections, as below |

```python
import numpy as np, onnxruntime
session = onnxruntime.InferenceSession("detector.onnx")
everywhere = np.array([-1e9, 1e9] * 3, np.float32)   # x0, x1, y0, y1, z0, z1 in metres
settings = {{"score_threshold": np.float32(0.3), "nms_iou": np.float32(0.3), "roi": everywhere}}
boxes, scores, classes, is_valid, num_truncated = session.run(
    None, {{"projection": x, **settings}})   # x [{batch_size}, {shape}] float32
```

Rows, units and the projection are those of `docs/deploy.md` of radejax; `config.json` has
grid, classes and thresholds. `radejax.Detector.from_checkpoint(folder)` reads this folder.
{camera}"""


def _camera_text(detector: Detector) -> str:
    if not detector.takes_camera:
        return ""
    size = detector.model.image_size
    return f"""
The model takes a camera: `detect(projection, image, camera)` with images
[B, {size[0]}, {size[1]}, 3] uint8, or what the image backbone made of them
[B, {", ".join(map(str, detector.model.feature_shape))}] float32 if `config.json` lists it
under `left_out`, and `camera` a dictionary of arrays: `cam_from_ego` [B, 3, 4],
`intrinsics` [B, 4], `distortion` [B, 5], `max_radius` [B], `size_px` [B, 2] (float32) and
`is_valid` [B] (bool, False: no image, radar alone), the fields of
`radejax.geometry.camera.Camera`.
"""


def _model_card(detector: Detector, content: Mapping[str, Any], half: bool) -> str:
    simulation = (content["training_config"] or {}).get("simulation") or {}
    origin = (
        "Before publishing, check the licence of the data that the weights were trained on\n"
        "(K-Radar: CC BY-NC-ND)."
    )
    if simulation.get("scenes") == "procedural":
        origin = "Trained on simulated data alone: it does not know real radar frames."
    name = {"radenet": "RADE-Net", "dinorade": "DinoRADE"}[content["model"]["name"]]
    left_out = ""
    if content["left_out"]:
        left_out = """
The frozen DINOv3 weights are not part of this repository: their licence restricts passing
them on. Download them from their owner and name the folder:

```python
detector = radejax.Detector.from_checkpoint("this folder", image_backbone="dinov3 folder")
```
"""
    return f"""---
library_name: radejax
pipeline_tag: object-detection
tags: [radar, 4d-radar, 3d-object-detection, k-radar, jax, flax]
---

# {name}

3D object detection in 4D radar tensors. Classes: {", ".join(detector.classes)}.

```python
import radejax
detector = radejax.Detector.from_checkpoint("this folder")
detector(projection).to_list()   # [B, {", ".join(map(str, detector.grid.projection_shape))}]
```
{left_out}
`config.json` holds the model, the sensor's grid, the decoding thresholds and the training
config; `model.safetensors` the weights, float{16 if half else 32}, by their names in Flax.

{origin}
"""
