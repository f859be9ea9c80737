"""A whole run: data, records, training, evaluation, and where everything is.

Work folder of a run:

    config.json      the configuration; a run never changes it
    run.json         where its data are, versions, command
    checkpoints/     newest two, by step
    metrics.jsonl    losses by step; tensorboard/ the same
    evaluation/      metrics.json, metrics.csv, tables, pictures of the last evaluation
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
import pathlib
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
from ml_collections import ConfigDict

import radejax
from radejax import camera_inputs, files, models
from radejax.data import pipeline, projection_job
from radejax.data.augment import Augmentation
from radejax.data.kradar import KRadar
from radejax.data.records import RecordSource
from radejax.errors import UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.training import loop, processes, sharding
from radejax.training.checkpoints import BEST, Checkpoints
from radejax.training.step import map_grid

_log = logging.getLogger(__name__)


PathLike = str | os.PathLike


@dataclasses.dataclass(frozen=True)
class DataPaths:
    """Where the data of a run are.

    Attributes:
        roots: K-Radar folders.
        labels: Folder or zip of a label revision, or None for the sequences' own.
        records: Folder of projected frames.
        embeddings: Folder of embedded images, or None for the images themselves.
        image_backbone: Weights of the image backbone, or None.
    """

    roots: tuple[str, ...]
    labels: str | None
    records: str
    embeddings: str | None = None
    image_backbone: str | None = None

    def open(self, config: ConfigDict, split: str | None) -> KRadar:
        """The frames of a split with the labels that the config asks for."""
        return KRadar(
            self.roots,
            self.labels,
            version=config.data.label_version,
            split=split,
            visibility=config.data.visibility,
            classes=config.classes,
        )


@dataclasses.dataclass(frozen=True)
class Run:
    """A run as its work folder keeps it.

    Attributes:
        workdir: Its folder.
        config: Its configuration.
        paths: Its data; None where the folder does not say.
        grid: Of the sensor.
        variables: Of the model, at `step`.
        step: Of the checkpoint.
    """

    workdir: pathlib.Path
    config: ConfigDict
    paths: DataPaths | None
    grid: RadarGrid
    variables: Mapping[str, Any]
    step: int


def config_name(filename: str) -> str:
    """Name of a run from its config: "configs/radenet.py:stem" gives "radenet-stem"."""
    path, _, words = filename.partition(":")
    return "-".join([pathlib.Path(path).stem, *filter(None, words.split(","))])


def run(
    config: ConfigDict,
    *,
    name: str,
    workdir: PathLike | None = None,
    data: Sequence[str] | None = None,
    labels: str | None = None,
    records: str | None = None,
    init_from: str | None = None,
    embeddings: str | None = None,
    image_backbone: str | None = None,
) -> pathlib.Path:
    """Everything from nothing to metrics; run again, it continues where it stopped.

    Args:
        config: Complete configuration; with `seeds` one run of each, see
            `seeds.run_seeds`.
        name: Of the config, for the default work folder.
        workdir: `runs/<name>` if None.
        data: K-Radar folders; None simulates them if the config says how.
        labels: Label revision, see `KRadar`.
        records: Folder of projected frames, beside the data if None.
        init_from: Weights to start from: official .pth file or another work folder.
        embeddings: Folder of `radejax embed`, in place of images.
        image_backbone: Weights of the image backbone, see `load_image_backbone`.

    Returns:
        The work folder.

    Raises:
        UserError: The work folder belongs to another configuration, no data, or no
            space.
    """
    if config.seeds:
        from radejax.seeds import run_seeds

        return run_seeds(
            config,
            name=name,
            workdir=workdir,
            data=data,
            labels=labels,
            records=records,
            init_from=init_from,
            embeddings=embeddings,
            image_backbone=image_backbone,
        )
    started = time.perf_counter()
    workdir = pathlib.Path(workdir or pathlib.Path("runs") / name).absolute()
    models.build(config.model)  # a config that cannot be built should fail first
    processes.main_first(lambda: claim_workdir(workdir, config))
    paths = dataclasses.replace(
        processes.main_first(
            lambda: prepare_data(config, data=data, labels=labels, records=records)
        ),
        embeddings=camera_inputs.saved_path(embeddings),
        image_backbone=camera_inputs.saved_path(image_backbone),
    )
    info = run_info(paths)
    if processes.is_main():
        files.write_json(workdir / "run.json", info)
    result = train(config, workdir, paths, info=info, init_from=init_from)
    if not result.finished:
        _log.info("stopped at step %d; run the same command to continue", result.step)
        return workdir
    from radejax.evaluate_run import evaluate_run  # drawing and tables: not to train

    evaluate_run(workdir)
    minutes = (time.perf_counter() - started) / 60
    _log.info(_CLOSING.format(minutes=minutes, workdir=_relative(workdir)))
    return workdir


_CLOSING = """Done in {minutes:.1f} minutes. Everything is in {workdir}:
  evaluation/      metrics.json, metrics.csv, tables, pictures
  checkpoints/     the trained model
  metrics.jsonl    losses by step (tensorboard --logdir {workdir})
Evaluate again:    python evaluate.py --workdir {workdir}
Boxes for a folder of frames:
                   radejax detect --workdir {workdir} --out boxes FOLDER"""


# Configuration -----------------------------------------------------------------------


def claim_workdir(workdir: pathlib.Path, config: ConfigDict) -> None:
    """Writes the configuration into a work folder, or checks that it is the same.

    Raises:
        UserError: The folder belongs to a run with another configuration; names the
            fields that differ.
    """
    path = workdir / "config.json"
    wanted = json.loads(config.to_json()) | {"profile": "", "seeds": []}
    if path.exists():
        found = files.read_json(path)
        if found | {"watch": None} != wanted | {"watch": None}:
            raise UserError(
                f"{_relative(workdir)} holds a run with another config: "
                + "; ".join(_differences(found, wanted))
                + ". Give another --workdir, or remove that one"
            )
        return
    workdir.mkdir(parents=True, exist_ok=True)
    files.write_json(path, wanted)


def load_config(workdir: pathlib.Path) -> ConfigDict:
    """Configuration of a run.

    Raises:
        FileNotFoundError: There is no run in that folder.
    """
    if not (workdir / "config.json").exists():
        raise FileNotFoundError(f"no run in {workdir}: config.json is missing")
    return ConfigDict(files.read_json(workdir / "config.json"), convert_dict=True)


def _differences(found: Any, wanted: Any, name: str = "config") -> list[str]:
    if isinstance(found, dict) and isinstance(wanted, dict):
        keys = sorted(set(found) | set(wanted))
        return [
            line
            for key in keys
            if found.get(key) != wanted.get(key)
            for line in _differences(found.get(key), wanted.get(key), f"{name}.{key}")
        ]
    return [f"{name} is {found!r} there and {wanted!r} here"]


def _relative(path: pathlib.Path) -> str:
    here = pathlib.Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


# Data --------------------------------------------------------------------------------


def prepare_data(
    config: ConfigDict,
    *,
    data: Sequence[str] | None,
    labels: str | None,
    records: str | None,
) -> DataPaths:
    """Simulates if there are no data, and projects what has no record yet.

    Raises:
        UserError: No data and nothing to simulate; no space left.
        FileNotFoundError: A folder that was named is not there.
    """
    simulation = config.get("simulation")
    if data is None and simulation is None:
        raise UserError(
            "no data: give --data ROOT[,ROOT...] with K-Radar's sequence folders, or a "
            "config that simulates them, such as configs/quickstart.py"
        )
    if simulation is not None:
        if data is None:
            digest = hashlib.sha256(simulation.to_json().encode()).hexdigest()[:8]
            data = [str(pathlib.Path("data") / f"simulated-{digest}")]
        if len(data) != 1:
            raise UserError(f"a simulated data set has one folder, got {list(data)}")
        from radejax.simulation.dataset import simulate_dataset

        simulate_dataset(simulation, data[0])
    roots = tuple(str(pathlib.Path(root).absolute()) for root in data)
    for root in roots:
        if not pathlib.Path(root).is_dir():
            raise FileNotFoundError(f"no such folder: {root}")
    records = str(
        pathlib.Path(records or pathlib.Path(roots[0]) / "records").absolute()
    )
    labels = labels and str(pathlib.Path(labels).absolute())
    paths = DataPaths(roots=roots, labels=labels, records=records)
    frames = paths.open(config, split=None)
    _log.info("%s", frames.summary().to_text())
    projection_job.project_dataset(frames, records)
    return paths


# Training ----------------------------------------------------------------------------


def train(
    config: ConfigDict,
    workdir: pathlib.Path,
    paths: DataPaths,
    *,
    info: Mapping[str, Any],
    init_from: str | None = None,
) -> loop.TrainResult:
    """Trains on the train split until the configured epochs are done."""
    records = RecordSource(paths.records)
    frames = paths.open(config, split="train")
    if not len(frames):
        raise UserError(f"no frames of the train split in {', '.join(paths.roots)}")
    sharding.check_batch_size(
        config.train.batch_size, sharding.make_mesh(), "train.batch_size"
    )
    loader = pipeline.make_loader(
        records,
        frames,
        batch_size=config.train.batch_size // jax.process_count(),
        max_objects=config.data.max_objects,
        classes=config.classes,
        seed=config.seed,
        augment=make_augmentation(config.data, records.grid),
        num_threads=config.data.num_threads,
        num_workers=config.data.num_workers,
        label_permutation_seed=config.data.label_permutation_seed,
        **camera_inputs.loader_arguments(config, frames, paths.embeddings),
    )
    evaluate = None
    if config.train.evaluate_every_epochs:
        from radejax.validation import Validation  # above: it reads whole runs

        evaluate = Validation(config, paths)
    model, variables = models.build(config.model), None
    if init_from is not None:
        variables = initial_variables(init_from, config)
    pretrained = None
    if paths.embeddings is None and not _has_backbone(variables):
        pretrained = camera_inputs.load_image_backbone(paths.image_backbone, config)
    return loop.train(
        model,
        variables,
        loader,
        map_grid(records.grid, model, config.data.azimuth_mapping),
        workdir,
        config=config,
        info={
            "config": json.loads(config.to_json()),
            "grid": records.grid.to_dict(),
            "run": dict(info),
        },
        steps_per_epoch=pipeline.steps_per_epoch(
            len(frames),
            config.train.batch_size // jax.process_count(),
            process_count=jax.process_count(),
        ),
        pretrained=pretrained,
        evaluate=evaluate,
        trace_folder=config.profile,
        frame_names=[frame.key for frame in frames],
    )


def _has_backbone(variables: Mapping[str, Any] | None) -> bool:
    return variables is not None and IMAGE_BACKBONE in variables["params"]


def make_augmentation(data: ConfigDict, grid: RadarGrid) -> Augmentation | None:
    """Random changes of training frames as `config.data` says; None for none."""
    augmentation = Augmentation(
        grid=grid,
        mirror_probability=data.mirror_probability,
        gain_db=data.gain_db,
        gain_slope_db=data.gain_slope_db,
    )
    is_on = data.mirror_probability or data.gain_db or data.gain_slope_db
    return augmentation if is_on else None


def initial_variables(path: str, config: ConfigDict) -> Mapping[str, Any]:
    """Weights to start from: an official .pth file, or another run's newest.

    Raises:
        UserError: They do not fit the configured model; names what differs.
    """
    if pathlib.Path(path).is_dir():
        other = load_run(path)
        if other.config.model != config.model:
            found, wanted = other.config.model.to_dict(), config.model.to_dict()
            raise UserError(
                f"weights of {path} do not fit: "
                + "; ".join(_differences(found, wanted, "config.model"))
            )
        return other.variables
    if camera_inputs.has_camera(config):
        from radejax.interop import dinorade_torch

        _, variables = dinorade_torch.load(path)
        camera_inputs.check_fits(models.build(config.model), variables, path)
        return variables
    from radejax.interop import radenet_torch

    _, variables = radenet_torch.load(path, **_structure(config.model))
    return variables


def _structure(model: ConfigDict) -> dict[str, Any]:
    """Fields that a state dict must agree with when a model is configured already."""
    return {key: value for key, value in model.items() if key not in ("name",)}


def run_info(paths: DataPaths) -> dict[str, Any]:
    """Where and with what a run was made; plain values."""
    return {
        "data": dataclasses.asdict(paths),
        "versions": {
            "radejax": radejax.__version__,
            "jax": jax.__version__,
            "python": sys.version.split()[0],
        },
        "device": str(jax.devices()[0].device_kind),
        "command": shlex.join(sys.argv),
    }


def load_run(
    workdir: PathLike,
    step: int | str | None = None,
    image_backbone: PathLike | None = None,
) -> Run:
    """The model of a work folder.

    A run that trained from embeddings, or whose backbone weights are not where they
    were, is loaded without its image backbone, for embedded images alone.

    Args:
        workdir: Of `train.py`.
        step: Of the checkpoint, or "best" by `train.best_metric`; the newest if None.
        image_backbone: Weights of a frozen backbone, in place of those that the run
            was trained with.

    Raises:
        FileNotFoundError: No run there, or no such checkpoint.
    """
    workdir = pathlib.Path(workdir).absolute()
    config = load_config(workdir)
    if not (workdir / "checkpoints").is_dir():
        raise FileNotFoundError(
            f"no checkpoints in {workdir}: the run has not trained yet"
        )
    folder = workdir / "checkpoints"
    with Checkpoints(folder, best_metric=BEST, read_only=True) as checkpoints:
        if step == "best":
            step = checkpoints.best_step()
        state, info, step = checkpoints.restore_variables(step)
    params = state["ema_params"] if state.get("ema_params") else state["params"]
    data = info["run"]["data"]
    paths = DataPaths(**{**data, "roots": tuple(data["roots"])})
    variables = {"params": params, **(state.get("model_state") or {})}
    image_backbone = image_backbone or paths.image_backbone
    if image_backbone and camera_inputs.missing_backbone(params, config):
        part = camera_inputs.load_image_backbone(image_backbone, config)
        frozen = {IMAGE_BACKBONE: part["params"][IMAGE_BACKBONE]}
        variables["params"] = {**params, **frozen}
    return Run(
        workdir=workdir,
        config=config,
        paths=paths,
        grid=RadarGrid.from_dict(info["grid"]),
        variables=variables,
        step=step,
    )
