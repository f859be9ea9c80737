"""Boxes as the lines of text that K-Radar's tools read: KITTI's form.

    sed 0.00 0 0 50 50 150 150 h w l y z x yaw          (ground truth, 2 decimals)
    sed -1 -1 0 50 50 150 150 h w l y z x yaw score     (prediction)

A frame without predictions has one line "dummy".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from radejax.core.errors import UserError

CLASS_KEYS = {
    "Sedan": "sed",
    "Bus or Truck": "bus",
    "Pedestrian": "ped",
    "Motorcycle": "mot",
    "Bicycle": "bic",
    "Pedestrian Group": "peg",
    "Bicycle Group": "big",
}
GT_HEADER = "0.00 0 0 50 50 150 150"
PRED_HEADER = "-1 -1 0 50 50 150 150"
DUMMY = "dummy -1 -1 0 0 0 0 0 0 0 0 0 0 0 0 0"
BOX_ORDER = [5, 4, 3, 1, 2, 0, 6]  # h w l y z x yaw of x y z l w h yaw


def prediction_texts(
    predictions: Mapping[str, np.ndarray], num_frames: int
) -> list[str]:
    """Content of the prediction files of frames 0 to `num_frames - 1`.

    Args:
        predictions: Columns frame, box, cls and score; every row is written.
        num_frames: Frames without predictions get the line "dummy".

    Raises:
        UserError: A class K-Radar has no key for.
    """
    score = np.asarray(predictions["score"], np.float64)
    found = object_lines(predictions, np.arange(score.size), score)
    return ["\n".join(found.get(frame, [DUMMY])) for frame in range(num_frames)]


def object_lines(
    table: Mapping[str, np.ndarray], rows: np.ndarray, score: np.ndarray | None
) -> dict[int, list[str]]:
    """Lines of every frame, in the order of the rows.

    Args:
        table: Columns frame, box and cls.
        rows: `[N]` which rows.
        score: `[M]` score of every row of the table; None: ground truth.

    Raises:
        UserError: A class K-Radar has no key for.
    """
    box = np.asarray(table["box"], np.float64).reshape(-1, 7)
    if score is None:
        box = np.round(box, 2)
    frame, cls = np.asarray(table["frame"]).tolist(), np.asarray(table["cls"]).tolist()
    lines: dict[int, list[str]] = {}
    for row in rows.tolist():
        if cls[row] not in CLASS_KEYS:
            raise UserError(
                f"K-Radar's tools have no key for class {cls[row]!r} (frame {frame[row]},"
                f" row {row}); known: {', '.join(CLASS_KEYS)}"
            )
        numbers = [repr(value) for value in box[row, BOX_ORDER].tolist()]
        header = GT_HEADER
        if score is not None:
            numbers.append(repr(float(score[row])))
            header = PRED_HEADER
        lines.setdefault(frame[row], []).append(
            " ".join([CLASS_KEYS[cls[row]], header, *numbers])
        )
    return lines
