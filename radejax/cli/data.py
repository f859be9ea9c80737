"""`radejax data check`: a copy of K-Radar, looked at."""

from __future__ import annotations

import pathlib
from typing import Any

import click

from radejax.cli import entry, options


@click.group()
def data() -> None:
    """Look at a copy of K-Radar."""


@data.command(cls=options.Command)
@options.roots
@options.labels
@options.label_version
@options.sequences
@options.weather
@click.option("--deep", is_flag=True, help="Read every tesseract whole.")
def check(
    roots: tuple[pathlib.Path, ...],
    labels: pathlib.Path | None,
    label_version: str,
    deep: bool,
    as_json: bool,
    **part: Any,
) -> None:
    """Report what is there, what is missing and what is damaged.

    Exit code 1 if anything is missing or damaged.

    Example: radejax data check /disk1/kradar /disk2/kradar
    """
    from radejax.data.kradar.check import check_dataset

    report = check_dataset(
        roots,
        labels=labels,
        version=label_version,
        deep=deep,
        progress=not as_json,
        **part,
    )
    options.echo_result(as_json, report.to_dict(), report.to_text())
    if report.num_problems:
        raise SystemExit(entry.FAILED)
