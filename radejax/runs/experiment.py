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

import flax.linen as nn
import jax
import numpy as np
from ml_collections import ConfigDict
from tabulate import tabulate

import radejax
from radejax import models
from radejax.core import files
from radejax.core.config import without_data_paths
from radejax.core.errors import DataError, UserError, require
from radejax.core.files import PathLike
from radejax.data.dataset import FrameSequence
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.saved import StartingWeights, starting_weights
from radejax.runs import checks
from radejax.runs.data import Data, located, open_data
from radejax.runs.evaluate import evaluate
from radejax.runs.validation import Validation
from radejax.training import distributed, loop
from radejax.training.step import TrainState

_log = logging.getLogger(__name__)


def run(
    config: ConfigDict,
    *,
    name: str,
    workdir: PathLike | None = None,
    init_from: PathLike | None = None,
    profile: PathLike = "",
) -> pathlib.Path:
    """Trains and evaluates; called again, it continues where it stopped.

    Args:
        config: Complete configuration of one seed; `run_seeds` takes several.
        name: Of the config, for the default workdir.
        workdir: `runs/<name>` if None.
        init_from: Weights to start from: official .pth file or another workdir.
        profile: Folder for a trace of the steps `config.logging.profile_steps`.

    Returns:
        The workdir.

    Raises:
        UserError: A field of the config is out of its range, the workdir belongs to
            another configuration or is in use, no data, or no space.
    """
    checks.check(config)
    config = located(config)
    distributed.check_batch_size(config.train.batch_size, distributed.make_mesh())
    model = models.build(config.model)
    folder = default_workdir(workdir, name)
    with claimed(folder, config):
        weights = starting_weights(
            *(config.model, init_from),
            *(config.data.image_backbone, config.data.embeddings),
        )
        data = open_data(config, model)
        has_test = len(data.split("test")) > 0
        if not has_test:
            _log.warning(
                "no frames of the test split in %s: the run is trained and not evaluated",
                ", ".join(data.options.roots),
            )
        state, is_finished = _train(model, weights, data, folder, config, str(profile))
        step = int(state.step)
        if not is_finished:
            _log.info("stopped at step %d; run the same command to continue", step)
            return folder
        if has_test:
            evaluate(config, model, state.eval_variables, data, folder, step=step)
    place = files.relative(folder)
    _log.info("Done in %s: checkpoints/, metrics.jsonl and evaluation/", place)
    if config.train.evaluate_every_epochs:
        best = f"radejax evaluate --workdir {place} --checkpoint best"
        split = data.choosing_split
        _log.info("Best checkpoint, chosen on the %s split: %s", split, best)
    _log.info("Evaluate again: radejax evaluate --workdir %s", place)
    _log.info("Boxes of frames: radejax detect --workdir %s --out boxes FOLDER", place)
    return folder


def _train(
    model: nn.Module,
    weights: StartingWeights,
    data: Data,
    folder: pathlib.Path,
    config: ConfigDict,
    profile: str,
) -> tuple[TrainState, bool]:
    """Trains on the train split until the configured epochs are done."""
    frames = data.split("train")
    if not len(frames):
        raise UserError(
            f"no frames of the train split in {', '.join(data.options.roots)}"
        )
    loader = data.training_batches(frames, config.train, config.seed)
    info = run_info(folder, weights.source)
    if distributed.is_main():
        files.write_json(folder / "run.json", info)
    validation = None
    if config.train.evaluate_every_epochs:
        validation = Validation(config, data)
    grid = data.records.grid
    return loop.train(
        config,
        model,
        loader,
        models.map_grid(grid, model, config.data.azimuth_mapping),
        folder,
        info=checkpoint_info(config, grid, info, _invariants(frames, weights)),
        steps_per_epoch=len(frames) // config.train.batch_size,
        variables=weights.variables,
        pretrained=weights.pretrained,
        evaluate=validation,
        profile=profile,
    )


# Workdir -----------------------------------------------------------------------------


def default_workdir(workdir: PathLike | None, name: str) -> pathlib.Path:
    """Absolute path of the workdir: `runs/<name>` unless another is given."""
    return pathlib.Path(workdir or pathlib.Path("runs") / name).absolute()


@contextlib.contextmanager
def claimed(workdir: pathlib.Path, config: ConfigDict) -> Iterator[None]:
    """Locks a workdir, which is created if missing, for a training with a config.

    A folder without a checkpoint takes the config that is given.

    Raises:
        UserError: Another process holds it, or it belongs to a run with another
            configuration; names the fields that differ.
    """
    message = (
        f"another training is at work in {files.relative(workdir)}: wait for its end, or "
        "give another --workdir"
    )
    with contextlib.ExitStack() as held:
        lock = files.lock(workdir / "lock", message)
        distributed.main_only(lambda: held.enter_context(lock))
        distributed.main_first(lambda: _claim(workdir, config))
        yield


def _claim(workdir: pathlib.Path, config: ConfigDict) -> None:
    """Writes the config; compares it with that of the run, if there are checkpoints."""
    path = workdir / "config.json"
    if distributed.is_main() and not any(workdir.glob("checkpoints/*")):
        path.unlink(missing_ok=True)
    files.claim(
        path,
        without_data_paths(config),
        "a run with another config",
        fix="give another --workdir, or remove that one",
        name="config",
        ignore=("logging",),
    )


def run_info(
    workdir: pathlib.Path, init_from: PathLike | None = None
) -> dict[str, Any]:
    """Versions, command and starting weights of a run; plain values.

    A run that continues keeps the weights that it started from.
    """
    init_from = init_from and str(pathlib.Path(init_from).absolute())
    if init_from is None and (workdir / "run.json").exists():
        saved = files.read_object(workdir / "run.json")
        init_from = saved.get("init_from")
    return {
        "init_from": init_from,
        "versions": {
            "radejax": radejax.__version__,
            "jax": jax.__version__,
            "python": sys.version.split()[0],
        },
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
    config_json = json.loads(config.to_json())
    return {
        "config": config_json,
        "grid": grid.to_dict(),
        "run": dict(run),
        "same": dict(same),
    }


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
        values["sha256 of the frozen image backbone"] = weights.frozen_sha256[:16]
    return values


# Several seeds -----------------------------------------------------------------------

_KEYS = ("protocol", "condition", "cls", "space", "iou")


def run_seeds(
    config: ConfigDict,
    seeds: Sequence[int],
    *,
    name: str,
    workdir: PathLike | None = None,
    **options: Any,
) -> pathlib.Path:
    """Runs a config with every seed, one after the other.

    Only `config.seed` changes: weights, order of the frames and augmentation. A
    simulated dataset has a seed of its own. Called again, finished seeds are evaluated
    again and the others continue.

    Args:
        config: Of the runs.
        seeds: Two or more, all different.
        name: Of the config, for the default workdir.
        workdir: Contains `seed0`, `seed1`, ... and the summary; `runs/<name>` if None.
        **options: Further arguments of `run`.

    Returns:
        The workdir. `seeds.json` and `seeds.txt` in it have mean and standard deviation
        of the seeds that are finished.

    Raises:
        UserError: Two seeds are equal; and as `run`.
    """
    require(len(set(seeds)) == len(seeds), "--seeds", seeds, "different seeds")
    workdir = default_workdir(workdir, name)
    tables = {}
    for seed in seeds:
        one = config.copy_and_resolve_references()
        one.seed = seed
        _log.info("seed %d of %s", seed, list(seeds))
        folder = run(one, name=name, workdir=workdir / f"seed{seed}", **options)
        if not (folder / "evaluation" / "metrics.csv").exists():
            _log.info("seed %d is not evaluated: it is not finished, or no data", seed)
            break
        tables[seed] = read_aps(folder / "evaluation" / "metrics.csv")
    if tables and distributed.is_main():
        rows = _summary(tables)
        text = _summary_text(rows)
        files.write_json(workdir / "seeds.json", rows)
        files.write_text(workdir / "seeds.txt", text)
        _log.info("%s\nWritten to %s", text, workdir)
    return workdir


def read_aps(path: pathlib.Path) -> dict[tuple[str, ...], float]:
    """APs of a report's metrics.csv by protocol, condition, class, space and IoU."""
    try:
        rows = list(csv.DictReader(files.read_text(path).splitlines()))
        return {
            tuple(row[key] for key in _KEYS): float(row["ap"] or "nan")
            for row in rows
            if float(row["num_gt"])
        }
    except (KeyError, ValueError, TypeError, csv.Error) as error:
        raise DataError(
            f"{path}: not the metrics of a report ({error!r:.200})"
        ) from None


def _summary(tables: dict[int, dict[tuple[str, ...], float]]) -> list[dict[str, Any]]:
    """Mean, standard deviation (n - 1; None for one seed) and values of common APs."""
    first, *others = tables.values()
    rows = []
    for key in (key for key in first if all(key in table for table in others)):
        values = {str(seed): table[key] for seed, table in tables.items()}
        aps = list(values.values())
        std = float(np.std(aps, ddof=1)) if others else None
        named = dict(zip(_KEYS, key, strict=True))
        rows.append(named | {"mean": float(np.mean(aps)), "std": std, "values": values})
    return rows


def _summary_text(rows: Sequence[dict[str, Any]]) -> str:
    """A table of the rows over all frames."""
    head = ["protocol", "class", "space", "IoU", "mean AP", "std"]
    lines = []
    for row in rows:
        if row["condition"] == "all":
            std = "-" if row["std"] is None else f"{row['std']:.2f}"
            aps = [f"{ap:.2f}" for ap in row["values"].values()]
            names = [row[key] for key in _KEYS if key != "condition"]
            lines.append([*names, f"{row['mean']:.2f}", std, *aps])
            seeds = [f"seed {seed}" for seed in row["values"]]
    return tabulate(lines, [*head, *seeds], disable_numparse=True) if lines else ""
