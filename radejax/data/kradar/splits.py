"""Which frames belong to a split: from its file, or by K-Radar's rule."""

from __future__ import annotations

import collections
import logging
import os
import pathlib
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from radejax.core.errors import UserError
from radejax.data.kradar import folders, sequences
from radejax.data.kradar.findings import Findings
from radejax.data.kradar.folders import LabelSource

_log = logging.getLogger(__name__)

Key = tuple[int, str]
"""Sequence number and frame name."""


def select_frames(
    source: LabelSource,
    findings: Findings,
    *,
    split: str | os.PathLike | None,
    near: Sequence[pathlib.Path],
    sequence_numbers: Iterable[int] | None,
    folders_here: Collection[int] = (),
) -> list[Key]:
    """Keys of the label files to read, sorted.

    Args:
        source: The labels that there are.
        findings: Where label files are reported that the split names in vain.
        split: "train", "test", a split file, or None for every frame.
        near: Folders in which split files are looked for.
        sequence_numbers: Only these sequences; None for all.
        folders_here: Sequences with folders. Labels of others are left out and counted,
            unless there are none at all: then labels alone are at hand.

    Raises:
        UserError: An unknown split, or a sequence without labels or folder.
    """
    present = {sequence for sequence, _ in source.files}
    absent = present.difference(folders_here) if folders_here else set()
    if sequence_numbers is None:
        wanted = present - absent
        findings.counts["sequences with labels that are not in the roots"] = len(absent)
        findings.counts["frames of sequences that are not in the roots"] = sum(
            sequence in absent for sequence, _ in source.files
        )
    else:
        wanted = set(sequence_numbers)
    if wanted & absent:
        raise UserError(
            f"no folders of sequences {sorted(wanted & absent)} in the roots; there are "
            f"{sorted(folders_here)}"
        )
    if wanted - present:
        raise UserError(
            f"no labels of sequences {sorted(wanted - present)} in "
            f"{source.description}; there are {sorted(present)}"
        )
    keys = [key for key in source.files if key[0] in wanted]
    if split is None:
        return keys
    entries = read_split_entries(split, near, keys, findings)
    _report_overlap(near, findings)
    for sequence, name in sorted(entries - set(keys)):
        if sequence in wanted:
            findings.report(
                "label file missing",
                f"{sequence}/{name}",
                f"in split {split} but not among the labels of {source.description}",
                error=FileNotFoundError,
            )
        elif sequence_numbers is None:
            findings.counts["split entries of sequences that are not here"] += 1
    return [key for key in keys if key in entries]


def _report_overlap(near: Sequence[pathlib.Path], findings: Findings) -> None:
    """Reports, and warns of, frames that the files of both splits name."""
    paths = [folders.find_split_file(split, near) for split in ("train", "test")]
    if None in paths:
        return
    train, test = (set(sequences.read_split(path)) for path in paths if path)
    if both := sorted(train & test):
        key = f"{both[0][0]}/{both[0][1]}"
        message = (
            f"{len(both)} frames are in both {paths[0]} and {paths[1]}, first {key}: what "
            "is evaluated on them was trained on them"
        )
        findings.report("split", key, message)
        _log.warning(message)


def check_weather(names: Iterable[str]) -> tuple[str, ...]:
    """The names; `UserError` for one that no sequence has, or for none."""
    names = tuple(names)
    known = (*sequences.WEATHERS, "unknown")
    if unknown := [name for name in names if name not in known]:
        raise UserError(f"unknown weather {unknown}; available: {', '.join(known)}")
    if not names:
        raise UserError(f"no weather given; available: {', '.join(known)}")
    return names


def held_out(
    sequences: Collection[int], validation: Sequence[float], seed: int
) -> list[int]:
    """Whole sequences of the train split that a run keeps for validation, sorted.

    Args:
        sequences: Numbers of those that have frames to train on.
        validation: Numbers of sequences; or one share of them above 0 and below 1, which
            is drawn, at least one sequence; () for none.
        seed: Of the draw.

    Raises:
        UserError: A sequence that is not there, or none is left to train on.

    Examples:
        >>> held_out({1, 2, 5}, (5,), 0)
        [5]
        >>> len(held_out(range(1, 59), (0.1,), 0))
        6
    """
    here = sorted(set(sequences))
    if len(validation) == 1 and 0 < validation[0] < 1:
        count = max(1, round(validation[0] * len(here)))
        chosen = {int(n) for n in np.random.default_rng(seed).permutation(here)[:count]}
    else:
        chosen = {int(number) for number in validation}
    if absent := sorted(chosen.difference(here)):
        raise UserError(
            f"config.data.validation holds out sequences {absent}, which have no frames in "
            f"the train split; there are {here}"
        )
    if chosen and len(chosen) == len(here):
        raise UserError(
            f"config.data.validation is {tuple(validation)}: of the sequences {here} of "
            "the train split none is left to train on"
        )
    return sorted(chosen)


def read_split_entries(
    split: str | os.PathLike,
    near: Sequence[pathlib.Path],
    keys: Collection[Key],
    findings: Findings,
) -> set[Key]:
    """Frames of a split, from its file or by rule; arguments as in `select_frames`.

    Args:
        split: "train", "test" or a split file.
        near: Folders in which split files are looked for.
        keys: All labelled frames, which the rule divides.
        findings: Where the use of the rule is noted.
    """
    if pathlib.Path(split).is_file():
        return set(sequences.read_split(split))
    if str(split) not in ("train", "test"):
        raise UserError(
            f"split {str(split)!r} is neither 'train', 'test', None nor a split file"
        )
    if path := folders.find_split_file(str(split), near):
        return set(sequences.read_split(path))
    findings.notes.append(
        f"no split/{split}.txt found: split by K-Radar's rule, alternating quarters"
    )
    names = collections.defaultdict(list)
    for sequence, name in keys:
        names[sequence].append(name)
    return {
        (sequence, name)
        for sequence in names
        for name in sequences.split_by_rule(names[sequence], str(split))
    }
