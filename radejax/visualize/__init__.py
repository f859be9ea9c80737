"""Figures of frames, cameras, curves and sequences with matplotlib."""

from radejax.visualize import camera, curves, draw, recordings, style

__all__ = ["camera", "curves", "draw", "recordings", "style"]
