"""What a radar-camera run needs beside a radar run: images, cameras, backbone weights."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
from ml_collections import ConfigDict

from radejax.data.cameras import frame_cameras
from radejax.data.frame import Frame
from radejax.embed import open_embeddings
from radejax.errors import UserError
from radejax.models.dinorade import IMAGE_BACKBONE, DinoRade
from radejax.models.lifting import ReferencePoints

PathLike = str | os.PathLike


def has_camera(config: ConfigDict) -> bool:
    """Whether the configured model looks at images."""
    return config.model.name == "dinorade"


def require_camera(config: ConfigDict) -> None:
    """`UserError` unless the configured model looks at images."""
    if not has_camera(config):
        raise UserError(
            f"config.model.name is {config.model.name!r}, which has no camera; expected "
            "'dinorade', for example configs/dinorade.py"
        )


def loader_arguments(
    config: ConfigDict, frames: Sequence[Frame], embeddings: PathLike | None = None
) -> dict[str, Any]:
    """Arguments of `radejax.data.pipeline.make_loader` for images and cameras.

    Args:
        config: Of the run; `model.image` and `data.camera` are read.
        frames: Of a data set.
        embeddings: Folder of `radejax embed`, in place of the images.

    Returns:
        Nothing for a model without a camera.

    Raises:
        UserError: Images, calibrations or embeddings are missing or of another size or
            backbone.
    """
    if not has_camera(config):
        if embeddings is not None:
            raise UserError(
                f"embeddings are given, but config.model.name is {config.model.name!r}, "
                "which has no camera"
            )
        return {}
    options, image = config.data.camera, config.model.image
    arguments = {
        "cameras": frame_cameras(
            frames,
            tuple(image.size),
            projection=options.projection,
            ego_from_lidar_m=options.ego_from_lidar_m,
            resize=options.resize,
            allow_missing=options.allow_missing,
        ),
        "allow_missing_images": options.allow_missing,
        "image_size": tuple(image.size),
        "resize_images": options.resize,
    }
    if embeddings is None:
        return {**arguments, "images": True}
    if not image.freeze:
        raise UserError(
            "embeddings are what a frozen backbone makes of images, but "
            "config.model.image.freeze is False"
        )
    if config.data.mirror_probability:
        raise UserError(
            "embeddings cannot be mirrored: set config.data.mirror_probability to 0"
        )
    return {**arguments, "features": open_embeddings(embeddings, config.model)}


def load_image_backbone(path: PathLike | None, config: ConfigDict) -> Any:
    """Pretrained part of the variables, for `radejax.models.dinorade.with_pretrained`.

    Args:
        path: A DINOv3 folder from Hugging Face, or torchvision's ResNet-50 file.
        config: Of the run; `model.image` says which kind is expected.

    Returns:
        None without a path.

    Raises:
        FileNotFoundError: Not there, or a folder lacks a file.
        DataError: Tensors are missing, unexpected or mis-shaped.
        UserError: It is another model than the configured one; or the model has a
            frozen backbone and no weights are given.
    """
    if not has_camera(config):
        if path is not None:
            raise UserError(
                f"image backbone weights are given, but config.model.name is "
                f"{config.model.name!r}, which has no camera"
            )
        return None
    image = config.model.image
    if path is None:
        if image.freeze:
            raise UserError(
                "config.model.image.freeze is True, but no weights are given: "
                "--image_backbone FOLDER (DINOv3 from Hugging Face: config.json and "
                "model.safetensors; for resnet50 torchvision's .pth file), or train it "
                "with --config.model.image.freeze=False"
            )
        return None
    if image.kind == "resnet50":
        from radejax.interop import resnet_torch

        return resnet_torch.load(path)
    from radejax.interop import dinov3_hf

    model, variables = dinov3_hf.load(path)
    names = ("hidden_size", "num_layers", "num_heads", "mlp_dim", "patch_size")
    for name in (*names, "num_registers", "gated_mlp"):
        found = getattr(model, name)
        if found != image[name]:
            raise UserError(
                f"{path}: the backbone has {name} = {found}, config.model.image.{name} "
                f"is {image[name]}"
            )
    return {"params": {IMAGE_BACKBONE: variables["params"]}}


def check_fits(model: DinoRade, variables: Mapping[str, Any], source: str) -> None:
    """`UserError` unless variables are those of a model; the backbone may be missing."""
    radar, bins = model.radar, model.radar.pad_multiple
    channels = radar.doppler_bins + radar.elevation_bins
    queries = (1, bins, bins, model.axes.num_elevation)
    inputs = (
        jnp.zeros((1, bins, bins, channels)),
        jnp.zeros((1, *model.image_size, 3), jnp.uint8),
        ReferencePoints(jnp.zeros((*queries, 2)), jnp.ones(queries, bool)),
    )
    wanted = jax.eval_shape(model.init, jax.random.key(0), *inputs)

    def shapes(tree: Any) -> dict[str, Any]:
        flat = flax.traverse_util.flatten_dict(dict(tree), sep="/")
        return {name: tuple(leaf.shape) for name, leaf in flat.items()}

    wanted, found = shapes(wanted), shapes(variables)
    differing = [
        f"{name} is {found.get(name, 'missing')}, expected {wanted.get(name, 'none')}"
        for name in sorted(set(wanted) | set(found))
        if found.get(name) != wanted.get(name)
        and not (name not in found and name.startswith(f"params/{IMAGE_BACKBONE}/"))
    ]
    if differing:
        raise UserError(
            f"weights of {source} do not fit config.model ({len(differing)} tensors), "
            f"for example: {'; '.join(differing[:3])}"
        )


def saved_path(path: PathLike | None) -> str | None:
    """Absolute path as a run keeps it."""
    return None if path is None else str(pathlib.Path(path).absolute())


def missing_backbone(params: Mapping[str, Any], config: ConfigDict) -> bool:
    """Whether parameters from a checkpoint lack the frozen backbone."""
    return has_camera(config) and IMAGE_BACKBONE not in params
