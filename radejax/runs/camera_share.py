"""What a fusion model takes from the camera, by weather: the gate's map averaged."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from ml_collections import ConfigDict

from radejax import models
from radejax.data.kradar.frame import Frame
from radejax.data.pipeline import make_loader
from radejax.data.records.projections import RecordSource
from radejax.interop import image_backbone
from radejax.training.step import model_inputs
from radejax.visualize.camera_share import average_by_group


def camera_share(
    config: ConfigDict,
    variables: Mapping[str, Any],
    records: RecordSource,
    frames: Sequence[Frame],
    *,
    embeddings: str | None = None,
    group: Callable[[Frame], str] = lambda frame: frame.weather,
    max_frames: int = 256,
    batch_size: int = 8,
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Mean share of the camera in the fused map by group of frames, "all" first.

    Args:
        config: Of a radar-camera run.
        variables: Of its model.
        records: Projections.
        frames: Of a data set; evenly spread ones where there are more than `max_frames`.
        embeddings: Folder of embeddings in place of images.
        group: Names the group of a frame.
        max_frames: Limit of frames.
        batch_size: Frames at once.

    Returns:
        `[R, A]` means by group, and how many frames with an image each is of; see
        `average_by_group`.
    """
    spread = np.linspace(0, len(frames) - 1, min(max_frames, len(frames)))
    frames = [frames[int(i)] for i in np.round(spread)]
    loader = make_loader(
        records,
        frames,
        batch_size=batch_size,
        max_objects=max(len(frame.boxes) for frame in frames) or 1,
        classes=config.classes,
        shuffle=False,
        num_epochs=1,
        pad_remainder=True,
        process_index=0,  # only the main process draws
        process_count=1,
        **image_backbone.loader_arguments(config, frames, embeddings),
    )
    model = models.build(config.model)

    @jax.jit
    def share_of(variables: Any, inputs: Any) -> jax.Array:
        _, sown = model.apply(variables, *inputs, mutable=["intermediates"])
        return sown["intermediates"]["image_fusion"]["camera_share"][0]

    variables = jax.device_put(dict(variables))

    def shares() -> Iterator[tuple[str, np.ndarray]]:
        for batch in loader:
            found = np.asarray(share_of(variables, model_inputs(batch)), np.float64)
            for index, share in zip(batch.frame, found, strict=True):
                if index >= 0:
                    yield group(frames[index]), share

    return average_by_group(shares())
