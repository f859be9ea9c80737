"""Trains RADE-Net on frames that are simulated when they are needed, without a dataset on disk.

    python examples/online_training.py --config configs/quickstart.py \\
        --workdir runs/online --sequences 1000

Every step samples frames of many procedural scenes and simulates them with new noise. The same
command resumes after an interruption. To detect objects with the result:

    radejax detect --model runs/online/checkpoints --out boxes data/sim
"""

from __future__ import annotations

import logging
import os
import pathlib

import click
import jax
from online_batches import OnlineBatches

from radejax import models
from radejax.cli import entry
from radejax.config import Config, load_config
from radejax.core import devices
from radejax.core.errors import UserError
from radejax.core.structures import CLASSES
from radejax.models.options import DinoRadeOptions
from radejax.runs.experiment import TrainingData, checkpoint_info, claimed, fit
from radejax.training.step import TrainState

SEED_OFFSET = 2_000_003
"""Offset added to the seed of the scenes, so that a dataset of the same config is held out."""

_log = logging.getLogger(__name__)


def train_online(
    config: Config, workdir: str | os.PathLike, *, num_sequences: int = 1000
) -> TrainState:
    """Trains a radar model on simulated frames, or resumes the run in the workdir.

    An epoch has as many frames as all sequences together, rounded down to whole batches. Frames
    are sampled with replacement, have new noise every time and are not augmented.

    Args:
        config: Config with a `simulation` section that describes the sensor and the number of
            frames per sequence. Its dataset is not used.
        workdir: Workdir of the run, with `config.json`, `checkpoints/` and `metrics.jsonl`.
        num_sequences: Number of procedural sequences.

    Returns:
        The state after the last step, which is an earlier one if a signal ended the training.

    Raises:
        UserError: The config has no `simulation` section, a camera model, other classes or real
            scenes; there are several processes; or the workdir is in use or belongs to a run with
            another config.
    """
    simulation = config.simulation
    if simulation is None:
        raise UserError("online training: the config has no `simulation` section")
    for is_wrong, text in (
        (simulation.scenes != "procedural", "scenes must be procedural"),
        (isinstance(config.model, DinoRadeOptions), "the model has a camera"),
        (config.classes != CLASSES, f"classes must be {CLASSES}"),
        (jax.process_count() > 1, "one process only"),
    ):
        if is_wrong:
            raise UserError(f"online training: {text}")
    simulation = simulation.replace(
        train_sequences=num_sequences,
        test_sequences=0,
        seed=simulation.seed + SEED_OFFSET,
    )
    batch_size = config.train.batch_size
    mesh = devices.make_mesh()
    devices.check_batch_size(batch_size, mesh)
    workdir = pathlib.Path(workdir).absolute()
    with claimed(workdir, config):
        batches = OnlineBatches(
            simulation,
            batch_size=batch_size,
            max_objects=config.data.max_objects,
            seed=config.seed,
            num_threads=config.data.num_threads,
        )
        _log.info(
            "%d frames to sample from, simulated when needed", len(batches.frame_names)
        )
        model = models.build(config.model)
        data = TrainingData(
            batches=batches.loader(),
            steps_per_epoch=max(len(batches.frame_names) // batch_size, 1),
            grid=models.map_grid(batches.grid, model, config.data.azimuth_mapping),
            info=checkpoint_info(
                config,
                batches.grid,
                {"online_sequences": num_sequences},
                {"number of sequences": num_sequences},
            ),
        )
        state, _ = fit(config, model, data, workdir, mesh)
    return state


@click.command()
@click.option("--config", required=True, help="Config with a `simulation` section.")
@click.option("--workdir", required=True, type=click.Path(path_type=pathlib.Path))
@click.option("--sequences", type=click.IntRange(1), default=1000, show_default=True)
@click.option(
    "--epochs",
    type=click.IntRange(1),
    help="Number of epochs. Default: that of the config.",
)
def main(config, workdir, sequences, epochs):
    """Train on procedural sequences that are not written to disk."""
    entry.set_up_jax()
    with entry.exit_codes():
        settings = load_config(config)
        if epochs is not None:
            settings = settings.replace(train={"num_epochs": epochs})
        state = train_online(settings, workdir, num_sequences=sequences)
        click.echo(f"{state.step} steps; checkpoints in {workdir / 'checkpoints'}")


if __name__ == "__main__":
    main()
