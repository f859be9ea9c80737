"""RADE-Net and DinoRADE in JAX: 3D object detection in 4D radar tensors."""

from typing import Any

from radejax.errors import DataError, UserError
from radejax.structures import CLASSES, Batch, DetectionMaps, Detections

__version__ = "0.1.0"

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
    """`radejax.Detector` on first use: reading labels should not load the models."""
    if name == "Detector":
        from radejax.detector import Detector

        return Detector
    raise AttributeError(f"module 'radejax' has no attribute {name!r}")
