"""Table of the runs in a folder: length, AP, and the config fields in which they differ."""

from __future__ import annotations

import pathlib

import numpy as np
from flax.traverse_util import flatten_dict

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import JsonObject, PathLike
from radejax.core.manifest import read_checked
from radejax.evaluation.report import Table, number
from radejax.visualize.curves import read_metrics

_MAX_TEXT = 40
"""Largest number of characters of a value in the table."""


def list_runs(folder: PathLike) -> list[JsonObject]:
    """Returns the runs in a folder and its subfolders in the order of their names.

    Args:
        folder: Folder that contains workdirs, or one of them.

    Returns:
        One dictionary per run: its folder "run"; "step", the last one that was logged;
        "minutes" of its training; the metric that `train.best_metric` names in the report
        of the run, "ap", with its full name "metric" and its "split"; and "fields", the
        values of the config fields in which the runs differ. Unknown values are None.

    Raises:
        UserError: There is no run in the folder.
        DataError: A file of a run is corrupted.
    """
    folder = files.as_path(folder)
    found = [path.parent for path in files.find_files(folder, "run.json")]
    runs = sorted(run for run in found if (run / "config.json").is_file())
    if not runs:
        raise UserError(
            f"no run in {folder}: expected a folder with workdirs of `radejax train`"
        )
    configs = [_config_of(run) for run in runs]
    names = list(dict.fromkeys(name for config in configs for name in config))
    differing = [
        name
        for name in names
        if any(x.get(name) != configs[0].get(name) for x in configs)
    ]
    rows = []
    for run, config in zip(runs, configs, strict=True):
        row: JsonObject = {"run": str(run.relative_to(folder)), **_progress(run)}
        fields = {name: config[name] for name in differing if name in config}
        rows.append({**row, **_score(run, config), "fields": fields})
    return rows


def table_of_runs(rows: list[JsonObject]) -> str:
    """Returns the result of `list_runs` as a table."""
    metrics = sorted({(row["metric"], row["split"]) for row in rows if row["metric"]})
    title = "; ".join(f"AP: {metric}, {split} split" for metric, split in metrics)
    body = []
    for row in rows:
        shown = {name: str(value) for name, value in row["fields"].items()}
        fields = ", ".join(
            f"{name}={x if len(x) <= _MAX_TEXT else x[: _MAX_TEXT - 3] + '...'}"
            for name, x in shown.items()
        )
        step = "-" if row["step"] is None else row["step"]
        metric = [row["metric"] or "-"] if len(metrics) > 1 else []
        scores = [number(row["ap"]), *metric, number(row["minutes"], digits=1), step]
        body.append([row["run"], fields, *scores])
    metric = ["Metric"] if len(metrics) > 1 else []
    header = ["Run", "Fields that differ", "AP", *metric, "Minutes", "Step"]
    return Table(title or "no run is evaluated", header, body).render()


def _config_of(run: pathlib.Path) -> JsonObject:
    """Returns the fields of a run's config, and the weights that it started from."""
    started = files.read_object(run / "run.json")
    start = {name: started.get(name) for name in ("init_from", "init_partial")}
    config = files.read_object(run / "config.json")
    return {**flatten_dict(config, sep="."), **start}


def _progress(run: pathlib.Path) -> JsonObject:
    """Returns the last step of a run and the minutes of all starts of its training."""
    path = run / "metrics.jsonl"
    series = read_metrics(path) if path.is_file() else {}
    if "minutes" not in series:
        return {"step": None, "minutes": None}
    steps, minutes = series["minutes"]
    gained = np.diff(minutes, prepend=0.0)
    # A run that was continued counts from zero again.
    total = np.where(gained < 0, minutes, gained).sum()
    return {"step": int(steps[-1]), "minutes": float(total)}


def _score(run: pathlib.Path, config: JsonObject) -> JsonObject:
    """Returns the AP of the report of a run, with its metric and split."""
    path = run / "evaluation" / "metrics.json"
    if path.is_file():
        metrics = read_checked(path, "ap", "options", "split")
        protocol = metrics["options"]["protocols"][0]
        start = f"{config['train.best_metric']}/{protocol}/"
        for row in metrics["ap"]:
            name = "m" + row["name"].removeprefix("mean/all/")
            if name.startswith(start):
                return {"ap": row["ap"], "metric": name, "split": metrics["split"]}
    return {"ap": None, "metric": None, "split": None}
