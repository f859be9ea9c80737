"""`radejax preprocess`: radar tensors of K-Radar to records of projections."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

import click

from radejax.cli import entry, options


class _Shard(click.ParamType):
    """Part i of n, i from 0."""

    name = "I/N"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """The two numbers; click's error for anything else."""
        index, _, count = value.partition("/")
        if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
            self.fail(f"{value!r}, expected i/n with i from 0 to n - 1", param, ctx)
        return int(index), int(count)


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
    help="Default: that of the records in the folder, else float16.",
)
@click.option(
    "--workers",
    "num_workers",
    type=options.COUNT,
    help="Number of processes. Default: one per core.",
)
@click.option(
    "--shard",
    type=_Shard(),
    default="0/1",
    show_default=True,
    help="Every N-th frame from the I-th on, for several machines.",
)
def preprocess(
    roots: tuple[pathlib.Path, ...],
    out: pathlib.Path,
    labels: pathlib.Path | None,
    label_version: str,
    sequence_numbers: tuple[int, ...] | None,
    weather: tuple[str, ...] | None,
    as_json: bool,
    **settings: Any,
) -> None:
    """Project radar tensors to records of range-azimuth maps.

    Run again, it preprocesses only frames without a record. Frames whose radar tensor is
    missing or corrupted are skipped and listed, with exit code 1.

    Example: radejax preprocess /disk1/kradar --out /fast/records --shard 3/16
    """
    from radejax.data import records
    from radejax.data.kradar import KRadar

    frames = KRadar(
        roots,
        labels,
        version=label_version,
        sequence_numbers=sequence_numbers,
        weather=weather,
    )
    click.echo(frames.summary().to_text(), err=True)
    report = records.preprocess(frames, out, **settings)
    options.echo_result(as_json, dataclasses.asdict(report), report.to_text())
    if report.skipped:
        raise SystemExit(entry.FAILED)
