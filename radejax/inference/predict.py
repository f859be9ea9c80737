"""Detection and image embedding for whole datasets."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import grain
import jax
import numpy as np
import tqdm
from jaxtyping import Shaped, UInt8

from radejax.core.errors import UserError
from radejax.core.structures import Batch
from radejax.data.cameras import CameraInputs, read_left_image
from radejax.data.dataset import FrameSequence, LabelledFrame
from radejax.data.pipeline import LoaderOptions, make_loader, make_table
from radejax.data.records import Records, embedding_fields
from radejax.inference.detector import Detector
from radejax.models.dinorade import IMAGE_BACKBONE, DinoRade
from radejax.training import distributed
from radejax.weights.image_backbone import weights_sha256


def predict_dataset(
    detector: Detector,
    records: Records,
    frames: FrameSequence,
    batch_size: int = 8,
    *,
    images: CameraInputs | None = None,
    progress: bool = True,
    should_stop: Callable[[], bool] | None = None,
) -> dict[str, Shaped[np.ndarray, "N ..."]]:
    """Detect the objects in every frame on the devices of the detector.

    Every process returns the detections of all frames.

    Args:
        detector: Detector. If its devices belong to several processes, each process reads
            its part of every batch.
        records: Projections of the frames.
        frames: Frames, in the order of the results.
        batch_size: Number of frames per batch over all processes; rounded up to a multiple
            of the number of devices.
        images: Images of the frames for a radar-camera model, see `camera_inputs`.
        progress: Show a progress bar.
        should_stop: Function that is called before every batch; returning True ends the
            detection.

    Returns:
        Columns "frame" (position in `frames`), "box", "cls" and "score", sorted by frame,
        then by descending score.

    Raises:
        UserError: There are no frames.
        distributed.Stopped: `should_stop` returned True.
    """
    table = make_table(
        records,
        frames,
        max_objects=max([1, *(len(frame.boxes) for frame in frames)]),
        classes=detector.classes,
        images=images,
        num_frames=detector.model.num_frames,
    )
    devices: set[Any] = detector.sharding.device_set
    num_devices, count = len(devices), len({d.process_index for d in devices})
    rows = -(-batch_size // num_devices) * num_devices // count
    options = LoaderOptions(
        batch_size=rows,
        shuffle=False,
        num_epochs=1,
        drop_remainder=False,
        pad_remainder=num_devices > 1,  # for one device, the detector pads the batch
        process_index=jax.process_index() % count,
        process_count=count,
    )
    detector = detector.replace(batch_sizes=(rows,))
    gather = jax.jit(lambda x: x, out_shardings=detector.replicated)
    started: list[jax.Array] = []

    def batches() -> Iterator[Batch]:
        for batch in make_loader(table, options):
            if should_stop is not None and should_stop():
                raise distributed.Stopped
            started.append(gather(detector.put(batch.frame)))
            yield batch

    parts: list[dict[str, np.ndarray]] = []
    show = progress and distributed.is_main()
    with tqdm.tqdm(total=len(frames), desc="detect", disable=not show) as bar:
        for found in detector.stream(batches()):
            frame = np.asarray(started.pop(0))  # -1 for frames that pad the batch
            columns = found.to_columns()
            columns["frame"] = frame[columns["frame"]]
            is_real = columns["frame"] >= 0
            parts.append({name: column[is_real] for name, column in columns.items()})
            bar.update(int((frame >= 0).sum()))
    names = ("frame", "box", "cls", "score")
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def embed_dataset(
    model: DinoRade,
    variables: Mapping[str, Any],
    frames: Sequence[LabelledFrame],
    folder: str | os.PathLike,
    *,
    dtype: str | None = None,
    resize: bool = False,
    batch_size: int = 8,
) -> dict[str, int]:
    """Write the backbone's features of every front image that has none in the folder yet.

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
        The number of all "frames", of newly "embedded" images, of "found" embeddings that
        existed before, and of "missing" images.

    Raises:
        UserError: The folder contains other records, there are no frames, or the dtype is
            unknown.
        DataError: An image is corrupted or, without `resize`, of another size.
    """
    if not len(frames):
        raise UserError("no frames to embed")
    params = variables["params"][IMAGE_BACKBONE]
    fields = embedding_fields(model.options.image.to_dict())
    source = {"image": fields, "weights_sha256": weights_sha256(params)}
    records = Records.create(folder, model.feature_shape, dtype, source, "float32")
    keys = records.keys()
    images = [f for f in frames if f.camera_path is not None and f.key not in keys]
    found = sum(frame.key in keys for frame in frames)

    def read(frame: Any) -> UInt8[np.ndarray, "H W 3"]:
        size = frame.calibrated_size()
        return read_left_image(
            frame.camera_path,
            model.options.image.size,
            resize=resize,
            calibrated_size=size,
        )

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
                records.write(frame.key, features[row])
            bar.update(len(batch))
    return {
        "frames": len(frames),
        "embedded": len(images),
        "found": found,
        "missing": len(frames) - len(images) - found,
    }
