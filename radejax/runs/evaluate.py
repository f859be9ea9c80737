"""Evaluation of a model on data: detect on a split, score, tabulate, draw."""

from __future__ import annotations

import dataclasses
import logging
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from ml_collections import ConfigDict

from radejax import models
from radejax.core import files
from radejax.core.errors import UserError
from radejax.data.cameras import require_images
from radejax.data.kradar import Frame, KRadar
from radejax.evaluation.files.load import tables_from_frames
from radejax.evaluation.report.measure import Options
from radejax.evaluation.report.report import Report, write_report
from radejax.inference.open import PathLike, Step, load
from radejax.inference.predict import Predictor, predict_dataset
from radejax.runs import pictures
from radejax.runs.data import Data, Sources, data_of_run
from radejax.training import processes

_log = logging.getLogger(__name__)


def evaluate(
    config: ConfigDict,
    model: nn.Module,
    variables: Mapping[str, Any],
    data: Data,
    workdir: pathlib.Path,
    *,
    out: pathlib.Path | None = None,
    split: str = "test",
    exchange_images: int | None = None,
    num_pictures: int | None = None,
    step: int | None = None,
) -> Report | None:
    """Detects on a split as the config says, on all devices, and writes the report.

    Args:
        config: Of the run.
        model: What `config.model` describes.
        variables: Of the model.
        data: To evaluate on.
        workdir: Of the run.
        out: Folder of the results; `evaluation` in the work folder if None.
        split: "test", "train", "all" or a split file.
        exchange_images: Seed; see `evaluate_run`.
        num_pictures: Frames drawn; as the config says if None.
        step: Of the variables, for `source.json`.

    Returns:
        The report that was written; None on all processes but the first, which return
        when it is there.

    Raises:
        UserError: There are no frames of the split, or images to exchange.
    """
    frames, seen = _frames(data, split, exchange_images)
    out = workdir / "evaluation" if out is None else out
    predictor = make_predictor(config, model, data)
    predictor.update(variables)
    batch_size, images = config.evaluation.batch_size, data.images(seen)
    predictions = predict_dataset(
        predictor, data.records, seen, batch_size, images=images
    )

    def report() -> Report:
        out.mkdir(parents=True, exist_ok=True)
        source = source_of(data, split, exchange_images)
        files.write_json(out / "source.json", {"step": step, **source})
        drawer = pictures.FrameDrawer(
            data.records,
            frames,
            predictions,
            roi=config.evaluation.roi,
            score_threshold=config.decode.score_threshold,
        )
        ground_truth, table = tables_from_frames(frames, split)
        report = write_report(
            ground_truth,
            predictions,
            table,
            out,
            report_options(config, workdir.name),
            bootstrap=config.evaluation.bootstrap,
            left_out_before=frames.summary().counts,
            draw_frame=drawer,
        )
        _log.info("step %s, split %s\n%s", step, split, report.text)
        if models.has_camera(model):
            pictures.draw_camera_share(model, variables, data, frames, out)
        count = config.evaluation.num_pictures if num_pictures is None else num_pictures
        drawn = drawer.draw_spread(out / "pictures", count)
        if drawn:
            drawer.draw_scenes(out / "scenes.png")
        if (workdir / "metrics.jsonl").exists():
            pictures.draw_curves(
                workdir, out / "training.png", is_simulated=frames.is_simulated
            )
        _log.info("drew %d frames in %s", len(drawn), out / "pictures")
        return report

    return processes.main_only(report)


def evaluate_run(
    workdir: PathLike,
    *,
    step: Step = None,
    split: str = "test",
    out: PathLike | None = None,
    num_pictures: int | None = None,
    image_backbone: PathLike | None = None,
    exchange_images: int | None = None,
    other: Sources | None = None,
) -> Report | None:
    """Evaluates a run's checkpoint as its config says, on all devices.

    Args:
        workdir: Of `train.py`.
        step: Of the checkpoint, or "best"; the newest if None.
        split: "test", "train", "all" or a split file.
        out: Folder of the results; `evaluation` in the work folder if None, and
            `evaluation_<name>` for other data.
        num_pictures: Frames drawn; as the config says if None.
        image_backbone: Weights of a frozen backbone, see `inference.open.load`.
        exchange_images: Seed; every frame gets the image and camera of another one, a
            control of what a radar-camera model knows from the images. `out` then ends
            in `_exchanged`.
        other: Other data than the run's own; projected if they are not yet.

    Returns:
        The report that was written; None on all processes but the first.

    Raises:
        UserError: There are no frames of the split, or images to exchange; the run has
            no data and none are given; other data do not fit the run, or `out` has
            results on others.
    """
    loaded = load(workdir, step=step, image_backbone=image_backbone)
    workdir = pathlib.Path(workdir).absolute()
    config, data = data_of_run(loaded, workdir, other)
    name = "evaluation" if other is None else f"evaluation_{other.name}"
    name += "" if exchange_images is None else "_exchanged"
    if other is not None:
        frames, _ = _frames(data, split, exchange_images)
        require_images(frames, data.images(frames), split)
        if out is None:
            _check_source(workdir / name, source_of(data, split, exchange_images))
        data.project()
    return evaluate(
        config,
        loaded.model,
        loaded.variables,
        data,
        workdir,
        out=pathlib.Path(out or workdir / name),
        split=split,
        exchange_images=exchange_images,
        num_pictures=num_pictures,
        step=loaded.step,
    )


def source_of(
    data: Data, split: str, exchange_images: int | None = None
) -> dict[str, Any]:
    """What results are of, plain values."""
    return {
        "split": split,
        "exchange_images": exchange_images,
        "label_version": data.options.label_version,
        "simulated": data.frames.is_simulated,
        **dataclasses.asdict(data.paths),
        "roots": list(data.paths.roots),  # as JSON has them
    }


def _check_source(out: pathlib.Path, source: Mapping[str, Any]) -> None:
    """`UserError` if a folder has results on other data than these."""
    if not (out / "source.json").exists():
        return
    names = ("roots", "labels", "label_version", "split")
    found, wanted = (
        {name: values.get(name) for name in names}
        for values in (files.read_json(out / "source.json", dict[str, Any]), source)
    )
    files.require_same(found, wanted, f"{out} has other results", mend="give --out")


def _frames(
    data: Data, split: str, exchange_images: int | None
) -> tuple[KRadar, Sequence[Frame]]:
    """Frames of a split, and the same as the model is to see them."""
    frames = data.split(None if split == "all" else split)
    if not len(frames):
        raise UserError(f"no frames of split {split} in {', '.join(data.paths.roots)}")
    if exchange_images is None:
        return frames, frames
    if data.camera is None:
        raise UserError(
            "config.model.name is 'radenet', which has no camera; expected 'dinorade', "
            "for example configs/dinorade.py"
        )
    return frames, with_images_exchanged(frames, exchange_images)


def with_images_exchanged(frames: Sequence[Frame], seed: int) -> list[Frame]:
    """The frames, each with the image and calibration of another one.

    Raises:
        UserError: Fewer than two frames have an image.
    """
    given = [i for i, frame in enumerate(frames) if frame.camera_path is not None]
    if len(given) < 2:
        raise UserError(f"{len(given)} frames have an image: none to exchange")
    order = np.random.default_rng(seed).permutation(given)
    exchanged = list(frames)
    for own, other in zip(order, np.roll(order, 1), strict=True):
        exchanged[own] = dataclasses.replace(
            frames[own],
            camera_path=frames[other].camera_path,
            camera_calibration_path=frames[other].camera_calibration_path,
        )
    return exchanged


def make_predictor(
    config: ConfigDict,
    model: nn.Module,
    data: Data,
    mesh: jax.sharding.Mesh | None = None,
) -> Predictor:
    """Predictor with the score threshold of evaluations, still without variables."""
    threshold = config.evaluation.score_threshold
    return Predictor(
        model,
        data.records.grid,
        classes=config.classes,
        decode={**config.decode, "score_threshold": threshold},
        azimuth_mapping=config.data.azimuth_mapping,
        mesh=mesh,
    )


def report_options(config: ConfigDict, name: str) -> Options:
    """How the config of a run says that it is evaluated, without intervals."""
    options = config.evaluation
    return Options(
        run=name,
        classes=tuple(config.classes),
        protocols=tuple(options.protocols),
        iou_thresholds=tuple(options.iou_thresholds),
        roi=tuple(options.roi),
        score_threshold=options.score_threshold,
        skip_empty=None if options.skip_empty == "none" else options.skip_empty,
        label_version=config.data.label_version,
        invalid_sizes="false_positive",
        bootstrap=0,
    )
