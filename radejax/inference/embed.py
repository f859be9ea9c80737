"""Images through the frozen image backbone once, into records to train from."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import hashlib
import os
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from tqdm import tqdm

from radejax.core import files
from radejax.core.errors import UserError
from radejax.data.images import read_left_image
from radejax.data.kradar import Frame
from radejax.data.records import embeddings
from radejax.data.records import files as record_files
from radejax.data.records.arrays import MANIFEST
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.weights.image_backbone import weights_sha256

DTYPES = ("float32", "float16")


def embed_dataset(
    model: nn.Module,
    variables: Mapping[str, Any],
    image_config: Mapping[str, Any],
    frames: Sequence[Frame],
    out_dir: str | os.PathLike,
    *,
    dtype: str = "float32",
    resize: bool = False,
    batch_size: int = 8,
    frames_per_file: int = 64,
    num_threads: int = 2,
    progress: bool = True,
) -> dict[str, int]:
    """Writes the backbone's features of every front image; finished files are kept.

    Args:
        model: A `DinoRade`.
        variables: With the backbone's parameters, `params/image_backbone`.
        image_config: `config.model.image`, kept with the embeddings.
        frames: Of a data set, normally without a split.
        out_dir: Folder of the embeddings; made if needed.
        dtype: "float32", with which training is the same as from images, or "float16",
            half the size.
        resize: Resize images of another size than the model's.
        batch_size: Images at once.
        frames_per_file: Frames of one file of records.
        num_threads: Threads that read images.
        progress: Show a progress bar.

    Returns:
        Counts: "frames", "embedded", "found", "missing" (frames without an image).

    Raises:
        UserError: Embeddings of others are in the folder; a full disk; unknown dtype.
        DataError: An image is damaged or of another size.
    """
    if dtype not in DTYPES:
        raise UserError(f"dtype is {dtype!r}, expected one of {DTYPES}")
    if not len(frames):
        raise UserError("no frames to embed")
    out_dir = pathlib.Path(out_dir)
    params = variables["params"][IMAGE_BACKBONE]
    keys = "\n".join(frame.key for frame in frames)
    plan = {
        "format": embeddings.FORMAT,
        "version": embeddings.FORMAT_VERSION,
        "image": embeddings.relevant_fields(image_config),
        "weights_sha256": weights_sha256(params),
        "shape": list(model.feature_shape),
        "dtype": dtype,
        "frames_per_file": frames_per_file,
        "num_frames": len(frames),
        "frames_sha256": hashlib.sha256(keys.encode()).hexdigest(),
    }
    files.claim(out_dir / "plan.json", plan, "other embeddings")
    embed = jax.jit(lambda params, image: model.apply(params, image, method="embed"))
    params = jax.device_put({"params": {IMAGE_BACKBONE: params}})
    starts = range(0, len(frames), frames_per_file)
    chunks = [frames[start : start + frames_per_file] for start in starts]
    counts = {"frames": len(frames), "embedded": 0, "found": 0, "missing": 0}
    entries = []
    bar = tqdm(total=len(frames), unit="frame", desc="embed", disable=not progress)
    with bar, concurrent.futures.ThreadPoolExecutor(num_threads) as pool:
        reader = _Reader(pool, model.image_size, resize, batch_size)
        for number, chunk in enumerate(chunks):
            name = record_files.file_name(number, len(chunks), "embeddings")
            entry = record_files.read_manifest_of(out_dir, name)
            kind = "embedded" if entry is None else "found"
            if entry is None:
                run = ((keys, embed(params, image)) for keys, image in reader(chunk))
                entry = _write_file(out_dir, name, chunk, run, dtype, bar)
            else:
                bar.update(len(chunk))
            counts[kind] += len(entry.frames)
            counts["missing"] += len(entry.skipped)
            entries.append(dataclasses.asdict(entry))
    content = {**plan, "counts": counts, "files": entries}
    files.write_json(out_dir / MANIFEST, content)
    return counts


@dataclasses.dataclass
class _Reader:
    """Batches of images of one size, read ahead by threads; the last is filled up."""

    pool: concurrent.futures.Executor
    size: tuple[int, int]
    resize: bool
    batch_size: int

    def __call__(self, frames: Sequence[Frame]) -> Iterator[tuple[list, np.ndarray]]:
        paths = [f.camera_path for f in frames if f.camera_path is not None]
        frames = [frame for frame in frames if frame.camera_path is not None]
        read = functools.partial(read_left_image, size=self.size, resize=self.resize)
        images = self.pool.map(read, paths)  # in order, ahead of use
        for start in range(0, len(frames), self.batch_size):
            part = frames[start : start + self.batch_size]
            batch = np.zeros((self.batch_size, *self.size, 3), np.uint8)
            for row, _ in enumerate(part):
                batch[row] = next(images)
            yield [frame.key for frame in part], batch


def _write_file(
    folder: pathlib.Path,
    name: str,
    frames: Sequence[Frame],
    batches: Iterator[tuple[list[str], jax.Array]],
    dtype: str,
    bar: tqdm,
) -> record_files.RecordFile:
    with record_files.RecordFileWriter(folder, name) as writer:
        for frame in frames:
            if frame.camera_path is None:
                writer.skipped[frame.key] = "no front image"
        bar.update(len(writer.skipped))
        for keys, features in batches:
            stored = np.asarray(features).astype(dtype)
            for key, row in zip(keys, stored, strict=False):  # the batch may be padded
                writer.write(key, row)
            bar.update(len(keys))
        return writer.commit()
