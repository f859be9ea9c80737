"""A whole run: data, training, evaluation. `workdir.py` says what is where."""

from __future__ import annotations

import hashlib
import logging
import pathlib
import time
from typing import Any

import flax.linen as nn
from ml_collections import ConfigDict

from radejax import models
from radejax.core import files
from radejax.core.errors import UserError
from radejax.data.dataset import FrameSequence
from radejax.inference.saved import PathLike, StartingWeights, starting_weights
from radejax.runs import checks
from radejax.runs.data import Data, open_data
from radejax.runs.evaluate import evaluate
from radejax.runs.sources import Sources
from radejax.runs.validation import Validation
from radejax.runs.workdir import checkpoint_info, claimed, default_workdir, run_info
from radejax.training import distributed, loop

_log = logging.getLogger(__name__)

_CLOSING = """Done in {minutes:.1f} minutes. Everything is in {folder}:
{report}  checkpoints/     the trained model
  metrics.jsonl    losses by step (tensorboard --logdir {folder})
{again}{best}Boxes for a folder of frames:
                   radejax detect --workdir {folder} --out boxes FOLDER"""

_REPORT = "  evaluation/      metrics.json, metrics.csv, tables, pictures\n"
_AGAIN = "Evaluate again:    radejax evaluate --workdir {folder}\n"
_BEST = """Best on the way:   radejax evaluate --workdir {folder} --checkpoint best
                   chosen on the {split} split: {word}
"""
_MAY_BE_REPORTED = {
    "validation": "its numbers on the test split may be reported",
    "test": "its numbers on that may not be reported (config.data.validation)",
}


def run(
    config: ConfigDict,
    *,
    name: str,
    sources: Sources = Sources(),  # noqa: B008, frozen
    workdir: PathLike | None = None,
    init_from: PathLike | None = None,
    profile: PathLike = "",
) -> pathlib.Path:
    """Everything from nothing to metrics; run again, it continues where it stopped.

    Args:
        config: Complete configuration of one seed; `seeds.run_seeds` takes several.
        name: Of the config, for the default work folder.
        sources: What the user says of the data; without any they are simulated if the
            config says how.
        workdir: `runs/<name>` if None.
        init_from: Weights to start from: official .pth file or another work folder.
        profile: Folder for a trace of the steps `config.logging.profile_steps`.

    Returns:
        The work folder.

    Raises:
        UserError: A field of the config has an impossible value, the work folder
            belongs to another configuration or is in use, no data, or no space.
    """
    started = time.perf_counter()
    checks.check(config)
    distributed.check_batch_size(config.train.batch_size, distributed.make_mesh())
    model = models.build(config.model)  # what cannot be built fails first
    folder = default_workdir(workdir, name)
    with claimed(folder, config):
        weights = starting_weights(
            config.model, init_from, sources.image_backbone, sources.embeddings
        )
        data = open_data(config, model, sources)
        has_test = len(data.split("test")) > 0
        if not has_test:
            _log.warning(
                "no frames of the test split in %s: the run is trained and not evaluated",
                ", ".join(data.paths.roots),
            )
        result = train(model, weights, data, folder, config, str(profile))
        if not result.finished:
            _log.info(
                "stopped at step %d; run the same command to continue", result.step
            )
            return folder
        if has_test:
            weights_now, step = result.state.eval_variables, result.step
            evaluate(config, model, weights_now, data, folder, step=step)
    minutes = (time.perf_counter() - started) / 60
    place, split, best = files.relative(folder), data.choosing_split, ""
    if config.train.evaluate_every_epochs:
        word = _MAY_BE_REPORTED[split]
        best = _BEST.format(folder=place, split=split, word=word)
    report, again = (_REPORT, _AGAIN.format(folder=place)) if has_test else ("", "")
    _log.info(
        _CLOSING.format(
            minutes=minutes, folder=place, best=best, report=report, again=again
        )
    )
    return folder


def train(
    model: nn.Module,
    weights: StartingWeights,
    data: Data,
    folder: pathlib.Path,
    config: ConfigDict,
    profile: str = "",
) -> loop.TrainResult:
    """Trains on the train split until the configured epochs are done.

    Args:
        model: What `config.model` describes.
        weights: That it starts from.
        data: Of the run.
        folder: Work folder.
        config: Of the run.
        profile: Folder for a trace; empty for none.

    Raises:
        UserError: No frames to train on, or no usable image.
    """
    frames = data.split("train")
    if not len(frames):
        raise UserError(
            f"no frames of the train split in {', '.join(data.paths.roots)}"
        )
    loader = data.training_batches(frames, config.train, config.seed)
    info = run_info(folder, data.paths, weights.source)
    if distributed.is_main():
        files.write_json(folder / "run.json", info)
    validation = None
    if config.train.evaluate_every_epochs:
        validation = Validation(config, data)
    grid = data.records.grid
    same = _what_stays(frames, weights)
    return loop.train(
        config,
        model,
        loader,
        models.map_grid(grid, model, config.data.azimuth_mapping),
        folder,
        info=checkpoint_info(config, grid, info, same),
        steps_per_epoch=len(frames) // config.train.batch_size,
        variables=weights.variables,
        pretrained=weights.pretrained,
        evaluate=validation,
        profile=profile,
    )


def _what_stays(frames: FrameSequence, weights: StartingWeights) -> dict[str, Any]:
    """What a checkpoint does not hold and a run must not change on its way.

    Folders may move, therefore frames are compared by their keys and the frozen
    backbone by its weights.
    """
    keys = "\n".join(frame.key for frame in frames)
    stays = {
        "frames to train on": len(frames),
        "sha256 of their keys": hashlib.sha256(keys.encode()).hexdigest()[:16],
    }
    if weights.frozen_sha256 is not None:
        stays["sha256 of the frozen image backbone"] = weights.frozen_sha256[:16]
    return stays
