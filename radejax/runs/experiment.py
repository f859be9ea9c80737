"""A whole run: data, training, evaluation, for one seed or several.

The workdir of a run contains

config.json      the configuration without the paths of the data, which checkpoints
                 contain; it never changes after the first checkpoint
run.json         versions, command, weights that training started from
checkpoints/     newest, best and last, by step
metrics.jsonl    losses by step; tensorboard/ has the same
evaluation/      metrics.json, metrics.csv, tables, figures of the last evaluation;
                 evaluation_<name>/ of one on other data, described by its source.json
lock             held by the training that is running
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import logging
import pathlib
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from ml_collections import ConfigDict
from tabulate import tabulate

import radejax
from radejax import models
from radejax.core import files
from radejax.core.config import without_data_paths
from radejax.core.errors import require
from radejax.core.files import PathLike
from radejax.data.dataset import FrameSequence
from radejax.data.records import open_embeddings
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.saved import (
    FROZEN_BACKBONE,
    StartingWeights,
    starting_weights,
)
from radejax.runs import checks
from radejax.runs.data import located, open_data
from radejax.runs.evaluate import Evaluation
from radejax.training import distributed, loop

_log = logging.getLogger(__name__)


def run(
    config: ConfigDict,
    workdir: PathLike,
    *,
    init_from: PathLike | None = None,
    profile: PathLike = "",
) -> pathlib.Path:
    """Trains and evaluates; called again, it continues where it stopped.

    Args:
        config: Complete configuration of one seed; `run_seeds` takes several.
        workdir: Folder of the run, created if missing.
        init_from: Weights to start from: official .pth file or another workdir.
        profile: Folder for a trace of the steps `config.logging.profile_steps`.

    Returns:
        The workdir.

    Raises:
        UserError: A field of the config is out of its range, the workdir belongs to
            another configuration or is in use, no data, or no space.
        FileNotFoundError: A path does not exist.
    """
    checks.check(config)
    config, folder = located(config), pathlib.Path(workdir).absolute()
    distributed.check_batch_size(config.train.batch_size)
    model, digest = models.build(config.model), None
    if config.data.embeddings is not None:
        embeddings = open_embeddings(config.data.embeddings)
        digest = embeddings.source["weights_sha256"]
    weights = starting_weights(
        config.model, init_from, config.data.image_backbone, digest
    )
    with claimed(folder, config):
        data = open_data(config, model)
        frames, grid = data.split("train"), data.records.grid
        has_test = len(data.split("test", may_be_empty=True)) > 0
        if not has_test:
            _log.warning(
                "no frames of the test split in %s: the run is trained and not evaluated",
                ", ".join(data.options.roots),
            )
        loader = data.training_batches(frames, config.train, config.seed)
        info = run_info(folder, init_from)
        if distributed.is_main():
            files.write_json(folder / "run.json", info)
        validate = None
        if config.train.evaluate_every_epochs:
            validate = Evaluation(config, data, data.choosing_split).validate
        state, is_finished = loop.train(
            config,
            model,
            loader,
            models.map_grid(grid, model, config.data.azimuth_mapping),
            folder,
            info=checkpoint_info(config, grid, info, _invariants(frames, weights)),
            steps_per_epoch=len(frames) // config.train.batch_size,
            variables=weights.variables,
            pretrained=weights.pretrained,
            evaluate=validate,
            profile=str(profile),
        )
        step = int(state.step)
        if not is_finished:
            _log.info("stopped at step %d; run the same command to continue", step)
            return folder
        if has_test:
            evaluation = Evaluation(config, data)
            evaluation.report(state.eval_variables, folder, step=step)
    place = files.relative(folder)
    _log.info(
        "Done in %s. Evaluate again: radejax evaluate %s. Boxes of frames: radejax detect "
        "--workdir %s --out boxes FOLDER",
        *(place, place, place),
    )
    if config.train.evaluate_every_epochs:
        best = f"radejax evaluate {place} --checkpoint best"
        split = data.choosing_split
        _log.info("Best checkpoint, chosen on the %s split: %s", split, best)
    return folder


# Workdir -----------------------------------------------------------------------------


@contextlib.contextmanager
def claimed(workdir: pathlib.Path, config: ConfigDict) -> Iterator[None]:
    """Locks a workdir, which is created if missing, for a training with a config.

    A folder without a checkpoint takes the config that is given.

    Raises:
        UserError: Another process holds it, or it belongs to a run with another
            configuration; names the fields that differ.
    """
    path = workdir / "config.json"
    message = (
        f"another training is at work in {files.relative(workdir)}: wait for its end, or "
        "give another --workdir"
    )
    with contextlib.ExitStack() as held:

        def take() -> None:
            held.enter_context(files.lock(workdir / "lock", message))
            if not any(workdir.glob("checkpoints/*")):
                files.write_json(path, without_data_paths(config))

        distributed.main_only(take)
        files.claim(
            path,
            without_data_paths(config),
            "a run with another config",
            fix="give another --workdir, or remove that one",
            name="config",
            ignore=("logging",),
        )
        yield


def run_info(
    workdir: pathlib.Path, init_from: PathLike | None = None
) -> dict[str, Any]:
    """Versions, command and starting weights of a run; plain values.

    A run that continues keeps the weights that it started from.
    """
    if init_from is not None:
        init_from = str(pathlib.Path(init_from).absolute())
    elif (workdir / "run.json").exists():
        init_from = files.read_object(workdir / "run.json").get("init_from")
    versions = {"radejax": radejax.__version__, "jax": jax.__version__}
    return {
        "init_from": init_from,
        "versions": {**versions, "python": sys.version.split()[0]},
        "device": str(jax.devices()[0].device_kind),
        "command": shlex.join(sys.argv),
    }


def checkpoint_info(
    config: ConfigDict,
    grid: RadarGrid,
    run: Mapping[str, Any],
    same: Mapping[str, Any],
) -> dict[str, Any]:
    """Plain values of every checkpoint of a run; `inference.saved` reads them.

    Args:
        config: Of the run.
        grid: Of the sensor.
        run: See `run_info`.
        same: Values by name that a run that continues must not change.
    """
    values = {"config": json.loads(config.to_json()), "grid": grid.to_dict()}
    return {**values, "run": dict(run), "same": dict(same)}


def _invariants(frames: FrameSequence, weights: StartingWeights) -> dict[str, Any]:
    """Properties of the data and frozen weights that a run must not change.

    Folders may move, therefore frames are compared by their keys and the frozen
    backbone by its weights.
    """
    keys = "\n".join(frame.key for frame in frames)
    values = {
        "frames to train on": len(frames),
        "sha256 of their keys": hashlib.sha256(keys.encode()).hexdigest()[:16],
    }
    if weights.frozen_sha256 is not None:
        values[FROZEN_BACKBONE] = weights.frozen_sha256[:16]
    return values


# Several seeds -----------------------------------------------------------------------

_KEYS = ("protocol", "condition", "cls", "space", "iou")


def run_seeds(
    config: ConfigDict, workdir: PathLike, seeds: Sequence[int], **options: Any
) -> pathlib.Path:
    """Runs a config with every seed, one after the other.

    Only `config.seed` changes: weights, order of the frames and augmentation. A
    simulated dataset has a seed of its own. Called again, finished seeds are evaluated
    again and the others continue.

    Args:
        config: Of the runs.
        workdir: Contains `seed0`, `seed1`, ... and the summary.
        seeds: Two or more, all different.
        **options: Further arguments of `run`.

    Returns:
        The workdir. `seeds.json` and `seeds.txt` in it have mean and standard deviation
        of the seeds that are finished.

    Raises:
        UserError: Two seeds are equal; and as `run`.
    """
    require(len(set(seeds)) == len(seeds), "--seeds", seeds, "different seeds")
    workdir, tables = pathlib.Path(workdir).absolute(), {}
    for seed in seeds:
        one = config.copy_and_resolve_references()
        one.seed = seed
        _log.info("seed %d of %s", seed, list(seeds))
        folder = run(one, workdir / f"seed{seed}", **options)
        metrics = folder / "evaluation" / "metrics.csv"
        if not metrics.exists():
            _log.info("seed %d is not evaluated: it is not finished, or no data", seed)
            break
        tables[str(seed)] = {
            tuple(row[key] for key in _KEYS): float(row["ap"] or "nan")
            for row in csv.DictReader(files.read_text(metrics).splitlines())
            if float(row["num_gt"])
        }
    if tables and distributed.is_main():
        _write_summary(workdir, tables)
    return workdir


def _write_summary(
    workdir: pathlib.Path, tables: dict[str, dict[tuple[str, ...], float]]
) -> None:
    """Mean, standard deviation (n - 1; None for one seed) and values of common APs."""
    rows, lines = [], []
    first, *others = tables.values()
    for key in (key for key in first if all(key in table for table in others)):
        values = {seed: table[key] for seed, table in tables.items()}
        aps = list(values.values())
        row: dict[str, Any] = dict(zip(_KEYS, key, strict=True))
        row["mean"] = float(np.mean(aps))
        row["std"] = float(np.std(aps, ddof=1)) if others else None
        rows.append({**row, "values": values})
        if row.pop("condition") == "all":
            lines.append(row | {f"seed {seed}": ap for seed, ap in values.items()})
    text = tabulate(lines, headers="keys", floatfmt=".2f", missingval="-")
    files.write_json(workdir / "seeds.json", rows)
    files.write_text(workdir / "seeds.txt", text)
    _log.info("%s\nWritten to %s", text, workdir)
