"""Models packed into a folder, to be given to others.

It has the files that the Hugging Face Hub expects:

    config.json          model, grid, classes, decoding, and the config it was trained with
    model.safetensors    variables by name, "params/backbone/..."

DINOv3's weights are never in it: their licence restricts passing them on.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Mapping
from typing import Any, Literal

import flax.linen as nn
import numpy as np
import safetensors.numpy
from flax import traverse_util
from ml_collections import ConfigDict

import radejax
from radejax import models
from radejax.core import files
from radejax.core.archives import read_safetensors
from radejax.core.config import renewed
from radejax.core.errors import DataError, UserError
from radejax.data.cameras import CameraOptions
from radejax.data.records.files import sha256
from radejax.geometry.radar_grid import RadarGrid
from radejax.models import dinorade_config, radenet
from radejax.models.dinorade import IMAGE_BACKBONE as BACKBONE
from radejax.models.vit import ViT
from radejax.weights.image_backbone import check_fits

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
FORMAT = "radejax-1"


_DECODE = {
    "score_threshold": float,
    "nms_iou": float,
    "max_detections": int,
    "threshold_inclusive?": bool,
    "per_class_nms?": bool,
    "pre_nms?": int | None,
    "roi?": tuple[float, float, float, float, float, float]
    | Literal["narrow", "wide"]
    | None,
    "z0_m?": float,
    "raw_yaw?": Literal["nms", "always", "never"],
    "clip_sizes?": bool,
}
_HINTS = {
    "model": dict[str, Any],
    "classes": tuple[str, ...],
    "decode": _DECODE,
    "azimuth_mapping": Literal["true", "stretched"],
    "camera": dict[str, Any],
    "grid": RadarGrid,
    "training_config": dict[str, Any] | None,
    "sha256?": dict[str, str],
}
"""What `config.json` holds."""


@dataclasses.dataclass(frozen=True)
class LoadedModel:
    """A model with what is known of it, wherever it came from.

    Attributes:
        model: Without parameters.
        variables: Its parameters and other collections.
        grid: Of the sensor.
        settings: Keyword arguments of `Detector`.
        config: It was trained with, or None.
        run: Of a checkpoint, where and with what the run was made, see
            `radejax.runs.workdir.run_info`; else empty.
        step: Of a checkpoint, or None.
    """

    model: nn.Module
    variables: Mapping[str, Any]
    grid: RadarGrid
    settings: Mapping[str, Any]
    config: ConfigDict | None = None
    run: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    step: int | None = None


def is_packed(folder: pathlib.Path) -> bool:
    """Whether a folder has the files of a packed model."""
    return (folder / WEIGHTS_FILE).is_file() and (folder / CONFIG_FILE).is_file()


def write_packed(
    folder: str | pathlib.Path,
    detector: Any,
    *,
    training_config: ConfigDict | None = None,
    with_backbone: bool = False,
    half: bool = False,
    programs: Mapping[str, bytes] | None = None,
) -> dict[str, Any]:
    """Writes `config.json` and `model.safetensors`.

    Args:
        folder: Made if missing.
        detector: A `Detector`.
        training_config: Kept in `config.json` to be read.
        with_backbone: Keep the image transformer's weights. DINOv3's are for own
            machines and not to be passed on.
        half: Store float16, to half the size; it is computed in float32 as ever.
        programs: Further files by name.

    Returns:
        The content of `config.json`; "sha256" has the checksum of each other file.

    Raises:
        UserError: The image transformer was trained along: without its weights the
            model is not the same.
    """
    folder = pathlib.Path(folder)
    left_out = []
    variables = {k: dict(v) for k, v in detector.variables.items()}
    is_vit = getattr(detector.model, "vit", None) is not None
    if is_vit and not with_backbone and BACKBONE in variables["params"]:
        if not detector.model.freeze:
            raise UserError(
                "the image transformer was trained along. Fine-tuned from DINOv3, its "
                "licence restricts passing it on; trained from scratch, keep it by "
                "with_backbone (--with-backbone)"
            )
        del variables["params"][BACKBONE]
    if is_vit and BACKBONE not in variables["params"]:
        left_out = [f"params/{BACKBONE}"]
    content = {
        "format": FORMAT,
        "radejax": radejax.__version__,
        "model": model_config(detector.model),
        "classes": list(detector.classes),
        "decode": {
            "score_threshold": detector.score_threshold,
            "nms_iou": detector.nms_iou,
            **detector.decode_options,
        },
        "azimuth_mapping": detector.azimuth_mapping,
        "camera": dataclasses.asdict(detector.camera_options),
        "grid": detector.grid.to_dict(),
        "left_out": left_out,
        "training_config": None
        if training_config is None
        else json.loads(training_config.to_json()),
    }
    arrays = {
        name: np.ascontiguousarray(value, np.float16 if half else None)
        for name, value in traverse_util.flatten_dict(variables, sep="/").items()
    }
    folder.mkdir(parents=True, exist_ok=True)
    with files.atomic_path(folder / WEIGHTS_FILE) as temporary:
        safetensors.numpy.save_file(arrays, temporary, {"format": "jax"})
    for name, program in (programs or {}).items():
        with files.atomic_write(folder / name) as file:
            file.write(program)
    written = (WEIGHTS_FILE, *(programs or {}))
    content["sha256"] = {name: sha256(folder / name) for name in written}
    files.write_json(folder / CONFIG_FILE, content)
    return content


def read_packed(folder: str | pathlib.Path) -> LoadedModel:
    """Inverse of `write_packed`.

    Raises:
        DataError: A file is damaged, or of another format.
    """
    path = pathlib.Path(folder) / CONFIG_FILE
    files.read_json(path, {"format": Literal[FORMAT]})
    content = files.read_json(path, _HINTS)
    decode = content["decode"]
    if unknown := sorted(set(decode) - {name.rstrip("?") for name in _DECODE}):
        raise DataError(f"{path}: decode has unknown {unknown}")
    shares = decode["score_threshold"], decode["nms_iou"]
    if not all(0 <= x <= 1 for x in shares) or not 1 <= decode["max_detections"] <= 1e5:
        raise DataError(
            f"{path}: decode has score_threshold {shares[0]}, nms_iou {shares[1]}, "
            f"max_detections {decode['max_detections']}; expected the first two from 0 "
            "to 1, the last from 1 to 100000"
        )
    try:
        model = models.build(content["model"])
        weights = path.with_name(WEIGHTS_FILE)
        saved = content.get("sha256", {}).get(WEIGHTS_FILE)  # 0.2 and before: without
        if saved and sha256(weights) != saved:
            raise DataError(
                f"{weights}: damaged or of another model, its sha256 is not the one in "
                f"{CONFIG_FILE}, {saved[:12]}...: export or download it again"
            )
        arrays = {
            name: value.astype(np.float32)
            for name, value in read_safetensors(weights).items()
        }
        variables = traverse_util.unflatten_dict(arrays, sep="/")
        check_fits(model, variables, weights)
    except UserError as error:
        raise DataError(f"{path}: {error}") from None
    if len(content["classes"]) != content["model"]["num_classes"]:
        raise DataError(
            f"{path}: {len(content['classes'])} classes, expected "
            f"{content['model']['num_classes']}, as model.num_classes says"
        )
    return LoadedModel(
        model,
        variables,
        content["grid"],
        {
            "classes": content["classes"],
            "azimuth_mapping": content["azimuth_mapping"],
            "score_threshold": decode.pop("score_threshold"),
            "nms_iou": decode.pop("nms_iou"),
            "decode_options": decode,
            "camera_options": CameraOptions.of_fields(content["camera"], path),
        },
        _training_config(content["training_config"], path),
    )


def _training_config(
    values: Mapping[str, Any] | None, path: pathlib.Path
) -> ConfigDict | None:
    if not values:
        return None
    try:
        return ConfigDict(renewed(values), convert_dict=True)
    except ValueError as error:  # names with dots
        raise DataError(f"{path}: training_config: {error}") from None


def model_config(model: nn.Module) -> dict[str, Any]:
    """`config.model` of a model: `models.build` makes the same one again.

    Raises:
        UserError: It has fields that no config states.
    """
    radar = getattr(model, "radar", model)
    config = {name: getattr(radar, name) for name in radenet.FIELDS}
    config["cbam"] = config["cbam"] or "off"
    config["name"] = "radenet"
    if radar is not model:
        config |= {"name": "dinorade", **_camera_fields(model)}
    config = json.loads(json.dumps(config))
    again = models.build(config)
    if again != model:
        raise UserError(f"no config describes this model: {again} is not {model}")
    return config


def _camera_fields(model: Any) -> dict[str, Any]:
    vit = model.vit or ViT()
    image = {
        "kind": "resnet50" if model.vit is None else "vit",
        "size": model.image_size,
        "freeze": model.freeze,
        "standardize": model.standardize_image,
        "resnet_width": model.resnet_width,
    }
    image |= {
        k: getattr(vit, k) for k in dinorade_config.IMAGE_FIELDS if k not in image
    }
    axes = {
        name: getattr(model.query_grid, name) for name in dinorade_config.AXES_FIELDS
    }
    return {"image": image, "fusion": dict(model.fusion), "query_grid": axes}
