"""Features of an image backbone for the images of whole datasets.

They are records, but `data` cannot compute them, as it uses neither models nor weights.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import jax
import numpy as np
import tqdm
from flax.typing import VariableDict
from jaxtyping import UInt8

from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.core.grain_import import grain
from radejax.core.manifest import state_of, warn_of_changes
from radejax.data.cameras import read_left_image
from radejax.data.dataset import LabeledFrame
from radejax.data.records import PreprocessReport, Records, embedding_fields
from radejax.models.dinorade import IMAGE_BACKBONE, DinoRade
from radejax.weights.image_backbone import weights_sha256

_log = logging.getLogger(__name__)


def embed_dataset(
    model: DinoRade,
    variables: VariableDict,
    frames: Sequence[LabeledFrame],
    folder: PathLike,
    *,
    dtype: str | None = None,
    resize: bool = False,
    batch_size: int = 8,
) -> PreprocessReport:
    """Writes the backbone's features of every front image that has none in the folder yet.

    Corrupted images are skipped and reported; the next call tries them again. Frames
    without an image, and embeddings whose image has changed since, are counted in warnings.

    Args:
        model: A `DinoRade` model.
        variables: Variables with the backbone's parameters in `params/image_backbone`.
        frames: Frames of a dataset, normally of all splits.
        folder: Folder of the embeddings, created if missing.
        dtype: Dtype of the stored features: "float32", with which training gives the same
            results as with images, or "float16", which needs half the space. None for
            that of existing ones, or float32 without any.
        resize: Resize images of another size to the model's size.
        batch_size: Number of images per batch.

    Returns:
        The report on the frames with an image or an embedding. Images are skipped if they
        are corrupted or, without `resize`, of another size.

    Raises:
        UserError: The folder contains other records, there are no images, or the dtype is
            unknown.
    """
    began = time.perf_counter()
    if not any(frame.camera_path for frame in frames):
        raise UserError(f"none of {len(frames)} frames has a front image to embed")
    params = variables["params"][IMAGE_BACKBONE]
    fields = embedding_fields(model.options.image.to_dict())
    source = {"image": fields, "weights_sha256": weights_sha256(params)}
    records = Records.create(
        folder, model.options.image.feature_shape, dtype, source, "float32"
    )
    keys = records.keys()
    images = [f for f in frames if f.camera_path is not None and f.key not in keys]
    found = {f.key: f.camera_path for f in frames if f.key in keys}
    warn_of_changes(records.folder, found)
    if missing := len(frames) - len(images) - len(found):
        _log.warning("%d of %d frames have no front image", missing, len(frames))
    states = {frame.key: state_of([frame.camera_path]) for frame in images}
    skipped: dict[str, str] = {}

    def read(frame: LabeledFrame) -> UInt8[np.ndarray, "H W 3"]:
        assert frame.camera_path is not None
        size = model.options.image.size
        try:
            return read_left_image(
                frame.camera_path,
                size,
                resize=resize,
                calibrated_size=frame.calibrated_size(),
            )
        except (DataError, OSError) as error:
            skipped[frame.key] = str(error)
            return np.zeros((*size, 3), np.uint8)

    embed = jax.jit(lambda params, image: model.apply(params, image, method="embed"))
    params = jax.device_put({"params": {IMAGE_BACKBONE: params}})
    batches: grain.IterDataset[np.ndarray] = (
        grain.MapDataset.source(images)
        .map(read)
        .batch(batch_size)
        .to_iter_dataset(grain.ReadOptions(2, prefetch_buffer_size=2))
    )
    with tqdm.tqdm(total=len(images), desc="embed") as bar:
        for i, batch in enumerate(batches):
            empty = [(0, batch_size - len(batch)), (0, 0), (0, 0), (0, 0)]
            features = np.asarray(embed(params, np.pad(batch, empty)))
            features = features.astype(records.dtype)
            for row, frame in enumerate(images[i * batch_size :][: len(batch)]):
                if frame.key not in skipped:
                    records.write(frame.key, features[row], states[frame.key])
            bar.update(len(batch))
    seconds = time.perf_counter() - began
    return PreprocessReport(len(images) + len(found), len(found), skipped, seconds)
