"""The folder of a run: what it says of configuration and data, and the model in it.

config.json      the configuration; a run never changes it
run.json         where its data are, versions, command
checkpoints/     newest, best and last, by step
metrics.jsonl    losses by step; tensorboard/ the same
evaluation/      metrics.json, metrics.csv, tables, pictures of the last evaluation;
                 evaluation_<name>/ of one on other data, source.json says on what
lock             held by the training under way
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import pathlib
import shlex
import sys
from collections.abc import Mapping
from typing import Any

import jax
from ml_collections import ConfigDict

import radejax
from radejax import models
from radejax.core import files
from radejax.geometry.radar_grid import RadarGrid
from radejax.interop import image_backbone as camera_inputs
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.runs.data import DataPaths, saved_path
from radejax.training.checkpoints import Checkpoints

_log = logging.getLogger(__name__)

PathLike = str | os.PathLike


@dataclasses.dataclass(frozen=True)
class Run:
    """A run as its work folder keeps it.

    Attributes:
        workdir: Its folder.
        config: Its configuration.
        paths: Its data; None of a run on frames that were never written.
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


def lock_workdir(workdir: pathlib.Path) -> contextlib.AbstractContextManager[None]:
    """Keeps a second training out of a work folder, which is made if missing.

    The system releases the lock however the process ends.

    Raises:
        UserError: Another process holds it.
    """
    return files.lock(
        workdir / "lock",
        f"another training is at work in {files.relative(workdir)}: wait for its end, "
        "or give another --workdir",
    )


def claim_workdir(workdir: pathlib.Path, config: ConfigDict) -> None:
    """Writes the configuration into a work folder, or checks that it is the same.

    Raises:
        UserError: The folder belongs to a run with another configuration; names the
            fields that differ.
    """
    files.claim(
        workdir / "config.json",
        json.loads(config.to_json()) | {"profile": "", "seeds": []},
        "a run with another config",
        mend="give another --workdir, or remove that one",
        name="config",
        ignore=("watch",),
    )


def load_config(workdir: PathLike) -> ConfigDict:
    """Configuration of a run.

    Raises:
        FileNotFoundError: There is no run in that folder.
    """
    workdir = pathlib.Path(workdir)
    if not (workdir / "config.json").exists():
        raise FileNotFoundError(f"no run in {workdir}: config.json is missing")
    return ConfigDict(files.read_json(workdir / "config.json"), convert_dict=True)


def run_info(
    workdir: pathlib.Path, paths: DataPaths, init_from: PathLike | None = None
) -> dict[str, Any]:
    """Where and with what a run was made; plain values.

    A run that continues keeps the weights that it started from.
    """
    init_from = saved_path(init_from)
    if init_from is None and (workdir / "run.json").exists():
        init_from = files.read_json(workdir / "run.json").get("init_from")
    return {
        "data": dataclasses.asdict(paths),
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
    """What every checkpoint of a run carries, plain values; `load_run` reads it.

    Args:
        config: Of the run.
        grid: Of the sensor.
        run: See `run_info`.
        same: What a run that continues must not change, by name.
    """
    return {
        "config": json.loads(config.to_json()),
        "grid": grid.to_dict(),
        "run": dict(run),
        "same": dict(same),
    }


def load_run(
    workdir: PathLike,
    step: int | str | None = None,
    image_backbone: PathLike | None = None,
) -> Run:
    """The model of a work folder.

    A frozen image backbone is in no checkpoint: it comes from the file that the run was
    trained with. A run that trained from embeddings, or whose backbone weights are not
    where they were, is loaded without, for embedded images alone.

    Args:
        workdir: Of `train.py`.
        step: Of the checkpoint, or "best" by `train.best_metric`; the newest if None.
        image_backbone: Weights of a frozen backbone, in place of those that the run
            was trained with.

    Raises:
        FileNotFoundError: No run there, or no such checkpoint.
        UserError: The backbone given is not the one that the embeddings are from.
    """
    workdir = pathlib.Path(workdir).absolute()
    config = load_config(workdir)
    if not (workdir / "checkpoints").is_dir():
        raise FileNotFoundError(
            f"no checkpoints in {workdir}: the run has not trained yet"
        )
    folder = workdir / "checkpoints"
    with Checkpoints(folder, read_only=True) as checkpoints:
        if step == "best":
            step = checkpoints.best_step()
        state, info, step = checkpoints.restore_variables(step)
    params = state["ema_params"] if state.get("ema_params") else state["params"]
    data, paths = info["run"].get("data"), None
    if data is not None:
        paths = DataPaths(**{**data, "roots": tuple(data["roots"])})
    if camera_inputs.missing_backbone(params, config):
        backbone = _frozen_backbone(config, info["run"], paths, image_backbone)
        params = {**params, **backbone}
    return Run(
        workdir=workdir,
        config=config,
        paths=paths,
        grid=RadarGrid.from_dict(info["grid"]),
        variables={"params": params, **(state.get("model_state") or {})},
        step=step,
    )


def _frozen_backbone(
    config: ConfigDict,
    info: Mapping[str, Any],
    paths: DataPaths,
    given: PathLike | None,
) -> dict[str, Any]:
    """`{"image_backbone": parameters}` of a run, empty where they are not at hand."""
    source = given or paths.image_backbone
    start = info.get("init_from")
    if given is None and source is not None and not pathlib.Path(source).exists():
        _log.warning("image backbone %s is gone: embedded images only", source)
        source = None
    if source is not None:
        part = camera_inputs.load_image_backbone(source, config)
    elif start is not None and pathlib.Path(start).exists() and not paths.embeddings:
        part = initial_variables(start, config)
    else:
        return {}
    params = part["params"].get(IMAGE_BACKBONE)
    if params is None:
        return {}
    if paths.embeddings is not None and pathlib.Path(paths.embeddings).exists():
        camera_inputs.check_same_backbone(params, paths.embeddings, source)
    return {IMAGE_BACKBONE: params}


def initial_variables(path: PathLike, config: ConfigDict) -> Mapping[str, Any]:
    """Weights to start from: an official .pth file, or another run's newest.

    Raises:
        UserError: They do not fit the configured model; names what differs.
    """
    if pathlib.Path(path).is_dir():
        other = load_run(path)
        found, wanted = (json.loads(c.model.to_json()) for c in (other.config, config))
        what, mend = f"weights of {path} do not fit", "give others"
        files.require_same(found, wanted, what, mend=mend, name="config.model")
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
