"""Evaluation of a model on data: detect on a split, score, tabulate, draw."""

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
from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.data.cameras import require_images
from radejax.data.dataset import FrameSequence, LabelledFrame, LabelledFrames
from radejax.evaluation.files.load import tables_from_frames
from radejax.evaluation.protocols import RECOMMENDED
from radejax.evaluation.report.measure import Options, rare_classes
from radejax.evaluation.report.report import Report, write_report
from radejax.inference.detector import Detector
from radejax.inference.predict import predict_dataset
from radejax.inference.saved import PathLike, SavedModel, Step, load_model
from radejax.runs import check_config, figures
from radejax.runs.data import Data, data_of_run
from radejax.runs.sources import Sources
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
    split: str = "test",
    exchange_images: int | None = None,
    step: int | None = None,
    remark: str = "",
    **options: Any,
) -> Report | None:
    """Detects on a split as the config says, on all devices, and writes the report.

    Args:
        config: Of the run.
        model: What `config.model` describes.
        variables: Of the model.
        data: To evaluate on.
        workdir: Of the run.
        out: Folder of the results; `evaluation` in the work folder if None.
        split: "test", "validation", "train", "all" or a split file.
        exchange_images: Seed; see `evaluate_run`.
        step: Of the variables, for `source.json`.
        remark: Behind the name of the run in the report.
        **options: Of the report's `Options`, in place of the config's.

    Returns:
        The report that was written; None on all processes but the first.

    Raises:
        UserError: No frames of the split, or images to exchange.
    """
    frames, seen = _frames(data, split, exchange_images)
    size, images = config.evaluation.batch_size, data.images(seen)
    detector = make_detector(config, data, variables)
    predictions = predict_dataset(detector, data.records, seen, size, images=images)

    def write(folder: pathlib.Path) -> Report:
        source = {"step": step, **source_of(data, split, exchange_images)}
        files.write_json(folder / "source.json", source)
        drawer = figures.FrameDrawer(
            data.records,
            frames,
            Boxes(**predictions),
            roi=config.evaluation.roi,
            score_threshold=config.decode.score_threshold,
        )
        truth, table = tables_from_frames(frames, split)
        options["rare"] = _rare_classes(config, data)
        made = write_report(
            *(truth, predictions, table, folder),
            report_options(config, f"{workdir.name}{remark}"),
            bootstrap=config.evaluation.bootstrap,
            left_out_before=frames.summary().counts,
            draw_frame=drawer,
            **options,
        )
        _log.info("step %s, split %s\n%s", step, split, made.text)
        if models.has_camera(model):
            figures.write_camera_share(
                folder / "camera_share.json", model, variables, data, frames
            )
        if drawer.draw_spread(
            folder / "pictures", config.evaluation.num_visualizations
        ):
            drawer.draw_scenes(folder / "scenes.png")
        figures.draw_curves(
            workdir, folder / "training.png", is_simulated=frames.is_simulated
        )
        return made

    def report() -> Report:
        place = out or workdir / "evaluation"
        with files.swapped_in(place) as folder:
            made = write(folder)
        placed = [place / path.relative_to(folder) for path in made.files]
        return dataclasses.replace(made, files=placed)

    return distributed.main_only(report)


def _rare_classes(config: ConfigDict, data: Data) -> tuple[tuple[str, str], ...]:
    """Of the train split of the data, with what may be held out of it."""
    objects, table = tables_from_frames(data.frames.of_split("train"))
    return rare_classes(objects, table, config.classes, config.evaluation.roi)


def evaluate_run(
    workdir: PathLike,
    *,
    step: Step = None,
    split: str = "test",
    out: PathLike | None = None,
    image_backbone: PathLike | None = None,
    exchange_images: int | None = None,
    other: Sources | None = None,
    **changes: Any,
) -> Report | None:
    """Evaluates a run's checkpoint as its config says, on all devices.

    Args:
        workdir: Of `train.py`.
        step: Of the checkpoint, or "best"; the newest if None.
        split: "test", "validation", "train", "all" or a split file.
        out: Folder of the results; `evaluation` in the work folder if None,
            `evaluation_<name>` for other data, and with `_validation` for that split.
        image_backbone: Weights of a frozen backbone, see `load_model`.
        exchange_images: Seed; every frame gets the image and camera of another one, a
            control of what a radar-camera model knows from the images. `out` then ends
            in `_exchanged`.
        other: Other data than the run's own; projected if they are not yet.
        **changes: Fields of `config.evaluation` in place of the run's, and `classes`,
            some of the run's, `run` and `invalid_sizes` of the report's `Options`. A
            `score_threshold` or `empty_frames` that is given here holds for `all_point` too.

    Returns:
        The report that was written; None on all processes but the first.

    Raises:
        UserError: There are no frames of the split, or images to exchange; the run has
            no data and none are given; other data do not fit the run, or `out` has
            results on others. Or a change that is impossible.
    """
    loaded = load_model(workdir, step=step, image_backbone=image_backbone)
    workdir = pathlib.Path(workdir).absolute()
    if not loaded.run:
        raise UserError(f"{workdir} is not a run: give a workdir of train.py")
    config, options = _changed(loaded.config, changes)
    config, data = data_of_run(
        dataclasses.replace(loaded, config=config), workdir, other
    )
    name = "evaluation" if other is None else f"evaluation_{other.name}"
    name += "_validation" if split == "validation" else ""
    name += "" if exchange_images is None else "_exchanged"
    remark = ""
    if step == "best" and other is None and split in (data.choosing_split, "all"):
        remark = f" (chosen on the {data.choosing_split} split)"
        _log.warning(
            "the best checkpoint was chosen on the %s split: its numbers on it may not be "
            "reported",
            data.choosing_split,
        )
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
        step=loaded.step,
        remark=remark,
        **options,
    )


def _changed(
    config: ConfigDict, changes: Mapping[str, Any]
) -> tuple[ConfigDict, dict[str, Any]]:
    """The config of a run with changes of its `evaluation`, and those of `Options`.

    Fields that are younger than the run stand at their default.
    """
    values = base_config().evaluation.to_dict()
    options = {name: v for name, v in changes.items() if name not in values}
    values |= config.evaluation.to_dict()
    for name in changes.keys() - options.keys():
        check_config.check_field(f"evaluation.{name}", changes[name])
        values[name] = changes[name]
    if unknown := sorted(set(options.get("classes", ())) - set(config.classes)):
        raise UserError(
            f"classes has {unknown[0]!r}, expected some of the run's: "
            f"{', '.join(config.classes)}"
        )
    if changes.keys() & {"score_threshold", "empty_frames"}:
        options["uncut"] = ()
    config = config.copy_and_resolve_references()
    config.evaluation = ConfigDict(values)
    return config, options


def source_of(
    data: Data, split: str, exchange_images: int | None = None
) -> dict[str, Any]:
    """What results are of, plain values."""
    return {
        "split": split,
        "exchange_images": exchange_images,
        "label_version": data.options.label_version,
        "sequences": list(data.options.get("sequences") or ()),
        "weather": list(data.options.get("weather") or ()),
        "simulated": data.frames.is_simulated,
        **dataclasses.asdict(data.paths),
        "roots": list(data.paths.roots),  # as JSON has them
    }


def _check_source(out: pathlib.Path, source: Mapping[str, Any]) -> None:
    """`UserError` if a folder has results on other data than these."""
    if not (out / "source.json").exists():
        return
    names = ("roots", "labels", "label_version", "split", "sequences", "weather")
    found, wanted = (
        {name: values.get(name) or None for name in names}
        for values in (files.read_json(out / "source.json", dict[str, Any]), source)
    )
    files.require_same(found, wanted, f"{out} has other results", mend="give --out")


def _frames(
    data: Data, split: str, exchange_images: int | None
) -> tuple[LabelledFrames, FrameSequence]:
    """Frames of a split, and the same as the model is to see them."""
    frames = data.split(None if split == "all" else split)
    if not len(frames):
        raise UserError(f"no frames of split {split} in {', '.join(data.paths.roots)}")
    if exchange_images is None:
        return frames, frames
    if data.camera is None:
        raise UserError(
            "config.model.name is 'radenet', which has no camera; expected 'dinorade', "
            "for example --config dinorade"
        )
    return frames, with_images_exchanged(frames, exchange_images)


def with_images_exchanged(frames: FrameSequence, seed: int) -> list[LabelledFrame]:
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
        frame: Any = frames[own]
        exchanged[own] = dataclasses.replace(
            frame,
            camera_path=frames[other].camera_path,
            camera_calibration_path=frames[other].camera_calibration_path,
        )
    return exchanged


def make_detector(
    config: ConfigDict,
    data: Data,
    variables: Mapping[str, Any],
    mesh: jax.sharding.Mesh | None = None,
) -> Detector:
    """Detector of all that evaluations keep, over all devices unless a mesh is given."""
    return Detector(
        SavedModel(config, data.records.grid, variables),
        distributed.batch_sharding(mesh or distributed.make_mesh()),
        score_threshold=_lowest_score(config),
    )


def _lowest_score(config: ConfigDict) -> float:
    """Score from which on predictions are kept."""
    options = config.evaluation
    return min(options.min_score, options.score_threshold)


def report_options(config: ConfigDict, name: str) -> Options:
    """How the config of a run says that it is evaluated, without intervals."""
    options = config.evaluation
    return Options(
        run=name,
        classes=tuple(config.classes),
        protocols=tuple(options.protocols),
        iou_thresholds=tuple(options.iou_thresholds),
        roi=options.roi and tuple(options.roi),
        score_threshold=options.score_threshold,
        uncut=(RECOMMENDED,),
        min_score=_lowest_score(config),
        empty_frames=None if options.empty_frames == "none" else options.empty_frames,
        label_version=config.data.label_version,
        invalid_sizes="false_positive",
        bootstrap=0,
    )
