"""Detectors as Flax modules; `build` makes one from its config."""

from radejax.models.detectors import build, has_camera, map_grid, with_dtype

__all__ = ["build", "has_camera", "map_grid", "with_dtype"]
