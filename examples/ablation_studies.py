"""Variants that `ablation.py` compares, and claims about them."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

from radejax.config import load_module
from radejax.core.structures import CLASSES

CONFIGS = pathlib.Path(__file__).resolve().parents[1] / "configs"
_VARIANTS = load_module(CONFIGS / "radenet.py").VARIANTS
_RELEASES = load_module(CONFIGS / "radenet.py").RELEASES
_RADAR = "quickstart:ablation"
_LABELS = {"data.label_permutation_seed": 0}
_OWN_INPUT = {"model.input_center": 0.64, "model.input_scale": 14.0}
"""Centering and scaling of the input in `configs/quickstart.py`."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """A variant, which is a run or another evaluation of the run of another variant.

    Attributes:
        config: Name of a config file and its options, such as "quickstart:ablation".
        fields: Config fields that the variant changes.
        exchanges: Variant whose run is evaluated with shuffled images; None for a new run.
        release: Reduced release to which the radar tensors are converted, "polar3d" or "rpc"
            with the fraction of the cells, such as "rpc 0.01"; None for the tensors.
    """

    config: str
    fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    exchanges: str | None = None
    release: str | None = None


@dataclasses.dataclass(frozen=True)
class Claim:
    """The claim that variant `a` beats `b` in a class by at least `least` points."""

    text: str
    a: str
    b: str
    cls: str = "Sedan"
    least: float = 0.0


@dataclasses.dataclass(frozen=True)
class Study:
    """A table of variants.

    Attributes:
        title: Title of the table.
        base: Variant that the others are compared with.
        cells: Variants by name. Variants of two studies with the same name and config file
            share a run, so they must be equal.
        claims: Claims to check.
        held_out: Number of held-out scenes, of one frame each.
        frames_per_sequence: Frames of every sequence. If there are several, networks are
            trained and evaluated on the last one; the others only precede it.
    """

    title: str
    base: str
    cells: Mapping[str, Cell]
    claims: tuple[Claim, ...]
    held_out: int
    frames_per_sequence: int = 1


def _radar(**fields: Any) -> Cell:
    named = {name.replace("__", "."): v for name, v in fields.items()}
    return Cell(_RADAR, named)


def _row(name: str) -> Cell:
    """Returns the variant of one row of Table III; "expand" doubles the width of this decoder."""
    fields = {f"model.{k}": v for k, v in _VARIANTS[name].items()}
    return Cell(
        _RADAR, fields | ({"model.decoder_width": 64} if name == "expand" else {})
    )


def _released(release: str, config: str = _RADAR, **model: Any) -> Cell:
    """Returns a variant that reads a reduced release instead of the tensors."""
    fields = {f"model.{k}": v for k, v in model.items()} | {
        "simulation.output": "tesseract"
    }
    fields |= _RELEASES[release.partition(" ")[0]]
    return Cell(config, fields, release=release)


STUDIES = {
    "3": Study(
        "RADE-Net's Table III",
        "base",
        {n: _row(n) for n in ("base", "cbam", "cbam_heads", "model", "no_cbam", "stem", "expand")}
        | {"shuffled labels": Cell(_RADAR, _LABELS)},
        (
            Claim("the whole network beats the plain one (64.06 to 57.96)", "model", "base"),
            Claim("attention alone does not pay (55.13 to 57.96)", "base", "cbam"),
            Claim("larger heads help (58.35 to 55.13)", "cbam_heads", "cbam"),
            Claim("the dilated neck helps (64.06 to 58.35)", "model", "cbam_heads"),
            Claim("attention pays with neck and heads (64.06 to 59.81)", "model", "no_cbam"),
            Claim("without a second stem it is better (64.06 to 63.47)", "model", "stem"),
            Claim("with a narrow decoder it is better (64.06 to 63.12)", "model", "expand"),
            Claim("sanity check: labels matter", "model", "shuffled labels"),
        ),
        1024,
    ),
    "sigma": Study(
        "spread of the heatmap's targets",
        "sigma 3",
        {
            "sigma 3": _radar(loss__heatmap_sigma_bins=3.0),
            "model": _row("model"),  # sigma 1
            "sigma 0.75": _radar(loss__heatmap_sigma_bins=0.75),
            "adaptive": _radar(loss__heatmap_sigma_mode="adaptive"),
            "anisotropic": _radar(loss__heatmap_sigma_mode="anisotropic"),
            "shuffled labels": Cell(_RADAR, _LABELS),
        },
        (
            Claim("0.75 is best for all classes", "sigma 0.75", "sigma 3", "mean"),
            Claim("0.75 is better than 1", "sigma 0.75", "model", "mean"),
            *(
                Claim(f"0.75 helps {cls}", "sigma 0.75", "sigma 3", cls)
                for cls in CLASSES[2:]
            ),
            Claim("a spread of the box's size is better than 1", "adaptive", "model", "mean"),
            Claim("a spread of its shape is better than 1", "anisotropic", "model", "mean"),
            Claim("sanity check: labels matter", "model", "shuffled labels"),
        ),
        1024,
    ),
    "4": Study(
        "DinoRADE's Table 4",
        "R",
        {
            "R": Cell("quickstart_fusion:radar"),
            "R+C": Cell("quickstart_fusion:pretrained", {"model.fusion.weighting": "off"}),
            "R+C+W": Cell("quickstart_fusion:pretrained"),
            "R+C+W ResNet": Cell("quickstart_fusion:resnet50"),
            "shuffled images": Cell("quickstart_fusion:pretrained", exchanges="R+C+W"),
            "shuffled labels": Cell("quickstart_fusion:pretrained", _LABELS),
        },
        (
            Claim("the camera helps (69.61 to 61.65)", "R+C", "R"),
            Claim("the whole model gains 4 (71.38 to 61.65)", "R+C+W", "R", least=4.0),
            Claim("the same in the mean", "R+C+W", "R", "mean", 4.0),
            Claim("elevation weights help (71.38 to 69.61)", "R+C+W", "R+C"),
            Claim("a transformer beats a ResNet (71.38 to 68.43)", "R+C+W", "R+C+W ResNet"),
            Claim("a transformer does in the mean", "R+C+W", "R+C+W ResNet", "mean"),
            Claim("sanity check: images matter", "R+C+W", "shuffled images"),
            Claim("sanity check: labels matter", "R+C+W", "shuffled labels"),
        ),
        1024,
    ),
    "camera": Study(
        "the camera with the quickstart's training",
        "R long",
        {
            "R long": Cell("quickstart_fusion:radar,long"),
            "R+C+W long": Cell("quickstart_fusion:pretrained,long"),
            "shuffled images long": Cell(
                "quickstart_fusion:pretrained,long", exchanges="R+C+W long"
            ),
        },
        (
            *(
                Claim(f"the camera helps {cls}", "R+C+W long", "R long", cls)
                for cls in CLASSES
            ),
            Claim("it does in the mean", "R+C+W long", "R long", "mean"),
            Claim("sanity check: images matter", "R+C+W long", "shuffled images long", "mean"),
        ),
        1024,
    ),
    "quickstart": Study(
        "what the quickstart does otherwise",
        "model",
        {
            "model": _row("model"),
            "input centered": Cell(_RADAR, _OWN_INPUT),
            "quickstart": Cell("quickstart"),
        },
        (
            Claim("a centered and scaled input helps", "input centered", "model"),
            Claim("it does in the mean", "input centered", "model", "mean"),
            Claim("all the rest helps", "quickstart", "input centered"),
            Claim("it does in the mean", "quickstart", "input centered", "mean"),
            *(
                Claim(f"all together help {cls}", "quickstart", "model", cls)
                for cls in CLASSES[2:]
            ),
        ),
        1024,
    ),
    "augmentation": Study(
        "a random gain of up to 6 dB in training",
        "sigma 0.75",
        {
            "sigma 0.75": _radar(loss__heatmap_sigma_bins=0.75),
            "random gain": _radar(loss__heatmap_sigma_bins=0.75, data__random_gain_db=6.0),
        },
        (
            Claim("a random gain helps", "random gain", "sigma 0.75"),
            Claim("it does in the mean", "random gain", "sigma 0.75", "mean"),
        ),
        1024,
    ),
    "releases": Study(
        "what K-Radar's reduced releases cost",
        "input centered",
        {
            "input centered": Cell(_RADAR, _OWN_INPUT),
            "polar3d": _released("polar3d"),
            "polar3d without Doppler": _released("polar3d", doppler_bins=0),
            "10 % points": _released("rpc 0.1"),
            "1 % points": _released("rpc 0.01"),
            "0.1 % points": _released("rpc 0.001"),
        },
        (
            Claim("tensors are better than polar3d", "input centered", "polar3d", "mean"),
            Claim(
                "the reconstructed Doppler helps", "polar3d", "polar3d without Doppler", "mean"
            ),
            *(
                Claim(f"polar3d is better than {cell}", "polar3d", cell, "mean")
                for cell in ("10 % points", "1 % points", "0.1 % points")
            ),
        ),
        1024,
    ),
    "polar3d_camera": Study(
        "the camera beside polar3d",
        "R polar3d",
        {
            "R polar3d": _released("polar3d", "quickstart_fusion:radar"),
            "R+C+W polar3d": _released("polar3d", "quickstart_fusion:pretrained"),
        },
        (
            Claim("the camera improves the mean", "R+C+W polar3d", "R polar3d", "mean"),
            *(
                Claim(f"the camera helps {cls}", "R+C+W polar3d", "R polar3d", cls)
                for cls in CLASSES
            ),
        ),
        1024,
    ),
    "frames": Study(
        "two frames against one",
        "one frame",
        {
            "one frame": _radar(simulation__frames_per_sequence=2),
            "two frames": _radar(simulation__frames_per_sequence=2, data__num_frames=2),
        },
        (
            *(
                Claim(f"the preceding frame helps {cls}", "two frames", "one frame", cls)
                for cls in CLASSES
            ),
            Claim("it does in the mean", "two frames", "one frame", "mean"),
        ),
        1024,
        2,
    ),
}  # fmt: skip
