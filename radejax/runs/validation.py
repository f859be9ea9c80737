"""Evaluation during training: metrics and figures of held-out frames."""

from __future__ import annotations

import functools
import math
import pathlib
import tempfile
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from ml_collections import ConfigDict
from PIL import Image

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.evaluation.boxes import Columns
from radejax.evaluation.evaluation_set import Result
from radejax.evaluation.files import tables_from_frames
from radejax.evaluation.results import EvaluationOptions, evaluate_tables
from radejax.inference.predict import predict_dataset
from radejax.runs.checks import check_best_metric
from radejax.runs.data import Data
from radejax.runs.evaluate import make_detector
from radejax.runs.figures import FrameDrawer
from radejax.training import distributed
from radejax.training.metric_logger import Scores
from radejax.training.step import TrainState


class Validation:
    """Called by the training loop with a state and its step.

    On the sequences of `data.validation`, or on the test split where there are none.
    Every process takes part in the predictions and computes the same numbers.

    Args:
        config: Of the run; `evaluation`, `decode`, `logging` and `train.best_metric` are
            read.
        data: Of the run.
        mesh: All devices if None.

    Raises:
        UserError: No frames to evaluate on, or no such metric as `train.best_metric`.
    """

    def __init__(
        self,
        config: ConfigDict,
        data: Data,
        mesh: jax.sharding.Mesh | None = None,
    ) -> None:
        self._config, self._records = config, data.records
        self._options = EvaluationOptions.from_config(config, bootstrap=0)
        check_best_metric(config.train.best_metric, self._options.iou_thresholds)
        self._frames = data.split(data.choosing_split)
        if not len(self._frames):
            raise UserError(
                f"no frames of the {data.choosing_split} split to evaluate on during "
                "training; set train.evaluate_every_epochs=0"
            )
        self._images = data.images(self._frames)
        self._detector = make_detector(config, data, {}, mesh, self._options)

    @functools.cached_property
    def _tables(self) -> tuple[Columns, Columns]:
        """Ground truth and frames as columns."""
        return tables_from_frames(self._frames)

    def __call__(
        self,
        state: TrainState,
        step: int,
        should_stop: Callable[[], bool] | None = None,
    ) -> Scores:
        """Scores of the state's (averaged) parameters.

        Raises:
            distributed.Stopped: `should_stop`, asked at every batch, said so.
        """
        predictions = self._predict(state.eval_variables, should_stop)
        ground_truth, table = self._tables
        _, results = evaluate_tables(
            ground_truth, predictions, table, self._options, kinds=()
        )
        values, best = {}, None
        for result in filter(lambda result: result.is_defined, results):
            if result.cls == "mean":
                values[f"validation/m{result.metric}"] = result.ap
            else:
                values[f"validation/{result.metric}/{result.cls}"] = result.ap
            if self._is_best_metric(result) and not math.isnan(result.ap):
                best = result.ap
        figures = distributed.main_only(lambda: self._draw(predictions)) or {}
        return Scores(values, best, figures)

    def _predict(
        self, variables: Mapping[str, Any], should_stop: Callable[[], bool] | None
    ) -> dict[str, np.ndarray]:
        return predict_dataset(
            self._detector.replace(variables=variables),
            self._records,
            self._frames,
            self._options.batch_size,
            images=self._images,
            progress=False,
            should_stop=should_stop,
        )

    def _is_best_metric(self, result: Result) -> bool:
        return (
            result.cls == "mean"
            and result.protocol == self._options.protocols[0]
            and f"m{result.metric.split('/')[0]}" == self._config.train.best_metric
        )

    def _draw(self, predictions: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Always the same frames, spread over the split."""
        count = self._config.logging.num_visualizations
        if not count:
            return {}
        drawer = FrameDrawer(
            self._records,
            self._frames,
            Boxes(**predictions),
            roi=self._options.roi_bounds,
            score_threshold=self._config.decode.score_threshold,
        )
        figures = {}
        with tempfile.TemporaryDirectory() as folder:
            for path in drawer.draw_spread(pathlib.Path(folder), count):
                with Image.open(path) as image:
                    pixels = np.asarray(image.convert("RGB"))
                figures[f"validation/{path.stem}"] = pixels
        return figures
