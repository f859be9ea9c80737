"""Detects objects in radar data without radejax: python load.py array.npy [...].

It needs `pip install jax flatbuffers`. README.md describes the arrays, here of one frame.
"""

import hashlib
import json
import pathlib
import sys
from collections.abc import Callable

import jax
import jax.export
import numpy as np

FOLDER = pathlib.Path(__file__).resolve().parent


def read_file(path: pathlib.Path, sha256: str) -> bytes:
    """Reads a file; raises `ValueError` if its SHA-256 differs from the exported file's."""
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != sha256:
        raise ValueError(
            f"{path}: corrupted, its sha256 differs from the one in config.json"
        )
    return data


def read_weights(data: bytes) -> dict[str, np.ndarray]:
    """Reads the arrays of a safetensors file: a JSON header, then float32 numbers."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = {k: v for k, v in json.loads(data[8:start]).items() if k[0] != "_"}
    flat = np.frombuffer(data, "<f4", offset=start)
    ends = {name: [x // 4 for x in v["data_offsets"]] for name, v in header.items()}
    return {n: flat[slice(*ends[n])].reshape(v["shape"]) for n, v in header.items()}


def load(
    folder: str | pathlib.Path = FOLDER, device: jax.Device | None = None
) -> Callable[..., dict[str, jax.Array]]:
    """Loads the detector of an exported folder as a function `detect(projection, ...)`.

    The function returns a dictionary of arrays. Its keyword arguments `score_threshold`,
    `nms_iou` and `roi` replace the defaults.
    """
    folder = pathlib.Path(folder).expanduser()
    config = json.loads((folder / "config.json").read_text())
    data = {name: read_file(folder / name, x) for name, x in config["sha256"].items()}
    run = jax.jit(jax.export.deserialize(bytearray(data["detector.stablehlo"])).call)
    weights = jax.device_put(read_weights(data["model.safetensors"]), device)
    decode = config["config"]["decode"]
    defaults = {name: decode[name] for name in ("score_threshold", "nms_iou")}
    defaults["roi"] = decode.get("roi") or [-np.inf, np.inf] * 3

    def detect(*inputs: object, **settings: object) -> dict[str, jax.Array]:
        if unknown := set(settings) - set(defaults):
            raise TypeError(f"unknown {unknown}, expected {sorted(defaults)}")
        values = [np.asarray(x, np.float32) for x in {**defaults, **settings}.values()]
        if not (values[2][::2] < values[2][1::2]).all():  # also if a limit is NaN
            raise ValueError(f"roi {values[2]}: expected x0 < x1, y0 < y1, z0 < z1")
        # On CPU, device_put shares memory with arrays that the caller may overwrite, so
        # they are copied.
        own = jax.tree.map(np.array, inputs)
        found: dict[str, jax.Array] = run(weights, jax.device_put(own, device), *values)
        return found

    return detect


if __name__ == "__main__":
    detect = load()
    for path in sys.argv[1:]:
        array = np.load(path)
        levels = np.float32(1 / 255 if array.dtype == np.uint8 else 1)  # of records
        found = jax.device_get(detect(array.astype(np.float32)[None] * levels))
        rows = found["is_valid"][0]
        print(path, found["scores"][0][rows], found["boxes"][0][rows], sep="\n")
