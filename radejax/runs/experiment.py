"""Complete runs of data preparation, training and evaluation, for one seed or several.

The workdir of a run contains

config.json      the configuration without the paths of the data, which the checkpoints
                 contain; after the first checkpoint, only its logging and length may change
run.json         versions, commits, date, data, hashes of own parts, command, weights that the
                 training started from
checkpoints/     the newest checkpoints and the best one, by step
metrics.jsonl    losses by step; tensorboard/ has the same values
evaluation/      metrics.json, metrics.csv, tables and figures of the last evaluation;
                 evaluation_<name>/ has those with other options or on other data
lock             lock file, which the running training holds
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import datetime
import functools
import hashlib
import logging
import pathlib
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from flax.typing import VariableDict
from jax.sharding import Mesh

from radejax import models
from radejax.config import Config
from radejax.core import devices, files
from radejax.core.errors import UserError, require
from radejax.core.files import JsonObject, PathLike
from radejax.core.grain_import import grain
from radejax.core.options import find_function
from radejax.core.structures import Batch
from radejax.core.version import __version__, commit, radejax_commit
from radejax.data.dataset import FrameSequence
from radejax.data.records import open_embeddings
from radejax.evaluation.report import Report, Table, number, numbers, write_tables
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.saved import FROZEN_BACKBONE, matching_weights, starting_weights
from radejax.runs.data import located, open_data
from radejax.runs.evaluate import Evaluation, named_aps
from radejax.training import hooks, loop
from radejax.training.checkpoints import Checkpoints
from radejax.training.hooks import Hook
from radejax.training.metric_writer import MetricWriter, Scores, log_results
from radejax.training.step import (
    Metrics,
    TrainState,
    count_steps,
    create_state,
    initial_variables,
    make_optimizer,
    make_schedule,
    make_train_step,
    merge_variables,
)

_log = logging.getLogger(__name__)


def run(
    config: Config,
    workdir: PathLike,
    *,
    init_from: PathLike | None = None,
    init_partial: PathLike | None = None,
    profile: PathLike | None = None,
    mesh: Mesh | None = None,
) -> pathlib.Path:
    """Trains and evaluates a model, or continues an interrupted run.

    Args:
        config: Complete configuration of one seed; `run_seeds` runs several.
        workdir: Folder of the run, created if missing.
        init_from: Weights to start from: a checkpoint file of the authors' code, another
            workdir, or another model that `load_model` accepts.
        init_partial: Model whose weights are used where name and shape are equal, see
            `matching_weights`, instead of `init_from`.
        profile: Folder for a profiler trace of the steps `config.logging.profile_steps`;
            None for no trace.
        mesh: Devices of the run, see `make_mesh`; all if None.

    Returns:
        The absolute path of the workdir.

    Raises:
        UserError: A field of the config is out of its range, the workdir belongs to a run
            with another configuration or other starting weights or is in use, there are no
            data, or no space is left on the disk.
        DataError: See `fit`.
        FileNotFoundError: A path does not exist.
    """
    folder = files.as_path(workdir).absolute()
    _run(config, folder, init_from, init_partial, profile, mesh)
    return folder


def _run(
    config: Config,
    folder: pathlib.Path,
    init_from: PathLike | None = None,
    init_partial: PathLike | None = None,
    profile: PathLike | None = None,
    mesh: Mesh | None = None,
) -> tuple[bool, Report | None]:
    """Does the work of `run`; returns whether the training is finished, and the report.

    The report is None without a test split, and on all processes except the first.
    """
    config.check_imports()
    config = located(config)
    mesh = devices.make_mesh() if mesh is None else mesh
    devices.check_batch_size(config.train.batch_size, mesh)

    # Weights --------------------------------------------------------------------------

    model = models.build(config.model, config.data.num_frames)
    digest = None
    if config.data.embeddings is not None:
        digest = open_embeddings(config.data.embeddings).source["weights_sha256"]
    weights, frozen_sha256 = starting_weights(
        model, init_from, config.data.image_backbone, digest
    )
    if init_partial is not None:
        require(
            init_from is None, "--init-from", init_from, "none, or no --init-partial"
        )
        weights = merge_variables(matching_weights(init_partial, model), weights)

    with claimed(folder, config):
        info = run_info(folder, init_from, init_partial)

        # Data -------------------------------------------------------------------------

        data = open_data(config)
        frames = data.split("train")
        grid = data.records.grid
        has_test = len(data.split("test", may_be_empty=True)) > 0
        if not has_test:
            _log.warning(
                "no frames of the test split in %s: the run is trained and not evaluated",
                ", ".join(data.options.roots),
            )
        info |= {"input": data.usual_input, "data": data.describe()}
        info |= {"parts": config.own_parts()}
        if (before := folder / "run.json").exists():
            config.check_parts(files.read_object(before).get("parts", {}), folder)
        if devices.is_main():
            files.write_json(folder / "run.json", info)
        training_data = TrainingData(
            batches=data.training_batches(),
            steps_per_epoch=len(frames) // config.train.batch_size,
            grid=models.map_grid(grid, model, config.data.azimuth_mapping),
            info=checkpoint_info(
                config, grid, info, _invariants(frames, frozen_sha256)
            ),
            keys=[frame.key for frame in frames],
        )

        # Model, state and training ----------------------------------------------------

        @functools.cache  # the splits of both evaluations may be the same
        def evaluation(split: str) -> Evaluation:
            return Evaluation(config, data, split, mesh=mesh)

        validate = None
        if config.train.evaluate_every_epochs:
            validate = evaluation(data.choosing_split).validate
        state, is_finished = fit(
            config,
            model,
            training_data,
            folder,
            mesh,
            weights=weights,
            validate=validate,
            profile=profile,
        )
        step = int(state.step)
        if not is_finished:
            _log.info("stopped at step %d; run the same command to continue", step)
            return False, None

        # Report -----------------------------------------------------------------------

        report = None
        if has_test:
            others = evaluation("validation") if config.data.validation else None
            report = evaluation("test").report(
                state.eval_variables, folder, step=step, choosing=others
            )
            if report is not None:
                log_results(folder, step, named_aps(report.results))
    place = files.relative(folder)
    _log.info(
        "Done in %s. Evaluate again: radejax evaluate %s. Boxes of frames: radejax detect "
        "--workdir %s --out boxes FOLDER",
        place,
        place,
        place,
    )
    if config.train.evaluate_every_epochs:
        best = f"radejax evaluate {place} --checkpoint best"
        split = data.choosing_split
        _log.info("Best checkpoint, chosen on the %s split: %s", split, best)
    return True, report


# Training ----------------------------------------------------------------------------


Validate = Callable[[VariableDict, Callable[[], bool]], Scores]
"""Function that evaluates variables during training. Its arguments are the variables, with
averaged parameters if there are any, and a function that returns whether to stop, which every
process must call equally often. If that returns True, it raises `devices.Stopped`."""


@dataclasses.dataclass(frozen=True)
class TrainingData:
    """What a model is trained on.

    Attributes:
        batches: Endless, checkpointable iterator over the batches of this process.
        steps_per_epoch: Number of batches of one pass over the data.
        grid: Grid of the model's maps.
        info: Plain values that are saved in each checkpoint, see `checkpoint_info`. The
            value of "same" must be the same whenever the run continues.
        keys: Keys of the frames by `Batch.frame` for messages; () names their indices.
    """

    batches: grain.DatasetIterator[Batch]
    steps_per_epoch: int
    grid: RadarGrid
    info: JsonObject
    keys: Sequence[str] = ()


def fit(
    config: Config,
    model: nn.Module,
    data: TrainingData,
    workdir: pathlib.Path,
    mesh: Mesh,
    *,
    weights: VariableDict | None = None,
    validate: Validate | None = None,
    profile: PathLike | None = None,
) -> tuple[TrainState, bool]:
    """Trains a model for the configured epochs or steps, or continues from a checkpoint.

    Args:
        config: Config of the run. `seed`, `train`, `loss`, `decode` and `logging`
            determine the training.
        model: Model, which is called as `model.apply(variables, *inputs, train=True)`.
        data: Data to train on.
        workdir: Folder of checkpoints and logs.
        mesh: Devices to train on.
        weights: Variables that replace initialized ones in step 0; None for no others.
        validate: Function that is called every `evaluate_every_epochs` epochs and, unless
            this field is 0, after the last step, see `Evaluation.validate`.
        profile: Folder for a profiler trace of the steps `config.logging.profile_steps`,
            counted from the first step of this call; None for no trace.

    Returns:
        The state, placed on all devices, and whether the training is finished. It is not
        finished if a signal ended the training or its last evaluation early; the state is
        saved in that case.

    Raises:
        DataError: No checkpoint can be restored, or the loss or gradient was not finite in
            too many consecutive steps or in most steps of the training.
        UserError: The run would continue with other data, the warm-up is too long, or no
            space is left on the disk.
    """
    kept = config.train.checkpoints_to_keep
    with contextlib.ExitStack() as stack:
        checkpoints = Checkpoints(workdir / "checkpoints", max_to_keep=kept)
        stack.enter_context(checkpoints)
        state, step = _make_state_and_step(
            config, model, data, mesh, checkpoints, weights or {}
        )
        start = int(state.step)
        num_steps = count_steps(config.train, data.steps_per_epoch)
        if start > num_steps:
            raise UserError(
                f"{workdir} is at step {start}, and config.train.num_epochs or max_steps "
                f"makes it end after {num_steps}: make it longer, or give another --workdir"
            )
        writer = stack.enter_context(MetricWriter(workdir, config, start))
        bar = stack.enter_context(hooks.ProgressBar(start, num_steps))
        should_stop = stack.enter_context(devices.stop_on_signal(mesh))

        timed_batches = hooks.Throughput(data.batches, start)
        log = hooks.Log(config, data.steps_per_epoch, timed_batches, writer, bar)
        log_every_steps = config.train.log_every_steps
        check = hooks.CheckSkipped(
            config.train.max_skipped_steps,
            log_every_steps,
            timed_batches,
            data.keys,
            int(state.num_skipped),
            int(state.num_skipped_in_row),
        )

        def save(
            step: int, state: TrainState, _: Metrics, *, best: float | None = None
        ) -> None:
            check.finish()
            kept = state.without(models.external_parts(model))
            checkpoints.save(step, kept, data.batches, info=data.info, best=best)

        due = functools.partial(hooks.every, num_steps)
        called: list[Hook] = [timed_batches, bar, due(log_every_steps, log), check]
        if validate is not None:

            def evaluate(step: int, state: TrainState, metrics: Metrics) -> None:
                try:
                    scores = validate(state.eval_variables, should_stop)
                except devices.Stopped:
                    _log.warning("the evaluation after step %d is skipped", step)
                    return
                writer.write(step, scores.values, scores.figures)
                timed_batches.restart(step)
                save(step, state, metrics, best=scores.best)

            epochs = config.train.evaluate_every_epochs
            called.append(due(epochs * data.steps_per_epoch, evaluate))
        for place in config.train.hooks:
            own: hooks.OwnHook = find_function(place, "config.train.hooks")
            called.append(hooks.logged(own, writer))
        called.append(due(config.train.checkpoint_every_steps, save))
        if profile is not None:
            shown = config.logging.profile_steps
            trace = hooks.Trace(str(profile), start, num_steps, shown)
            called.append(stack.enter_context(trace))

        state = loop.train(
            state,
            step,
            timed_batches,
            called,
            num_steps=num_steps,
            should_stop=should_stop,
        )
        last = int(state.step)
        is_finished = last >= num_steps and not should_stop()
        if last > start:
            save(last, state, {})
        checkpoints.wait()
        if is_finished:
            check.check_total(num_steps)
    return state, is_finished


def _make_state_and_step(
    config: Config,
    model: nn.Module,
    data: TrainingData,
    mesh: Mesh,
    checkpoints: Checkpoints,
    weights: VariableDict,
) -> tuple[TrainState, loop.PlacedStep]:
    """Restores or initializes the state, and returns it with the function of a step."""
    train = config.train
    optimizer = make_optimizer(train, make_schedule(train, data.steps_per_epoch))

    batch = loop.empty_batch(data.batches)

    def initial() -> VariableDict:
        return initial_variables(model, config.seed, batch, weights)

    create = functools.partial(
        create_state,
        optimizer=optimizer,
        use_ema=train.ema_decay is not None,
        model=model,
        freeze=train.freeze,
    )

    state = loop.restore_or_initialize(
        checkpoints,
        data.batches,
        initial,
        create,
        mesh,
        train.parameter_sharding,
        data.info.get("same", {}),
        models.external_parts(model),
    )
    if train.freeze:
        counts = [len(jax.tree.leaves(part)) for part in (state.frozen, state.params)]
        _log.info("%d arrays of parameters are frozen, %d are trained", *counts)
    step = make_train_step(
        model,
        optimizer,
        data.grid,
        loss=config.loss,
        decoding=config.decode,
        ema_decay=train.ema_decay,
    )
    return state, loop.place_step(step, state, mesh, config.seed)


# Workdir -----------------------------------------------------------------------------

_MAY_CHANGE = (
    "logging",
    "train.checkpoint_every_steps",
    "train.checkpoints_to_keep",
    "train.evaluate_every_epochs",
    "train.hooks",
    "train.log_every_steps",
    "train.max_skipped_steps",
    "train.max_steps",
    "train.num_epochs",
)
"""Fields that may change when a run continues. With more steps, a run becomes longer."""


@contextlib.contextmanager
def claimed(workdir: pathlib.Path, config: Config) -> Iterator[None]:
    """Locks a workdir for a training with a config while a block runs.

    The workdir is created if missing. The given config replaces the one in it. If there
    is a checkpoint, only the fields `_MAY_CHANGE` may differ.

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
    what = "a run with another config"
    fix = "give another --workdir, or remove that one"
    with contextlib.ExitStack() as held:

        def take() -> None:
            held.enter_context(files.lock(workdir / "lock", message))
            if any(workdir.glob("checkpoints/*")):
                files.claim(
                    path, content, what, fix=fix, name="config", ignore=_MAY_CHANGE
                )
                for line in files.differences(files.read_json(path), content):
                    _log.warning("the run continues with another config: %s", line)
            files.write_json(path, content)

        devices.main_only(take)
        # The config of every process has to be that of the main one.
        files.claim(path, content, what, fix=fix, name="config")
        yield


def run_info(
    workdir: pathlib.Path,
    init_from: PathLike | None = None,
    init_partial: PathLike | None = None,
) -> JsonObject:
    """Returns versions, commits, date, device, command and starting weights of a run.

    Args:
        workdir: Workdir of the run.
        init_from: Weights that the run starts from. If None, the entry of an existing
            `run.json` is kept.
        init_partial: Model whose weights are used where they match; as `init_from`.

    Raises:
        UserError: The workdir has checkpoints of a run that started from other weights.
    """
    path = workdir / "run.json"
    before = files.read_object(path) if path.exists() else {}
    given = {"init_from": init_from, "init_partial": init_partial}
    start = {
        name: before.get(name) if one is None else str(files.as_path(one).absolute())
        for name, one in given.items()
    }
    for name in given if any(workdir.glob("checkpoints/*")) else ():
        if start[name] != before.get(name):
            raise UserError(
                f"--{name.replace('_', '-')} is {start[name]}, expected "
                f"{before.get(name) or 'none'} as at the start of the run, because "
                f"{files.relative(workdir)} has checkpoints from which it continues: leave "
                "it out, or give another --workdir"
            )
    versions = {"radejax": __version__, "jax": jax.__version__}
    return {
        **start,
        "versions": {**versions, "python": sys.version.split()[0]},
        "commit": commit(pathlib.Path.cwd()),
        "radejax_commit": radejax_commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "device": str(jax.devices()[0].device_kind),
        "command": shlex.join(sys.argv),
    }


def checkpoint_info(
    config: Config, grid: RadarGrid, run: JsonObject, same: JsonObject
) -> JsonObject:
    """Returns the plain values in every checkpoint of a run, which `inference.saved` reads.

    Args:
        config: Config of the run.
        grid: Grid of the sensor.
        run: Result of `run_info`.
        same: Values by name that must not change when the run continues.
    """
    values = {"config": config.model_dump(mode="json"), "grid": grid.to_dict()}
    return {**values, "run": run, "same": same}


def _invariants(frames: FrameSequence, frozen_sha256: str | None) -> JsonObject:
    """Returns properties of the data and frozen weights that a run must not change.

    Folders may move. Therefore frames are identified by their keys and labels, and the
    frozen backbone by its weights.
    """
    keys = "\n".join(frame.key for frame in frames)
    classes = str([",".join(frame.classes) for frame in frames])
    boxes = np.concatenate([np.reshape(frame.boxes, (-1, 7)) for frame in frames])
    labels = classes.encode() + np.round(boxes, 4).tobytes()
    values: dict[str, Any] = {"frames to train on": len(frames)}
    for name, content in (("keys", keys.encode()), ("labels", labels)):
        values[f"sha256 of their {name}"] = hashlib.sha256(content).hexdigest()[:16]
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
        `seeds.md` and `seeds.tex` contain the mean and standard deviation over the seeds
        that are finished and evaluated.

    Raises:
        UserError: Two seeds are equal, or `run` raises it.
    """
    require(len(set(seeds)) == len(seeds), "--seeds", seeds, "different seeds")
    workdir = files.as_path(workdir).absolute()
    tables = {}
    for seed in seeds:
        _log.info("seed %d of %s", seed, list(seeds))
        folder = workdir / f"seed{seed}"
        is_finished, report = _run(config.replace(seed=seed), folder, **options)
        if not is_finished:
            break
        if report is None:  # no test split, or not the main process
            continue
        metrics = folder / "evaluation" / "metrics.csv"
        tables[str(seed)] = {
            tuple(row[key] for key in _KEYS): float(row["ap"] or "nan")
            for row in csv.DictReader(files.read_text(metrics).splitlines())
            if float(row["num_gt"])
        }
    if tables:
        _write_summary(workdir, tables)
    return workdir


def _write_summary(
    workdir: pathlib.Path, tables: dict[str, dict[tuple[str, ...], float]]
) -> None:
    """Writes mean, standard deviation and values of the APs that all seeds have.

    The standard deviation is the sample standard deviation with n - 1, and None for one
    seed. If there is no such AP, a warning is logged instead.

    Args:
        workdir: Folder of `seeds.json`, `seeds.txt`, `seeds.md` and `seeds.tex`.
        tables: APs by seed and by the values of `_KEYS`.
    """
    rows = list[JsonObject]()
    lines = []
    first, *others = tables.values()
    for key in (key for key in first if all(key in table for table in others)):
        values = {seed: table[key] for seed, table in tables.items()}
        aps = list(values.values())
        row: JsonObject = dict(zip(_KEYS, key, strict=True))
        row["mean"] = float(np.mean(aps))
        row["std"] = float(np.std(aps, ddof=1)) if others else None
        rows.append({**row, "values": values})
        if row["condition"] == "all":
            terms = f"{row['protocol']}, score>{float(row['score_threshold']):g}"
            line = row["cls"], terms, row["space"].upper(), row["iou"]
            mean = f"{number(row['mean'])} ± {number(row['std'])}"
            lines.append([*line, mean, *numbers(aps)])
    if not rows:
        _log.warning("no summary of %s: no class has objects in every seed", workdir)
        return
    title = f"AP, mean ± standard deviation over {len(tables)} seeds, all weathers"
    header = ["Class", "Protocol", "AP", "IoU", "Mean", *(f"Seed {x}" for x in tables)]
    table = Table(title, header, lines, "seeds")
    is_simulated = rows[0]["name"].endswith("/simulated")
    text = table.render(is_simulated=is_simulated)
    files.write_json(workdir / "seeds.json", rows)
    files.write_text(workdir / "seeds.txt", text)
    write_tables(workdir / "seeds", [table], is_simulated=is_simulated)
    _log.info("%s\nWritten to %s", text, workdir)
