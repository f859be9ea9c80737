"""`radejax simulate`: a data set in K-Radar's folders and file formats."""

from __future__ import annotations

import pathlib

import click

from radejax.cli import entry, options
from radejax.core.errors import UserError


@click.command(cls=options.Command)
@click.option("--config", help="With a `simulation` section; small by default.")
@click.option(
    "--out", required=True, type=options.FOLDER, help="Root of the new data set."
)
@click.option("--seed", type=click.IntRange(0), help="Instead of the config's.")
@click.option("--scenes", help='"procedural", or a label folder or zip of K-Radar.')
@click.option("--sequences", help="Of the labels, such as 1,5,58; all by default.")
@click.option(
    "--frames", type=click.IntRange(0), help="A sequence; 0 for all of the labels."
)
@click.option("--full-size", is_flag=True, help="K-Radar's own grid and 2560 x 720.")
@click.option("--projections", is_flag=True, help="Write no tesseracts (260 MB each).")
@click.option(
    "--workers",
    "num_workers",
    type=options.COUNT,
    help="Processes; one per core by default.",
)
def simulate(
    config: str | None,
    out: pathlib.Path,
    seed: int | None,
    scenes: str | None,
    sequences: str | None,
    frames: int | None,
    full_size: bool,
    projections: bool,
    num_workers: int | None,
    as_json: bool,
) -> None:
    """Simulate a data set in K-Radar's folders and file formats.

    Run again after an interruption, it goes on where it stopped. The same options give
    the same bytes, whatever the number of processes.

    Example: radejax simulate --scenes labels_v2_1.zip --sequences 5,11 --out data/sim
    """
    from radejax.core.config import load_config
    from radejax.simulation.config import FULL_SIZE, default_config, plain
    from radejax.simulation.dataset import simulate_dataset

    entry.set_up_jax()
    simulation = default_config()
    if config is not None:
        section = load_config(config).get("simulation")
        if section is None:
            raise UserError(f"{config} has no `simulation` section")
        simulation = plain(section)
    given = {"seed": seed, "scenes": scenes, "frames_per_sequence": frames}
    simulation |= {name: value for name, value in given.items() if value is not None}
    if full_size:
        simulation |= FULL_SIZE
    if projections:
        simulation["output"] = "projection"
    if sequences is not None:
        try:
            simulation["sequences"] = [int(number) for number in sequences.split(",")]
        except ValueError:
            raise UserError(f"--sequences {sequences!r}, expected 1,5,58") from None
    simulate_dataset(simulation, out, num_workers=num_workers)
    options.echo_result(as_json, {"root": str(out)}, f"simulated data set in {out}")
