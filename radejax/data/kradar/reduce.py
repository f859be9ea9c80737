"""Writer of K-Radar's reduced releases from 4D radar tensors."""

from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Iterable

import numpy as np
from tqdm import tqdm

from radejax.core import manifest
from radejax.core.errors import DataError, UserError, require
from radejax.core.files import PathLike, as_path, atomic_write
from radejax.data.kradar.folders import find_sequences, is_elevation_axis_up, read_grid
from radejax.data.kradar.reduced import RELEASES, strongest_points
from radejax.data.kradar.tesseract import check_axes, read_polar
from radejax.data.records import PreprocessReport

_LEFT_OUT = shutil.ignore_patterns("*_tesseract", "records*", "manifest.*")


def reduce_dataset(
    roots: Iterable[PathLike], out: PathLike, release: str, rate: float = 0.01
) -> PreprocessReport:
    """Writes a dataset with the frames of a reduced release instead of radar tensors.

    The other files of the roots become symbolic links. Existing files are kept, so that an
    interrupted call can be repeated; those whose tensor has changed since are counted in a
    warning.

    Args:
        roots: Folders that contain the sequences.
        out: Root of the new dataset.
        release: "polar3d" or "rpc".
        rate: Fraction of the cells that become points of "rpc".

    Raises:
        FileNotFoundError: A root does not exist.
        UserError: The rate is out of its range, there are no tensors, the grid has too few
            bins, or the new dataset has frames of another form or rate, or of unknown
            ones.
        DataError: The folders are ambiguous.
    """
    require(0 < rate < 1, "rate", rate, "a number above 0 and below 1")
    began = time.perf_counter()
    out = as_path(out)
    paths = list(map(as_path, roots))
    require(out not in paths, "out", str(out), "another folder than the roots")
    grid = read_grid(paths)
    targets = {}
    check_axes(grid)
    for folder in find_sequences(paths).values():
        for path in folder.listing("radar_tesseract").values():
            name = f"{release}_{path.stem.rpartition('_')[2]}.npy"
            targets[path] = out / folder.folders[0].name / name
    if not targets:
        raise UserError(f"no radar_tesseract/*.mat in {', '.join(map(str, paths))}")
    missing = [path for path in targets if not targets[path].exists()]
    options = {"release": release, "rate": rate if release == "rpc" else None}
    patterns = [f"{name}_*.npy" for name in RELEASES]
    manifest.Manifest.claim(out, "reduced frames", options, patterns=patterns)
    names = {path: str(target.relative_to(out)) for path, target in targets.items()}
    done = {names[path]: path for path in sorted(targets.keys() - set(missing))}
    manifest.warn_of_changes(out, done)
    for root in paths:
        shutil.copytree(root, out, False, _LEFT_OUT, _link, dirs_exist_ok=True)
        for made, *_ in os.walk(out):  # those of a write-protected root are so too
            if not (mode := os.stat(made).st_mode) & stat.S_IWUSR:
                os.chmod(made, mode | stat.S_IWUSR)
    is_axis_up = is_elevation_axis_up(paths)
    skipped = {}
    for path in tqdm(missing, "reduce", unit="frame"):
        state = manifest.state_of([path])
        try:
            frame = read_polar(path, grid)
        except (DataError, OSError) as error:
            skipped[str(path)] = str(error)
            continue
        if release == "rpc":
            frame = strongest_points(frame, grid, rate, is_axis_up=is_axis_up)
        manifest.add(out, names[path], state)
        with atomic_write(targets[path]) as file:
            np.save(file, frame)
    num_found = len(targets) - len(missing)
    seconds = time.perf_counter() - began
    return PreprocessReport(len(targets), num_found, skipped, seconds)


def _link(path: str, target: str) -> None:
    if not os.path.lexists(target):
        os.symlink(os.path.abspath(path), target)
