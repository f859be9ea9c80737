"""Export of models to folders: StableHLO and ONNX programs, and Hugging Face models.

The programs run without radejax. Folders of all formats contain `config.json` and
`model.safetensors`, which `load_model` reads. docs/deploy.md explains how to use each format.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import json
import logging
import pathlib
import re
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.export  # not a part of `import jax`
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from flax.typing import MutableVariableDict, VariableDict
from jax.typing import DTypeLike
from jaxtyping import PyTree

from radejax import models
from radejax.core import files
from radejax.core.errors import UserError, require
from radejax.core.files import JsonObject
from radejax.core.version import __version__, radejax_commit
from radejax.data.cameras import no_images
from radejax.geometry.camera import Camera
from radejax.inference import exported_loader
from radejax.inference.detector import Detector, check_frames, network_input
from radejax.inference.inputs import Settings
from radejax.inference.saved import CONFIG_FILE, WEIGHTS_FILE, save_model
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.models.options import DinoRadeOptions

PLATFORMS = ("cpu", "cuda", "tpu")
KNOWN_PLATFORMS = (*PLATFORMS, "rocm")
FORMATS = ("stablehlo", "onnx", "huggingface")
PROGRAM_FILE = "detector.stablehlo"
BYTECODE_FILE = "detector.mlirbc"
OPTIONS_FILE = "compile_options.pb"
INPUTS_FILE = "inputs.json"
OUTPUTS_FILE = "outputs.json"
_OF_PROGRAMS = {
    PROGRAM_FILE: "network, decoding and rotated NMS",
    BYTECODE_FILE: "the same as bytecode for PJRT",
    OPTIONS_FILE: "the compile options for PJRT",
    "detector.onnx": "network, decoding and rotated NMS",
    "network.onnx": "the network",
    INPUTS_FILE: "inputs of the program by index; null is any size",
    OUTPUTS_FILE: "outputs of the program by index",
    "load.py": "runs the program without radejax",
}
_OF_MODELS = {
    CONFIG_FILE: "config, origin, grid, and checksums of the other files",
    WEIGHTS_FILE: "weights by name",
}
_COMPILE_OPTIONS = bytes.fromhex("1a0420012801")
"""XLA's `CompileOptionsProto` for one replica and one partition."""

_SMALLEST_JAX = "0.9.2"
_TESTED_JAX = 0, 10, 2
"""Smallest version of JAX that reads what versions up to the second one export."""

_OPSET = 18
_IR_VERSION = 8
_SMALLEST_RUNTIME = "1.19"
"""Versions of ONNX, and the smallest one of ONNX Runtime; older ones lack `Trilu` of bool."""

CHUNK_SIZE = 1024
"""Default chunk size of the deformable attention in ONNX files, in bins."""

INPUTS = ("projection", "tensor")
"""Radar data with which a program begins: projections, or tensors that it projects."""

RESULTS = ("boxes", "scores", "classes", "is_valid", "num_truncated", "num_invalid")

_MODEL_CARD = pathlib.Path(__file__).with_name("model_card.md")
_Z_ORIGINS = {"kradar": "LiDAR"}  # by the format of the training data
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
    radar_input: str = "projection",
) -> tuple[int, list[str]]:
    """Writes a folder with the model, which replaces an earlier export.

    Args:
        detector: Detector to export. Its thresholds and region of interest become the
            defaults.
        folder: Folder, which is created if missing.
        kind: Format of the folder. All formats contain the weights, the config and a
            model card, and "huggingface" contains only these. "stablehlo" adds the program
            and `load.py`, which needs only jax, flatbuffers and numpy. "onnx" adds the
            network, the network with decoding and NMS, for one batch size, and `load.py`,
            which needs only onnxruntime and numpy.
        platforms: Platforms of the StableHLO program, from `KNOWN_PLATFORMS`.
        with_backbone: Keep the weights of the image transformer, see `save_model`.
        batch_size: Number of frames per call; None means any number with StableHLO, and 1
            with ONNX.
        half: Store the weights as float16; only with "huggingface".
        radar_input: Radar data with which the program begins, from `INPUTS`.

    Returns:
        The size of all files in the folder in bytes, and the names of the variables that
        were not written.

    Raises:
        UserError: The kind or a platform is unknown, jax2onnx is not installed for ONNX,
            the image transformer is to be kept for ONNX, `half` is given for a program,
            which takes float32 weights, the model computes in bfloat16 for ONNX, or the
            folder has other files than an export.
    """
    require(kind in FORMATS, "format", kind, f"one of {FORMATS}")
    is_known = set(platforms) <= set(KNOWN_PLATFORMS)
    require(is_known, "platforms", platforms, f"some of {KNOWN_PLATFORMS}")
    if half and kind != "huggingface":
        raise UserError("--half is only supported with --format huggingface")
    if detector.saved.config.model.dtype == "bfloat16" and kind == "onnx":
        raise UserError("--dtype bfloat16 is not supported with --format onnx")
    shape = _radar_shape(detector, radar_input)
    folder = files.as_path(folder)
    there = {path.name for path in folder.glob("[!.]*")}
    foreign = there - {*_OF_PROGRAMS, *_OF_MODELS, "README.md", "__pycache__"}
    if CONFIG_FILE in there and "format" not in files.read_object(folder / CONFIG_FILE):
        foreign.add(CONFIG_FILE)
    if foreign:
        raise UserError(
            f"{files.relative(folder)} holds files that are not of an export, such as "
            f"{min(foreign)}: choose another folder, or delete them"
        )
    programs: dict[str, bytes] = {}
    if kind == "stablehlo":
        programs = _stablehlo(detector, shape, platforms, batch_size, with_backbone)
    elif kind == "onnx":
        programs = _onnx_files(detector, shape, batch_size or 1, with_backbone)
    with files.swapped_in(folder, *_OF_PROGRAMS) as temporary:
        content = save_model(
            detector.saved,
            temporary,
            with_backbone=with_backbone,
            half=half,
            programs=programs,
            jax_versions=_jax_versions() if kind == "stablehlo" else None,
        )
        if programs:
            files.write_text(temporary / "load.py", inspect.getsource(exported_loader))
        names = {path.name for path in temporary.iterdir()}
        card = _readme(detector, shape, kind, content, names)
        files.write_text(temporary / "README.md", card)
    left_out: list[str] = content["left_out"]
    num_bytes = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    return num_bytes, left_out


def _radar_shape(detector: Detector, radar_input: str) -> tuple[int, ...]:
    """Returns the shape of one frame of the radar data with which a program begins."""
    require(radar_input in INPUTS, "input", radar_input, f"one of {INPUTS}")
    if radar_input == "projection":
        *bins, channels = detector.grid.projection_shape
        return (*bins, detector.num_frames * channels)
    release = detector.saved.config.data.release
    reason = "config.data.num_frames of the model is above 1"
    if release:
        reason = f"the model is for {release} files"
    is_possible = detector.num_frames == 1 and not release
    require(is_possible, "input", radar_input, f"projection, as {reason}")
    return detector.grid.shape_drea


def _jax_versions() -> dict[str, str]:
    """Returns the smallest and largest version of JAX that can read a program.

    Versions older than the tested ones may lack operations that newer ones write. JAX
    reads what was exported six months before, which is about two minor versions.
    """
    version = jax.__version__
    major, minor = jax.__version_info__[:2]
    is_tested = jax.__version_info__ <= _TESTED_JAX
    return {
        "smallest": _SMALLEST_JAX if is_tested else version,
        "exported": version,
        "largest": f"{major}.{minor + 1}",
    }


def _readme(
    detector: Detector,
    shape: Sequence[int],
    kind: str,
    content: JsonObject,
    names: Iterable[str],
) -> str:
    """Returns the text of the model card of a folder.

    Args:
        detector: The detector.
        shape: Shape of one frame of the input.
        kind: Format of the folder. Parts of the text are for some formats, "all", or models
            of several "frames", "calibrated" or in "bfloat16".
        content: Content of `config.json`.
        names: Names of the files.
    """
    radar = "Power of radar tensors" if len(shape) == 4 else "Projections"
    config = detector.saved.config
    if release := config.data.release:
        radar = f"Projections of K-Radar's {release} files"
    simulation = config.simulation
    is_simulated = simulation is not None and simulation.scenes == "procedural"
    every, *parts = re.split(r"<!-- (.*) -->\n", _MODEL_CARD.read_text())
    pairs = zip(parts[::2], parts[1::2], strict=True)
    frames = "frames" if detector.num_frames > 1 else ""
    calibrated = "calibrated" if config.decode.calibration else ""
    tags = {kind, "all", frames, calibrated, config.model.dtype}
    own = [text for names, text in pairs if tags & set(names.split())]
    use = "`load.py`, or " if "load.py" in names else ""
    listed = {n: x for n, x in (_OF_MODELS | _OF_PROGRAMS).items() if n in names}
    return "".join([every, *own]).format(
        name=type(detector.model).__name__,
        classes=", ".join(detector.classes),
        use=f"{use}`radejax.Detector.from_workdir(folder)`; see docs/deploy.md of radejax",
        input=f"{radar} [B, {', '.join(map(str, shape))}] float32, B frames.",
        frames=detector.num_frames,
        jax=content.get("jax"),
        opset=_OPSET,
        runtime=_SMALLEST_RUNTIME,
        count=config.decode.max_detections,
        z=_Z_ORIGINS.get(config.data.format, "origin of the training's labels"),
        left_out=_LEFT_OUT if content["left_out"] else "nothing",
        origin=_SIMULATED if is_simulated else _MEASURED,
        identity=_origin(content),
        files="\n".join(f"- `{n}`: {x}" for n, x in listed.items()),
    )


def _origin(content: JsonObject) -> str:
    """Returns the rows of a table of what identifies a model."""
    known = {"run": "not known", "metrics": None} | content["identity"]
    known["export"] = {"radejax": content["radejax"], "commit": content["commit"]}
    classes = content["config"]["classes"]
    least = np.broadcast_to(
        content["config"]["decode"]["score_threshold"], len(classes)
    )
    known["score threshold"] = dict(zip(classes, least.tolist(), strict=True))
    values = flatten_dict(known, sep=" ").items()
    texts = {n: f"{x:.4g}" if isinstance(x, float) else x for n, x in values}
    rows = (f"| {n} | {'none' if x is None else x} |" for n, x in texts.items())
    return "\n".join(rows)


# Programs ----------------------------------------------------------------------------

_Shaped = jax.ShapeDtypeStruct | jax.core.ShapedArray


def _array(*shape: int, dtype: DTypeLike = jnp.float32) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


def _settings(detector: Detector) -> dict[str, jax.ShapeDtypeStruct]:
    """Returns the shapes of the fields of `Settings`, in their order."""
    given = Settings.of(detector.saved.config, {})
    return {n: _array(*x.shape) for n, x in given._asdict().items()}


def _exported(
    detector: Detector, shape: Sequence[int], batch: Any, with_backbone: bool
) -> tuple[MutableVariableDict, tuple[PyTree, ...]]:
    """Returns the variables of a program and the shapes of its inputs.

    The inputs are projections or tensors and, for a radar-camera model, images and a
    dictionary of the camera's fields. Without the image transformer, the images are
    embedded ones.
    """
    variables = {name: dict(tree) for name, tree in detector.variables.items()}
    radar = _array(batch, *shape)
    model = detector.model
    if not models.has_camera(model):
        return variables, (radar,)
    image, camera = jax.tree.map(
        lambda x: _array(batch, *x.shape[1:], dtype=x.dtype),
        no_images(1, model.options.image.size),
    )
    if model.options.image.kind == "vit" and not with_backbone:
        variables["params"].pop(IMAGE_BACKBONE, None)
        image = _array(batch, *model.options.image.feature_shape)
    return variables, (radar, image, vars(camera))


def _names(shapes: Sequence[PyTree]) -> list[str]:
    """Returns the names of the leaves of the inputs that `_exported` returns."""
    radar = "projection" if len(shapes[0].shape) == 4 else "tensor"
    names = [radar, "image"][: len(shapes)]
    return names + [f"camera_{n}" for n in sorted(shapes[2])] if shapes[2:] else names


_UNITS = {
    "projection": "(10 log10(power + 1e-10) + 1.2) / 184.3",
    "tensor": "linear power",
    "image": "RGB of 0 to 255 (uint8), or features of the image backbone (float32)",
    "camera_cam_from_ego": "rotation and translation in m from the radar frame",
    "camera_distortion": "k1, k2, p1, p2, k3",
    "camera_intrinsics": "fx, fy, cx, cy in pixels",
    "camera_is_valid": "whether the frame has an image",
    "camera_max_radius": "tangent of the viewing angle",
    "camera_size_px": "width, height in pixels",
    "score_threshold": "0 to 1, by class",
    "nms_iou": "0 to 1",
    "roi": "x0, x1, y0, y1, z0, z1 in m",
    "boxes": "x, y, z, length, width, height in m, yaw in rad",
    "scores": "0 to 1",
    "classes": "index into config.classes, -1 for padding",
    "is_valid": "true for a detection",
    "num_truncated": "number of peaks and boxes that were dropped",
    "probability": "0 to 1",
    "num_invalid": "number of frames that cannot be radar data",
}


def _described(
    arrays: Iterable[tuple[str, _Shaped]],
    other: str = "weights: the tensor in model.safetensors",
) -> bytes:
    """Returns a list of the inputs or outputs of a program as JSON, null for any size.

    Args:
        arrays: Names and shapes.
        other: Text for those that are not in `_UNITS`.
    """
    rows = [
        {
            "index": index,
            "name": name,
            "shape": [n if isinstance(n, int) else None for n in x.shape],
            "dtype": str(x.dtype),
            "unit": _UNITS.get(name, other),
        }
        for index, (name, x) in enumerate(arrays)
    ]
    return json.dumps(rows, indent=1).encode()


def _detect(
    detector: Detector, variables: VariableDict, inputs: PyTree, settings: Settings
) -> dict[str, jax.Array]:
    """Runs the detector on inputs in the shapes of `_exported`, for both program formats."""
    radar, *rest = inputs
    image, camera = (rest[0], Camera(**rest[1])) if rest else (None, None)
    function = detector.detect_function()
    found = function(variables, radar, image, camera, settings)
    _, num_invalid = check_frames(radar, detector.grid)
    results = vars(found) | {"num_invalid": num_invalid}
    own = dict(sorted(found.outputs.items()))
    return {name: results[name] for name in RESULTS} | own


@contextlib.contextmanager
def _without_locations() -> Iterator[None]:
    """Leaves source files out of programs, which are then the same on other machines."""
    name = "jax_traceback_in_locations_limit"
    limit = getattr(jax.config, name)
    jax.config.update(name, 0)
    try:
        yield
    finally:
        jax.config.update(name, limit)


def _stablehlo(
    detector: Detector,
    shape: Sequence[int],
    platforms: Sequence[str],
    batch_size: int | None,
    with_backbone: bool,
) -> dict[str, bytes]:
    """Returns the program from weights, inputs and settings to detections, in files.

    The result of the program is a dictionary of arrays. The batch size is symbolic if
    `batch_size` is None. Without the backbone, the images are embedded ones. With a batch
    size and a single platform, the bytecode and compile options are returned too, from
    which other languages can run the program.
    """
    batch = batch_size or jax.export.symbolic_shape("b")[0]
    variables, inputs = _exported(detector, shape, batch, with_backbone)
    flat = flatten_dict(variables, sep="/")

    def program(weights: PyTree, inputs: PyTree, *settings: jax.Array) -> PyTree:
        tree = unflatten_dict(weights, sep="/")
        return _detect(detector, tree, inputs, Settings(*settings))

    weights = {name: _array(*x.shape) for name, x in flat.items()}
    export_of = jax.export.export(jax.jit(program), platforms=tuple(platforms))
    settings = _settings(detector)
    with _without_locations():
        exported = export_of(weights, inputs, *settings.values())
    names = [*sorted(weights), *_names(inputs), *settings]
    kept = exported.module_kept_var_idx  # a program has only the inputs that it uses
    used = [(names[i], exported.in_avals[i]) for i in kept]
    results = jax.tree.unflatten(exported.out_tree, exported.out_avals)
    contents = {
        PROGRAM_FILE: bytes(exported.serialize()),
        INPUTS_FILE: _described(used),
        OUTPUTS_FILE: _described(results.items(), "output of the model's own"),
    }
    if batch_size and len(platforms) == 1:
        contents[BYTECODE_FILE] = exported.mlir_module_serialized
        contents[OPTIONS_FILE] = _COMPILE_OPTIONS
    return contents


def _onnx_metadata(detector: Detector) -> dict[str, object]:
    """Returns the metadata of the model that an ONNX file contains, by name."""
    return {
        "radejax": __version__,
        "commit": radejax_commit(),
        "onnxruntime": f">={_SMALLEST_RUNTIME}",
        "identity": detector.saved.identity,
        "classes": detector.classes,
        "grid": detector.grid.to_dict(),
        "decode": detector.decode_options.model_dump(mode="json"),
    }


def _simplified(model: Any) -> Any:
    """Returns an ONNX model with folded constants, so that runtimes can quantize kernels."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # it warns of what it removes
    level = onnxruntime.GraphOptimizationLevel
    options.graph_optimization_level = level.ORT_ENABLE_BASIC
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder, "model.onnx")
        options.optimized_model_filepath = str(path)
        providers = ["CPUExecutionProvider"]
        onnxruntime.InferenceSession(model.SerializeToString(), options, providers)
        simplified = type(model).FromString(path.read_bytes())
    del simplified.opset_import[:]  # the runtime lists all that it knows
    simplified.opset_import.extend(model.opset_import)
    return simplified


def _onnx_files(
    detector: Detector, shape: Sequence[int], batch_size: int, with_backbone: bool
) -> dict[str, bytes]:
    """Returns the contents of the ONNX files and their inputs and outputs by file name.

    `network.onnx` contains the network, and `detector.onnx` also decoding and rotated NMS.

    Raises:
        UserError: jax2onnx is not installed, or the image transformer is to be kept.
    """
    model = detector.saved.config.model
    is_vit = isinstance(model, DinoRadeOptions) and model.image.kind == "vit"
    if with_backbone and is_vit:
        raise UserError(
            "the image backbone cannot be exported to ONNX: drop --with-backbone and "
            "feed precomputed embeddings (docs/deploy.md)"
        )
    try:
        import onnxruntime  # noqa: F401, of `_simplified`
        from jax2onnx import to_onnx
    except ModuleNotFoundError as error:
        raise UserError(
            "format onnx needs jax2onnx and onnxruntime: pip install -e '.[onnx]'"
        ) from error

    # With a fixed chunk size, the program does not choose by platform, which jax2onnx
    # cannot convert.
    if isinstance(model, DinoRadeOptions):
        size = model.fusion.chunk_size or CHUNK_SIZE
        config = detector.saved.config.with_fields({"model.fusion.chunk_size": size})
        detector = Detector(dataclasses.replace(detector.saved, config=config))
    variables, shapes = _exported(detector, shape, batch_size, with_backbone)
    leaves, tree = jax.tree.flatten(shapes)
    inputs = dict(zip(_names(shapes), leaves, strict=True))

    def network(*arrays: jax.Array) -> list[jax.Array]:
        radar, *rest = jax.tree.unflatten(tree, arrays)
        camera = [rest[0], Camera(**rest[1])] if rest else []
        levels = network_input(radar, detector.grid)
        maps: Any = detector.model.apply(variables, levels, *camera, train=False)
        return [maps.heatmap_logits, maps.box_params]

    def program(*arrays: jax.Array) -> dict[str, jax.Array]:
        given = jax.tree.unflatten(tree, arrays[: len(leaves)])
        settings = Settings(*arrays[len(leaves) :])
        return _detect(detector, variables, given, settings)

    def convert(
        function: Callable[..., list[jax.Array]],
        given: Mapping[str, jax.ShapeDtypeStruct],
        results: Sequence[str],
    ) -> bytes:
        names = {"input_names": list(given), "output_names": list(results)}
        converted = to_onnx(function, list(given.values()), opset=_OPSET, **names)
        converted.ir_version = _IR_VERSION
        converted = _simplified(converted)
        mark = {"key": "onnx.quant.pre_process", "value": "onnxruntime.quant"}
        converted.metadata_props.add(**mark)  # the quantization would ask for it
        for name, value in _onnx_metadata(detector).items():
            converted.metadata_props.add(key=name, value=json.dumps(value))
        return bytes(converted.SerializeToString())

    every = inputs | _settings(detector)
    shapes_of = jax.eval_shape(program, *every.values())
    names = [*RESULTS, *sorted(shapes_of.keys() - set(RESULTS))]
    results = {name: shapes_of[name] for name in names}

    def listed(*arrays: jax.Array) -> list[jax.Array]:
        return list(program(*arrays).values())

    # onnx_ir warns of every shape that is not static.
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Explicitly requested dtype float64")
        return {
            "network.onnx": convert(network, inputs, ("heatmap_logits", "box_params")),
            "detector.onnx": convert(listed, every, names),
            INPUTS_FILE: _described(every.items()),
            OUTPUTS_FILE: _described(results.items(), "output of the model's own"),
        }
