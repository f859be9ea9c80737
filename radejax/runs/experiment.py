"""Complete runs of data preparation, training and evaluation, for one seed or several.

The workdir of a run contains

config.json      the configuration without the paths of the data, which the checkpoints
                 contain; it does not change after the first checkpoint
run.json         versions, command, weights that the training started from
checkpoints/     the newest checkpoints and the best one, by step
metrics.jsonl    losses by step; tensorboard/ has the same values
evaluation/      metrics.json, metrics.csv, tables and figures of the last evaluation;
                 evaluation_<name>/ has those with other options or on other data
lock             lock file, which the running training holds
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

import radejax
from radejax import models
from radejax.config import Config
from radejax.core import files
from radejax.core.errors import require
from radejax.core.files import PathLike
from radejax.data.dataset import FrameSequence
from radejax.data.records import open_embeddings
from radejax.evaluation.report import Table, number, numbers, write_tables
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.saved import FROZEN_BACKBONE, starting_weights
from radejax.runs.data import located, open_data
from radejax.runs.evaluate import Evaluation, named_aps
from radejax.training import distributed, loop
from radejax.training.metric_logger import log_results
from radejax.weights.image_backbone import check_fits

_log = logging.getLogger(__name__)


def run(
    config: Config,
    workdir: PathLike,
    *,
    init_from: PathLike | None = None,
    profile: PathLike = "",
) -> pathlib.Path:
    """Trains and evaluates a model, or continues an interrupted run.

    Args:
        config: Complete configuration of one seed; `run_seeds` runs several.
        workdir: Folder of the run, created if missing.
        init_from: Weights to start from: an official checkpoint file, another workdir, or
            another model that `load_model` accepts.
        profile: Folder for a profiler trace of the steps `config.logging.profile_steps`;
            empty for no trace.

    Returns:
        The absolute path of the workdir.

    Raises:
        UserError: A field of the config is out of its range, the workdir belongs to a run
            with another configuration or is in use, there are no data, or no space is
            left on the disk.
        FileNotFoundError: A path does not exist.
    """
    config, folder = located(config), files.as_path(workdir).absolute()
    distributed.check_batch_size(config.train.batch_size)
    model, digest = models.build(config.model, config.data.num_frames), None
    if config.data.embeddings is not None:
        digest = open_embeddings(config.data.embeddings).source["weights_sha256"]
    variables, pretrained, frozen_sha256 = starting_weights(
        config.model, init_from, config.data.image_backbone, digest
    )
    if variables is not None:
        check_fits(model, variables, str(init_from))
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
        same = _invariants(frames, frozen_sha256)
        state, is_finished = loop.train(
            config,
            model,
            loader,
            models.map_grid(grid, model, config.data.azimuth_mapping),
            folder,
            info=checkpoint_info(config, grid, info, same),
            steps_per_epoch=len(frames) // config.train.batch_size,
            variables=variables,
            pretrained=pretrained,
            evaluate=validate,
            profile=str(profile),
        )
        step = int(state.step)
        if not is_finished:
            _log.info("stopped at step %d; run the same command to continue", step)
            return folder
        if has_test:
            evaluation = Evaluation(config, data)
            report = evaluation.report(state.eval_variables, folder, step=step)
            if report is not None:
                log_results(folder, step, named_aps(report.results))
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
def claimed(workdir: pathlib.Path, config: Config) -> Iterator[None]:
    """Locks a workdir for a training with a config while a block runs.

    The workdir is created if missing. If it has no checkpoint yet, the given config
    replaces the one in it.

    Raises:
        UserError: Another process holds the lock; or the workdir belongs to a run with
            another configuration, in which case the message names the fields that differ.
    """
    path = workdir / "config.json"
    content = config.without_data_paths()
    message = (
        f"another training is at work in {files.relative(workdir)}: wait for its end, or "
        "give another --workdir"
    )
    with contextlib.ExitStack() as held:

        def take() -> None:
            held.enter_context(files.lock(workdir / "lock", message))
            if not any(workdir.glob("checkpoints/*")):
                files.write_json(path, content)

        distributed.main_only(take)
        what = "a run with another config"
        fix = "give another --workdir, or remove that one"
        files.claim(path, content, what, fix=fix, name="config", ignore=("logging",))
        yield


def run_info(
    workdir: pathlib.Path, init_from: PathLike | None = None
) -> dict[str, Any]:
    """Returns the versions, device, command and starting weights of a run as plain values.

    Args:
        workdir: Workdir of the run.
        init_from: Weights that the run starts from. If None, the entry of an existing
            `run.json` is kept.
    """
    if init_from is not None:
        init_from = str(files.as_path(init_from).absolute())
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
    config: Config,
    grid: RadarGrid,
    run: Mapping[str, Any],
    same: Mapping[str, Any],
) -> dict[str, Any]:
    """Returns the plain values in every checkpoint of a run, which `inference.saved` reads.

    Args:
        config: Config of the run.
        grid: Grid of the sensor.
        run: Result of `run_info`.
        same: Values by name that must not change when the run continues.
    """
    values = {"config": json.loads(config.model_dump_json()), "grid": grid.to_dict()}
    return {**values, "run": dict(run), "same": dict(same)}


def _invariants(frames: FrameSequence, frozen_sha256: str | None) -> dict[str, Any]:
    """Returns properties of the data and frozen weights that a run must not change.

    Folders may move. Therefore frames are identified by their keys, and the frozen
    backbone by its weights.
    """
    keys = "\n".join(frame.key for frame in frames)
    digest = hashlib.sha256(keys.encode()).hexdigest()[:16]
    values = {"frames to train on": len(frames), "sha256 of their keys": digest}
    if frozen_sha256 is not None:
        values[FROZEN_BACKBONE] = frozen_sha256[:16]
    return values


# Several seeds -----------------------------------------------------------------------

_KEYS = ("name", "protocol", "score_threshold", "condition", "cls", "space", "iou")


def run_seeds(
    config: Config, workdir: PathLike, seeds: Sequence[int], **options: Any
) -> pathlib.Path:
    """Runs a config with several seeds, one after the other.

    Only `config.seed` differs between the runs, which determines the initial weights, the
    order of the frames, dropout and augmentation. A simulated dataset has its own seed.
    When the function is called again, finished seeds are evaluated again and the others
    continue.

    Args:
        config: Config of the runs.
        workdir: Folder of the runs `seed0`, `seed1`, ... and the summary.
        seeds: Seeds, all different.
        **options: Further arguments of `run`.

    Returns:
        The absolute path of the workdir. Its files `seeds.json`, `seeds.txt`,
        `seeds.md` and `seeds.tex` contain the mean and standard deviation over the finished
        seeds.

    Raises:
        UserError: Two seeds are equal, or `run` raises it.
    """
    require(len(set(seeds)) == len(seeds), "--seeds", seeds, "different seeds")
    workdir, tables = files.as_path(workdir).absolute(), {}
    for seed in seeds:
        _log.info("seed %d of %s", seed, list(seeds))
        folder = run(config.replace(seed=seed), workdir / f"seed{seed}", **options)
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
    """Writes mean, standard deviation and values of the APs that all seeds have.

    The standard deviation is the sample standard deviation with n - 1, and None for one
    seed.

    Args:
        workdir: Folder of `seeds.json`, `seeds.txt`, `seeds.md` and `seeds.tex`.
        tables: APs by seed and by the values of `_KEYS`.
    """
    rows, lines = list[dict[str, Any]](), []
    first, *others = tables.values()
    for key in (key for key in first if all(key in table for table in others)):
        values = {seed: table[key] for seed, table in tables.items()}
        aps = list(values.values())
        row: dict[str, Any] = dict(zip(_KEYS, key, strict=True))
        row["mean"] = float(np.mean(aps))
        row["std"] = float(np.std(aps, ddof=1)) if others else None
        rows.append({**row, "values": values})
        if row["condition"] == "all":
            terms = f"{row['protocol']}, score>{float(row['score_threshold']):g}"
            line = row["cls"], terms, row["space"].upper(), row["iou"]
            mean = f"{number(row['mean'])} ± {number(row['std'])}"
            lines.append([*line, mean, *numbers(aps)])
    title = f"AP, mean ± standard deviation over {len(tables)} seeds, all weathers"
    header = ["Class", "Protocol", "AP", "IoU", "Mean", *(f"Seed {x}" for x in tables)]
    table = Table(title, header, lines)
    is_simulated = rows[0]["name"].endswith("/simulated")
    text = table.render(is_simulated=is_simulated)
    files.write_json(workdir / "seeds.json", rows)
    files.write_text(workdir / "seeds.txt", text)
    write_tables(workdir / "seeds", [table], is_simulated=is_simulated)
    _log.info("%s\nWritten to %s", text, workdir)
