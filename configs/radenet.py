"""RADE-Net on K-Radar: the variants of Table III and the settings of paper and release.

    python train.py --config configs/radenet.py --data ... --workdir ...
    python train.py --config configs/radenet.py:stem,sedan ...
    python train.py --config configs/radenet.py:official --config.train.batch_size=4 ...

The argument is a list of options, at most one of each group:

- variant: `base`, `cbam`, `cbam_heads`, `model` (default), `stem`, `expand`; the rows of Table III,
  from no attention, plain neck and small heads to the wide decoder. `no_cbam` is the full model
  without attention, the fourth row of the table, see below.
- preset: `paper` or `official` (what the authors' code runs, including its padded and stretched
  azimuth axis). The default follows the paper, but with the released attention block, with
  regression losses at the objects' own bins, and with the raw yaw vector in NMS.
- sigma: `sigma3`, `sigma0.75` (in bins), `adaptive`, `anisotropic` (from the size of the object);
  the heatmap targets that the papers compare. It overrides the preset.
- classes: `all` (default; five classes, v2.1 labels) or `sedan` (v1.1 labels).
- release: `polar3d` or `rpc`, for K-Radar's reduced releases. The input is centered at the level
  of the noise (estimated: the mean over Doppler is 6.8 dB below the maximum) or of bins without a
  point, and scaled as in `quickstart.py`, because the noise is almost constant.
  `--config.model.doppler_bins=0` leaves out the reconstructed Doppler half.

Table III reports (models with the option `sedan`, narrow region, IoU 0.3):

| variant | AP 3D | AP BEV |
|---|---|---|
| base | 57.96 | 63.98 |
| cbam | 55.13 | 62.88 |
| cbam_heads | 58.35 | 64.70 |
| no_cbam | 59.81 | 66.32 |
| model | 64.06 | 68.71 |
| stem | 63.47 | 69.05 |
| expand | 63.12 | 67.92 |

The authors' code trains on one GPU with batch size 10 and epochs of 17,458 frames. The row of
`no_cbam` has the same marks as `model` in the paper. It is read as the model without
attention, because the paper says that attention helps once neck and heads are complex enough, and
no other row would show that.
"""

from radejax.config import Config, parse_options
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
"""Fields of `config.model` that each row of Table III changes in the full model."""

PRESETS = {
    "paper": {
        "model.cbam": "paper",
        "model.crop_output": True,
        "loss.gwd_transform": "sqrt",
        "loss.assignment": "nms",
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
"""Fields in which the paper and the authors' code differ."""

SIGMAS = {
    "sigma3": {"heatmap_sigma_mode": "fixed", "heatmap_sigma_bins": 3.0},
    "sigma0.75": {"heatmap_sigma_mode": "fixed", "heatmap_sigma_bins": 0.75},
    "adaptive": {"heatmap_sigma_mode": "adaptive"},
    "anisotropic": {"heatmap_sigma_mode": "anisotropic"},
}
"""Fields of `config.loss` for the Gaussians of the heatmap targets."""

CLASS_SETS = ("all", "sedan")

SEDAN = {
    "classes": ("Sedan",),
    "model.num_classes": 1,
    "data.label_version": "v1.1",
}
"""Fields of the option `sedan`."""

RELEASES = {
    name: {
        "data.release": name,
        "model.input_center": center,
        "model.input_scale": 25.0,
    }
    for name, center in (("polar3d", 0.52), ("rpc", 0.5))
}
"""Fields for K-Radar's reduced releases, see `radejax.data.kradar.reduced`."""


def get_config(arg: str | None = None) -> Config:
    """Returns the complete config; see the module docstring for `arg`."""
    variant, preset, sigma, classes, release = parse_options(
        arg, VARIANTS, PRESETS, SIGMAS, CLASS_SETS, RELEASES
    )
    config = Config()
    if preset is not None:
        config = config.with_fields(PRESETS[preset])
    # The variant comes last, as the base row has no attention with any preset.
    config = config.replace(model=VARIANTS[variant or "model"])
    if sigma is not None:
        config = config.replace(loss=SIGMAS[sigma])
    if release is not None:
        config = config.with_fields(RELEASES[release])
    if classes == "sedan":
        config = config.with_fields(SEDAN)
    return config
