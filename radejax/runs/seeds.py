"""The same run with several seeds, and how much its metrics spread."""

from __future__ import annotations

import csv
import io
import logging
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from ml_collections import ConfigDict
from tabulate import tabulate

from radejax.core import files
from radejax.core.errors import DataError, require
from radejax.runs.experiment import run
from radejax.runs.workdir import PathLike, default_workdir
from radejax.training import distributed

_log = logging.getLogger(__name__)

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
    simulated data set has a seed of its own. Called again, finished seeds are evaluated
    again and the others continue.

    Args:
        config: Of the runs.
        seeds: Two or more, all different.
        name: Of the config, for the default work folder.
        workdir: Holds `seed0`, `seed1`, ... and the summary; `runs/<name>` if None.
        **options: Further arguments of `experiment.run`.

    Returns:
        The work folder. `seeds.json` and `seeds.txt` in it tell mean and spread, of the
        seeds that are done where a signal stopped the rest.

    Raises:
        UserError: Two seeds are equal; and as `experiment.run`.
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
            _log.info(
                "seed %d has no evaluation: it is not finished (run the same command to "
                "go on), or there are no test frames",
                seed,
            )
            break
        tables[seed] = read_aps(folder / "evaluation" / "metrics.csv")
    if tables and distributed.is_main():
        rows = summarize(tables)
        files.write_json(workdir / "seeds.json", rows)
        files.write_text(workdir / "seeds.txt", to_text(rows, list(tables)))
        _log.info("%s\nWritten to %s", to_text(rows, list(tables)), workdir)
    return workdir


def read_aps(path: pathlib.Path) -> dict[tuple[str, ...], float]:
    """APs of a report's metrics.csv by protocol, condition, class, space and IoU."""
    try:
        rows = list(csv.DictReader(io.StringIO(files.read_text(path), newline="")))
        return {
            tuple(row[key] for key in _KEYS): float(row["ap"] or "nan")
            for row in rows
            if float(row["num_gt"])
        }
    except (KeyError, ValueError, TypeError, csv.Error) as error:
        raise DataError(f"{path}: no metrics of a report ({error!r:.200})") from None


def summarize(tables: dict[int, dict[tuple[str, ...], float]]) -> list[dict[str, Any]]:
    """Mean, standard deviation and values of every AP that all seeds have.

    Args:
        tables: By seed, as `read_aps` returns them.

    Returns:
        One dictionary an AP: protocol, condition, cls, space, iou, mean, std (of a
        sample, n - 1; None for one seed) and values by seed.
    """
    common = [
        k for k in next(iter(tables.values())) if all(k in t for t in tables.values())
    ]
    rows = []
    for key in common:
        values = [table[key] for table in tables.values()]
        rows.append(
            {
                **dict(zip(_KEYS, key, strict=True)),
                "mean": float(np.mean(values)),
                "std": float(np.std(values, ddof=1)) if len(values) > 1 else None,
                "values": dict(zip(map(str, tables), values, strict=True)),
            }
        )
    return rows


def to_text(rows: Sequence[dict[str, Any]], seeds: Sequence[int]) -> str:
    """A table of the rows over all frames."""
    lines = [
        [row["protocol"], row["cls"], row["space"], row["iou"]]
        + [f"{row['mean']:.2f}", "-" if row["std"] is None else f"{row['std']:.2f}"]
        + [f"{row['values'][str(seed)]:.2f}" for seed in seeds]
        for row in rows
        if row["condition"] == "all"
    ]
    head = ["protocol", "class", "space", "IoU", "mean AP", "std"]
    return tabulate(
        lines, [*head, *(f"seed {s}" for s in seeds)], disable_numparse=True
    )
