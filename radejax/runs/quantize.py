"""Exports in int8: calibration on frames of a run's data, and APs before and after."""

from __future__ import annotations

import functools
import json
import logging
import pathlib
import types
from collections.abc import Sequence
from typing import Any

import numpy as np

from radejax.config import Config
from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.manifest import checksums
from radejax.core.structures import Boxes, Detections
from radejax.data.dataset import LabeledFrame
from radejax.data.projection import decode
from radejax.evaluation.boxes import tables_from_frames
from radejax.evaluation.results import compute_results, make_set
from radejax.inference import exported_loader
from radejax.inference.detector import Detector
from radejax.inference.export import export
from radejax.inference.saved import CONFIG_FILE
from radejax.runs.data import Data, data_of_run
from radejax.runs.evaluate import report_options
from radejax.runs.figures import spread

_CALIBRATION_FRAMES = 64
_COMPARED_FRAMES = 256
"""Largest numbers of frames; ONNX Runtime takes seconds for one of K-Radar."""

_log = logging.getLogger(__name__)


def export_int8(
    detector: Detector,
    folder: pathlib.Path,
    roots: Sequence[str] | None = None,
    **settings: Any,
) -> tuple[int, list[str]]:
    """Writes an ONNX export in int8, whose README and config have the APs of both types.

    The ranges of the activations are those on frames of the validation split, or of the
    train split if nothing is held out. The APs are those on frames of the test split, with
    the first protocol of the run.

    Args:
        detector: Detector of a radar-only model of one frame.
        folder: Folder, which is created if missing.
        roots: Roots of the data; those of the run if None.
        **settings: Other arguments of `export`.

    Returns:
        See `export`.

    Raises:
        UserError: Int8 is not possible, there are no data, or a split has no frames.
    """
    given = settings["kind"], settings["radar_input"], settings["batch_size"] or 1
    if given != ("onnx", "projection", 1):
        raise UserError("--int8 needs --format onnx, --input projection, batch size 1")
    if detector.takes_camera or detector.num_frames > 1:
        raise UserError("--int8 is only for radar-only models of one frame")
    config, data = data_of_run(detector.saved, {"roots": roots} if roots else None)
    data.preprocess()
    split = "validation" if config.data.validation else "train"
    known = spread(data.split(split), _CALIBRATION_FRAMES)
    frames = spread(data.split("test"), _COMPARED_FRAMES)
    num_bytes, left_out = export(detector, folder, **settings)
    exact = _aps(folder, config, data, frames)
    num_bytes -= _quantize(folder, data, known)
    quantized = _aps(folder, config, data, frames)
    options = report_options(config)
    protocol = options.protocols[0]
    least = options.settings_of(protocol)["score_threshold"]
    calibrated_on = f"{len(known)} frames of the {split} split"
    data_name = data.describe()["name"]
    evaluated_on = f"{len(frames)} frames of the test split of {data_name}, "
    evaluated_on += f"by {protocol} with scores above {least:g}"
    content = files.read_object(folder / CONFIG_FILE)
    aps = {"float32": exact, "int8": quantized}
    content["int8"] = {"ranges": calibrated_on, "evaluated": evaluated_on, "ap": aps}
    files.write_json(folder / CONFIG_FILE, content)
    lines = [
        "Convolutions are computed in int8: weights in 8 bits per output channel, and",
        f"activations in 8 bits, with the ranges on {calibrated_on}.",
        f"APs on {evaluated_on}:",
        "",
        "| class, boxes, threshold | float32 | int8 |\n|---|---|---|",
        *(f"| {n} | {x:.1f} | {quantized[n]:.1f} |" for n, x in exact.items()),
    ]
    text = "\n".join(lines)
    _log.info("%s", text)
    card = folder / "README.md"
    files.write_text(card, f"{card.read_text()}\n{text}\n")
    return num_bytes, left_out


def _quantize(folder: pathlib.Path, data: Data, frames: Sequence[LabeledFrame]) -> int:
    """Replaces the ONNX files of a folder; returns by how many bytes they are smaller."""
    from onnxruntime import quantization

    content = files.read_object(folder / CONFIG_FILE)
    rows = json.loads((folder / "inputs.json").read_text())
    zeros = {row["name"]: np.zeros(row["shape"], row["dtype"]) for row in rows}
    num_saved = 0
    for name, given in (("network.onnx", {}), ("detector.onnx", zeros)):
        path = folder / name
        num_saved += path.stat().st_size
        feeds = (
            {**given, "projection": decode(data.records[frame.key])[None]}
            for frame in frames
        )
        quantization.quantize_static(
            path,
            path,
            types.SimpleNamespace(get_next=functools.partial(next, feeds, None)),
            op_types_to_quantize=["Conv"],
            per_channel=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
        )
        num_saved -= path.stat().st_size
        content["sha256"] |= checksums(folder, name)
    files.write_json(folder / CONFIG_FILE, content)
    return num_saved


def _aps(
    folder: pathlib.Path, config: Config, data: Data, frames: Sequence[LabeledFrame]
) -> dict[str, float]:
    """Returns the APs of the program of a folder by class, boxes and threshold."""
    options = report_options(config)
    options = options.replace(protocols=options.protocols[:1], bootstrap=0)
    run = exported_loader.load(folder)
    parts = list[Boxes]()
    for index, frame in enumerate(frames):
        projection = decode(data.records[frame.key])
        found = run(projection[None], score_threshold=options.min_score)
        fields = ("boxes", "scores", "classes", "is_valid", "num_truncated")
        own = {name: found[name] for name in fields}
        detections = Detections(**own, class_names=data.classes)
        parts.append(detections.to_boxes(np.array([index])))
    truth, table = tables_from_frames(frames, "test", config.data.targets)
    compared = make_set(truth, Boxes.concatenate(parts), table, options)
    return {
        f"{x.cls}, {x.space}, IoU {x.iou:g}": x.ap
        for x in compute_results(compared, {}, options)
        if x.is_defined
    }
