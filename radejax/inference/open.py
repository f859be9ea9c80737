"""One way to a `Detector` from everything that the command line takes as a model."""

from __future__ import annotations

import os
import pathlib
from typing import Any

from radejax.inference import packed
from radejax.inference.detector import Detector
from radejax.inference.packed import LoadedModel


def open_detector(
    source: str | os.PathLike,
    image_backbone: str | os.PathLike | None = None,
    *,
    step: int | str | None = None,
    **overrides: Any,
) -> tuple[Detector, LoadedModel | None]:
    """Detector of a folder or an official checkpoint.

    Args:
        source: Work folder of a run, its checkpoints, one of them, an exported folder,
            or an official .pth file.
        image_backbone: Weights of the image backbone, where `source` is without.
        step: See `checkpoint_files.load`.
        **overrides: Arguments of `Detector`.

    Returns:
        The detector and what was read of a folder; None for a file.

    Raises:
        FileNotFoundError: There is no model.
        UserError: A step of what holds one model.
    """
    source = pathlib.Path(source)
    if source.is_file():
        packed.check_no_step(source, step)
        detector = Detector.from_torch(
            source, image_backbone=image_backbone, **overrides
        )
        return detector, None
    loaded = packed.load(source, image_backbone=image_backbone, step=step)
    settings = {**loaded.settings, **overrides}
    detector = Detector(loaded.model, loaded.variables, loaded.grid, **settings)
    return detector, loaded
