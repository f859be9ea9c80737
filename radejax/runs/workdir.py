"""The folder of a run, and what is where in it.

config.json      the configuration; from its first checkpoint a run never changes it
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
import pathlib
import shlex
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import jax
from ml_collections import ConfigDict

import radejax
from radejax.core import files
from radejax.core.files import PathLike
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs.sources import DataPaths, saved_path
from radejax.training import distributed


def default_workdir(workdir: PathLike | None, name: str) -> pathlib.Path:
    """Absolute path of the work folder: `runs/<name>` unless another is given."""
    return pathlib.Path(workdir or pathlib.Path("runs") / name).absolute()


@contextlib.contextmanager
def claimed(workdir: pathlib.Path, config: ConfigDict) -> Iterator[None]:
    """Keeps a second training out of a work folder, which is made if missing.

    A folder without a checkpoint takes the config that is given.

    Raises:
        UserError: Another process holds it, or it belongs to a run with another
            configuration; names the fields that differ.
    """
    with contextlib.ExitStack() as held:
        distributed.main_only(
            lambda: held.enter_context(
                files.lock(
                    workdir / "lock",
                    f"another training is at work in {files.relative(workdir)}: wait "
                    "for its end, or give another --workdir",
                )
            )
        )
        distributed.main_first(lambda: _claim(workdir, config))
        yield


def _claim(workdir: pathlib.Path, config: ConfigDict) -> None:
    """Keeps the config; compares it with that of the run, if there are checkpoints."""
    path = workdir / "config.json"
    if distributed.is_main() and not any(workdir.glob("checkpoints/*")):
        path.unlink(missing_ok=True)
    files.claim(
        path,
        json.loads(config.to_json()),
        "a run with another config",
        mend="give another --workdir, or remove that one",
        name="config",
        ignore=("logging",),
    )


def run_info(
    workdir: pathlib.Path, paths: DataPaths, init_from: PathLike | None = None
) -> dict[str, Any]:
    """Where and with what a run was made; plain values.

    A run that continues keeps the weights that it started from.
    """
    init_from = saved_path(init_from)
    if init_from is None and (workdir / "run.json").exists():
        saved = files.read_json(workdir / "run.json", {"init_from?": str | None})
        init_from = saved.get("init_from")
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
    """What every checkpoint of a run carries, plain values; `inference.open` reads it.

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
