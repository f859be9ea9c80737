"""RADE-Net on K-Radar: the rows of Table III, and paper or released settings.

    python train.py --config configs/radenet.py --data ... --workdir ...
    python train.py --config configs/radenet.py:stem,sedan ...
    python train.py --config configs/radenet.py:official --config.train.batch_size=4 ...

The argument is a list of options, at most one of each group:

- variant: `base`, `cbam`, `cbam_heads`, `model` (default), `stem`, `expand`; the rows
  of Table III, from no attention, plain neck and small heads to the wide decoder.
  `no_cbam` is the full model without attention: the fourth row of the table, see below.
- preset: `paper` or `official` (what the released code runs, the padded and stretched
  azimuth axis included). Without one: the paper's, but with the released attention
  block and the losses read at the objects' own bins.
- sigma: `sigma3`, `sigma0.75` (bins), `adaptive`, `anisotropic` (metres of the object
  read as bins); the targets that the papers compare, over what preset or default say.
- classes: `all` (default; five classes, v2.1 labels) or `sedan` (v1.1 labels).

What Table III reports (Sedan, narrow region, IoU 0.3, AP 3D and BEV): base 57.96 and
63.98, cbam 55.13 and 62.88, cbam_heads 58.35 and 64.70, model 64.06 and 68.71, stem
63.47 and 69.05, expand 63.12 and 67.92. Training there: one GPU, batch 10, 10 epochs
of 17,458 frames. A row of 59.81 and 66.32 has the ticks of `model`; it is read as
`no_cbam`, as the paper says that attention gains much once neck and heads are complex
enough, and no other row would show that.
"""

from ml_collections import ConfigDict

from radejax.core.config import base_config, parse_options
from radejax.core.structures import WIDE_ROI

_OFF = {"cbam": "off", "neck": "plain", "heads": "default"}

VARIANTS = {
    "base": _OFF,
    "cbam": {"neck": "plain", "heads": "default"},
    "cbam_heads": {"neck": "plain"},
    "model": {},
    "no_cbam": {"cbam": "off"},
    "stem": {"input_stem": True},
    "expand": {"decoder_width": 256},
}
"""Fields of `config.model` per row of Table III, on top of the full model."""

PRESETS = {
    "paper": {
        "model.cbam": "paper",
        "model.crop_output": True,
        "loss.gwd_transform": "sqrt",
        "loss.assignment": "nms",
        "loss.z0_m": 0.0,
        "decode.threshold_inclusive": True,
        "decode.roi": None,
        "decode.raw_yaw": "never",
        "decode.clip_sizes": True,
        "train.final_learning_rate": 1e-4,
        "train.schedule": "cosine",
        "train.num_epochs": 10,
        "data.azimuth_mapping": "true",
        "data.validation": (),
        "data.include_unstarred_v11_labels": False,
        "evaluation.protocols": ("coco101", "all_point", "kradar_r40"),
        "evaluation.empty_frames": "protocol",
    },
    "official": {
        "model.cbam": "official",
        "model.crop_output": False,
        "loss.gwd_transform": "none",
        "loss.assignment": "center",
        "loss.z0_m": 0.0,
        "decode.threshold_inclusive": False,
        "decode.roi": WIDE_ROI,
        "decode.raw_yaw": "always",
        "decode.clip_sizes": False,
        "train.final_learning_rate": 1e-5,
        "train.schedule": "cyclic_cosine",
        "train.num_epochs": 11,
        "data.azimuth_mapping": "stretched",
        "data.validation": (),
        "data.include_unstarred_v11_labels": True,
        "evaluation.protocols": ("coco101",),
        "evaluation.empty_frames": "class",
    },
}
"""Where the paper and the released code differ, one field per row."""

SIGMAS = {
    "sigma3": {"heatmap_sigma_mode": "fixed", "heatmap_sigma_bins": 3.0},
    "sigma0.75": {"heatmap_sigma_mode": "fixed", "heatmap_sigma_bins": 0.75},
    "adaptive": {"heatmap_sigma_mode": "adaptive"},
    "anisotropic": {"heatmap_sigma_mode": "anisotropic"},
}
"""Fields of `config.loss` for the spread of the heatmap's targets."""

CLASS_SETS = ("all", "sedan")


def get_config(arg: str | None = None) -> ConfigDict:
    """One complete config; see the module's text for `arg`."""
    variant, preset, sigma, classes = parse_options(
        arg, VARIANTS, PRESETS, SIGMAS, CLASS_SETS
    )
    config = base_config()
    if preset is not None:
        config.update_from_flattened_dict(PRESETS[preset])
    # After the preset: the base row has no attention in either world.
    config.model.update(VARIANTS[variant or "model"])
    if sigma is not None:
        config.loss.update(SIGMAS[sigma])
    if classes == "sedan":
        config.classes = ("Sedan",)
        config.model.num_classes = 1
        config.data.label_version = "v1.1"
    return config
