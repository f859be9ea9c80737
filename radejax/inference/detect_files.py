"""Detection in folders of frames, as in `radejax detect`.

Labels are needed only to find images: in K-Radar, only the header of a label file states
which image belongs to each frame.
"""

from __future__ import annotations

import csv
import dataclasses
import logging
import pathlib
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from radejax import models
from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.core.manifest import Manifest, State, add, state_of
from radejax.core.structures import Array, Boxes, Detections
from radejax.data.cameras import camera_inputs, require_images
from radejax.data.dataset import FrameSequence, find_reader, read_frames
from radejax.data.kradar import KRadar
from radejax.data.kradar.folders import find_labels, find_sequences, sequence_number
from radejax.data.kradar.radar_files import find_frames, key_of, sequence_folder
from radejax.data.pipeline import frame_histories
from radejax.evaluation import kitti
from radejax.geometry.camera import Camera
from radejax.inference.detector import Detector, Item
from radejax.inference.inputs import InputReader
from radejax.inference.predict import Batches, detect_batches
from radejax.weights.image_backbone import weights_sha256

_log = logging.getLogger(__name__)

View = tuple[pathlib.Path | None, Camera | None]
"""Front image and camera of a frame."""

NO_VIEW: View = (None, None)

_Inputs = tuple[Array, Array | None, Camera | None]


def front_images(
    paths: Sequence[pathlib.Path],
    detector: Detector,
    labels: PathLike | None = None,
    camera_calibration: PathLike | None = None,
    roots: Sequence[PathLike] = (),
) -> dict[pathlib.Path, View]:
    """Finds the images and cameras of frames.

    Args:
        paths: Radar files that `find_frames` returned.
        detector: Detector of a radar-camera model. The version of the labels is that of
            its config.
        labels: Label revision, see `KRadar`. If None, the label files of the sequences
            are used. Sequences without labels have no images.
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
    if labels:
        labeled = {number for number, _ in find_labels(files.as_path(labels))}
    else:
        places = sorted({folder.parent for folder in sequences} | others)
        labeled = {
            number
            for number, sequence in find_sequences(places).items()
            if any(any(folder.glob("info_label*")) for folder in sequence.folders)
        }
    sequences = {folder for folder in sequences if int(folder.name) in labeled}
    if not sequences:
        return {}
    frames = KRadar(
        sorted({folder.parent for folder in sequences}) + sorted(others),
        labels,
        version=detector.saved.config.data.label_version,
        visibility=None,
        field_of_view=False,
        sequences={int(folder.name) for folder in sequences},
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
    """Returns image file and camera of every frame, `NO_VIEW` unless it has both.

    A radar-only model has none of them.

    Raises:
        UserError: There are images, and no calibration for any of them.
    """
    model = detector.model
    if not models.has_camera(model):
        return [NO_VIEW] * len(frames)
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
        keys: Key of every frame, by which its boxes are written.
        paths: Radar file of every frame; None if it is not known.
        radar: Function that returns the radar data of a frame, or their file, by position.
        views: Front image and camera of every frame.
    """

    keys: list[str]
    paths: Sequence[pathlib.Path | None]
    radar: Callable[[int], Array | PathLike]
    views: Sequence[View]

    def parts(self, num_frames: int) -> list[list[int]]:
        """Returns the positions of every part of consecutive frames, in their order.

        Every frame is a part if a sample has one frame.
        """
        if num_frames == 1:
            return [[index] for index in range(len(self.keys))]
        positions = {key: index for index, key in enumerate(self.keys)}
        parts = dict[str, list[int]]()  # by the key of their last frame
        for before, key in frame_histories(self.keys, 2).values():
            part = parts[key] = parts.pop(before, [])
            part.append(positions[key])
        return list(parts.values())

    def read(self, index: int, reader: InputReader) -> _Inputs:
        """Reads the radar data and the image of a frame, and returns its camera too.

        Raises:
            DataError: A file is corrupted.
            OSError: A file cannot be read.
        """
        path, camera = self.views[index]
        image = None
        if path is not None:
            image = np.asarray(reader.read_cameras([path], [camera], 1)[0])[0]
        return reader.read_radar([self.radar(index)])[0], image, camera

    def state(self, index: int) -> State:
        """Returns the state of the files of a frame, and a checksum of its camera."""
        image, camera = self.views[index]
        checksum = zlib.crc32(repr(camera).encode())
        return [*state_of([self.paths[index], image]), ["camera", checksum]]


def find_inputs(
    detector: Detector,
    paths: Sequence[PathLike],
    *,
    sequences: Sequence[int] | None = None,
    weather: Sequence[str] | None = None,
    labels: PathLike | None = None,
    camera_calibration: PathLike | None = None,
) -> FrameInputs:
    """Finds the frames in files and folders by the reader of the detector's run.

    Args:
        detector: Detector of the frames.
        paths: Files and folders of frames.
        sequences: Numbers of the sequences to take, see `find_frames`.
        weather: Kinds of weather to take, see `find_frames`.
        labels: Label revision in which a radar-camera model's images are looked up; the
            revision that the run was trained with if None.
        camera_calibration: Folder of camera calibrations; that of the run if None.

    Returns:
        The frames, with their images for a radar-camera model, for `detect_files`.

    Raises:
        FileNotFoundError: A path does not exist.
        UserError: There is no frame, two frames would be written to the same file, or a
            radar-camera model has images without any calibration.
    """
    config = detector.saved.config
    labels = labels or config.data.labels
    camera_calibration = camera_calibration or config.data.camera_calibration
    # A derived reader may read frames in another way.
    if find_reader(config.data.format) is KRadar:
        found = find_frames(paths, sequences, weather)
        return _of_files(found, paths, detector, labels, camera_calibration)
    options = config.data.replace(
        roots=tuple(paths),
        labels=labels,
        camera_calibration=camera_calibration,
        sequences=tuple(sequences or ()),
        weather=tuple(weather or ()),
    )
    frames = read_frames(options, config.classes)
    if detector.grid != frames.grid:
        raise UserError(f"{paths[0]}: the radar has other axes than that of the run")

    return FrameInputs(
        [frame.key for frame in frames],
        [frame.radar_path for frame in frames],
        lambda index: frames[index].read_projection(frames.grid),
        _views(frames, detector),
    )


def _of_files(
    found: list[pathlib.Path],
    roots: Sequence[PathLike],
    detector: Detector,
    labels: PathLike | None,
    camera_calibration: PathLike | None,
) -> FrameInputs:
    """Returns K-Radar's files as inputs, with their images for a radar-camera model."""
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
    views = [known.get(path.absolute(), NO_VIEW) for path in found]
    keys = [key_of(path) for path in found]
    return FrameInputs(keys, found, found.__getitem__, views)


def _write_json(path: pathlib.Path, boxes: Boxes, frame: int, key: str) -> None:
    files.write_json(path, [{"frame": key, **box} for box in boxes.to_list()])


def _write_kitti(path: pathlib.Path, boxes: Boxes, frame: int, key: str) -> None:
    files.write_text(path, f"{kitti.prediction_text(boxes, frame)}\n")


class _Format(NamedTuple):
    """How boxes are written.

    Attributes:
        file: Name of the file of a frame, with its key or its position.
        write: Function that writes the boxes of a frame, by position and key, to its file;
            None if the boxes of all frames are written to one table at the end.
        listing: File that lists the frames, if the files are numbered as those of K-Radar's
            tools, which have no columns for outputs of the model's own.
    """

    file: str
    write: Callable[[pathlib.Path, Boxes, int, str], None] | None
    listing: tuple[str, ...] = ()


_FORMATS = {
    "json": _Format("{key}.json", _write_json),
    "kitti": _Format("preds/{frame:06d}.txt", _write_kitti, listing=("frames.json",)),
    "csv": _Format("{key}.json", None),
}


def detect_files(
    detector: Detector,
    inputs: FrameInputs,
    out: PathLike,
    *,
    batch_size: int = 8,
    file_format: str = "json",
) -> tuple[dict[str, int], dict[str, str]]:
    """Detects the objects in every frame, and writes one file per frame atomically.

    A second call with the same model, settings and frames continues an interrupted one: it
    detects in the frames without a file and in those whose radar file or image changed, or
    in whole parts of consecutive frames for a model of several frames. A frame with a file
    that cannot be read, or with a box that is not finite, fails and has no file.

    Args:
        detector: Detector, whose default thresholds and region are used.
        inputs: Frames that `find_inputs` found.
        out: Folder of the files `<sequence>_<radar>.json`. Each contains a list of {frame,
            cls, score, x, y, z, l, w, h, yaw}, in meters and radians in the radar frame;
            the value of "frame" is "<sequence>/<radar>". `core.manifest` describes them.
        batch_size: Number of frames per call of the detector.
        file_format: "json", or "kitti" for files `preds/000000.txt` in the format of
            K-Radar's tools, and `frames.json` with the frames that these numbers stand for.
            "csv" writes one table `boxes.csv` of all boxes at the end, in the columns of
            the records; a second call begins again.

    Returns:
        The numbers of "frames" in which objects were detected, of "boxes", of "clipped"
        boxes, whose size was clipped, of "truncated" ones, which are not written because
        of `max_detections`, and of frames that were "done" by an earlier call; and the
        reasons of failed frames by key.
        For a model of several frames, "repeated" is the number of frames that repeat
        themselves, as there is no preceding one. For a radar-camera model, "radar_only" is
        the number of frames without a label file, image or calibration.

    Raises:
        UserError: A weight is not as expected, or the folder has boxes of another model,
            of other settings or of other frames.
    """
    detector = detector.replace()  # its counters start at zero
    keys = inputs.keys
    out = files.as_path(out)
    kind = _FORMATS[file_format]
    names, manifest = _claim(detector, keys, out, file_format)
    states = [inputs.state(frame) for frame in range(len(keys))]
    done = {i for i, x in enumerate(states) if manifest.is_done(names[i], x)}
    parts = [x for x in inputs.parts(detector.num_frames) if not done.issuperset(x)]
    todo = [frame for part in parts for frame in part]
    for frame in todo:
        (out / names[frame]).unlink(missing_ok=True)
    queue = [iter(todo)] if detector.num_frames == 1 else [iter(x) for x in parts]
    found = list[Boxes]()
    seen = list[str]()
    failed = dict[int, str]()
    count = {"frames": 0, "boxes": 0, "clipped": 0, "truncated": 0}
    count["done"] = len(keys) - len(todo)
    batches = (_batches(inputs, detector, x, batch_size, failed, queue) for x in queue)
    results = detect_batches(detector, batches, len(todo), progress=True)
    for frame, detections in _single(results):
        seen.append(keys[frame])
        try:
            boxes = detections.to_boxes(np.array([frame]))
        except DataError as error:
            failed[frame] = str(error)
            continue
        count["frames"] += 1
        count["boxes"] += len(boxes)
        count["truncated"] += boxes.num_truncated
        count["clipped"] += int(boxes.is_clipped.sum())
        if kind.write is None:
            found.append(boxes)
            continue
        kind.write(out / names[frame], boxes, frame, keys[frame])
        add(out, names[frame], states[frame])
    for frame in failed:
        add(out, names[frame], None)
    if kind.write is None:
        _write_csv(out / "boxes.csv", found, keys)
    config = detector.saved.config
    own = list(config.model.outputs)
    if config.decode.calibration:
        own.append("probability")
    if kind.listing and own:
        text = "the format kitti has no columns for %s: not written"
        _log.warning(text, ", ".join(own))
    if detector.num_frames > 1:
        count["repeated"] = len(dataclasses.replace(inputs, keys=seen).parts(2))
    if detector.takes_camera:
        count["radar_only"] = detector.num_radar_only
    return count, {keys[frame]: reason for frame, reason in failed.items()}


def _claim(
    detector: Detector, keys: list[str], out: pathlib.Path, file_format: str
) -> tuple[list[str], Manifest]:
    """Describes the boxes in their folder, or opens that of the same detection.

    Returns:
        The file of every frame, and the description.
    """
    kind = _FORMATS[file_format]
    stems = (key.replace("/", "_") for key in keys)
    names = [kind.file.format(key=x, frame=i) for i, x in enumerate(stems)]
    options: files.JsonObject = {
        "format": file_format,
        "frames": keys,
        "step": detector.saved.step,
        "weights": weights_sha256(detector.variables)[:16],
        "config": detector.saved.config.without_data_paths(),
    }
    made = [] if kind.write is None else [*names, *kind.listing]
    patterns = [f"*.{suffix}" for suffix in ("json", "txt", "csv")]
    manifest = Manifest.claim(out, "boxes", options, made, patterns)
    for name in kind.listing:
        table = {"frame": list(range(len(keys))), "name": keys}
        files.write_json(out / name, table)
    return names, manifest


def _batches(
    inputs: FrameInputs,
    detector: Detector,
    part: Iterator[int],
    batch_size: int,
    failed: dict[int, str],
    queue: list[Iterator[int]],
) -> Batches:
    """Reads the frames of a part as batches of `detect_batches`.

    Frames that cannot be read go to `failed`. For a model of several frames, the rest of
    the part goes to the end of `queue` as a part of its own, as its first frame has no
    preceding one.
    """
    is_whole = True
    while is_whole:
        items = dict[int, _Inputs]()
        for frame in part:
            try:
                items[frame] = inputs.read(frame, detector.reader)
            except (DataError, OSError) as error:
                failed[frame] = str(error)
                if detector.num_frames > 1:
                    queue.append(part)
                    break
            if len(items) == batch_size:
                break
        is_whole = len(items) == batch_size
        if items:
            radar, images, cameras = zip(*items.values(), strict=True)
            item: Item = [*radar]
            if any(image is not None for image in images):
                item = [*radar], images, cameras
            yield np.array([*items]), item


def _single(
    results: Iterable[tuple[Int[np.ndarray, " B"], Detections]],
) -> Iterator[tuple[int, Detections]]:
    """Yields index and detections of every frame on the host."""
    for frames, detections in results:
        on_host = jax.device_get(detections)
        for row, frame in enumerate(frames.tolist()):
            yield frame, jax.tree.map(lambda x, row=row: x[row : row + 1], on_host)


def _write_csv(path: pathlib.Path, found: list[Boxes], keys: Sequence[str]) -> None:
    """Writes all boxes as one table with the keys of their frames."""
    boxes = Boxes.concatenate(found or [Boxes.one_frame([], [], [])])
    with files.atomic_path(path) as temporary, open(temporary, "w") as file:
        # A column with several values per box becomes several columns.
        columns = {
            f"{name}_{i}" if x.ndim > 1 else name: column
            for name, x in boxes.fields().items()
            for i, column in enumerate(np.atleast_2d(x.T))
        }
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", *columns])
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        for frame, row in zip(boxes.frame, rows, strict=True):
            writer.writerow([keys[frame], *row])
