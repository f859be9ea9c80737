"""RADE-Net and DinoRADE in JAX: 3D object detection in 4D radar tensors."""

import importlib
import sys
from typing import TYPE_CHECKING

from radejax.core.version import __version__ as __version__

if sys.platform == "win32":
    raise ImportError("radejax runs on Linux and macOS; on Windows, use WSL 2")

if TYPE_CHECKING:  # the names for editors and type checkers
    from radejax.config import Config as Config
    from radejax.config import load_config as load_config
    from radejax.core.compilation_cache import (
        enable_compilation_cache as enable_compilation_cache,
    )
    from radejax.core.errors import DataError as DataError
    from radejax.core.errors import UserError as UserError
    from radejax.core.structures import CLASSES as CLASSES
    from radejax.core.structures import Batch as Batch
    from radejax.core.structures import Boxes as Boxes
    from radejax.core.structures import DetectionMaps as DetectionMaps
    from radejax.core.structures import Detections as Detections
    from radejax.data.cameras import front_view as front_view
    from radejax.data.kradar import KRadar as KRadar
    from radejax.data.kradar.tesseract import project_file as project_file
    from radejax.data.kradar.tesseract import read_tesseract as read_tesseract
    from radejax.evaluation import evaluate as evaluate
    from radejax.geometry.radar_grid import RadarGrid as RadarGrid
    from radejax.inference.detector import Detector as Detector
    from radejax.inference.predict import predict_dataset as predict_dataset
    from radejax.inference.saved import SavedModel as SavedModel
    from radejax.inference.saved import load_model as load_model
    from radejax.runs.data import data_of_run as data_of_run
    from radejax.runs.experiment import run as run
    from radejax.runs.figures import frame_scene as frame_scene
    from radejax.simulation.dataset import simulate_dataset as simulate
    from radejax.visualize.draw import draw_frame as draw_frame
    from radejax.visualize.style import Scene as Scene

# On first use: reading labels or evaluating files should not load the models.
_MODULES = {
    "config": ("Config", "load_config"),
    "core.compilation_cache": ("enable_compilation_cache",),
    "core.errors": ("DataError", "UserError"),
    "core.structures": ("CLASSES", "Batch", "Boxes", "DetectionMaps", "Detections"),
    "data.cameras": ("front_view",),
    "data.kradar": ("KRadar",),
    "data.kradar.tesseract": ("project_file", "read_tesseract"),
    "evaluation": ("evaluate",),
    "geometry.radar_grid": ("RadarGrid",),
    "inference.detector": ("Detector",),
    "inference.predict": ("predict_dataset",),
    "inference.saved": ("SavedModel", "load_model"),
    "runs.data": ("data_of_run",),
    "runs.experiment": ("run",),
    "runs.figures": ("frame_scene",),
    "simulation.dataset:simulate_dataset": ("simulate",),
    "visualize.draw": ("draw_frame",),
    "visualize.style": ("Scene",),
}
_LAZY = {name: module for module, names in _MODULES.items() for name in names}

# Type checkers export a function under another name only if `__all__` has a literal.
__all__ = [*_LAZY, "simulate"]


def __dir__() -> list[str]:
    return [*globals(), *_LAZY]


def __getattr__(name: str) -> object:
    if name in _LAZY:
        module, _, attribute = _LAZY[name].partition(":")
        return getattr(importlib.import_module(f"radejax.{module}"), attribute or name)
    raise AttributeError(f"module 'radejax' has no attribute {name!r}")
