"""A whole run: data, records, training, evaluation. `workdir.py` says what is where."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import logging
import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
from ml_collections import ConfigDict

from radejax import models
from radejax.core import files
from radejax.core.errors import UserError
from radejax.data import pipeline
from radejax.data.augment import make_augmentation
from radejax.data.cameras import require_images
from radejax.data.frame_table import make_table
from radejax.data.kradar.frame import Frame
from radejax.data.records.embeddings import embeddings_sha256
from radejax.data.records.projections import RecordSource
from radejax.inference.embed import weights_sha256
from radejax.interop.image_backbone import load_image_backbone
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.runs.data import DataPaths, camera_inputs, prepare_data, saved_path
from radejax.runs.workdir import (
    PathLike,
    checkpoint_info,
    claim_workdir,
    initial_variables,
    load_run,
    lock_workdir,
    run_info,
)
from radejax.training import loop, processes, sharding
from radejax.training.start import Plan
from radejax.training.step import map_grid

__all__ = [
    "config_name",
    "load_run",
    "run",
    "train",
]

_log = logging.getLogger(__name__)


def config_name(filename: str) -> str:
    """Name of a run from its config: "configs/radenet.py:stem" gives "radenet-stem"."""
    path, _, words = filename.partition(":")
    return "-".join([pathlib.Path(path).stem, *filter(None, words.split(","))])


def run(
    config: ConfigDict,
    *,
    name: str,
    workdir: PathLike | None = None,
    data: Sequence[str] | None = None,
    labels: str | None = None,
    records: str | None = None,
    init_from: str | None = None,
    embeddings: str | None = None,
    image_backbone: str | None = None,
    camera_calibration: str | None = None,
) -> pathlib.Path:
    """Everything from nothing to metrics; run again, it continues where it stopped.

    Args:
        config: Complete configuration; with `seeds` one run of each, see
            `seeds.run_seeds`.
        name: Of the config, for the default work folder.
        workdir: `runs/<name>` if None.
        data: K-Radar folders; None simulates them if the config says how.
        labels: Label revision, see `KRadar`.
        records: Folder of projected frames, beside the data if None.
        init_from: Weights to start from: official .pth file or another work folder.
        embeddings: Folder of `radejax embed`, in place of images.
        image_backbone: Weights of the image backbone, see `load_image_backbone`.
        camera_calibration: Folder of camera calibrations, the roots' own if None.

    Returns:
        The work folder.

    Raises:
        UserError: The work folder belongs to another configuration or is in use, no
            data, or no space.
    """
    if config.seeds:
        from radejax.runs.seeds import run_seeds

        return run_seeds(
            config,
            name=name,
            workdir=workdir,
            data=data,
            labels=labels,
            records=records,
            init_from=init_from,
            embeddings=embeddings,
            image_backbone=image_backbone,
            camera_calibration=camera_calibration,
        )
    started = time.perf_counter()
    workdir = pathlib.Path(workdir or pathlib.Path("runs") / name).absolute()
    models.build(config.model)  # a config that cannot be built should fail first
    with contextlib.ExitStack() as held:
        processes.main_only(lambda: held.enter_context(lock_workdir(workdir)))
        processes.main_first(lambda: claim_workdir(workdir, config))
        paths = dataclasses.replace(
            processes.main_first(
                lambda: prepare_data(
                    config,
                    data=data,
                    labels=labels,
                    records=records,
                    camera_calibration=camera_calibration,
                )
            ),
            embeddings=saved_path(embeddings),
            image_backbone=saved_path(image_backbone),
        )
        if _train_and_evaluate(config, workdir, paths, init_from):
            minutes = (time.perf_counter() - started) / 60
            _log.info(_CLOSING.format(minutes=minutes, workdir=files.relative(workdir)))
    return workdir


def _train_and_evaluate(
    config: ConfigDict, workdir: pathlib.Path, paths: DataPaths, init_from: str | None
) -> bool:
    """False where a signal stopped it."""
    has_test = len(paths.open(config, split="test")) > 0
    if not has_test:
        _log.warning(
            "no frames of the test split in %s: the run is trained and not evaluated",
            ", ".join(paths.roots),
        )
    info = run_info(workdir, paths, init_from)
    if processes.is_main():
        files.write_json(workdir / "run.json", info)
    result = train(config, workdir, paths, info=info, init_from=init_from)
    if not result.finished:
        _log.info("stopped at step %d; run the same command to continue", result.step)
        return False
    if has_test:
        from radejax.runs.evaluate import evaluate_run  # drawing, tables: not to train

        evaluate_run(workdir)
    return True


_CLOSING = """Done in {minutes:.1f} minutes. Everything is in {workdir}:
  evaluation/      metrics.json, metrics.csv, tables, pictures
  checkpoints/     the trained model
  metrics.jsonl    losses by step (tensorboard --logdir {workdir})
Evaluate again:    python evaluate.py --workdir {workdir}
Boxes for a folder of frames:
                   radejax detect --workdir {workdir} --out boxes FOLDER"""


# Training ----------------------------------------------------------------------------


def train(
    config: ConfigDict,
    workdir: pathlib.Path,
    paths: DataPaths,
    *,
    info: Mapping[str, Any],
    init_from: str | None = None,
) -> loop.TrainResult:
    """Trains on the train split until the configured epochs are done."""
    records = RecordSource(paths.records)
    frames = paths.open(config, split="train")
    if not len(frames):
        raise UserError(f"no frames of the train split in {', '.join(paths.roots)}")
    sharding.check_batch_size(
        config.train.batch_size,
        sharding.make_mesh(),
        "train.batch_size",
        config.train.num_accumulate,
    )
    images = camera_inputs(config, frames, paths.embeddings)
    require_images(frames, images)
    table = make_table(
        records,
        frames,
        max_objects=config.data.max_objects,
        classes=config.classes,
        images=images,
        label_permutation_seed=config.data.label_permutation_seed,
    )
    options = pipeline.LoaderOptions(
        config.train.batch_size // jax.process_count(),
        seed=config.seed,
        num_threads=config.data.num_threads,
        num_workers=config.data.num_workers,
    )
    augment = make_augmentation(
        records.grid,
        mirror_probability=config.data.mirror_probability,
        gain_db=config.data.gain_db,
        gain_slope_db=config.data.gain_slope_db,
    )
    loader = pipeline.make_loader(table, options, augment=augment)
    evaluate = None
    if config.train.evaluate_every_epochs:
        from radejax.runs.validation import Validation  # above: it reads whole runs

        evaluate = Validation(config, paths)
    model, variables = models.build(config.model), None
    if init_from is not None:
        variables = initial_variables(init_from, config)
    pretrained = None
    if not _has_backbone(variables):
        pretrained = load_image_backbone(paths.image_backbone, config, paths.embeddings)
    return loop.train(
        model,
        variables,
        loader,
        map_grid(records.grid, model, config.data.azimuth_mapping),
        workdir,
        Plan(
            options=config.train,
            loss=config.loss,
            watch=config.watch,
            seed=config.seed,
            info=checkpoint_info(
                config,
                records.grid,
                info,
                _what_stays(frames, variables, pretrained, paths.embeddings, model),
            ),
            steps_per_epoch=pipeline.steps_per_epoch(
                len(frames),
                config.train.batch_size // jax.process_count(),
                process_count=jax.process_count(),
            ),
            pretrained=pretrained,
            trace_folder=config.profile,
            frame_names=[frame.key for frame in frames],
        ),
        evaluate=evaluate,
    )


def _has_backbone(variables: Mapping[str, Any] | None) -> bool:
    return variables is not None and IMAGE_BACKBONE in variables["params"]


def _what_stays(
    frames: Sequence[Frame],
    variables: Mapping[str, Any] | None,
    pretrained: Mapping[str, Any] | None,
    embeddings: str | None,
    model: Any,
) -> dict[str, Any]:
    """What a checkpoint does not hold and a run must not change on its way.

    Folders may move, therefore frames are compared by their keys and the frozen
    backbone by its weights.
    """
    keys = "\n".join(frame.key for frame in frames)
    stays = {
        "frames to train on": len(frames),
        "sha256 of their keys": hashlib.sha256(keys.encode()).hexdigest()[:16],
    }
    if getattr(model, "freeze", False):
        if embeddings is not None:
            digest = embeddings_sha256(embeddings)
        else:
            source = pretrained if pretrained is not None else variables
            digest = weights_sha256(source["params"][IMAGE_BACKBONE])
        stays["sha256 of the frozen image backbone"] = digest[:16]
    return stays
