"""RADE-Net and DinoRADE in JAX: 3D object detection in 4D radar tensors."""

import importlib
import sys
from typing import Any

if sys.platform == "win32":
    raise ImportError("radejax runs on Linux and macOS; on Windows, use WSL 2")

__version__ = "0.2.0"

# On first use: reading labels or evaluating files should not load the models.
_LAZY = {
    "Batch": "core.structures",
    "Boxes": "core.structures",
    "CLASSES": "core.structures",
    "DataError": "core.errors",
    "DetectionMaps": "core.structures",
    "Detections": "core.structures",
    "Detector": "inference.detector",
    "KRadar": "data.kradar",
    "RadarGrid": "geometry.radar_grid",
    "SavedModel": "inference.saved",
    "Scene": "visualize.style",
    "UserError": "core.errors",
    "data_of_run": "runs.data",
    "draw_frame": "visualize.draw",
    "enable_compilation_cache": "core.compilation_cache",
    "evaluate": "evaluation",
    "frame_scene": "runs.figures",
    "front_view": "data.dataset",
    "load_config": "core.config",
    "load_model": "inference.saved",
    "predict_dataset": "inference.predict",
    "project_file": "data.tesseract",
    "read_tesseract": "data.tesseract",
    "run": "runs.experiment",
    "simulate": "simulation.dataset:simulate_dataset",
}

__all__ = list(_LAZY)


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        module, _, attribute = _LAZY[name].partition(":")
        return getattr(importlib.import_module(f"radejax.{module}"), attribute or name)
    raise AttributeError(f"module 'radejax' has no attribute {name!r}")
