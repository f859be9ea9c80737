"""Detects objects in radar data without radejax: python load.py ARRAY.npy [...].

It needs `pip install jax flatbuffers`, or `pip install onnxruntime` in a folder with an
ONNX program. README.md describes the arrays, here of one frame.
"""

import argparse
import hashlib
import json
import pathlib
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

FORMAT = "radejax-3"
FOLDER = pathlib.Path(__file__).resolve().parent

Run = Callable[[Sequence[Any], Sequence[np.ndarray]], dict[str, Any]]


def read_folder(folder: pathlib.Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Reads config.json and the files that it lists, of which none may be changed.

    Raises:
        ValueError: The folder has another format, or a file is corrupted.
        FileNotFoundError: A file is missing.
    """
    config = json.loads((folder / "config.json").read_text())
    if config["format"] != FORMAT:
        raise ValueError(
            f"{folder}: format {config['format']!r}, and this load.py reads {FORMAT!r}: "
            "export the model again, or use the load.py of that folder"
        )
    data = {name: (folder / name).read_bytes() for name in config["sha256"]}
    for name, sha256 in config["sha256"].items():
        if hashlib.sha256(data[name]).hexdigest() != sha256:
            raise ValueError(
                f"{folder / name}: corrupted, its sha256 differs from the one in config.json"
            )
    return config, data


def read_weights(data: bytes) -> dict[str, np.ndarray]:
    """Reads the arrays of a safetensors file: a JSON header, then float32 numbers."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = {k: v for k, v in json.loads(data[8:start]).items() if k[0] != "_"}
    flat = np.frombuffer(data, "<f4", offset=start)
    ends = {name: [x // 4 for x in v["data_offsets"]] for name, v in header.items()}
    return {n: flat[slice(*ends[n])].reshape(v["shape"]) for n, v in header.items()}


def check_jax(found: str, versions: Mapping[str, str]) -> None:
    """Raises `ImportError` for a version of JAX that is too old; warns of a newer one."""
    numbers = {n: [*map(int, re.findall("[0-9]+", x))] for n, x in versions.items()}
    number = [*map(int, re.findall("[0-9]+", found)[:3])]
    text = f"JAX {found}, expected {versions['smallest']} to {versions['largest']}"
    if number < numbers["smallest"]:
        raise ImportError(f"{text}: pip install jax=={versions['exported']}")
    if number[:2] > numbers["largest"]:
        warnings.warn(f"{text}: if loading fails, export again", stacklevel=3)


def checked(rows: Mapping[str, Mapping[str, Any]], name: str, value: Any) -> np.ndarray:
    """Returns an input as an array, in which floats of another size are converted.

    Args:
        rows: Rows of inputs.json by name.
        name: Name of the input.
        value: The input.

    Raises:
        ValueError: The input has another shape or dtype.
    """
    array = np.asarray(value)
    shape = rows[name]["shape"]
    dtype = np.dtype(rows[name]["dtype"])
    fits = array.dtype == dtype or array.dtype.kind == dtype.kind == "f"
    sizes = [m if n is None else n for n, m in zip(shape, array.shape, strict=False)]
    if not fits or len(shape) != array.ndim or tuple(sizes) != array.shape:
        expected = f"{dtype} {shape}".replace("None", "any")
        found = f"{array.dtype} {list(array.shape)}"
        raise ValueError(f"{name} is {found}, expected {expected}")
    return array.astype(dtype, copy=False)


def stablehlo(versions: Mapping[str, str], data: dict[str, bytes], device: Any) -> Run:
    """Returns the program for JAX, with its weights on a device.

    Args:
        versions: Versions of JAX of config.json.
        data: Contents of the files by name.
        device: Device of JAX; its default if None.

    Raises:
        ImportError: The version of JAX is too old for the program.
    """
    import jax
    import jax.export  # not a part of `import jax`

    check_jax(jax.__version__, versions)
    run = jax.jit(jax.export.deserialize(bytearray(data["detector.stablehlo"])).call)
    weights = jax.device_put(read_weights(data["model.safetensors"]), device)

    def call(inputs: Sequence[Any], settings: Sequence[np.ndarray]) -> dict[str, Any]:
        # On CPU, device_put shares memory with arrays that the caller may overwrite, so
        # they are copied.
        own = jax.tree.map(np.array, inputs)
        found: dict[str, Any] = run(weights, *jax.device_put([own], device), *settings)
        return found

    return call


def onnx(data: dict[str, bytes], session_options: Any) -> Run:
    """Returns the program for ONNX Runtime.

    Args:
        data: Contents of the files by name.
        session_options: `SessionOptions` of ONNX Runtime, or None.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(data["detector.onnx"], session_options)
    rows = json.loads(data["inputs.json"])
    names = [output.name for output in session.get_outputs()]

    def call(inputs: Sequence[Any], settings: Sequence[np.ndarray]) -> dict[str, Any]:
        camera = [part[name] for part in inputs[2:] for name in sorted(part)]
        arrays = zip(rows, [*inputs[:2], *camera, *settings], strict=True)
        feed = {row["name"]: np.asarray(x, row["dtype"]) for row, x in arrays}
        return dict(zip(names, session.run(None, feed), strict=True))

    return call


def load(
    folder: str | pathlib.Path = FOLDER, device: Any = None, session_options: Any = None
) -> Callable[..., dict[str, Any]]:
    """Loads the detector of an exported folder as a function `detect(projection, ...)`.

    The function returns a dictionary of arrays. Its keyword arguments `score_threshold` (one
    number, or one per class), `nms_iou` and `roi` replace the defaults.

    Args:
        folder: The folder.
        device: Device of JAX; its default if None.
        session_options: `SessionOptions` of ONNX Runtime, such as its number of threads.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: The folder has another format or no program, or a file is corrupted. The
            function raises it for an input of another shape or dtype, and for settings
            out of their range.
        ImportError: The version of JAX is too old for the program.
    """
    folder = pathlib.Path(folder).expanduser()
    try:
        config, data = read_folder(folder)
        decode = config["config"]["decode"]
        defaults = {name: decode[name] for name in ("score_threshold", "nms_iou")}
        defaults["roi"] = decode["roi"] or [-np.inf, np.inf] * 3
        classes = len(config["config"]["classes"])
        versions = config["jax"] if "detector.stablehlo" in data else {}
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        text = f"{folder / 'config.json'}: corrupted, {error!r}: export the model again"
        raise ValueError(text) from None
    if "detector.onnx" in data:
        run = onnx(data, session_options)
    elif "detector.stablehlo" in data:
        run = stablehlo(versions, data, device)
    else:
        raise ValueError(f"{folder}: only weights, expected --format stablehlo or onnx")
    rows = {row["name"]: row for row in json.loads(data["inputs.json"])}
    names = [name for name in ("projection", "tensor", "image") if name in rows]

    def detect(*inputs: Any, **settings: object) -> dict[str, Any]:
        if unknown := set(settings) - set(defaults):
            raise TypeError(f"unknown {unknown}, expected {sorted(defaults)}")
        given = {**defaults, **settings}
        values = [np.asarray(x, np.float32) for x in given.values()]
        if values[0].ndim == 0:
            values[0] = np.repeat(values[0], classes)
        values = [checked(rows, n, x) for n, x in zip(given, values, strict=True)]
        for name, value in zip(given, values[:2], strict=False):
            if not ((value >= 0) & (value <= 1)).all():  # also if it is NaN
                raise ValueError(f"{name} {value}: expected a number from 0 to 1")
        if not (values[2][::2] < values[2][1::2]).all():
            raise ValueError(f"roi {values[2]}: expected x0 < x1, y0 < y1, z0 < z1")
        arrays = [checked(rows, n, x) for n, x in zip(names, inputs, strict=False)]
        return run((*arrays, *inputs[len(names) :]), values)

    return detect


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("arrays", nargs="+", metavar="ARRAY.npy", help="one frame each")
    paths = parser.parse_args().arrays
    detect = load()
    for path in paths:
        array = np.load(path)
        levels = np.float32(1 / 255 if array.dtype == np.uint8 else 1)  # of records
        result = detect(array.astype(np.float32)[None] * levels)
        found = {name: np.asarray(value)[0] for name, value in result.items()}
        rows = found["is_valid"]
        print(path, found["scores"][rows], found["boxes"][rows], sep="\n")
        if found["num_invalid"]:
            print("The values are not those of radar data: the boxes are meaningless.")
