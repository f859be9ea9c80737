"""Detection in folders of frames, as in `radejax detect`.

Labels are needed only to find images: in K-Radar, only the header of a label file states
which image belongs to each frame.
"""

from __future__ import annotations

import csv
import dataclasses
import itertools
import pathlib
from collections.abc import Callable, Sequence

import jax
import numpy as np

from radejax import models
from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.core.structures import Boxes
from radejax.data.cameras import camera_inputs, require_images
from radejax.data.dataset import FrameSequence, find_reader
from radejax.data.kradar import KRadar
from radejax.data.kradar.folders import sequence_number
from radejax.data.kradar.radar_files import find_frames, key_of, sequence_folder
from radejax.data.pipeline import frame_histories
from radejax.evaluation import kitti
from radejax.geometry.camera import Camera
from radejax.inference.detector import Detector, Item
from radejax.inference.inputs import Frames
from radejax.inference.predict import detect_batches

View = tuple[pathlib.Path | None, Camera | None]
"""Front image and camera of a frame."""

NO_VIEW: View = (None, None)


def front_images(
    paths: Sequence[pathlib.Path],
    detector: Detector,
    labels: PathLike | None = None,
    camera_calibration: PathLike | None = None,
    roots: Sequence[PathLike] = (),
) -> dict[pathlib.Path, View]:
    """Find the images and cameras of frames.

    Args:
        paths: Radar files that `find_frames` returned.
        detector: Detector of a radar-camera model. The version of the labels is that of
            its config.
        labels: Label revision, see `KRadar`. If None, the label files of the sequences
            are used, and sequences without them have no images.
        camera_calibration: Folder of camera calibrations; None for those in the roots.
        roots: Files and folders in which `find_frames` searched. Folders of sequences
            without radar files may have their images and labels.

    Returns:
        Image file and camera by the path of the radar file, for the frames that have both.

    Raises:
        UserError: The labels are of another version, there are images and no calibration,
            or a calibration is for images of another size than the model's.
    """
    searched = map(files.as_path, roots)
    others = {path.absolute() for path in searched if path.is_dir()}
    others = {root for root in others if any(map(sequence_number, root.iterdir()))}
    folders = {sequence_folder(path) for path in paths}
    others -= {folder.parent for folder in folders}
    sequences = {f for f in folders if sequence_number(f) is not None}
    if not (labels or others):
        sequences = {f for f in sequences if any(f.glob("info_label*"))}
    if not sequences:
        return {}
    frames = KRadar(
        sorted({folder.parent for folder in sequences}) + sorted(others),
        labels,
        version=detector.saved.config.data.label_version,
        visibility=None,
        field_of_view=False,
        sequence_numbers={int(folder.name) for folder in sequences},
        camera_calibration=camera_calibration,
        common_camera=detector.camera_options.calibration == "common",
    )
    return {
        path: view
        for frame, view in zip(frames, _views(frames, detector), strict=True)
        for path in (frame.tesseract_path, frame.projection_path)
        if path is not None and view is not NO_VIEW
    }


def _views(frames: FrameSequence, detector: Detector) -> list[View]:
    """Return image file and camera of every frame, `NO_VIEW` unless it has both.

    The list is empty for a radar-only model.

    Raises:
        UserError: There are images, and no calibration for any of them.
    """
    model = detector.model
    if not models.has_camera(model):
        return []
    options = detector.camera_options.replace(allow_missing=True)
    inputs = camera_inputs(frames, model.options.image.size, options)
    if any(frame.camera_path is not None for frame in frames):
        require_images(frames, inputs, "dataset")
    return [
        (frame.camera_path, camera) if camera.is_valid else NO_VIEW
        for frame, camera in zip(frames, inputs.cameras, strict=True)
    ]


@dataclasses.dataclass(frozen=True)
class FrameInputs:
    """Frames in files, as inputs of a detector.

    Attributes:
        keys: Key of every frame, by which its boxes are written. The frames of a sequence
            follow each other in their order.
        read: Function that returns the radar data of a range of the frames.
        views: Front image and camera of every frame; empty if no frame has them.
    """

    keys: list[str]
    read: Callable[[slice], Frames]
    views: list[View]

    def batches(self, num_frames: int, batch_size: int) -> list[list[range]]:
        """Return the batches of every part of consecutive frames, as positions.

        All frames are one part if a sample has one frame.
        """
        starts = [0]
        if num_frames > 1:
            sample_of = frame_histories(self.keys, 2)
            pairs = itertools.pairwise(self.keys)
            starts += [i for i, (a, b) in enumerate(pairs, 1) if sample_of[b][0] != a]
        return [
            [range(i, min(i + batch_size, end)) for i in range(start, end, batch_size)]
            for start, end in itertools.pairwise([*starts, len(self.keys)])
        ]

    def item(self, batch: range) -> Item:
        """Read the frames of a batch as an item of `Detector.stream`."""
        rows = slice(batch.start, batch.stop)
        if not self.views:
            return self.read(rows)
        images, cameras = zip(*self.views[rows], strict=True)
        return self.read(rows), images, cameras


def find_inputs(
    detector: Detector,
    paths: Sequence[PathLike],
    *,
    sequence_numbers: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
    labels: PathLike | None = None,
    camera_calibration: PathLike | None = None,
) -> FrameInputs:
    """Find the frames in files and folders by the reader of the detector's run.

    Args:
        detector: Detector of the frames.
        paths: Files and folders of frames.
        sequence_numbers: Numbers of the sequences to take, see `find_frames`.
        weather: Kinds of weather to take, see `find_frames`.
        labels: Label revision in which a radar-camera model's images are looked up; the
            revision that the run was trained with if None.
        camera_calibration: Folder of camera calibrations; that of the run if None.

    Raises:
        FileNotFoundError: A path does not exist.
        UserError: There is no frame, two frames would be written to the same file, or a
            radar-camera model has images without any calibration.
    """
    config = detector.saved.config
    labels = labels or config.data.labels
    camera_calibration = camera_calibration or config.data.camera_calibration
    reader = find_reader(config.data.format)
    if reader is KRadar:  # a derived reader may read frames in another way
        found = find_frames(paths, sequence_numbers, weather)
        return _of_files(found, paths, detector, labels, camera_calibration)
    options = config.data.replace(
        roots=tuple(paths),
        labels=labels,
        camera_calibration=camera_calibration,
        sequences=tuple(sequence_numbers or ()),
        weather=tuple(weather or ()),
    )
    frames = reader.from_options(options, config.classes)
    frames = frames.part(options.sequences, options.weather)
    if not len(frames):
        named = ", ".join(map(str, paths))
        raise UserError(f"no frames in {named}: give the roots of the dataset")
    if detector.grid != frames.grid:
        raise UserError(f"{paths[0]}: the radar has other axes than that of the run")

    def read(rows: slice) -> np.ndarray:
        return np.stack([f.read_projection(frames.grid) for f in frames[rows]])

    return FrameInputs([f.key for f in frames], read, _views(frames, detector))


def _of_files(
    found: list[pathlib.Path],
    roots: Sequence[PathLike],
    detector: Detector,
    labels: PathLike | None,
    camera_calibration: PathLike | None,
) -> FrameInputs:
    """Return K-Radar's files as inputs, with their images for a radar-camera model."""
    seen: dict[str, pathlib.Path] = {}
    for path in found:
        if (other := seen.setdefault(key_of(path), path)) is not path:
            raise UserError(
                f"{other} and {path} would both be written as frame "
                f"{key_of(path)}: detect each root into a folder of its own"
            )
    if detector.num_frames > 1:  # folders of tensors and of projections may be mixed
        found = sorted(found, key=key_of)
    known: dict[pathlib.Path, View] = {}
    if detector.takes_camera:
        known = front_images(found, detector, labels, camera_calibration, roots)
    views = [known.get(path.absolute(), NO_VIEW) for path in found if known]
    return FrameInputs([key_of(path) for path in found], found.__getitem__, views)


def detect_files(
    detector: Detector,
    inputs: FrameInputs,
    out: PathLike,
    *,
    batch_size: int = 8,
    file_format: str = "json",
) -> tuple[dict[str, int], dict[str, str]]:
    """Detect the objects in every frame, and write one file per frame atomically.

    A frame with a box that is not finite fails, and a file of an earlier detection in it is
    removed.

    Args:
        detector: Detector, whose default thresholds and region are used.
        inputs: Frames that `find_inputs` found.
        out: Folder of the files `<sequence>_<radar>.json`. Each contains a list of {frame,
            cls, score, x, y, z, l, w, h, yaw}, in meters and radians in the radar frame;
            the value of "frame" is "<sequence>/<radar>".
        batch_size: Number of frames per call of the detector.
        file_format: "json", or "kitti" for files `preds/000000.txt` in the format of
            K-Radar's tools, and `frames.json` with the frames that these numbers stand for.
            "csv" writes one table `boxes.csv` of all boxes at the end, in the columns of
            the records.

    Returns:
        The numbers of "frames" that did not fail, of "boxes", of "clipped" boxes, whose size
        was clipped, and of "truncated" ones, which are not written because of
        `max_detections`; and the reasons of failed frames by key.
        For a model of several frames, "repeated" is the number of frames that repeat
        themselves, as there is no preceding one. For a radar-camera model, "radar_only" is
        the number of frames without a label file, image or calibration.

    Raises:
        UserError: An image or weight is not as expected.
    """
    detector = detector.replace()  # its counters start at zero
    keys = inputs.keys
    out = files.as_path(out)
    out.mkdir(parents=True, exist_ok=True)
    names = [f"{key.replace('/', '_')}.json" for key in keys]
    if file_format == "kitti":
        names = [f"preds/{frame:06d}.txt" for frame in range(len(keys))]
        table = {"frame": list(range(len(keys))), "name": keys}
        files.write_json(out / "frames.json", table)
    parts = inputs.batches(detector.num_frames, batch_size)
    batches = (((np.array(rows), inputs.item(rows)) for rows in part) for part in parts)
    found = [Boxes.one_frame([], [], [])]
    failed = dict[str, str]()
    count = {"frames": 0, "boxes": 0, "clipped": 0, "truncated": 0}
    results = detect_batches(detector, batches, len(keys), progress=True)
    for frames, detections in results:
        on_host = jax.device_get(detections)
        for row, frame in enumerate(frames.tolist()):
            key = keys[frame]
            path = out / names[frame]
            one = jax.tree.map(lambda x, row=row: x[row : row + 1], on_host)
            try:
                boxes = one.to_boxes(frames[row : row + 1])
            except DataError as error:
                failed[key] = str(error)
                if file_format != "csv":
                    path.unlink(missing_ok=True)
                continue
            count["frames"] += 1
            count["boxes"] += len(boxes)
            count["truncated"] += boxes.num_truncated
            count["clipped"] += int(boxes.is_clipped.sum())
            if file_format == "csv":
                found.append(boxes)
            elif file_format == "kitti":
                (text,) = kitti.prediction_texts(boxes, [frame])
                files.write_text(path, f"{text}\n")
            else:
                rows = [{"frame": key, **box} for box in boxes.to_list()]
                files.write_json(path, rows)
    if file_format == "csv":
        _write_csv(out / "boxes.csv", Boxes.concatenate(found), keys)
    if detector.num_frames > 1:
        count["repeated"] = len(parts)
    if detector.takes_camera:
        count["radar_only"] = detector.num_radar_only
    return count, failed


def _write_csv(path: pathlib.Path, boxes: Boxes, keys: Sequence[str]) -> None:
    """Write all boxes as one table with the keys of their frames."""
    with files.atomic_path(path) as temporary, open(temporary, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", *boxes.fields()])
        for frame, box in zip(boxes.frame, boxes.to_list(), strict=True):
            writer.writerow([keys[frame], *box.values()])
