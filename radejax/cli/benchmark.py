"""`radejax benchmark`: time from radar to boxes on this machine."""

from __future__ import annotations

import pathlib

import click

from radejax.cli import entry, options
from radejax.core.errors import UserError


@click.command(cls=options.Command)
@click.argument("source", type=options.EXISTING, required=False)
@click.option("--config", help="Untrained model of a config instead of SOURCE.")
@click.option("--batch-size", "batches", multiple=True, type=options.COUNT)
@click.option(
    "--input",
    "kind",
    type=click.Choice(["tesseract", "projection"]),
    default="tesseract",
    show_default=True,
)
@click.option("--repeats", type=options.COUNT, default=5, show_default=True)
@click.option("--dtype", type=click.Choice(["float32", "bfloat16"]))
def benchmark(
    source: pathlib.Path | None,
    config: str | None,
    batches: tuple[int, ...],
    kind: str,
    repeats: int,
    dtype: str | None,
    as_json: bool,
) -> None:
    """Time from radar to boxes on this machine: stages, and backbone, neck and heads.

    SOURCE as for `radejax export`. Batch sizes 1 and 10 unless given.

    Example: radejax benchmark runs/quickstart --batch-size 1
    """
    if (source is None) == (config is None):
        raise UserError("give one of SOURCE and --config")
    from radejax.core.config import load_config
    from radejax.inference import benchmark as timing
    from radejax.inference.detector import Detector
    from radejax.inference.open import load

    entry.set_up_jax()
    detector = (
        Detector.from_loaded(load(source), dtype=dtype)
        if source is not None
        else timing.untrained(dict(load_config(str(config))), dtype=dtype)
    )
    rows = timing.measure(
        detector, batches or (1, 10), repeats=repeats, tesseract=kind == "tesseract"
    )
    options.echo_result(as_json, rows, timing.as_table(rows))
