"""Evaluation of a model on data: detect on a split, evaluate, tabulate, draw."""

from __future__ import annotations

import dataclasses
import logging
import pathlib
from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from ml_collections import ConfigDict

from radejax import models
from radejax.core import files
from radejax.core.config import DATA_PATHS
from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.data.cameras import require_images
from radejax.data.dataset import FrameSequence, LabelledFrame, LabelledFrames
from radejax.evaluation.files import tables_from_frames
from radejax.evaluation.report import Report, write_report
from radejax.evaluation.results import EvaluationOptions
from radejax.inference.detector import Detector
from radejax.inference.predict import predict_dataset
from radejax.inference.saved import PathLike, SavedModel, Step, load_model
from radejax.runs import figures
from radejax.runs.data import Data, data_name, data_of_run
from radejax.training import distributed

_log = logging.getLogger(__name__)


def evaluate(
    config: ConfigDict,
    model: nn.Module,
    variables: Mapping[str, Any],
    data: Data,
    workdir: pathlib.Path,
    *,
    out: pathlib.Path | None = None,
    options: EvaluationOptions | None = None,
    split: str = "test",
    shuffle_images: int | None = None,
    step: int | None = None,
    run: str | None = None,
) -> Report | None:
    """Detect on a split, on all devices, and write the report.

    Args:
        config: Of the run.
        model: What `config.model` describes.
        variables: Of the model.
        data: To evaluate on.
        workdir: Of the run.
        out: Folder of the results; `evaluation` in the workdir if None.
        options: As the config says if None.
        split: "test", "validation", "train", "all" or a split file.
        shuffle_images: Seed; see `evaluate_run`.
        step: Of the variables, for `source.json`.
        run: Name of the run in the report; that of the workdir if None.

    Returns:
        The report that was written; None on all processes except the first.

    Raises:
        UserError: The split has no frames, or too few images to shuffle.
    """
    options = options or EvaluationOptions.from_config(config)
    frames, seen = _frames(data, split, shuffle_images)
    detector = make_detector(config, data, variables, options=options)
    predictions = predict_dataset(
        detector, data.records, seen, options.batch_size, images=data.images(seen)
    )

    def write(folder: pathlib.Path) -> Report:
        source = {"step": step, **source_of(data, split, shuffle_images)}
        files.write_json(folder / "source.json", source)
        drawer = figures.FrameDrawer(
            data.records,
            frames,
            Boxes(**predictions),
            roi=options.roi_bounds,
            score_threshold=config.decode.score_threshold,
        )
        truth, table = tables_from_frames(frames, split)
        report = write_report(
            *(truth, predictions, table, folder, options),
            run=run or workdir.name,
            left_out=frames.summary().counts,
            draw_frame=drawer,
        )
        _log.info("step %s, split %s\n%s", step, split, report.text)
        if models.has_camera(model):
            figures.write_camera_share(
                folder / "camera_share.json", model, variables, data, frames
            )
        if drawer.draw_spread(folder / "pictures", options.num_visualizations):
            drawer.draw_scenes(folder / "scenes.png")
        figures.draw_curves(
            workdir, folder / "training.png", is_simulated=frames.is_simulated
        )
        return report

    def write_whole() -> Report:
        place = out or workdir / "evaluation"
        with files.swapped_in(place) as folder:
            report = write(folder)
        placed = [place / path.relative_to(folder) for path in report.files]
        return dataclasses.replace(report, files=placed)

    return distributed.main_only(write_whole)


def evaluate_run(
    workdir: PathLike,
    *,
    step: Step = None,
    split: str = "test",
    out: PathLike | None = None,
    image_backbone: PathLike | None = None,
    shuffle_images: int | None = None,
    other: Mapping[str, Any] | None = None,
    run: str | None = None,
    **changes: Any,
) -> Report | None:
    """Evaluate a run's checkpoint as its config says, on all devices.

    Args:
        workdir: Of `train.py`.
        step: Checkpoint step or "best"; the latest if None.
        split: "test", "validation", "train", "all" or a split file.
        out: Folder of the results; `evaluation` in the workdir if None,
            `evaluation_<name>` for other data, and with `_validation` for that split.
        image_backbone: Weights of a frozen backbone, see `load_model`.
        shuffle_images: Seed; every frame gets the image and camera of another one, a
            sanity check of what a radar-camera model takes from the images. The default
            `out` then ends in `_shuffled`.
        other: Fields of `config.data` to replace, such as `{"roots": ("/data",)}`.
        run: Name of the run in the report; that of the workdir if None.
        **changes: Fields of `EvaluationOptions` to replace.

    Returns:
        The report that was written; None on all processes except the first.

    Raises:
        UserError: The split has no frames, or too few images to shuffle; the run has no
            data and none are given; other data do not fit the run, or `out` has results
            on others. Or a change out of its range.
    """
    loaded = load_model(workdir, step=step, image_backbone=image_backbone)
    workdir = pathlib.Path(workdir).absolute()
    if not loaded.run:
        raise UserError(f"{workdir} is not a run: give a workdir of train.py")
    options = EvaluationOptions.from_config(loaded.config, **changes)
    config, data = data_of_run(loaded, other)
    # Other labels may have been given.
    options = dataclasses.replace(options, label_version=config.data.label_version)
    name = "evaluation" if other is None else f"evaluation_{data_name(other)}"
    name += "_validation" if split == "validation" else ""
    name += "" if shuffle_images is None else "_shuffled"
    run = run or workdir.name
    if step == "best" and other is None and split in (data.choosing_split, "all"):
        run += f" (chosen on the {data.choosing_split} split)"
        _log.warning(
            "the best checkpoint was chosen on the %s split: its numbers on it may not be "
            "reported",
            data.choosing_split,
        )
    if other is not None:
        frames, _ = _frames(data, split, shuffle_images)
        require_images(frames, data.images(frames), split)
        if out is None:
            _check_source(workdir / name, source_of(data, split, shuffle_images))
    data.preprocess()
    return evaluate(
        config,
        loaded.model,
        loaded.variables,
        data,
        workdir,
        out=pathlib.Path(out or workdir / name),
        options=options,
        split=split,
        shuffle_images=shuffle_images,
        step=loaded.step,
        run=run,
    )


def source_of(
    data: Data, split: str, shuffle_images: int | None = None
) -> dict[str, Any]:
    """Description of what results are of, plain values."""
    return {
        "split": split,
        "shuffle_images": shuffle_images,
        "label_version": data.options.label_version,
        "sequences": list(data.options.sequences),
        "weather": list(data.options.weather),
        "simulated": data.frames.is_simulated,
        **{name: data.options[name] for name in DATA_PATHS},
        "roots": list(data.options.roots),  # as JSON has them
    }


def _check_source(out: pathlib.Path, source: Mapping[str, Any]) -> None:
    """Raise `UserError` if a folder has results on other data than these."""
    if not (out / "source.json").exists():
        return
    names = ("roots", "labels", "label_version", "split", "sequences", "weather")
    found, wanted = (
        {name: values.get(name) or None for name in names}
        for values in (files.read_object(out / "source.json"), source)
    )
    if lines := files.differences(found, wanted, ""):
        raise UserError(f"{out} has other results: {'; '.join(lines)}; give --out")


def _frames(
    data: Data, split: str, shuffle_images: int | None
) -> tuple[LabelledFrames, FrameSequence]:
    """Frames of a split, and the same as the model is to see them."""
    frames = data.split(None if split == "all" else split)
    if not len(frames):
        raise UserError(
            f"no frames of split {split} in {', '.join(data.options.roots)}"
        )
    if shuffle_images is None:
        return frames, frames
    if data.camera is None:
        raise UserError(
            "config.model.name is 'radenet', which has no camera; expected 'dinorade', "
            "for example --config dinorade"
        )
    return frames, with_shuffled_images(frames, shuffle_images)


def with_shuffled_images(frames: FrameSequence, seed: int) -> list[LabelledFrame]:
    """The frames, each with the image and calibration of another one.

    Raises:
        UserError: Fewer than two frames have an image.
    """
    given = [i for i, frame in enumerate(frames) if frame.camera_path is not None]
    if len(given) < 2:
        raise UserError(
            "shuffling images needs at least two frames with an image, found "
            f"{len(given)}"
        )
    order = np.random.default_rng(seed).permutation(given)
    shuffled = list(frames)
    for own, other in zip(order, np.roll(order, 1), strict=True):
        frame: Any = frames[own]
        shuffled[own] = dataclasses.replace(
            frame,
            camera_path=frames[other].camera_path,
            camera_calibration_path=frames[other].camera_calibration_path,
        )
    return shuffled


def make_detector(
    config: ConfigDict,
    data: Data,
    variables: Mapping[str, Any],
    mesh: jax.sharding.Mesh | None = None,
    options: EvaluationOptions | None = None,
) -> Detector:
    """Detector of all boxes that evaluations store, on all devices or those of a mesh."""
    options = options or EvaluationOptions.from_config(config)
    return Detector(
        SavedModel(config, data.records.grid, variables),
        distributed.batch_sharding(mesh or distributed.make_mesh()),
        score_threshold=options.min_score,
    )
