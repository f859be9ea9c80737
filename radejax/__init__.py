"""RADE-Net and DinoRADE in JAX: 3D object detection in 4D radar tensors."""

import importlib
from typing import Any

from radejax.core.errors import DataError, UserError

__version__ = "0.1.0"

# On first use: reading labels or evaluating files should not load the models.
_LAZY = {
    "Batch": "radejax.core.structures",
    "CLASSES": "radejax.core.structures",
    "DetectionMaps": "radejax.core.structures",
    "Detections": "radejax.core.structures",
    "Detector": "radejax.inference.detector",
}

__all__ = [
    "CLASSES",
    "Batch",
    "DataError",
    "DetectionMaps",
    "Detections",
    "Detector",
    "UserError",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'radejax' has no attribute {name!r}")
