"""Figures of frames, cameras, curves and sequences with matplotlib."""

from radejax.visualize import animate, camera, curves, draw, slices, style

__all__ = ["animate", "camera", "curves", "draw", "slices", "style"]
