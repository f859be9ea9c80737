"""Evaluation of a run: detect on a split, score, tabulate, draw."""

from __future__ import annotations

import dataclasses
import logging
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from radejax.core import files
from radejax.core.errors import UserError
from radejax.data.cameras import require_images
from radejax.data.encoding import decode as decode_array
from radejax.data.images import front_view
from radejax.data.kradar import KRadar
from radejax.data.kradar.folders import read_grid
from radejax.data.kradar.frame import Frame
from radejax.data.records.projections import (
    RecordSource,
    describe_grid,
    record_positions,
)
from radejax.evaluation.files.predictions import tables_from_frames
from radejax.evaluation.report.measure import Options
from radejax.evaluation.report.report import Report, write_report
from radejax.inference.predict import Predictor, predict_dataset
from radejax.interop.image_backbone import (
    has_camera,
    missing_backbone,
    require_camera,
)
from radejax.runs.camera_share import camera_share, write_camera_share
from radejax.runs.data import OtherData, camera_inputs, project
from radejax.runs.workdir import Run, load_run
from radejax.training import processes

_log = logging.getLogger(__name__)


def evaluate_run(
    workdir: str | os.PathLike,
    *,
    step: int | str | None = None,
    split: str = "test",
    out: str | os.PathLike | None = None,
    num_pictures: int | None = None,
    image_backbone: str | os.PathLike | None = None,
    exchange_images: int | None = None,
    other: OtherData | None = None,
) -> Report | None:
    """Evaluates a run's checkpoint as its config says, on all devices.

    Args:
        workdir: Of `train.py`.
        step: Of the checkpoint, or "best"; the newest if None.
        split: "test", "train", "all" or a split file.
        out: Folder of the results; `evaluation` in the work folder if None, and
            `evaluation_<name>` for other data.
        num_pictures: Frames drawn; as the config says if None.
        image_backbone: Weights of a frozen backbone, see `load_run`.
        exchange_images: Seed; every frame gets the image and camera of another one, a
            control of what a radar-camera model knows from the images. `out` then ends
            in `_exchanged`.
        other: Other data than the run's own; projected if they are not yet.

    Returns:
        The report that was written; None on all processes but the first, which return
        when it is there.

    Raises:
        UserError: There are no frames of the split, or images to exchange; the run has
            no data and none are given; other data do not fit the run, or `out` has
            results on others.
    """
    run = load_run(workdir, step, image_backbone)
    if other is not None:
        run = with_other_data(run, other)
    config = run.config
    if run.paths is None:
        raise UserError(
            f"{run.workdir}: trained on frames that were never written, there is no "
            "split to evaluate on; give --data ROOT, or use `radejax detect`"
        )
    frames = run.paths.open(config, None if split == "all" else split)
    if not len(frames):
        raise UserError(f"no frames of split {split} in {', '.join(run.paths.roots)}")
    seen = frames
    if exchange_images is not None:
        require_camera(config)
        seen = with_images_exchanged(frames, exchange_images)
    images = camera_inputs(config, seen, run.paths.embeddings)
    source = {
        "step": run.step,
        "split": split,
        "exchange_images": exchange_images,
        "label_version": config.data.label_version,
        **dataclasses.asdict(run.paths),
        "roots": list(run.paths.roots),  # as JSON has them
    }
    name = "evaluation" if other is None else f"evaluation_{other.name}"
    name += "" if exchange_images is None else "_exchanged"
    if other is not None:
        require_images(frames, images, split)
        if out is None:
            _check_source(run.workdir / name, source)
        processes.main_first(lambda: project(config, run.paths))
    out = pathlib.Path(out or run.workdir / name)
    records = RecordSource(run.paths.records, grid=run.grid)
    options = config.evaluation
    predictor = Predictor(
        config, run.variables, run.grid, score_threshold=options.score_threshold
    )
    predictions = predict_dataset(
        predictor, records, seen, options.batch_size, images=images
    )
    count = options.num_pictures if num_pictures is None else num_pictures
    return processes.main_only(
        lambda: _report(run, source, frames, records, predictions, out, count)
    )


def with_other_data(run: Run, other: OtherData) -> Run:
    """A run with other data in place of its own; nothing is projected.

    Raises:
        UserError: They are of another radar grid, or without what a frozen image
            backbone makes of their images.
        FileNotFoundError: A folder is not there.
    """
    config, paths = run.config, other.paths(run.paths)
    if other.label_version is not None:
        config = config.copy_and_resolve_references()
        config.data.label_version = other.label_version
    grid = read_grid(list(map(pathlib.Path, paths.roots)))
    if grid != run.grid:
        raise UserError(
            f"{', '.join(paths.roots)}: the radar has {describe_grid(grid)}, "
            f"{run.workdir} was trained on {describe_grid(run.grid)}"
        )
    is_blind = missing_backbone(run.variables["params"], config)
    if is_blind and paths.embeddings is None:
        raise UserError(
            f"{run.workdir} is without the weights of its image backbone: give "
            "--image_backbone FOLDER, or --embeddings FOLDER of these images"
        )
    return dataclasses.replace(run, config=config, paths=paths)


def _check_source(out: pathlib.Path, source: Mapping[str, Any]) -> None:
    """`UserError` if a folder has results on other data than these."""
    if not (out / "source.json").exists():
        return
    names = ("roots", "labels", "label_version", "split")
    found, wanted = (
        {name: values.get(name) for name in names}
        for values in (files.read_json(out / "source.json"), source)
    )
    files.require_same(found, wanted, f"{out} has other results", mend="give --out")


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


def _report(
    run: Run,
    source: Mapping[str, Any],
    frames: KRadar,
    records: RecordSource,
    predictions: Mapping[str, np.ndarray],
    out: pathlib.Path,
    num_pictures: int,
) -> Report:
    """Scores predictions, and writes and draws everything into `out`."""
    config = run.config
    out.mkdir(parents=True, exist_ok=True)
    files.write_json(out / "source.json", source)
    drawer = FrameDrawer(records, frames, predictions, config)
    ground_truth, table = tables_from_frames(frames)
    report = write_report(
        ground_truth,
        predictions,
        table,
        out,
        report_options(config, run.workdir.name),
        bootstrap=config.evaluation.bootstrap,
        left_out_before=frames.summary().counts,
        draw_frame=drawer,
    )
    _log.info("step %d, split %s\n%s", run.step, source["split"], report.text)
    if has_camera(config):
        shares = camera_share(
            config, run.variables, records, frames, embeddings=run.paths.embeddings
        )
        write_camera_share(out, *shares, run.grid)
    pictures = drawer.draw_spread(out / "pictures", num_pictures)
    if pictures:
        drawer.draw_scenes(out / "scenes.png")
    if (run.workdir / "metrics.jsonl").exists():
        draw_curves(run.workdir, out / "training.png")
    _log.info("drew %d frames in %s", len(pictures), out / "pictures")
    return report


def report_options(config: Any, name: str) -> Options:
    """How the config of a run says that it is evaluated, without intervals."""
    options = config.evaluation
    protocols = tuple(options.protocols)
    return Options(
        run=name,
        classes=tuple(config.classes),
        protocols=protocols,
        # The papers' printed numbers fit this one best, see docs/evaluation.md.
        paper_protocol="coco101" if "coco101" in protocols else protocols[0],
        iou_thresholds=tuple(options.iou_thresholds),
        roi=tuple(options.roi),
        score_threshold=options.score_threshold,
        skip_empty=None if options.skip_empty == "none" else options.skip_empty,
        label_version=config.data.label_version,
        invalid_sizes="false_positive",
        bootstrap=0,
    )


class FrameDrawer:
    """Draws frames of a data set with their ground truth and predictions.

    Args:
        records: Projections.
        frames: The data set.
        predictions: Columns as `predict_dataset` returns; drawn are those above
            `decode.score_threshold`, as a detector in use would show them.
        config: Of the run.
    """

    def __init__(
        self,
        records: RecordSource,
        frames: KRadar,
        predictions: Mapping[str, np.ndarray],
        config: Any,
    ) -> None:
        self._records = records
        self._frames = frames
        self._positions = record_positions(records, frames)
        self._predictions = predictions
        self._roi = tuple(config.evaluation.roi)
        self._score_threshold = config.decode.score_threshold

    def __call__(self, index: int, path: str | os.PathLike) -> None:
        """Draws the frame at a position of the data set into a picture file."""
        from radejax.visualize import bev

        scene = self._scene(int(index))
        frame = self._frames[int(index)]
        figure = bev.draw_frame(
            scene.projection,
            self._records.grid,
            ground_truth=scene.ground_truth,
            predictions=scene.predictions,
            roi=self._roi,
            image=scene.image,
            camera=scene.camera,
            title=f"sequence {frame.sequence}, frame {frame.name}, {frame.weather}",
        )
        bev.save_figure(figure, path)

    def _scene(self, index: int) -> Any:
        """The frame at a position with its boxes and image."""
        from radejax.visualize.scenes import Scene

        frame = self._frames[index]
        mine = self._predictions["frame"] == index
        mine &= self._predictions["score"] >= self._score_threshold
        columns = {k: v[mine] for k, v in self._predictions.items()}
        record = self._records[self._positions[index]]
        image, camera = front_view(frame)
        return Scene(
            decode_array(record["projection"]),
            ground_truth=(frame.boxes, list(frame.classes)),
            predictions=(columns["box"], columns["score"], list(columns["cls"])),
            image=image,
            camera=camera,
            title=f"{frame.weather} ({frame.key})",
        )

    def draw_scenes(self, path: str | os.PathLike) -> None:
        """Draws one frame of each weather, that with the most objects, side by side.

        The layout of RADE-Net's Figure 4.
        """
        from radejax.visualize import bev
        from radejax.visualize.scenes import draw_scenes

        fullest: dict[str, int] = {}
        for i, frame in enumerate(self._frames):
            best = fullest.setdefault(frame.weather, i)
            if len(frame.boxes) > len(self._frames[best].boxes):
                fullest[frame.weather] = i
        scenes = [self._scene(i) for i in fullest.values()]
        figure = draw_scenes(scenes, self._records.grid, roi=self._roi)
        bev.save_figure(figure, path)

    def draw_spread(self, folder: pathlib.Path, count: int) -> list[pathlib.Path]:
        """Draws frames with objects, spread evenly over the data set."""
        candidates = [i for i, frame in enumerate(self._frames) if len(frame.boxes)]
        if not candidates or count < 1:
            return []
        folder.mkdir(parents=True, exist_ok=True)
        spread = np.linspace(0, len(candidates) - 1, min(count, len(candidates)))
        paths = []
        for index in np.array(candidates)[np.round(spread).astype(int)]:
            frame = self._frames[index]
            paths.append(folder / f"{frame.sequence:02d}_{frame.name}.png")
            self(index, paths[-1])
        return paths


def draw_curves(workdir: pathlib.Path, path: pathlib.Path) -> None:
    """Draws the losses of a run over its steps into a picture file."""
    from radejax.visualize import bev, curves

    figure = curves.draw_training(workdir / "metrics.jsonl", title=workdir.name)
    bev.save_figure(figure, path)
