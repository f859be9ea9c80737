"""RADE-Net and DinoRADE in JAX: 3D object detection in 4D radar tensors."""

import importlib
from typing import Any

__version__ = "0.2.0"

# On first use: reading labels or evaluating files should not load the models.
_LAZY = {
    "Batch": "radejax.core.structures",
    "CLASSES": "radejax.core.structures",
    "DataError": "radejax.core.errors",
    "DetectionMaps": "radejax.core.structures",
    "Detections": "radejax.core.structures",
    "Detector": "radejax.inference.detector",
    "Scene": "radejax.visualize.style",
    "UserError": "radejax.core.errors",
    "draw_frame": "radejax.visualize.draw",
}

__all__ = list(_LAZY)


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'radejax' has no attribute {name!r}")
