"""DinoRADE on K-Radar: the variants of Table 4 and the settings of paper and release.

    python train.py --config configs/dinorade.py --data ... --workdir ...
    python train.py --config configs/dinorade.py:rc ...
    python train.py --config configs/dinorade.py:official ...

The argument is a list of options, at most one of each group:

- variant: `r` radar-only (a RADE-Net with the dual stem), `rc` with camera and without elevation
  weights, `rcw` (default) the whole model, `rcw_resnet50` with a ResNet-50, whose last stage is
  trained, instead of DINOv3; `rcw_dinov2` with DINOv2 ViT-S/14, which is not in the paper.
- preset: `paper` or `official` (the authors' code with these values, including its geometry). The
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

from radejax.config import Config, load_module, parse_options
from radejax.data.options import CameraOptions
from radejax.geometry.camera import KRADAR_RADAR_FROM_LIDAR_Z_M
from radejax.models.lifting import OFFICIAL_OFFSET_M
from radejax.models.options import DinoRadeOptions, QueryGridOptions, RadeNetOptions

VARIANTS: dict[str, dict[str, object]] = {
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
"""Fields in which the paper and the authors' code differ, in addition to RADE-Net's."""

CLASS_SETS = ("all", "sedan")


def get_config(arg: str | None = None) -> Config:
    """Returns the complete config; see the module docstring for `arg`."""
    radenet = load_module(pathlib.Path(__file__).with_name("radenet.py"))
    variant, preset, sigma, classes, release = parse_options(
        arg, VARIANTS, PRESETS, radenet.SIGMAS, CLASS_SETS, radenet.RELEASES
    )
    variant = variant or "rcw"
    config = Config(model=DinoRadeOptions(input_stem=True)).replace(
        loss={"heatmap_sigma_bins": 0.75},
        train={"batch_size": 6, "num_epochs": 11},
        data={"camera": CameraOptions()},
    )
    if preset is not None:
        config = config.with_fields(radenet.PRESETS[preset] | PRESETS[preset])
    if preset == "official":
        # The authors' code only scales the images of its ResNet to [0, 1].
        is_standardized = variant != "rcw_resnet50"
        config = config.replace(
            model={
                "query_grid": QueryGridOptions.official(),
                "image": {"standardize": is_standardized},
            }
        )
    config = config.with_fields(VARIANTS[variant])
    if sigma is not None:
        config = config.replace(loss=radenet.SIGMAS[sigma])
    if release is not None:
        config = config.with_fields(radenet.RELEASES[release])
    if variant == "r":
        config = config.replace(model=radar_part(config.model), data={"camera": None})
    if classes == "sedan":
        config = config.with_fields(radenet.SEDAN)
    return config


def radar_part(model: RadeNetOptions) -> RadeNetOptions:
    """Returns the options of only the radar branch of a model."""
    names = RadeNetOptions.model_fields
    fields = {name: value for name, value in model if name in names}
    return RadeNetOptions(**fields | {"name": "radenet"})
