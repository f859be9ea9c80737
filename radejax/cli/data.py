"""`radejax data check` and `radejax project`: a copy of K-Radar, looked at and projected."""

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


@click.command(cls=options.Command)
@options.roots
@click.option(
    "--out", required=True, type=options.FOLDER, help="Folder of the records."
)
@options.labels
@options.label_version
@options.sequences
@options.weather
@click.option(
    "--dtype",
    type=click.Choice(["float16", "uint8", "float32"]),
    help="Of records that are there already, else float16.",
)
@click.option(
    "--compress/--no-compress",
    default=None,
    help="A third of the bytes, slower to read; as what is there, else not.",
)
@click.option(
    "--workers",
    "num_workers",
    type=options.COUNT,
    help="Processes; one per core by default.",
)
@click.option(
    "--shard", default="0/1", show_default=True, help="Part i of n, i from 0."
)
@click.option("--skip-bad", is_flag=True, help="Leave out what is corrupt.")
def project(
    roots: tuple[pathlib.Path, ...],
    out: pathlib.Path,
    labels: pathlib.Path | None,
    label_version: str,
    sequence_numbers: tuple[int, ...] | None,
    weather: tuple[str, ...] | None,
    shard: str,
    as_json: bool,
    **settings: Any,
) -> None:
    """Project tesseracts to range-azimuth records; resumes where it stopped.

    Example: radejax project /disk1/kradar --out /fast/records --shard 3/16
    """
    from radejax.data.kradar import KRadar
    from radejax.data.records.job import parse_shard, project_dataset

    parse_shard(shard)  # before the labels are read
    frames = KRadar(
        roots,
        labels,
        version=label_version,
        sequence_numbers=sequence_numbers,
        weather=weather,
    )
    click.echo(frames.summary().to_text(), err=True)
    summary = project_dataset(frames, out, shard=shard, **settings)
    options.echo_result(as_json, summary.to_dict(), summary.to_text())
