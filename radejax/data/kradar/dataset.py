"""Reader of K-Radar: labeled frames with boxes in the radar frame.

`scan` finds the files, `keys_of_split` chooses label files, `read` reads frames with all of
their objects, and `select` keeps the wanted objects. Reading starts from the label files:
`KRadar` can be opened without radar tensors, so that labels can be counted and replaced
without them.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import itertools
import logging
import pathlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from radejax.core.errors import DataError, UserError, require
from radejax.core.files import PathLike, as_path
from radejax.core.structures import CLASSES
from radejax.data.dataset import LabeledFrame, LabeledFrames, Summary
from radejax.data.kradar import conditions, folders, motion
from radejax.data.kradar.labels import (
    LABEL_CLASSES,
    VISIBILITY_FLAGS,
    Key,
    Label,
    LabelFile,
    LabelHeader,
    LabelPath,
    normalize_version,
    read_label_file,
)
from radejax.data.kradar.tesseract import read_frame
from radejax.data.options import DataOptions
from radejax.geometry.camera import (
    KRADAR_RADAR_FROM_LIDAR_Z_M,
    RADAR_FROM_LIDAR_M,
    CameraCalibration,
)
from radejax.geometry.radar_grid import RadarGrid

_log = logging.getLogger(__name__)

T = TypeVar("T")

_CAMERA_FOLDERS = ("calib", "cam_calib", "resources/cam_calib")
_SPLIT_FOLDERS = ("split", "resources/split", ".")


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame(LabeledFrame):
    """One labeled frame of K-Radar.

    The `name` consists of the radar and LiDAR frame numbers, such as `"00033_00001"`.
    `boxes` contains only the objects that the options of the dataset keep. The `columns`
    are "track_id" (-1 if unknown), "visibility" (the flag) and "velocity_mps" `[N, 2]`: the
    change of x and y over time in the radar frame, so relative to the radar. It is read
    from the files of simulated sequences and otherwise estimated from the labels before
    and after (`motion.estimate_velocities`), and NaN where it is unknown. "speed_mps" is
    the speed over ground, which only simulated sequences have.

    Attributes:
        header: Frame numbers of all sensors and the time stamp.
        labels: All objects of the label file, unfiltered and in the LiDAR frame.
        tesseract_path: File of the 4D radar tensor, or None if it is missing.
        projection_path: File of the `.npy` projection of the authors' code,
            or of a reduced release, or None if it is missing. It is the `radar_path` if
            the tensor is missing.
        ego_speed_mps: Speed of the radar over ground, or None as in all label files.
    """

    header: LabelHeader
    labels: tuple[Label, ...]
    tesseract_path: pathlib.Path | None
    projection_path: pathlib.Path | None
    ego_speed_mps: float | None = None

    def read_projection(self, grid: RadarGrid) -> np.ndarray:
        """Reads the float32 projection, see `tesseract.read_frame`."""
        if self.radar_path is None:
            raise FileNotFoundError("no radar tensor in any root")
        return read_frame(self.radar_path, grid)

    def read_calibration(
        self, radar_from_lidar_m: tuple[float, ...] | None = None
    ) -> CameraCalibration:
        """Reads the camera calibration, with the frame's own translation or a given one."""
        path = self.camera_calibration_path
        assert path is not None  # callers check it
        shift_m = radar_from_lidar_m or self.radar_from_lidar_m
        calibration = CameraCalibration.from_kradar(path, radar_from_lidar_m=shift_m)
        calibration.require_view_ahead(path)
        return calibration


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options of reading K-Radar: keyword arguments of `KRadar`.

    Attributes:
        version: Version of the labels: v1.0, v1.1, v2.0 or v2.1.
        visibility: Visibility flags of the objects to keep, or None for all.
        include_unstarred_v11_labels: Whether lines of v1.x labels without a `*` are
            objects too, as in the authors' code.
        classes: Classes to keep.
        field_of_view: Whether to keep only boxes whose center is in the field of view.
        sequences: Sequences to read, or None for all. None skips and counts
            sequences that have labels but no folder in the roots, if roots are given.
        weather: Weathers of the sequences to keep, or None for all.
        camera_calibration: Folder of camera calibrations (`calib_seq_v2/`, `common/`).
        common_camera: Whether to use `common/cam_front0.yml` for all sequences, as the
            authors' code does.

    Raises:
        UserError: A value is invalid.
    """

    version: str = "v2.1"
    visibility: Collection[str] | None = ("R",)
    include_unstarred_v11_labels: bool = False
    classes: Collection[str] = CLASSES
    field_of_view: bool = True
    sequences: Collection[int] | None = None
    weather: Collection[str] | None = None
    camera_calibration: PathLike | None = None
    common_camera: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "version", normalize_version(self.version))
        for name in ("visibility", "classes", "sequences", "weather"):
            values = getattr(self, name)
            if not isinstance(values, str | None):  # iterators can be read only once
                object.__setattr__(self, name, tuple(values))
        if self.visibility is not None:
            _require_known("visibility", self.visibility, VISIBILITY_FLAGS)
        if self.weather is not None:
            conditions.check_weather(self.weather)
        _require_known("classes", self.classes, LABEL_CLASSES)
        require(bool(self.classes), "classes", (), "at least one")


def _require_known(name: str, values: Collection[str], known: Sequence[str]) -> None:
    is_known = not isinstance(values, str) and set(values) <= set(known)
    is_different = len(set(values)) == len(values)
    expected = f"different ones of {', '.join(known)}"
    require(is_known and is_different, name, values, expected)


# Reading -----------------------------------------------------------------------------


class Index(NamedTuple):
    """The files of a K-Radar copy.

    Attributes:
        roots: Folders that contain the sequences.
        options: Options of reading them.
        sequences: Folders of every sequence in the roots, by sequence number.
        label_paths: Label files, sorted by sequence and frame.
        label_source: Folder or zip of the label revision, or "the sequences' own folders".
        split_folders: Folders in which split files are searched: the roots and those of
            the label revision.
        grid: Sensor axes of K-Radar, or of the `radar_grid.json` in a root.
        release: Reduced release that the roots contain ("polar3d" or "rpc"), or None.
        simulated_z_m: z of `radar_from_lidar_m` of a simulated dataset, or None.
        read_labels: Reads a label file, and returns it again without reading it twice.
    """

    roots: Sequence[pathlib.Path]
    options: ReadOptions
    sequences: Mapping[int, folders.SequenceFolder]
    label_paths: Mapping[Key, LabelPath]
    label_source: str
    split_folders: Sequence[pathlib.Path]
    grid: RadarGrid
    release: str | None
    simulated_z_m: float | None
    read_labels: Callable[[LabelPath], LabelFile]


def scan(
    roots: Sequence[pathlib.Path], label_source: PathLike | None, options: ReadOptions
) -> Index:
    """Finds the files of a K-Radar copy; see `KRadar` for arguments and errors."""
    sequences = folders.find_sequences(roots)
    release = folders.find_release(sequences)
    names = ", ".join(map(str, roots))
    if not sequences and (roots or label_source is None):
        raise UserError(f"no sequence folders (1, 2, ...) in the roots: {names}")
    split_folders = list(roots)
    if label_source is not None:
        path = as_path(label_source)
        label_paths = folders.find_labels(path)
        split_folders += [path, path.parent]
    elif not (label_paths := folders.find_own_labels(sequences, options.version)):
        raise UserError(
            f"no {options.version} labels in the sequence folders of {names} "
            "(info_label/*.txt); give the folder or zip of a label revision: --labels"
        )
    read_labels = functools.partial(
        read_label_file,
        version=options.version,
        include_unstarred=options.include_unstarred_v11_labels,
    )
    return Index(
        roots=roots,
        options=options,
        sequences=sequences,
        label_paths=label_paths,
        label_source=str(label_source or "the sequences' own folders"),
        split_folders=split_folders,
        grid=folders.read_grid(roots),
        release=release,
        simulated_z_m=folders.read_simulated_z_m(split_folders),
        read_labels=functools.cache(read_labels),
    )


def keys_of_split(index: Index, split: PathLike | None) -> tuple[list[Key], Summary]:
    """Returns the keys of the label files to read, sorted, and counts the others.

    They are those of a split in the chosen sequences.
    """
    summary = Summary()
    numbers = index.options.sequences
    labeled = {number for number, _ in index.label_paths}
    here = labeled & set(index.sequences) if index.sequences else labeled
    wanted = here if numbers is None else set(numbers)
    if wanted - here:
        raise UserError(
            f"no labels in {index.label_source}, or no folders in the roots, of "
            f"sequences {sorted(wanted - here)}; there are {sorted(here)}"
        )
    keys = [key for key in index.label_paths if key[0] in wanted]
    if numbers is None:
        absent = len(labeled - here)
        summary.counts["sequences without labels"] = len(set(index.sequences) - labeled)
        rest = len(index.label_paths) - len(keys)
        summary.counts["sequences with labels that are not in the roots"] = absent
        summary.counts["frames of sequences that are not in the roots"] = rest
    if split is None:
        return keys, summary
    entries = _split_entries(index, str(split), keys, summary)
    for number, name in sorted(entries.difference(keys)):
        if number in wanted:
            summary.report(
                "label file missing",
                f"{number}/{name}: in split {split} but not among the labels of "
                f"{index.label_source}",
            )
        elif numbers is None:
            summary.counts["split entries of sequences that are not here"] += 1
    return [key for key in keys if key in entries], summary


def _split_entries(
    index: Index, split: str, keys: Sequence[Key], summary: Summary
) -> set[Key]:
    """Returns the frames of a split, from its file or by K-Radar's rule.

    Frames that are in both official split files are reported.
    """
    if split not in ("train", "test"):
        if not as_path(split).is_file():
            raise UserError(
                f"split {split!r} is neither 'train', 'test', None nor a split file"
            )
        return set(folders.read_split(split))
    paths = {name: _split_files(index, name) for name in ("train", "test")}
    entries = {
        name: {key for path in found for key in folders.read_split(path)}
        for name, found in paths.items()
        if found
    }
    if len(entries) == 2 and (both := sorted(entries["train"] & entries["test"])):
        train, test = (", ".join(map(str, found)) for found in paths.values())
        message = (
            f"{both[0][0]}/{both[0][1]}: the first of {len(both)} frames that are in "
            f"both {train} and {test}; a model is evaluated on frames that it was "
            "trained on"
        )
        summary.report("split", message)
        _log.warning(message)
    if split in entries:
        return entries[split]
    summary.notes.append(
        f"no split/{split}.txt found: split by K-Radar's rule, alternating quarters"
    )
    return {
        (number, name)
        for number, group in itertools.groupby(keys, key=lambda key: key[0])
        for name in folders.split_by_rule([name for _, name in group], split)
    }


def _split_files(index: Index, split: str) -> list[pathlib.Path]:
    """Returns the files of a split: of every root, or else one beside the labels."""
    names = [f"{place}/{split}.txt" for place in _SPLIT_FOLDERS]
    found = [folders.first_file([folder], names) for folder in index.split_folders]
    of_roots = list(filter(None, found[: len(index.roots)]))
    return of_roots or list(filter(None, found))[:1]


def read(index: Index, keys: Iterable[Key]) -> tuple[list[Frame], Summary]:
    """Reads frames with all of their objects, in the order of their keys.

    Frames of other weathers than the wanted ones are left out. Missing or malformed files
    and lines are skipped and reported.
    """
    summary = Summary()
    keys = list(keys)
    sequences = {
        number: _read_sequence(index, number, summary)
        for number in sorted({number for number, _ in keys})
    }
    if (weather := index.options.weather) is not None:
        kept = [key for key in keys if sequences[key[0]].weather in weather]
        summary.counts["frames left out by weather"] = len(keys) - len(kept)
        keys = kept
    files = _read_label_files(index, keys, summary)
    motions = _read_motions(index, files, summary)
    frames = [
        _make_frame(index, key, file, motions[key], sequences[key[0]], summary)
        for key, file in files.items()
    ]
    return frames, summary


class _Sequence(NamedTuple):
    """What the frames of a sequence share."""

    environment: str
    time: str
    weather: str
    radar_from_lidar_m: tuple[float, float, float]
    camera_calibration_path: pathlib.Path | None


def _read_sequence(index: Index, number: int, summary: Summary) -> _Sequence:
    """Reads the files of a sequence; missing ones have default values."""
    folder = index.sequences.get(number, folders.NO_FOLDER)
    counts = summary.counts
    options = index.options
    places = folders.as_paths(options.camera_calibration)
    places += [root / name for root in index.roots for name in _CAMERA_FOLDERS]
    camera = None
    own = f"seq_{number:02d}/cam_1.yml"
    if not options.common_camera:
        camera = folders.first_file(places, [f"calib_seq_v2/{own}", own])
    if camera is None:
        names = ["common/cam_front0.yml", "cam_front0.yml"]
        camera = folders.first_file(places, names)
        kind = "with the common" if camera else "without"
        counts[f"sequences {kind} camera calibration"] += 1
    path = folder.find("info_calib", "calib_radar_lidar.txt")
    if path is None and folder.folders:
        summary.report(
            "calibration missing",
            f"sequence {number}: no info_calib/calib_radar_lidar.txt, using K-Radar's "
            f"{RADAR_FROM_LIDAR_M[:2]}",
        )
    calibration = _read_or_report(
        folders.read_calibration, path, "calibration", summary
    )
    if calibration is None:
        counts["sequences with the default calibration"] += 1
        calibration = (0, *RADAR_FROM_LIDAR_M[:2])
    _, dx_m, dy_m = calibration
    names = [f"{number}/description.txt", f"{number:02d}/description.txt"]
    path = folder.find(".", "description.txt")
    path = path or folders.first_file(index.split_folders, names)
    read_description = conditions.read_description
    found = _read_or_report(read_description, path, "description", summary)
    if found is None:
        counts["sequences with built-in conditions"] += 1
        found = conditions.KRADAR_CONDITIONS.get(number, conditions.UNKNOWN_CONDITIONS)
    elif found.weather not in (*conditions.WEATHERS, "unknown"):
        summary.notes.append(
            f"{path}: weather {found.weather!r} is none of K-Radar's: "
            f"{', '.join(conditions.WEATHERS)}"
        )
    return _Sequence(*found, (dx_m, dy_m, 0.0), camera)


def _read_or_report(
    read: Callable[[PathLike], T], path: PathLike | None, kind: str, summary: Summary
) -> T | None:
    """Returns the content of a file, or None if it is missing or malformed.

    A malformed file is reported.
    """
    try:
        return None if path is None else read(path)
    except DataError as error:
        summary.report(kind, str(error))
        return None


def _read_label_files(
    index: Index, keys: Iterable[Key], summary: Summary
) -> dict[Key, LabelFile]:
    """Reads label files; corrupted ones are left out and reported."""
    files = {}
    counts = summary.counts
    lines = []
    for key in keys:
        try:
            file = index.read_labels(index.label_paths[key])
        except DataError as error:
            summary.report("label file", str(error))
            continue
        files[key] = file
        lines += file.problems
        summary.problems += [("label line", text) for text in file.problems]
        summary.problems += file.doubts
        expected = f"{file.header.radar:05d}_{file.header.lidar:05d}"
        counts["objects in the label files"] += len(file.labels)
        counts["disabled objects (no leading *)"] += file.num_unstarred
        counts["files named unlike their header"] += key[1] != expected
    if lines and not counts["objects in the label files"]:
        raise UserError(
            f"no object could be read from {index.label_source}: {lines[0]}; give the "
            "version of these labels: --label-version VERSION, in training "
            "--config.data.label_version=VERSION, such as v1.0"
        )
    return files


def _read_motions(
    index: Index, files: Mapping[Key, LabelFile], summary: Summary
) -> dict[Key, Float[np.ndarray, "N 3"]]:
    """Returns `motion.Motion` of the labels of every file, NaN where it is unknown."""
    # An estimate needs the labels before and after, which may be of another split. Their
    # problems are reported where their own split is read.
    every = list(index.label_paths)
    read = [position for position, key in enumerate(every) if key in files]
    positions = {position + step for position in read for step in range(-2, 3)}
    near = [key for position, key in enumerate(every) if position in positions]
    velocities = motion.estimate_velocities(_read_label_files(index, near, Summary()))
    motions = {
        key: np.pad(velocities[key], ((0, 0), (0, 1)), constant_values=np.nan)
        for key in files
    }
    for number, keys in itertools.groupby(files, key=lambda key: key[0]):
        folder = index.sequences.get(number, folders.NO_FOLDER)
        path = folder.find("info_motion", "objects.csv")
        table = _read_or_report(motion.read_motion, path, "motion", summary)
        if table is None:
            continue
        for key in keys:
            names = [(key[1], label.cls, label.track_id) for label in files[key].labels]
            found = [table.get(name, (np.nan,) * 3) for name in names]
            motions[key] = np.array(found).reshape(-1, 3)
    return motions


def _make_frame(
    index: Index,
    key: Key,
    file: LabelFile,
    motion_mps: Float[np.ndarray, "N 3"],
    sequence: _Sequence,
    summary: Summary,
) -> Frame:
    """Returns a frame with all of its objects and the files that there are.

    A missing radar tensor is reported; missing images are counted.
    """
    header = file.header
    folder = index.sequences.get(key[0], folders.NO_FOLDER)
    stem = f"tesseract_{header.radar:05d}"
    tesseract = folder.find("radar_tesseract", f"{stem}.mat")
    projection = folder.find("DERA_tesseract", f"DERA_{stem}.npy")
    wanted = f"radar_tesseract/{stem}.mat"
    if index.release is not None:
        wanted = f"{index.release}_{header.radar:05d}.npy"
        projection = folder.find(".", wanted)
    camera = folder.find("cam-front", f"cam-front_{header.camera_front:05d}.png")
    if folder.folders:
        if not (tesseract or projection):
            places = ", ".join(map(str, folder.folders))
            message = f"{key[0]}/{key[1]}: no {wanted} in {places}"
            summary.report("tesseract missing", message)
        summary.counts["frames without front image"] += camera is None
    boxes = np.array([x.box for x in file.labels], np.float64).reshape(-1, 7)
    boxes[:, :3] += sequence.radar_from_lidar_m
    # K-Radar's own files do not contain the height offset between radar and LiDAR.
    z_m = index.simulated_z_m
    return Frame(
        sequence=key[0],
        name=key[1],
        header=header,
        labels=tuple(file.labels),
        boxes=boxes,
        classes=np.array([label.cls for label in file.labels], np.str_),
        columns={
            "track_id": np.array([label.track_id for label in file.labels], np.int64),
            "velocity_mps": motion_mps[:, :2],
            "speed_mps": motion_mps[:, 2],
            "visibility": np.array([x.visibility for x in file.labels], np.str_),
        },
        tesseract_path=tesseract,
        projection_path=projection,
        radar_path=tesseract or projection,
        camera_path=camera,
        radar_from_lidar_z_m=KRADAR_RADAR_FROM_LIDAR_Z_M if z_m is None else z_m,
        is_simulated=z_m is not None,
        **sequence._asdict(),
    )


def select(
    frames: Sequence[Frame], options: ReadOptions, grid: RadarGrid
) -> tuple[list[Frame], collections.Counter[str]]:
    """Returns the frames with the objects to keep, and counts the others by reason."""
    # The objects of all frames are selected at once, which is faster.
    boxes = np.concatenate([np.zeros((0, 7)), *(frame.boxes for frame in frames)])
    text = np.zeros(0, np.str_)
    classes = np.concatenate([text, *(frame.classes for frame in frames)])
    flags = np.concatenate([text, *(frame.columns["visibility"] for frame in frames)])
    is_odd = ~np.isin(flags, VISIBILITY_FLAGS)
    is_kept = np.ones(len(boxes), bool)
    rules = {"class": np.isin(classes, list(options.classes))}
    rules["visibility"] = rules["field of view"] = is_kept
    if options.visibility is not None:
        rules["visibility"] = np.isin(flags, list(options.visibility))
    if options.field_of_view:
        rules["field of view"] = grid.in_field_of_view(*boxes[:, :2].T)
    counts = collections.Counter[str]()
    counts["objects with an odd availability flag"] = int(is_odd.sum())
    for rule, passes in rules.items():
        counts[f"objects left out by {rule}"] = int((is_kept & ~passes).sum())
        is_kept = is_kept & passes
    counts["objects kept"] = int(is_kept.sum())
    ends = np.cumsum([len(frame.boxes) for frame in frames])
    selected = [
        frame.with_objects(rows)
        for frame, rows in zip(frames, np.split(is_kept, ends)[:-1], strict=True)
    ]
    counts["frames"] = len(selected)
    counts["frames without objects"] = sum(not len(x.boxes) for x in selected)
    return selected, counts


def _frames_of_split(
    index: Index, split: PathLike | None
) -> tuple[list[Frame], Summary]:
    """Returns the frames of a split with the objects to keep."""
    keys, summary = keys_of_split(index, split)
    frames, found = read(index, keys)
    selected, counts = select(frames, index.options, index.grid)
    return selected, summary.plus(found).plus(Summary(counts))


class KRadar(LabeledFrames[Frame]):
    """The labeled frames of a K-Radar copy, sorted by sequence and frame.

    Missing or malformed files and lines are skipped, counted and listed in `summary()`.

    Args:
        root: Folder that contains the sequences, or several such folders if they are
            spread over disks. None if only labels are available.
        labels: Folder or zip file of a label revision. None reads the labels in the
            sequences' own folders.
        split: "train" or "test", the path of a split file, or None for every frame.
            The official split files are searched as `<split>.txt` in `split/`,
            `resources/split/` and the top level of every root, whose entries are merged,
            or else of `labels` and of its parent folder. Without them, K-Radar's rule
            (alternating quarters of every sequence) is applied, which `summary()` notes.
        **options: Fields of `ReadOptions`, such as `version="v1.0"`.

    Attributes:
        files: The files of the copy.
        grid, release: Those of the files.
        is_simulated: Whether the simulator wrote the roots or the labels.

    Raises:
        FileNotFoundError: A root or `labels` does not exist.
        UserError: There are no sequences, labels or labels of the given sequences; the
            roots contain several forms of radar data; an option has an invalid value; or
            the labels have another version.
        DataError: The folders, the labels or the split file are ambiguous or corrupted
            as a whole.

    Examples:
        >>> data = KRadar("/data/kradar", split="train")  # doctest: +SKIP
        >>> print(data.summary().to_text())  # doctest: +SKIP
    """

    reader_version = None
    has_label_versions = True
    license = "CC BY-NC-ND, that of K-Radar"

    def __init__(
        self,
        root: PathLike | Iterable[PathLike] | None = None,
        labels: PathLike | None = None,
        *,
        split: PathLike | None = None,
        **options: Any,
    ) -> None:
        index = scan(folders.as_paths(root), labels, ReadOptions(**options))
        frames, summary = _frames_of_split(index, split)
        is_simulated = index.simulated_z_m is not None
        super().__init__(frames, index.grid, summary, is_simulated=is_simulated)
        self.files = index
        self.release = index.release

    @classmethod
    def from_options(cls, options: DataOptions, classes: Sequence[str]) -> KRadar:
        """Reads all frames of `config.data`; see `KRadar` for errors.

        Args:
            options: The section `config.data`.
            classes: Classes of the objects to read.
        """
        return cls(
            options.roots,
            options.labels,
            version=options.label_version,
            visibility=options.visibility,
            include_unstarred_v11_labels=options.include_unstarred_v11_labels,
            classes=classes,
            sequences=options.sequences or None,
            weather=options.weather or None,
            camera_calibration=options.camera_calibration,
            common_camera=options.used_camera.calibration == "common",
        )

    @classmethod
    def check_options(cls, options: DataOptions, classes: Sequence[str]) -> None:
        """Raises `UserError` if a label version, flag, weather or class is unknown.

        Args:
            options: The section `config.data`.
            classes: Classes to detect.
        """
        normalize_version(options.label_version)
        _require_known("config.data.weather", options.weather, conditions.WEATHERS)
        visibility = options.visibility or ()
        _require_known("config.data.visibility", visibility, VISIBILITY_FLAGS)
        _require_known("config.classes", classes, LABEL_CLASSES)

    def of_split(self, split: PathLike | None) -> KRadar:
        """Returns the frames of another split of the same files.

        Label files that were read before are not read again.

        Args:
            split: "train" or "test", the path of a split file, or None for every frame.

        Raises:
            UserError: There is no such split.
            DataError: The split file is malformed.
        """
        frames, summary = _frames_of_split(self.files, split)
        return self._with(frames, summary)

    def with_valid_boxes(self, classes: Collection[str]) -> KRadar:
        """Returns the dataset itself, whose boxes were checked and selected when read.

        Args:
            classes: Ignored; those of the dataset were given when it was read.
        """
        return self

    def class_counts(self) -> dict[str, int]:
        """Returns the number of kept objects of every class."""
        counts = collections.Counter(cls for frame in self for cls in frame.classes)
        return {cls: counts[cls] for cls in self.files.options.classes}

    def lidar_path(self, frame: Frame) -> pathlib.Path:
        """Returns the file of a frame's OS2-64 LiDAR scan.

        Args:
            frame: Frame of this dataset.

        Raises:
            FileNotFoundError: No root has it.
        """
        name = f"os2-64_{frame.header.lidar:05d}.pcd"
        folder = self.files.sequences.get(frame.sequence, folders.NO_FOLDER)
        path = folder.find("os2-64", name)
        if path is None:
            raise FileNotFoundError(f"frame {frame.key}: no os2-64/{name} in any root")
        return path
