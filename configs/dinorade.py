"""DinoRADE on K-Radar: the variants of Table 4 and the settings of paper and release.

    python train.py --config configs/dinorade.py --data ... --workdir ...
    python train.py --config configs/dinorade.py:rc ...
    python train.py --config configs/dinorade.py:official ...

The argument is a list of options, at most one of each group:

- variant: `r` radar-only (a RADE-Net with the dual stem), `rc` with camera and without elevation
  weights, `rcw` (default) the whole model, `rcw_resnet50` with a ResNet-50, whose last stage is
  trained, instead of DINOv3; `rcw_dinov2` with DINOv2 ViT-S/14, which is not in the paper.
- preset: `paper` or `official` (the released code with these values, including its geometry). The
  paper's models were not trained with `official`: the released settings for radar and camera
  (`params_radcam.py`) are a copy of the radar-only ones and lack keys that the code reads. The
  default follows the paper, but with the released attention block in the radar branch, with
  regression losses at the objects' own bins, and with the raw yaw vector in NMS.
- sigma: `sigma3`, `sigma0.75`, `adaptive`, `anisotropic`, as in `radenet.py`.
- classes: `all` (default; five classes, v2.1 labels) or `sedan` (v1.1 labels).
- release: `polar3d` or `rpc`, as in `radenet.py`.

Table 4 reports (Sedan AP of the five-class models, without the option `sedan`, narrow region,
IoU 0.3):

| variant | AP 3D | AP BEV |
|---|---|---|
| r | 61.65 | 66.68 |
| rc | 69.61 | 74.96 |
| rcw | 71.38 | 75.32 |
| rcw_resnet50 | 68.43 | 72.42 |

It was trained on one NVIDIA A30 with batch size 6 for 11 epochs of 17,458 frames.

The weights of the image backbone are not part of a config; `train.py --image-backbone` names them.
"""

import pathlib
import types

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from radejax.core.config import base_config, load_module, parse_options
from radejax.geometry.camera import KRADAR_RADAR_FROM_LIDAR_Z_M
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.lifting import OFFICIAL_OFFSET_M, LiftingAxes


def _radenet() -> types.ModuleType:
    """Load the config of the radar branch, whose presets apply here too."""
    return load_module(pathlib.Path(__file__).with_name("radenet.py"))


VARIANTS = {
    "r": {},
    "rc": {"model.fusion.weighting": "off"},
    "rcw": {},
    "rcw_resnet50": {"model.image.kind": "resnet50"},
    "rcw_dinov2": {
        "model.image.patch_size": 14,
        "model.image.num_registers": 0,
        "model.image.position_grid": 37,
    },
}
"""Fields that each row of Table 4 and `rcw_dinov2` change in the full model."""

PRESETS = {
    "paper": {
        "loss.heatmap_sigma_bins": 0.75,
        "train.num_epochs": 11,
        "model.fusion.num_points": 4,
        "model.fusion.weighting": "mlp",
        "model.fusion.gate": "channel",
        "model.fusion.out_of_view": "drop",
        "model.image.standardize": True,
        "data.camera.projection": "raw",
        "data.camera.radar_from_lidar_z_m": KRADAR_RADAR_FROM_LIDAR_Z_M,
    },
    "official": {
        "loss.heatmap_sigma_bins": 3.0,
        "train.num_epochs": 11,
        "model.fusion.num_points": 8,
        "model.fusion.weighting": "cnn",
        "model.fusion.gate": "bin",
        "model.fusion.out_of_view": "official",
        "model.image.standardize": True,
        "data.camera.projection": "pinhole",
        "data.camera.radar_from_lidar_m": OFFICIAL_OFFSET_M,
        "data.camera.calibration": "common",
    },
}
"""Fields in which the paper and the released code differ, in addition to RADE-Net's."""

CLASS_SETS = ("all", "sedan")


def get_config(arg: str | None = None) -> ConfigDict:
    """Return the complete config; see the module docstring for `arg`."""
    sigmas, releases = _radenet().SIGMAS, _radenet().RELEASES
    variant, preset, sigma, classes, release = parse_options(
        arg, VARIANTS, PRESETS, sigmas, CLASS_SETS, releases
    )
    variant = variant or "rcw"
    config = base_config()
    config.model.input_stem = True
    config.loss.heatmap_sigma_bins = 0.75
    config.train.update(batch_size=6, num_epochs=11)
    config.data.camera = _camera()
    _add_camera_model(config.model)
    if preset is not None:
        for rows in (_radenet().PRESETS[preset], PRESETS[preset]):
            config.update_from_flattened_dict(rows)
    if preset == "official":
        config.model.query_grid = _axes(LiftingAxes.official())
        # The released code only scales the images of its ResNet to [0, 1].
        config.model.image.standardize = variant != "rcw_resnet50"
    config.update_from_flattened_dict(VARIANTS[variant])
    if sigma is not None:
        config.loss.update(sigmas[sigma])
    if release is not None:
        config.update_from_flattened_dict(releases[release])
    if variant == "r":
        config.model.name = "radenet"
        for section in ("image", "fusion", "query_grid"):
            del config.model[section]
        del config.data.camera
    if classes == "sedan":
        config.classes = ("Sedan",)
        config.model.num_classes = 1
        config.data.label_version = "v1.1"
    return config


def _add_camera_model(model: ConfigDict) -> None:
    model.name = "dinorade"
    model.image = ConfigDict(
        {
            # vit or resnet50.
            "kind": "vit",
            # Height and width of the images in pixels; the transformer resizes them to the
            # nearest multiples of its patch size.
            "size": (720, 1280),
            # Keep the image backbone fixed.
            "freeze": True,
            # Normalize by ImageNet's statistics; otherwise scale to [0, 1].
            "standardize": True,
            # Channels of the transformer (the defaults are DINOv3 ViT-S/16).
            "hidden_size": 384,
            # Layers of the transformer.
            "num_layers": 12,
            # Attention heads of the transformer.
            "num_heads": 6,
            # Hidden channels of its MLPs.
            "mlp_dim": 1536,
            # Pixels per patch and axis.
            "patch_size": 16,
            # Register tokens.
            "num_registers": 4,
            # Gated MLPs with SiLU instead of GELU.
            "gated_mlp": False,
            # Initial value of the layer scale; DINOv3's come with the weights.
            "layer_scale": 1.0,
            # Patches per axis of DINOv2's position embedding; 0: DINOv3's rotary embedding.
            "position_grid": 0,
            # Implementation of the attention: auto, or one of `radejax.models.vit`.
            "attention": "auto",
            # Channels of the ResNet's stem; 64 in ResNet-50.
            "resnet_width": 64,
        }
    )
    model.fusion = ConfigDict(
        {
            # Heads of the deformable attention; must divide `decoder_width`.
            "num_heads": 4,
            # Sampling points per head and query.
            "num_points": 4,
            # Queries per bin, at different elevations.
            "num_elevation": 10,
            # Elevation weights: mlp (paper), cnn (released), off.
            "weighting": "mlp",
            # Gate: channel (paper) or bin (released).
            "gate": "channel",
            # Queries outside the image: drop, or official (zeroed, but counted).
            "out_of_view": "drop",
            # A dilated neck on each map before the attention.
            "necks": True,
            # Dropout rate on the fused map, from 0 to below 1.
            "dropout": 0.1,
            # Bins that are attended at a time; 0: chosen by platform.
            "chunk_size": 0,
        }
    )
    model.query_grid = _axes(LiftingAxes.of_grid(RadarGrid.kradar()))


def _axes(axes: LiftingAxes) -> ConfigDict:
    """Axes of the radar queries."""
    return ConfigDict(
        {
            # Center of the first query in range and the step, in meters; or the centers of
            # all bins if they are not uniform.
            "range_m": axes.range_m,
            # The same in azimuth, in degrees.
            "azimuth_deg": axes.azimuth_deg,
            # Elevation span in degrees, which `fusion.num_elevation` segments divide.
            "elevation_deg": axes.elevation_deg,
        }
    )


def _camera() -> ConfigDict:
    return ConfigDict(
        {
            # raw (with lens distortion) or pinhole (without, as released).
            "projection": "raw",
            # Shift from LiDAR to radar in meters; None: each sequence's own.
            "radar_from_lidar_m": placeholder(tuple),
            # Its z, which does not move boxes; None: K-Radar's 0.7, or the simulation's.
            "radar_from_lidar_z_m": placeholder(float),
            # sequence (each sequence's own) or common (cam_front0.yml, as released).
            "calibration": "sequence",
            # Resize images of another size than `model.image.size`; otherwise an error.
            "resize": False,
            # Predict frames without an image from the radar only; otherwise an error.
            "allow_missing": True,
        }
    )
