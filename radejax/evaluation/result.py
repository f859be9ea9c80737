"""One average precision with everything it depends on."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

SPACES = ("bev", "3d")


@dataclasses.dataclass(frozen=True)
class Result:
    """One average precision and what it means.

    Attributes:
        cls: Class name.
        space: "bev" or "3d".
        iou: IoU threshold; a match needs more.
        ap: Average precision, 0 to 100. Without any object of the class it is NaN, except
            in K-Radar's protocols, which define it as 0; test `num_gt`.
        num_gt: Objects of the class in the frames that take part.
        num_det: Predictions of the class in those frames, after the score cut.
        protocol: Name of the protocol.
        num_frames: Frames that take part.
        score_threshold: Predictions need a score above this.
        empty_frames: Frame rule that was used.
        roi: Name of the region of interest.
        label_version: Label revision of the ground truth, if known.
        precision: Precision along the curve (K-Radar: after making it monotone).
        recall: Recall along the curve.
        score: Score threshold along the curve, falling.
        is_simulated: The frames are simulated.
    """

    cls: str
    space: str
    iou: float
    ap: float
    num_gt: int
    num_det: int
    protocol: str
    num_frames: int
    score_threshold: float
    empty_frames: str | None
    roi: str
    label_version: str | None
    precision: Float[np.ndarray, " K"] = dataclasses.field(repr=False)
    recall: Float[np.ndarray, " K"] = dataclasses.field(repr=False)
    score: Float[np.ndarray, " K"] = dataclasses.field(repr=False)
    is_simulated: bool = False

    @property
    def is_defined(self) -> bool:
        """Whether the class occurs at all; reports show `-` where it does not."""
        return self.num_gt > 0

    @property
    def metric(self) -> str:
        """Name with everything the number depends on but the class and the frames.

        Such as ap_3d_iou30/kradar_r40/score>0/skip=frame/labels=v2.1/roi=narrow, and
        then /simulated where the frames are.
        """
        return (
            f"ap_{self.space}_iou{100 * self.iou:.4g}/{self.protocol}"
            f"/score>{self.score_threshold:g}/skip={self.empty_frames or 'none'}"
            f"/labels={self.label_version or 'unknown'}/roi={self.roi}"
            + ("/simulated" if self.is_simulated else "")
        )


def mean_ap(results: Sequence[Result]) -> float:
    """Mean AP over the classes that occur; NaN if none does.

    Examples:
        >>> mean_ap([])
        nan
    """
    present = [result.ap for result in results if result.is_defined]
    return float(np.mean(present)) if present else float("nan")
