"""Features of front images by the frozen image backbone, as records to train from."""

from __future__ import annotations

import concurrent.futures
import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from jaxtyping import UInt8
from tqdm import tqdm

from radejax.core.errors import UserError
from radejax.data.cameras import read_left_image
from radejax.data.dataset import LabelledFrame
from radejax.data.records import Records, embedding_fields
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.weights.image_backbone import weights_sha256


def embed_dataset(
    model: nn.Module,
    variables: Mapping[str, Any],
    image_config: Mapping[str, Any],
    frames: Sequence[LabelledFrame],
    folder: str | os.PathLike,
    *,
    dtype: str = "float32",
    resize: bool = False,
    batch_size: int = 8,
    num_threads: int = 2,
    progress: bool = True,
) -> dict[str, int]:
    """Write the backbone's features of every front image that has none yet.

    Args:
        model: A `DinoRade`.
        variables: With the backbone's parameters, `params/image_backbone`.
        image_config: `config.model.image`, kept with the embeddings.
        frames: Of a dataset, normally without a split.
        folder: Folder of the embeddings; made if needed.
        dtype: "float32", with which training is the same as from images, or "float16",
            half the size.
        resize: Resize images of another size than the model's.
        batch_size: Images at once.
        num_threads: Threads that read images.
        progress: Show a progress bar.

    Returns:
        Counts: "frames", "embedded", "found", "missing" (frames without an image).

    Raises:
        UserError: The folder has other records; no frames; an unknown dtype.
        DataError: An image is corrupted or of another size.
    """
    if not len(frames):
        raise UserError("no frames to embed")
    params = variables["params"][IMAGE_BACKBONE]
    source = {
        "image": embedding_fields(image_config),
        "weights_sha256": weights_sha256(params),
    }
    records = Records.create(folder, model.feature_shape, dtype, source)
    keys = records.keys()
    images = [f for f in frames if f.camera_path is not None and f.key not in keys]
    found = sum(frame.key in keys for frame in frames)
    embed = jax.jit(lambda params, image: model.apply(params, image, method="embed"))
    params = jax.device_put({"params": {IMAGE_BACKBONE: params}})
    read = functools.partial(read_left_image, size=model.image_size, resize=resize)
    bar = tqdm(total=len(images), unit="frame", desc="embed", disable=not progress)
    with bar, concurrent.futures.ThreadPoolExecutor(num_threads) as pool:
        for names, batch in _batches(pool, read, images, batch_size, model.image_size):
            features = np.asarray(embed(params, batch)).astype(dtype)
            for key, row in zip(names, features, strict=False):  # may be padded
                records.write(key, row)
            bar.update(len(names))
    return {
        "frames": len(frames),
        "embedded": len(images),
        "found": found,
        "missing": len(frames) - len(images) - found,
    }


def _batches(
    pool: concurrent.futures.Executor,
    read: Any,
    frames: Sequence[LabelledFrame],
    batch_size: int,
    size: tuple[int, int],
) -> Iterator[tuple[list[str], UInt8[np.ndarray, "B H W 3"]]]:
    """Keys and images; threads read ahead, the last batch is padded."""
    for start in range(0, len(frames), 8 * batch_size):
        chunk = frames[start : start + 8 * batch_size]
        images = pool.map(read, [frame.camera_path for frame in chunk])
        for first in range(0, len(chunk), batch_size):
            part = chunk[first : first + batch_size]
            batch = np.zeros((batch_size, *size, 3), np.uint8)
            for row, _ in enumerate(part):
                batch[row] = next(images)
            yield [frame.key for frame in part], batch
