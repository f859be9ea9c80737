"""Trains RADE-Net on frames that are simulated as they are needed.

    python examples/online_training.py --config configs/quickstart.py \\
        --workdir runs/online --sequences 1000

The same command continues after an interruption. Then, for a look at the result:

    radejax detect --model runs/online/checkpoints --out boxes data/sim
"""

import pathlib

import click

from radejax.cli import entry
from radejax.core.config import load_config
from radejax.online_training import train_online


@click.command()
@click.option("--config", required=True, help="With a `simulation` section.")
@click.option("--workdir", required=True, type=click.Path(path_type=pathlib.Path))
@click.option("--sequences", type=click.IntRange(1), default=1000, show_default=True)
@click.option("--epochs", type=click.IntRange(1), help="Instead of the config's.")
def main(config, workdir, sequences, epochs):
    """Trains on sequences that are never written."""
    entry.set_up_jax()
    with entry.exit_codes():
        settings = load_config(config)
        if epochs is not None:
            settings.train.num_epochs = epochs
        result = train_online(settings, workdir, num_sequences=sequences)
        click.echo(f"{result.step} steps; checkpoints in {workdir / 'checkpoints'}")


if __name__ == "__main__":
    main()
