"""Training on frames that are simulated as they are needed: no data set, no disk.

Every step sees new frames of procedural scenes, so that there is nothing to overfit
but the simulator itself. A checkpoint is read by `Detector.from_checkpoint`.
"""

from __future__ import annotations

import logging
import os
import pathlib
from typing import Any

import jax
from ml_collections import ConfigDict

from radejax import models
from radejax.core.errors import UserError
from radejax.core.structures import CLASSES
from radejax.interop import image_backbone
from radejax.runs.workdir import checkpoint_info, claim_workdir, lock_workdir
from radejax.simulation.config import plain
from radejax.simulation.online import OnlineBatches
from radejax.training import loop, sharding
from radejax.training.start import Plan
from radejax.training.step import map_grid

SEED_OFFSET = 1_000_003
"""Added to the seed of scenes: those of a data set of the same config stay unseen."""

_log = logging.getLogger(__name__)


def train_online(
    config: ConfigDict,
    workdir: str | os.PathLike,
    *,
    num_sequences: int = 1000,
    rows_per_step: int | None = None,
) -> loop.TrainResult:
    """Trains a radar model on fresh frames; run again, it continues.

    An epoch is as many frames as the sequences have. Frames are drawn with
    replacement and get new noise each time; they are not augmented.

    Args:
        config: With a `simulation` section that describes sensor and frames a
            sequence. Its data set is neither made nor used.
        workdir: Of the run: `config.json`, `checkpoints/`, `metrics.jsonl`.
        num_sequences: Procedural sequences that frames are drawn from.
        rows_per_step: See `OnlineBatches`; by device if None.

    Raises:
        UserError: A camera, other classes, real scenes or several processes are asked
            for, or the folder belongs to a run with another config.
    """
    simulation = plain(config.get("simulation") or {})
    for is_wrong, text in (
        (not simulation, "the config has no `simulation` section"),
        (simulation.get("scenes") != "procedural", "scenes must be procedural"),
        (image_backbone.has_camera(config), "the model takes a camera"),
        (tuple(config.classes) != CLASSES, f"classes must be {CLASSES}"),
        (jax.process_count() > 1, "one process only"),
    ):
        if is_wrong:
            raise UserError(f"on-line training: {text}")
    workdir = pathlib.Path(workdir).absolute()
    with lock_workdir(workdir):
        claim_workdir(workdir, config)
        return _train(config, workdir, simulation, num_sequences, rows_per_step)


def _train(
    config: ConfigDict,
    workdir: pathlib.Path,
    simulation: dict[str, Any],
    num_sequences: int,
    rows_per_step: int | None,
) -> loop.TrainResult:
    batch_size = config.train.batch_size
    sharding.check_batch_size(
        batch_size,
        sharding.make_mesh(),
        "train.batch_size",
        config.train.num_accumulate,
    )
    if rows_per_step is None:
        rows_per_step = 1 if jax.default_backend() == "cpu" else 64
    simulation |= {
        "train_sequences": num_sequences,
        "test_sequences": 0,
        "seed": simulation["seed"] + SEED_OFFSET,
    }
    batches = OnlineBatches(
        simulation,
        batch_size=batch_size,
        max_objects=config.data.max_objects,
        seed=config.seed,
        rows_per_step=rows_per_step,
        num_threads=config.data.num_threads,
    )
    _log.info("%d frames to draw from, simulated anew", len(batches.frame_names))
    model = models.build(config.model)
    return loop.train(
        model,
        None,
        batches.loader(),
        map_grid(batches.grid, model, config.data.azimuth_mapping),
        workdir,
        Plan(
            options=config.train,
            loss=config.loss,
            watch=config.watch,
            seed=config.seed,
            info=checkpoint_info(
                config,
                batches.grid,
                {"online_sequences": num_sequences},
                {"number of sequences": num_sequences},
            ),
            steps_per_epoch=max(len(batches.frame_names) // batch_size, 1),
            frame_names=batches.frame_names,
        ),
    )
