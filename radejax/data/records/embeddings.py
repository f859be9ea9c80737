"""Embedded images as records: what a frozen image backbone made of front images.

A folder of embeddings has a `manifest.json` like one of projections: which backbone
made them (configuration and a checksum of its weights), their shape, and its files.
"""

from __future__ import annotations

import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from radejax.core.files import read_json, require_same
from radejax.data.records.arrays import MANIFEST, ArrayRecords, read_manifest_json

FORMAT = "radejax-embeddings"
FORMAT_VERSION = 1

# Fields of `config.model.image` that do not change what comes out.
_IRRELEVANT = ("freeze", "attention", "layer_scale")


def open_embeddings(
    folder: str | os.PathLike, image_config: Mapping[str, Any] | None = None
) -> ArrayRecords:
    """Features `[h, w, C]` of a folder, by record; `index_of()` maps frame keys to them.

    Args:
        folder: What `radejax embed` wrote.
        image_config: `config.model.image` that they must fit, or None.

    Raises:
        FileNotFoundError: There is no such folder, or it is not finished.
        DataError: The manifest is damaged or of another version.
        UserError: They come from another backbone.
    """
    folder = pathlib.Path(folder)
    if not (folder / MANIFEST).is_file():
        raise FileNotFoundError(
            f"{folder}: no {MANIFEST}; expected a folder that `radejax embed` finished"
        )
    manifest = read_manifest_json(
        folder,
        (FORMAT, FORMAT_VERSION),
        {
            "image": dict[str, Any],
            "shape": tuple[int, int, int],
            "dtype": Literal["float32", "float16"],
        },
    )
    if image_config is not None:
        wanted = relevant_fields(image_config)
        require_same(
            {name: manifest["image"].get(name) for name in wanted},
            wanted,
            f"{folder}: embeddings of another backbone",
            mend="embed the images anew",
            name="config.model.image",
        )
    dtype = np.dtype(manifest["dtype"])
    return ArrayRecords(folder, manifest["files"], manifest["shape"], dtype)


def embeddings_sha256(folder: str | os.PathLike) -> str:
    """Checksum of the weights that embeddings were made with."""
    path = pathlib.Path(folder) / MANIFEST
    return read_json(path, {"weights_sha256": str})["weights_sha256"]


def relevant_fields(image_config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of `config.model.image` that embeddings depend on, as JSON has it."""
    plain = {k: v for k, v in dict(image_config).items() if k not in _IRRELEVANT}
    return json.loads(json.dumps(plain))
