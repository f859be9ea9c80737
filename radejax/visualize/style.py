"""Shared parts of all figures: colors, the frame to draw, axes helpers and saving.

Figures are plain `matplotlib.figure.Figure` objects. pyplot, its backend and its list of
open figures are not used, so drawing works without a display, in threads and in
notebooks.
"""

from __future__ import annotations

import dataclasses
import io
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke
from matplotlib.textpath import TextPath
from numpy.typing import ArrayLike

from radejax.core.errors import UserError
from radejax.core.files import PathLike, as_path, atomic_path
from radejax.core.structures import Boxes
from radejax.core.version import __version__, radejax_commit
from radejax.geometry.boxes import bev_corners
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid

# The brightest fifth is omitted so that white boxes are visible on the strongest echoes.
COLOR_MAP = LinearSegmentedColormap.from_list(
    "radar", matplotlib.colormaps["viridis"](np.linspace(0.0, 0.82, 256))
)
ROI_COLOR = "black"
LIDAR_COLOR = "#ffa64d"
# Color-blind safe palette, with a yellow that is visible on paper.
_OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
SERIES_COLORS = (*_OKABE_ITO, "#000000", "#8A6D00")


class Style(NamedTuple):
    """Style of one set of boxes.

    Attributes:
        name: Name in legends.
        color: Color of lines and labels.
        width: Width of lines in points.
        side: Side of a box on a map at which its label is preferably written; empty if it
            has no label.
    """

    name: str
    color: str
    width: float
    side: str


GROUND_TRUTH = Style("ground truth", "white", 1.9, "left")
PREDICTION = Style("prediction", "#ff7f6e", 1.3, "right")
# Styles of matched boxes. An object that was found has the label of its prediction.
FOUND = Style("object, found", "white", 1.9, "")
MISSED = Style("object, missed", "#ffd400", 1.9, "left")
TRUE_POSITIVE = Style("true positive", "#5ce1ff", 1.3, "right")
FALSE_POSITIVE = Style("false positive", "#ff7f6e", 1.3, "right")
NOT_EVALUATED = Style("not evaluated", "#b0b0b0", 0.9, "")


class Matches(NamedTuple):
    """Matches between the boxes of one frame, by which they are colored.

    A box is matched (1), not matched (0) or not evaluated (-1), as outside the region.

    Attributes:
        ground_truth: `[N]` matches of the objects.
        predictions: `[M]` matches of the predictions.
        iou: 3D IoU above which boxes match.
    """

    ground_truth: Int[np.ndarray, " N"]
    predictions: Int[np.ndarray, " M"]
    iou: float


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """The data of one frame to draw, of which each figure uses a part.

    Attributes:
        projection: `[R, A, D+E]` normalized log power of one frame.
        grid: Grid of the projection.
        ground_truth: Boxes of the frame in the radar frame, or None.
        predictions: Boxes of the frame with scores, or None.
        roi: x_min, x_max, y_min, y_max, z_min, z_max in meters, drawn as a dashed
            rectangle; or None.
        image: `[H, W, 3]` left front camera image, uint8 or float in [0, 1], or None.
        camera: Calibration of the image, with which boxes are drawn on it; or None.
        title: Title, such as sequence, frame and weather.
        score_threshold: Score threshold of the predictions for the legend, one or one per
            class, whose lowest score is named instead if it is below; or None.
        time_s: Seconds since the Unix epoch for recordings, or None.
        lidar_m: LiDAR points `[N, 3]` in the radar frame in meters, drawn on ground plane and
            image; or None.
        matches: Matches of ground truth and predictions, which then both exist; or None.

    Raises:
        UserError: The projection does not match the grid, or the boxes belong to several
            frames.
    """

    projection: ArrayLike
    grid: RadarGrid
    ground_truth: Boxes | None = None
    predictions: Boxes | None = None
    roi: Sequence[float] | None = None
    image: ArrayLike | None = None
    camera: CameraCalibration | None = None
    title: str = ""
    score_threshold: float | Sequence[float] | None = None
    time_s: float | None = None
    lidar_m: Float[np.ndarray, "N 3"] | None = None
    matches: Matches | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.projection)
        if shape != self.grid.projection_shape:
            raise UserError(
                f"projection has shape {shape}, the grid expects (range, azimuth, "
                f"Doppler + elevation) = {self.grid.projection_shape}; pass one frame, "
                "without a batch axis, and the grid that it was recorded on"
            )
        for style, boxes in self.sets:
            if len(np.unique(boxes.frame)) > 1:
                raise UserError(
                    f"{style.name}: boxes of {len(np.unique(boxes.frame))} frames, "
                    "expected those of one; select them with Boxes.take"
                )

    @property
    def sets(self) -> list[tuple[Style, Boxes]]:
        """Ground truth and predictions with their styles, see `styled_sets`."""
        return styled_sets(self.ground_truth, self.predictions, self.matches)

    @property
    def power(self) -> Float[np.ndarray, "R A"]:
        """Maximum over all channels, which equals that over Doppler and elevation."""
        power: np.ndarray = np.asarray(self.projection, np.float32).max(-1)
        return power


def styled_sets(
    ground_truth: Boxes | None,
    predictions: Boxes | None,
    matches: Matches | None = None,
) -> list[tuple[Style, Boxes]]:
    """Returns ground truth and predictions with their styles; None is left out.

    With `matches`, they are split into those found, missed, correct, wrong and not
    evaluated, of which the last are left out if there are none.
    """
    pairs = (GROUND_TRUTH, ground_truth), (PREDICTION, predictions)
    given = [(style, boxes) for style, boxes in pairs if boxes is not None]
    if matches is None:
        return given
    (_, truth), (_, found) = given
    sets = [
        (NOT_EVALUATED, truth.take(matches.ground_truth < 0)),
        (NOT_EVALUATED, found.take(matches.predictions < 0)),
        (FOUND, truth.take(matches.ground_truth == 1)),
        (MISSED, truth.take(matches.ground_truth == 0)),
        (TRUE_POSITIVE, found.take(matches.predictions == 1)),
        (FALSE_POSITIVE, found.take(matches.predictions == 0)),
    ]
    return [(style, x) for style, x in sets if style != NOT_EVALUATED or len(x)]


def label_texts(boxes: Boxes) -> list[str]:
    """Returns the class name of each box, followed by its score if there is one."""
    if boxes.score is None:
        return list(boxes.cls)
    pairs = zip(boxes.cls, boxes.score, strict=True)
    return [f"{name} {score:.2f}" for name, score in pairs]


def footprints(
    boxes: Float[np.ndarray, "N 7"], points_per_edge: int = 1
) -> Float[np.ndarray, "N {4*points_per_edge+1} 2"]:
    """Returns closed counter-clockwise outlines of boxes on the ground.

    Args:
        boxes: Boxes in the radar frame.
        points_per_edge: Number of points on each edge; more than 1 for views in which
            edges are curves, such as the polar view.

    Returns:
        x and y of the points, starting at the front left corner.
    """
    corners = bev_corners(boxes)
    following = np.roll(corners, -1, axis=1)
    t = np.arange(points_per_edge)[:, None] / points_per_edge
    edges = corners[:, :, None] * (1 - t) + following[:, :, None] * t  # [N, 4, P, 2]
    points = edges.reshape(len(boxes), 4 * points_per_edge, 2)
    return np.concatenate([points, corners[:, :1]], 1)


def draw_tiles(
    ax: Axes,
    edges_x: Float[np.ndarray, "*edges_x"],
    edges_y: Float[np.ndarray, "*edges_y"],
    values: Float[np.ndarray, "rows columns"],
    color_limits: tuple[float, float] | None = None,
) -> QuadMesh:
    """Draws one tile per value; the color limits are `color_limits_of(values)` by default."""
    low, high = color_limits or color_limits_of(values)
    return ax.pcolormesh(
        edges_x, edges_y, values, cmap=COLOR_MAP, vmin=low, vmax=high, rasterized=True
    )


def draw_points(ax: Axes, points: Float[np.ndarray, "N 2"]) -> None:
    """Draws LiDAR points on axes of fixed limits, below the lines of boxes."""
    x, y = points.T
    ax.scatter(x, y, s=0.6, color=LIDAR_COLOR, lw=0, zorder=2, rasterized=True)


def draw_lines(
    ax: Axes,
    lines: Sequence[Float[np.ndarray, "_ 2"]],
    color: str,
    widths: ArrayLike,
    zorder: float = 4.0,
) -> None:
    """Draws lines with a black outline of half a point, without changing the axes limits."""
    for stroke, extra in (("black", 1.1), (color, 0.0)):
        collection = LineCollection(
            list(lines),
            colors=stroke,
            linewidths=np.asarray(widths) + extra,
            capstyle="round",
            zorder=zorder + (0.1 if stroke == color else 0.0),
        )
        ax.add_collection(collection, autolim=False)


def line_scales(
    ax: Axes, outlines: Iterable[Float[np.ndarray, "_ 2"]], full_pt: float
) -> Float[np.ndarray, " N"]:
    """Returns factors from 0.4 to 1 for the line widths of boxes.

    Lines of boxes smaller than `full_pt` points are thinner, as they would otherwise fill
    the box. The size of a box is the shorter side of the bounding rectangle of its outline
    in the figure.
    """
    pixels = [np.ptp(ax.transData.transform(o), axis=0).min() for o in outlines]
    size_pt = np.array(pixels) * 72 / ax.figure.dpi
    return np.clip(size_pt / full_pt, 0.4, 1.0)


def halo(width: float, color: str = "black") -> list[AbstractPathEffect]:
    """Returns path effects that outline lines and text to be legible on any map."""
    return [Stroke(linewidth=width, foreground=color), Normal()]


# Texts next to boxes -----------------------------------------------------------------

LABEL_PT = 7.5
_LINE_HEIGHT = 1.25  # in units of the font size
_SIDES = {"left": (-1, 0), "right": (1, 0), "above": (0, 1), "below": (0, -1)}


class Label(NamedTuple):
    """A text next to an outline.

    Attributes:
        outline: Points in data coordinates.
        text: One line of text.
        color: Color of the text.
        side: "left", "right", "above" or "below".
    """

    outline: Float[np.ndarray, "P 2"]
    text: str
    color: str
    side: str


def draw_labels(ax: Axes, labels: Sequence[Label], font_size: float = LABEL_PT) -> None:
    """Writes each text next to its outline, at a side where it covers no other text.

    Among these sides, the one where it covers the fewest outlines is used, and the
    label's own in a tie. A text that would cover another one at every side is left out, as
    are those of outlines with their center outside the axes. Texts are moved into the
    axes. The limits and the aspect of the axes must be final, because overlaps are
    computed in pixels.

    Args:
        ax: Axes to draw on.
        labels: Labels in descending order of importance.
        font_size: Font size in points.
    """
    point = ax.figure.dpi / 72  # in pixels
    low, high = ax.get_window_extent().get_points()
    pixels = [ax.transData.transform(label.outline) for label in labels]
    outlines = np.array([[*x.min(0), *x.max(0)] for x in pixels]).reshape(-1, 4)
    taken = np.zeros((0, 4))
    for label, (*first, right, top) in zip(labels, outlines, strict=True):
        extent = np.array([right, top]) - first
        center = first + extent / 2
        if (center < low).any() or (center > high).any():
            continue
        width = TextPath((0, 0), label.text, size=font_size).get_extents().width
        size = point * np.array([width + 3, _LINE_HEIGHT * font_size])
        sides = np.array([_SIDES[label.side], *_SIDES.values()])
        middles = center + sides * (extent / 2 + 3 * point + size / 2)
        middles = np.clip(middles, low + size / 2, high - size / 2)
        texts = np.concatenate([middles - size / 2, middles + size / 2], 1)
        is_free = ~_overlaps(texts, taken).any(1)
        if not is_free.any():
            continue
        best = np.where(is_free, _overlaps(texts, outlines).sum(1), np.inf).argmin()
        taken = np.concatenate([taken, texts[[best]]])
        x, y = ax.transData.inverted().transform(middles[best])
        ax.text(
            x,
            y,
            label.text,
            ha="center",
            va="center",
            color=label.color,
            fontsize=font_size,
            bbox={"facecolor": "black", "alpha": 0.6, "lw": 0, "pad": 1.0},
            zorder=6,
        )


def _overlaps(
    one: Float[np.ndarray, "N 4"], other: Float[np.ndarray, "M 4"]
) -> Bool[np.ndarray, "N M"]:
    """Returns which rectangles (left, bottom, right, top) overlap."""
    is_before = one[:, None, :2] < other[:, 2:]
    is_after = one[:, None, 2:] > other[:, :2]
    overlaps: np.ndarray = np.all(is_before & is_after, axis=-1)
    return overlaps


# Figures ------------------------------------------------------------------------------


class _NotebookFigure(Figure):
    """A figure that Jupyter displays without pyplot and its backends."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=80)
        return buffer.getvalue()


def new_figure(width_in: float, height_in: float, **options: Any) -> Figure:
    """Returns an empty figure outside pyplot's list of open figures."""
    return _NotebookFigure(figsize=(width_in, height_in), **{"dpi": 110, **options})


def color_limits_of(values: np.ndarray) -> tuple[float, float]:
    """Returns color limits from the noise (20th percentile) to strong echoes (99.9th).

    Non-finite values are ignored. The limits of a constant map differ by one.
    """
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(finite, [20.0, 99.9])
    if high <= low:  # nearly constant with a few peaks, such as a heatmap
        high = finite.max()
    return (float(low), float(high)) if high > low else (float(low), float(low) + 1.0)


def figure_format(path: pathlib.Path) -> str:
    """Returns the format of a figure file; raises a `UserError` for unknown suffixes."""
    suffix = path.suffix.lstrip(".").lower()
    supported = FigureCanvasBase.get_supported_filetypes()
    if suffix not in supported:
        raise UserError(
            f"cannot write a figure as {path.name!r}; suffixes: {sorted(supported)}"
        )
    return suffix


_KEYS = {
    "png": ("Software", "Description"),
    "svg": ("Creator", "Description"),
    "pdf": ("Creator", "Subject"),
}
"""Names of the metadata that figure files have."""


def save_figure(figure: Figure, path: PathLike, description: str = "") -> pathlib.Path:
    """Writes a figure to a file, which is replaced atomically.

    Args:
        figure: The figure.
        path: File to write. The suffix determines the format; missing folders are created.
        description: Origin of the figure for the metadata of the file, which also have the
            version and commit.

    Returns:
        The path of the file.

    Raises:
        UserError: matplotlib does not support the suffix.
    """
    path = as_path(path)
    suffix = figure_format(path)
    values = f"radejax {__version__}, commit {radejax_commit()}", description
    metadata = dict(zip(_KEYS.get(suffix, ()), values, strict=False)) or None
    # Publishers require TrueType fonts; matplotlib embeds Type 3 fonts by default.
    with (
        atomic_path(path) as temporary,
        matplotlib.rc_context({"pdf.fonttype": 42, "ps.fonttype": 42}),
    ):
        figure.savefig(temporary, format=suffix, metadata=metadata)
    return path
