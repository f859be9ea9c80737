"""Health report on a dataset: what there is, and what is missing, corrupted or implausible."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Mapping, Sequence

from tabulate import tabulate
from tqdm import tqdm

from radejax.core.errors import DataError
from radejax.core.files import JsonObject
from radejax.core.structures import RARE_SHARE
from radejax.data.cameras import front_view
from radejax.data.dataset import FrameSequence, LabeledFrame, LabeledFrames, Summary

Rows = list[JsonObject]


@dataclasses.dataclass(frozen=True)
class HealthReport:
    """Result of `check_frames`, and of `check_dataset` for K-Radar.

    Attributes:
        roots: The folders that were checked.
        version: Version of the labels, or name of the reader.
        sequences: One row per sequence with its conditions, its numbers of files, and
            the numbers of labeled frames without these files.
        objects: One row per split and weather with the number of objects of every class
            that training uses: visible to the radar and in its field of view.
        summary: Counts, problems with file and line, and notes.
    """

    roots: list[str]
    version: str
    sequences: Rows
    objects: Rows
    summary: Summary

    @property
    def num_problems(self) -> int:
        """Number of missing, malformed or implausible items."""
        return len(self.summary.problems)

    def to_dict(self) -> JsonObject:
        """Returns the report as JSON values."""
        summary = {"num_problems": self.num_problems, **self.summary.to_dict()}
        return {**vars(self), "summary": summary}

    def to_text(self) -> str:
        """Returns the report as tables for a terminal."""
        names = {
            name: name.replace("_", "\n") for row in self.sequences for name in row
        }
        objects = [_with_shares(row) for row in self.objects]
        parts = [
            f"{len(self.sequences)} sequences in {', '.join(self.roots)}; labels "
            f"{self.version}",
            tabulate(self.sequences, headers=names),
            "Objects that training uses (visible to the radar and in its field of view), and "
            f"their share of the row; *: under {RARE_SHARE:.0%} of the training objects of a "
            "weather.",
            tabulate(objects, "keys", disable_numparse=True, stralign="right"),
            self.summary.to_text(),
            f"{self.num_problems:,} problems" if self.num_problems else "no problems",
        ]
        return "\n\n".join(part for part in parts if part)


def _with_shares(row: JsonObject) -> dict[str, str]:
    """Formats one row of `objects` as text with the share of every class."""
    counts = {name: x for name, x in row.items() if name not in ("split", "weather")}
    cells = {}
    for cls, count in counts.items():
        share = count / max(sum(counts.values()), 1)
        mark = "*" if row["split"] == "train" and share < RARE_SHARE else ""
        cells[cls] = f"{mark}{count:,} ({100 * share:4.1f} %)"
    return {**row, **cells}


def check_frames(
    frames: LabeledFrames[LabeledFrame],
    classes: Sequence[str],
    roots: Sequence[str],
    *,
    deep: bool = False,
    progress: bool = False,
) -> HealthReport:
    """Checks the frames of any reader and reports their content and their problems.

    Args:
        frames: Frames, such as those of `read_frames`.
        classes: Classes of their objects.
        roots: Folders of the dataset, for the report.
        deep: Whether to read radar data, image and calibration of every frame, instead of
            those of one frame of each sequence, the first with most of these files.
        progress: Whether to show a progress bar.
    """
    summary = frames.summary()
    splits = find_splits(frames)
    sequences: dict[int, list[LabeledFrame]] = {}
    for frame in frames:
        sequences.setdefault(frame.sequence, []).append(frame)
    groups = sequences.values()
    read = list(frames) if deep else [min(own, key=_num_missing) for own in groups]
    for frame in tqdm(read, "check", unit="frame", disable=not progress):
        try:
            frame.read_checked(frames.grid)
            front_view(frame)
        except (DataError, OSError) as error:
            summary.report("frame", f"{frame.key}: {error}")
    summary.counts["frames that were read"] = len(read)
    rows = []
    for number, own in sequences.items():
        in_split = collections.Counter(splits.get(frame.key) for frame in own)
        lacking = {
            f"without_{kind}": sum(getattr(x, f"{kind}_path") is None for x in own)
            for kind in ("radar", "camera", "camera_calibration")
        }
        row = {"sequence": number, "weather": own[0].weather, "frames": len(own)}
        rows.append(row | {x: in_split[x] for x in ("train", "test")} | lacking)
    reader = f"read by {type(frames).__module__}:{type(frames).__qualname__}"
    objects = count_objects(frames, splits, classes)
    return HealthReport(list(roots), reader, rows, objects, summary)


def _num_missing(frame: LabeledFrame) -> int:
    """Returns how many of radar data, image and calibration a frame lacks."""
    files = frame.radar_path, frame.camera_path, frame.camera_calibration_path
    return files.count(None)


def find_splits(data: LabeledFrames[LabeledFrame]) -> dict[str, str]:
    """Returns the split of every frame and adds problems of the splits to the summary."""
    splits: dict[str, str] = {}
    summary = data.summary()
    for name in ("train", "test"):
        part = data.of_split(name)
        splits |= {frame.key: name for frame in part}
        found = part.summary()
        summary.problems[:] = dict.fromkeys(summary.problems + found.problems)
        summary.notes[:] = dict.fromkeys(summary.notes + found.notes)
    summary.problems += [
        ("split", f"{frame.key}: labeled, but in neither train nor test")
        for frame in data
        if frame.key not in splits
    ]
    return splits


def count_objects(
    frames: FrameSequence, splits: Mapping[str, str], classes: Sequence[str]
) -> Rows:
    """Counts the objects of every split and weather by class.

    Args:
        frames: Frames of the dataset.
        splits: Split of every frame by its key, see `find_splits`.
        classes: Classes to count.
    """
    counts: dict[tuple[str, str], collections.Counter[str]] = {}
    for frame in frames:
        for weather in (frame.weather, "all"):
            row = splits.get(frame.key, "none"), weather
            counts.setdefault(row, collections.Counter()).update(frame.classes.tolist())
    return [
        {"split": split, "weather": weather}
        | {cls: counts[split, weather][cls] for cls in classes}
        for split, weather in sorted(counts)
    ]
