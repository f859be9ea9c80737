"""Evaluation of a model on a split: detections, metrics, tables and figures."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import logging
import math
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import VariableDict
from jax.sharding import Mesh
from jaxtyping import Float
from matplotlib.figure import Figure

from radejax import models
from radejax.config import Config
from radejax.core import devices, files
from radejax.core.errors import UserError, require
from radejax.core.files import JsonObject, PathLike
from radejax.core.structures import Batch, Boxes, DetectionMaps
from radejax.data.cameras import require_images
from radejax.data.dataset import FrameSequence, LabeledFrame, find_reader
from radejax.data.projection import decode
from radejax.evaluation.analysis import (
    OPERATING_SCORE,
    box_errors,
    mistakes,
    worst_frames,
)
from radejax.evaluation.boxes import class_indices, roi_name, tables_from_frames
from radejax.evaluation.evaluation_set import EvaluationSet, Result
from radejax.evaluation.html import SceneFigure
from radejax.evaluation.report import (
    STALE,
    Origin,
    Report,
    warn_of_replaced,
    write_report,
)
from radejax.evaluation.results import (
    ReportOptions,
    compute_results,
    make_set,
    name_of_changes,
)
from radejax.evaluation.scores import fit_calibrations
from radejax.inference.detector import Detector
from radejax.inference.inputs import check_backbone
from radejax.inference.predict import predict_dataset
from radejax.inference.saved import CALIBRATION_FILE, SavedModel, Step, load_model
from radejax.losses.detection import detection_loss
from radejax.runs import figures
from radejax.runs.data import Data, data_name, data_of_run
from radejax.training.metric_writer import Scores
from radejax.visualize import curves
from radejax.visualize.draw import draw_frame, draw_scenes
from radejax.visualize.style import Scene, save_figure

_log = logging.getLogger(__name__)

Losses = dict[str, Float[jax.Array, ""]]

_STALE = ("camera_share.json", "figures", "scenes.*", "training.*")


class Evaluation:
    """Evaluation of a model's detections on a split.

    Every process takes part in the predictions.

    Args:
        config: Config of the run.
        data: Data to evaluate on.
        split: "test", "validation", "train", "all" or the path of a split file.
        shuffle_images: Seed for shuffling the images, or None; see `evaluate_run`.
        mesh: Devices of all processes, see `make_mesh`; all if None.
        options: Settings of the evaluation; those of the config if None.

    Raises:
        UserError: The split has no frames, or too few images to shuffle.
    """

    def __init__(
        self,
        config: Config,
        data: Data,
        split: str = "test",
        *,
        shuffle_images: int | None = None,
        mesh: Mesh | None = None,
        options: ReportOptions | None = None,
    ) -> None:
        self._config = config
        self._data = data
        self._split = split
        self._options = report_options(config) if options is None else options
        self._source = source_of(data, split, shuffle_images)
        self._frames = data.split(split)
        self._seen: FrameSequence = self._frames
        if shuffle_images is not None:
            self._seen = with_shuffled_images(data, split, shuffle_images)
        self._images = data.images(self._seen)
        self._truth, self._table = tables_from_frames(
            self._frames, split, config.data.targets
        )
        saved = SavedModel(config, data.records.grid, {})
        mesh = devices.make_mesh() if mesh is None else mesh
        placement = devices.batch_sharding(mesh)
        least = self._options.min_score
        self._detector = Detector(saved, placement, score_threshold=least)

    def predict(self, variables: VariableDict, **options: Any) -> Boxes:
        """Detects objects in all frames of the split.

        Args:
            variables: Variables of the model.
            **options: Keyword arguments of `predict_dataset`.

        Returns:
            Boxes whose score reaches `min_score`, see `predict_dataset`.
        """
        return predict_dataset(
            self._detector.replace(variables=variables),
            self._data.records,
            self._seen,
            self._options.batch_size,
            images=self._images,
            **options,
        )

    def validate(
        self,
        variables: VariableDict,
        should_stop: Callable[[], bool] | None = None,
    ) -> Scores:
        """Evaluates the variables of a model during training: APs and loss.

        Every process computes the same numbers, whose names begin with that of the split.

        Args:
            variables: Variables of the model.
            should_stop: Function that is called before every batch; returning True ends
                the evaluation.

        Raises:
            devices.Stopped: `should_stop` returned True.
        """
        losses: list[Losses] = []
        placed = self._detector.replace(variables=variables).variables

        def add_losses(batch: Batch) -> None:
            # It is waited for: with several batches in flight, CPU devices that share cores
            # can fail to synchronize.
            losses.append(jax.device_get(self._sum_losses(placed, batch)))

        predictions = self.predict(
            variables,
            progress=False,
            should_stop=should_stop,
            each_batch=add_losses,
        )
        data = make_set(self._truth, predictions, self._table, self._options)
        # Without the frame table, there are no weathers and no intervals.
        aps = named_aps(compute_results(data, {}, self._options))
        main = f"{self._config.train.best_metric}/{self._options.protocols[0]}/"
        best = next((ap for name, ap in aps.items() if name.startswith(main)), math.nan)
        shown = self._spread(self._config.logging.num_visualizations)
        drawn = devices.main_only(
            lambda: dict(self._figure(predictions, index) for index in shown)
        )
        means = {
            n: sum(float(x[n]) for x in losses) / len(self._frames) for n in losses[0]
        }
        values = {f"{self._split}/{name}": x for name, x in (means | aps).items()}
        if metrics := self._options.find_metrics():
            errors = box_errors(data, self._options.iou_thresholds[0], metrics)
            for name, cls in itertools.product(metrics, errors):
                if not math.isnan(median := errors[cls][f"{name}_median"]):
                    values[f"{self._split}/{name}_median/{cls}"] = median
        named = {
            f"{self._split}/{name}": figure for name, figure in (drawn or {}).items()
        }
        return Scores(values, None if math.isnan(best) else best, named)

    @functools.cached_property
    def _sum_losses(self) -> Callable[[VariableDict, Batch], Losses]:
        """Jitted sum over the frames of a batch of the loss of each frame and its terms.

        Frames are summed one by one, so that the mean over a split depends neither on the
        batches nor on the frames that pad them.
        """
        config = self._config
        model = self._detector.model
        grid = self._detector.grid
        grid = models.map_grid(grid, model, config.data.azimuth_mapping)

        def of_frame(maps: DetectionMaps, batch: Batch) -> Losses:
            total, terms = detection_loss(maps, batch, grid, config.loss, config.decode)
            names = (*config.loss.weights, "weighted_sum")
            return {"loss": total} | {name: terms[name] for name in names}

        def summed(variables: VariableDict, batch: Batch) -> Losses:
            maps = model.apply(variables, *batch.model_inputs(), train=False)
            one_by_one = jax.tree.map(lambda x: x[:, None], (maps, batch))
            losses: Losses = jax.vmap(of_frame)(*one_by_one)
            is_real = batch.frame >= 0
            return {name: jnp.sum(x, where=is_real) for name, x in losses.items()}

        return jax.jit(summed, out_shardings=self._detector.replicated)

    def report(
        self,
        variables: VariableDict,
        workdir: pathlib.Path,
        *,
        out: pathlib.Path | None = None,
        step: int | None = None,
        run: str | None = None,
        choosing: Evaluation | None = None,
    ) -> Report | None:
        """Detects objects, and writes the tables and figures of an evaluation.

        Args:
            variables: Variables of the model.
            workdir: Workdir of the run.
            out: Folder of the results, which replace earlier ones; `evaluation` in the
                workdir if None.
            step: Step of the variables, which is written to `source.json`.
            run: Name of the run in the report; the workdir's name if None.
            choosing: Evaluation on the validation split, see `write_report`.

        Returns:
            The report that was written; None on all processes except the first.
        """
        predictions = self.predict(variables)
        others = None if choosing is None else choosing._matched(variables)
        place = out or workdir / "evaluation"
        name = run or workdir.name
        warn_of_replaced(place, name)

        def write() -> Report:
            with files.swapped_in(place, *_STALE, *STALE) as folder:
                files.write_json(folder / "source.json", {"step": step, **self._source})
                data_name = self._data.describe()["name"]
                origin = f"{name}, step {step}, data {data_name}, split {self._split}"
                draw_scenes = functools.partial(self._draw_scenes, origin)
                report = write_report(
                    self._truth,
                    predictions,
                    self._table,
                    folder,
                    self._options,
                    Origin(name, step, data_name, self._frames.summary().counts),
                    choosing=others,
                    draw_scenes=draw_scenes,
                )
                _log.info("step %s, split %s\n%s", step, self._split, report.text)
                if self._detector.takes_camera:
                    self._write_camera_share(variables, folder / "camera_share.json")
                self._write_figures(predictions, workdir, folder, origin)
            return dataclasses.replace(report, folder=place)

        return devices.main_only(write)

    def _matched(self, variables: VariableDict) -> EvaluationSet:
        found = self.predict(variables)
        return make_set(self._truth, found, self._table, self._options)

    def _write_camera_share(self, variables: VariableDict, path: pathlib.Path) -> None:
        """Writes the mean weight of the camera by weather, computed on up to 256 frames."""
        some = figures.spread(self._frames, 256)
        maps = figures.frame_shares(self._detector.model, variables, self._data, some)
        shares = ((frame.weather, share) for frame, share in maps)
        grid = self._data.records.grid
        files.write_json(path, figures.average_shares(shares, grid))

    def _draw_scenes(
        self, origin: str, data: EvaluationSet, folder: pathlib.Path
    ) -> Iterator[SceneFigure]:
        """Draws frames, writes figures of the usual and the worst ones, and yields all.

        With visualizations, there are also frames of every class, weather and kind of
        mistake.
        """
        frames = self._frames
        iou = self._options.iou_thresholds[0]
        counts = mistakes(data, iou)
        worst = [int(entry["index"]) for entry in worst_frames(data, {}, iou)]
        usual = self._spread(self._options.num_visualizations)
        indices = [*worst, *usual]
        if usual:
            indices += figures.fullest_of_weathers(frames).values()
            indices += data.gt_count.argmax(axis=0).tolist()
            indices += [int(count.sum(axis=1).argmax()) for count in counts.values()]
        (folder / "worst_frames").mkdir()  # replaces that of an earlier evaluation
        for index in dict.fromkeys(indices):
            name, figure = self._figure(data.predictions, index)
            for kind, among in (("figures", usual), ("worst_frames", worst)):
                if index in among:
                    path = folder / kind / f"{name}.{self._options.figures}"
                    save_figure(figure, path, origin)
            made = {kind: int(x[index].sum()) for kind, x in counts.items()}
            made = {kind: count for kind, count in made.items() if count}
            is_there = data.gt_count[index] > 0
            tags = {
                "frames": ["worst frames"] if index in worst else [],
                "class": [data.classes[i] for i in np.flatnonzero(is_there)],
                "weather": [frames[index].weather],
                "mistake": list(made),
            }
            text = ", ".join(f"{kind}: {count}" for kind, count in made.items())
            title = f"{name}, score > {OPERATING_SCORE:g}: {text or 'no mistakes'}"
            yield SceneFigure(title, tags, figure)

    def _write_figures(
        self,
        predictions: Boxes,
        workdir: pathlib.Path,
        folder: pathlib.Path,
        origin: str,
    ) -> None:
        """Writes a figure of all weathers and the loss curves."""
        frames = self._frames
        suffix = ", simulated" if frames.is_simulated else ""
        ending = self._options.figures
        if self._options.num_visualizations:  # the layout of RADE-Net's Figure 4
            scenes = [
                self._scene(predictions, i, title=f"{name} ({frames[i].key}){suffix}")
                for name, i in figures.fullest_of_weathers(frames).items()
            ]
            save_figure(draw_scenes(scenes), folder / f"scenes.{ending}", origin)
        if (workdir / "metrics.jsonl").exists():
            series = curves.read_metrics(workdir / "metrics.jsonl")
            if losses := [n for n in self._config.loss.weights if n in series]:
                figure = curves.draw_training(series, losses, workdir.name + suffix)
                save_figure(figure, folder / f"training.{ending}", origin)

    def _scene(self, predictions: Boxes, index: int, **fields: Any) -> Scene:
        """Returns the scene of a frame with its boxes and image.

        Predictions are drawn if their score reaches `config.decode.score_threshold`, the
        default of the detector.
        """
        frame = self._frames[index]
        records = self._data.records
        threshold = self._config.decode.score_threshold
        assert predictions.score is not None
        classes = self._config.classes
        least = np.broadcast_to(threshold, len(classes))
        least = least[class_indices(predictions, classes, "predictions")]
        is_drawn = (predictions.frame == index) & (predictions.score >= least)
        return figures.frame_scene(
            frame,
            decode(records[frame.key]),
            records.grid,
            predictions=predictions.take(is_drawn),
            roi=self._options.roi,
            iou=self._options.iou_thresholds[0],
            score_threshold=threshold,
            **fields,
        )

    def _spread(self, count: int) -> list[int]:
        """Returns the positions of a fixed selection of the split's frames with objects."""
        candidates = [i for i, frame in enumerate(self._frames) if len(frame.boxes)]
        return figures.spread(candidates, count)

    def _figure(self, predictions: Boxes, index: int) -> tuple[str, Figure]:
        """Returns name and figure of a frame by its position in the split."""
        frame = self._frames[index]
        name = f"{frame.sequence:02d}_{frame.name}"
        return name, draw_frame(self._scene(predictions, index))


def report_options(config: Config, **changes: Any) -> ReportOptions:
    """Returns the options of a report on a run.

    Args:
        config: Config of the run.
        **changes: Fields to replace.

    Raises:
        UserError: A value is invalid, or the run does not have one of the classes.
    """
    if unknown := sorted(set(changes.get("classes", ())) - set(config.classes)):
        raise UserError(
            f"classes has {unknown[0]!r}, expected some of the run's: "
            f"{', '.join(config.classes)}"
        )
    has_versions = find_reader(config.data.format).has_label_versions
    own = {
        "classes": config.classes,
        "known_classes": config.classes,
        "label_version": config.data.label_version if has_versions else None,
        "invalid_sizes": "false_positive",
        **dict(config.evaluation),
    }
    options = ReportOptions(**own | changes)
    options.find_protocols()
    return options.replace(min_score=min(options.min_score, options.score_threshold))


def named_aps(results: Sequence[Result]) -> dict[str, float]:
    """Returns the APs over all frames by metric and class, and means by m and metric."""
    return {
        f"m{x.metric}" if x.cls == "mean" else f"{x.metric}/{x.cls}": x.ap
        for x in results
        if x.is_defined and x.condition == "all"
    }


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
    """Evaluates a checkpoint of a run with the settings of its config, on all devices.

    Args:
        workdir: Workdir of `train.py`.
        step: Step of the checkpoint, or "best"; the latest if None.
        split: "test", "validation", "train", "all" or the path of a split file.
        out: Folder of the results. If None, it is `evaluation` in the workdir, with other
            data, split, checkpoint and changes that change numbers appended to the name,
            such as `evaluation_all_roi_wide`.
        image_backbone: Weights of a frozen backbone, see `load_model`.
        shuffle_images: Seed with which every frame with an image gets the image and
            camera of another frame, or None. This is a sanity check of how much a
            radar-camera model uses the images.
        other: Fields of `config.data` to replace, such as `{"roots": ("/data",)}`.
        run: Name of the run in the report; the workdir's name if None.
        **changes: Fields of `ReportOptions` to replace.

    Returns:
        The report that was written; None on all processes except the first.

    Raises:
        UserError: The split has no frames, or too few images to shuffle; the run has no
            data and none are given; other data do not fit the run; the default folder of
            their results contains results on different data; or a change is out of its
            range.
    """
    saved = load_model(workdir, step=step, image_backbone=image_backbone)
    workdir = files.as_path(workdir).absolute()
    if not saved.run:
        raise UserError(f"{workdir} is not a run: give a workdir of train.py")
    usual = dict(report_options(saved.config))
    if usual["roi"] is not None:  # changes name the known regions
        usual["roi"] = roi_name(usual["roi"])
    # A wrong change fails before labels are read, which takes long.
    report_options(saved.config, **changes)
    config, data = data_of_run(saved, other)
    options = report_options(config, **changes)
    name = "evaluation" if other is None else f"evaluation_{data_name(other)}"
    name += "" if split == "test" else f"_{files.as_path(split).stem}"
    name += "" if shuffle_images is None else "_shuffled"
    name += "" if step is None else f"_checkpoint_{step}"
    name += name_of_changes(changes, usual)
    run = run or workdir.name
    if step == "best" and other is None and split in (data.choosing_split, "all"):
        run += f" (chosen on the {data.choosing_split} split)"
        _log.warning(
            "the best checkpoint was chosen on the %s split: its numbers on it may not be "
            "reported",
            data.choosing_split,
        )
    if other is not None:
        frames = data.split(split)
        images = data.images(frames)
        require_images(frames, images, f"{split} split")
        if images is not None:
            check_backbone(images.empty_images(1), saved.variables)
        if out is None:
            _check_source(workdir / name, source_of(data, split, shuffle_images))
    data.preprocess()
    saved.check_input(*data.input_of(split))
    evaluation = Evaluation(
        config, data, split, shuffle_images=shuffle_images, options=options
    )
    place = files.as_path(out or workdir / name)
    others = None
    if split == "test" and other is None and config.data.validation:
        others = Evaluation(config, data, "validation", options=options)
    return evaluation.report(
        saved.variables, workdir, out=place, step=saved.step, run=run, choosing=others
    )


def calibrate_run(workdir: PathLike, **options: Any) -> JsonObject:
    """Fits probabilities to the scores of a run, and writes them to its workdir.

    Models that are loaded from the workdir then predict them, see `DecodeOptions`. The
    predictions are evaluated too, in a folder of their own.

    Args:
        workdir: Workdir of the run.
        **options: Further arguments of `evaluate_run`, such as the split, by default
            "validation".

    Returns:
        The content of the file: the step, the evaluation with data and split, the IoU
        threshold of a match, and temperature and offset by class.

    Raises:
        UserError: There is no validation split, a class has no predictions, or
            `evaluate_run` raises it.
    """
    options = {"split": "validation", **options}
    report = evaluate_run(workdir, **options)
    assert report is not None  # because this is the only process
    iou = report.metrics["options"]["iou_thresholds"][0]
    data = report.data
    count = np.bincount(data.pred.cls, minlength=len(data.classes))
    by_class = dict(zip(data.classes, count.tolist(), strict=True))
    expected = "some of every class: give more sequences by --split or --data"
    require(all(count), f"{report.folder}: predictions to fit", by_class, expected)
    content: JsonObject = {
        "step": report.metrics["step"],
        "data": report.metrics["data"],
        "split": files.as_path(options["split"]).name,
        "evaluation": report.folder.name,
        "iou": iou,
        "classes": fit_calibrations(data, iou),
    }
    files.write_json(files.as_path(workdir) / CALIBRATION_FILE, content)
    return content


def source_of(data: Data, split: str, shuffle_images: int | None = None) -> JsonObject:
    """Returns a description of the data and split of results as plain values."""
    return {
        "split": split,
        "shuffle_images": shuffle_images,
        "simulated": data.frames.is_simulated,
        **data.options.model_dump(mode="json"),
    }


def _check_source(out: pathlib.Path, source: JsonObject) -> None:
    """Raises `UserError` if a folder contains results on other data than `source`."""
    if not (out / "source.json").exists():
        return
    found = files.read_object(out / "source.json")
    names = ("roots", "labels", "label_version", "split", "sequences", "weather")
    there, here = ({name: of.get(name) for name in names} for of in (found, source))
    if lines := files.differences(there, here, ""):
        raise UserError(f"{out} has other results: {'; '.join(lines)}; give --out")


def with_shuffled_images(data: Data, split: str, seed: int) -> list[LabeledFrame]:
    """Returns the frames of a split with images and calibrations shuffled among them.

    Every frame that has an image gets the image and calibration of another one.

    Args:
        data: Data of the run.
        split: Name of the split, see `Data.split`.
        seed: Seed of the permutation.

    Raises:
        UserError: The model has no camera, or fewer than two frames have an image.
    """
    frames = list(data.split(split))
    given = [i for i, frame in enumerate(frames) if frame.camera_path is not None]
    if data.camera is None or len(given) < 2:
        raise UserError(
            "shuffling images needs a model with a camera, such as dinorade, and at least "
            f"two frames with an image, found {len(given)}"
        )
    order = np.random.default_rng(seed).permutation(given)
    shuffled = list(frames)
    for own, other in zip(order, np.roll(order, 1), strict=True):
        shuffled[own] = dataclasses.replace(
            frames[own],
            camera_path=frames[other].camera_path,
            camera_calibration_path=frames[other].camera_calibration_path,
        )
    return shuffled
