"""One way to a model: a run, a checkpoint, a packed folder or an official file.

Also where weights come from that a checkpoint is without: those of a frozen image
backbone, and those that a training starts from.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import pathlib
from collections.abc import Mapping
from typing import Any, Literal

import flax.linen as nn
from ml_collections import ConfigDict

from radejax import models
from radejax.core.config import renewed
from radejax.core.errors import UserError
from radejax.core.files import PathLike, differences
from radejax.data.cameras import CameraOptions
from radejax.data.records.embeddings import embeddings_sha256
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference import packed
from radejax.inference.packed import LoadedModel
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.models.lifting import OFFICIAL_OFFSET_M
from radejax.training.checkpoints import Checkpoints
from radejax.weights import dinorade_torch, image_backbone, radenet_torch
from radejax.weights.convert import read_content

_log = logging.getLogger(__name__)

Step = int | Literal["best"] | None
"""Of a checkpoint: a number, "best" by the run's metric, or None for the newest."""


def load(
    path: PathLike, *, step: Step = None, image_backbone: PathLike | None = None
) -> LoadedModel:
    """Model of a run, of its checkpoints, of one of them, of a packed folder or a .pth.

    A frozen image backbone is in no checkpoint: it comes from the files that the run was
    trained with. Where they are gone, or embeddings stood for them, the model is loaded
    without, for embedded images alone.

    Args:
        path: Folder, or official file.
        step: Of a run or of a folder of checkpoints.
        image_backbone: DINOv3's folder from Hugging Face (torchvision's file for a
            ResNet), in place of the weights that the run was trained with.

    Raises:
        FileNotFoundError: There is no model, or no such checkpoint.
        UserError: A step of what holds only one model; the backbone given is not the
            one that the run's embeddings are from.
        DataError: A file is damaged, or config and weights do not fit.
    """
    path = pathlib.Path(path).absolute()
    if path.is_file():
        _check_no_step(path, step)
        return load_torch(path, image_backbone=image_backbone)
    if not path.is_dir():
        raise FileNotFoundError(f"no such file or folder: {path}")
    if packed.is_packed(path):
        _check_no_step(path, step)
        return _with_backbone(packed.read_packed(path), image_backbone)
    if (path / "checkpoints").is_dir():
        folder = path / "checkpoints"
    elif _is_checkpoint(path):
        _check_no_step(path, step)
        folder, step = path.parent, int(path.name)
    elif any(map(_is_checkpoint, path.iterdir())):
        folder = path
    elif (path / "config.json").is_file():
        raise FileNotFoundError(
            f"no checkpoints in {path}: the run has not trained yet"
        )
    else:
        raise FileNotFoundError(
            f"no model in {path}: expected {packed.CONFIG_FILE} and "
            f"{packed.WEIGHTS_FILE}, the work folder of a run, its checkpoints, or one "
            "of them"
        )
    return _with_backbone(_read_checkpoint(folder, step), image_backbone)


def load_torch(
    path_or_state_dict: PathLike | Mapping[str, Any],
    *,
    image_backbone: PathLike | None = None,
    **model_overrides: Any,
) -> LoadedModel:
    """Official RADE-Net or DinoRADE weights, on K-Radar's grid as they were trained.

    Args:
        path_or_state_dict: `.pth` file, or mapping of names to arrays. Names with
            `rad_backbone.` are DinoRADE's.
        image_backbone: Folder of DINOv3's weights, for DinoRADE without them.
        **model_overrides: For what names and shapes cannot tell.

    Raises:
        UserError: A backbone is given, and the model is RADE-Net.
        DataError: Tensors are missing, unexpected or mis-shaped.
    """
    content = path_or_state_dict
    if isinstance(content, str | os.PathLike):
        content, _ = read_content(content)
    settings: dict[str, Any] = {"azimuth_mapping": "stretched"}
    model: nn.Module
    if dinorade_torch.is_dinorade(content):
        model, variables = dinorade_torch.load(
            path_or_state_dict, dinov3=image_backbone, **model_overrides
        )
        settings["camera_options"] = CameraOptions(
            "pinhole", OFFICIAL_OFFSET_M, calibration="common"
        )
    else:
        if image_backbone is not None:
            raise UserError("image_backbone is given, but the model is RADE-Net")
        model, variables = radenet_torch.load(path_or_state_dict, **model_overrides)
    return LoadedModel(model, variables, RadarGrid.kradar(), settings)


def settings_of_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments of `Detector` that a config states."""
    decode = dict(config["decode"])
    return {
        "classes": tuple(config["classes"]),
        "azimuth_mapping": config["data"]["azimuth_mapping"],
        "score_threshold": decode.pop("score_threshold"),
        "nms_iou": decode.pop("nms_iou"),
        "decode_options": decode,
        "camera_options": CameraOptions.of_config(config["data"]),
    }


@dataclasses.dataclass(frozen=True)
class StartingWeights:
    """What a training starts from in place of random numbers.

    Attributes:
        source: Where `variables` come from, or None.
        variables: Of the whole model, or None.
        pretrained: A part that takes the place of drawn ones, or None.
        frozen_sha256: Checksum of the frozen image backbone; None where none is.
    """

    source: str | None = None
    variables: Mapping[str, Any] | None = None
    pretrained: Mapping[str, Any] | None = None
    frozen_sha256: str | None = None


def starting_weights(
    model: nn.Module,
    init_from: PathLike | None = None,
    image_backbone_path: PathLike | None = None,
    embeddings: PathLike | None = None,
) -> StartingWeights:
    """Reads what is to be trained further, or to stay as it is.

    Args:
        model: To be trained.
        init_from: Official .pth file, or what `load` takes; None draws all weights.
        image_backbone_path: Weights of the image backbone, see
            `image_backbone.load_image_backbone`.
        embeddings: Folder of `radejax embed` that stands for the frozen part.

    Raises:
        UserError: They do not fit the model; names what differs.
    """
    variables = pretrained = digest = source = None
    if init_from is not None:
        source = str(pathlib.Path(init_from).absolute())
        variables = _fitting_variables(init_from, model)
    if variables is None or IMAGE_BACKBONE not in variables["params"]:
        pretrained = image_backbone.load_image_backbone(
            image_backbone_path, model, embeddings
        )
    if getattr(model, "freeze", False):
        if embeddings is not None:
            digest = embeddings_sha256(embeddings)
        else:
            given = variables if pretrained is None else pretrained
            assert given is not None  # without both there has been an error
            digest = image_backbone.weights_sha256(given["params"][IMAGE_BACKBONE])
    return StartingWeights(source, variables, pretrained, digest)


def _fitting_variables(path: PathLike, model: nn.Module) -> Mapping[str, Any]:
    """Weights of another run or an official file, for a model that they must fit."""
    wanted = packed.model_config(model)
    if pathlib.Path(path).is_dir():
        other = load(path)
        found = packed.model_config(other.model)
        if lines := differences(found, wanted, "config.model"):
            raise UserError(f"weights of {path} do not fit: {'; '.join(lines)}")
        return other.variables
    if models.has_camera(model):
        _, variables = dinorade_torch.load(path)
        image_backbone.check_fits(model, variables, path)
        return variables
    structure = {name: value for name, value in wanted.items() if name != "name"}
    return radenet_torch.load(path, **structure)[1]


# Checkpoints -------------------------------------------------------------------------


def _is_checkpoint(path: pathlib.Path) -> bool:
    return path.name.isdigit() and (path / "state").is_dir()


def _check_no_step(path: pathlib.Path, step: Step) -> None:
    if step is not None:
        raise UserError(f"step {step} of {path}, which holds one model: give none")


def _read_checkpoint(folder: pathlib.Path, step: Step) -> LoadedModel:
    """A checkpoint; it carries config, grid and what its run was made with."""
    with Checkpoints(folder, read_only=True) as checkpoints:
        chosen = checkpoints.best_step() if step == "best" else step
        state, info, number = checkpoints.restore_variables(chosen)
    config = ConfigDict(renewed(info["config"]), convert_dict=True)
    params = state["ema_params"] if state.get("ema_params") else state["params"]
    return LoadedModel(
        models.build(config.model),
        {"params": params, **(state.get("model_state") or {})},
        RadarGrid.from_dict(info["grid"]),
        settings_of_config(dict(config)),
        config,
        run=info["run"],
        step=number,
    )


def _with_backbone(loaded: LoadedModel, given: PathLike | None) -> LoadedModel:
    """The same with the weights of its image backbone, where they are at hand."""
    is_complete = IMAGE_BACKBONE in loaded.variables["params"]
    if not models.has_camera(loaded.model) or (is_complete and given is None):
        return loaded
    part = _find_backbone(loaded, given)
    params = {**loaded.variables["params"], **part}
    return dataclasses.replace(loaded, variables={**loaded.variables, "params": params})


def _find_backbone(loaded: LoadedModel, given: PathLike | None) -> dict[str, Any]:
    """`{"image_backbone": parameters}`, empty where they are not at hand.

    In this order: what is given, what the run was trained with, what it started from.
    """
    data = loaded.run.get("data") or {}
    embeddings, start = data.get("embeddings"), loaded.run.get("init_from")
    source = given or data.get("image_backbone")
    if given is None and source is not None and not pathlib.Path(source).exists():
        _log.warning("image backbone %s is gone: embedded images only", source)
        source = None
    if source is not None:
        part = image_backbone.load_image_backbone(source, loaded.model)
    elif start is not None and pathlib.Path(start).exists() and not embeddings:
        part = _fitting_variables(start, loaded.model)
    else:
        return {}
    if part is None or IMAGE_BACKBONE not in part["params"]:
        return {}
    params = part["params"][IMAGE_BACKBONE]
    if source is not None and embeddings and pathlib.Path(embeddings).exists():
        image_backbone.check_same_backbone(params, embeddings, source)
    return {IMAGE_BACKBONE: params}
