"""What all pictures share: figures without global state, colours, boxes, saving.

Figures are plain `matplotlib.figure.Figure` objects: nothing here touches pyplot, its
backend or its list of open figures, so drawing works without a display, in threads
and in notebooks alike.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke

from radejax.core.errors import UserError
from radejax.core.files import atomic_path
from radejax.core.structures import CLASSES
from radejax.geometry.boxes import bev_corners
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid

# The brightest fifth is left out: white boxes must stand out on the strongest echoes.
COLOR_MAP = LinearSegmentedColormap.from_list(
    "radar", matplotlib.colormaps["viridis"](np.linspace(0.0, 0.82, 256))
)
ROI_COLOR = "black"
# Okabe and Ito's palette: told apart under every common colour blindness.
CLASS_COLORS = ("#E69F00", "#56B4E9", "#009E73", "#F0E442", "#CC79A7")
SERIES_COLORS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"),
    *("#000000", "#8A6D00"),  # black of theirs, and a yellow that paper shows
)


Layout = Literal["constrained"] | None
Side = Literal["left", "right", "above"]


class Style(NamedTuple):
    """How one set of boxes is drawn.

    Attributes:
        name: In legends.
        color: Of lines.
        text_color: Of labels; thin strokes need more light than lines.
        map_width: Of lines on a map, points.
        image_width: Of lines on an image, points.
        side: Of a box on a map where its label stands.
    """

    name: str
    color: str
    text_color: str
    map_width: float
    image_width: float
    side: Side


GROUND_TRUTH = Style("ground truth", "white", "white", 1.9, 1.6, "left")
PREDICTION = Style("prediction", "#ff4d40", "#ff7d70", 1.3, 1.2, "right")


class Objects(NamedTuple):
    """Boxes of one frame, ready to draw.

    Attributes:
        boxes: x, y, z, l, w, h, yaw in the ego frame.
        names: N class names.
        scores: None for ground truth.
    """

    boxes: Float[np.ndarray, "N 7"]
    names: tuple[str, ...]
    scores: Float[np.ndarray, " N"] | None = None


def as_objects(
    value: Any, class_names: Sequence[str] | None = None, *, what: str = "objects"
) -> Objects:
    """Boxes, classes and scores of one frame from whatever holds them.

    Args:
        value: None; `Objects`; `(boxes, classes)`; `(boxes, scores, classes)`; a
            mapping or an object (a frame, one frame of `Detections`) with `boxes`,
            `classes` and perhaps `scores` and `is_valid`; or the evaluation's columns
            `box`, `cls`, `score`. Classes are names or indices into `class_names`.
        class_names: Names of the class indices; if None those that a `Detections`
            brings along, K-Radar's otherwise.
        what: Named in errors.

    Raises:
        UserError: Shapes do not fit together, or a class index has no name.
    """
    if value is None:
        return Objects(np.zeros((0, 7)), ())
    if class_names is None:
        class_names = getattr(value, "class_names", CLASSES)
    scores = is_valid = None
    if isinstance(value, Objects):
        boxes, classes, scores = value
    elif isinstance(value, tuple | list):
        if len(value) not in (2, 3):
            raise UserError(
                f"{what} must be (boxes, classes) or (boxes, scores, classes), "
                f"got {len(value)} parts"
            )
        boxes, *middle, classes = value
        scores = middle[0] if middle else None
    else:
        boxes = _field(value, "boxes", "box")
        classes = _field(value, "classes", "cls")
        scores = _field(value, "scores", "score")
        is_valid = _field(value, "is_valid")
        for name, column in (("boxes", boxes), ("classes", classes)):
            if column is None:
                raise UserError(f"{what} ({type(value).__name__}) has no {name!r}")
    boxes = np.asarray(boxes, np.float64)
    if boxes.size == 0:
        return Objects(np.zeros((0, 7)), (), None if scores is None else np.zeros(0))
    if boxes.ndim != 2 or boxes.shape[1] != 7:
        raise UserError(
            f"{what}: boxes must be [N, 7] (x, y, z, l, w, h, yaw) of one frame, "
            f"got shape {boxes.shape}"
        )
    columns = {"classes": classes, "scores": scores, "is_valid": is_valid}
    for name, column in columns.items():
        if column is not None and len(column) != len(boxes):
            raise UserError(f"{what}: {len(boxes)} boxes but {len(column)} {name}")
    keep = np.ones(len(boxes), bool) if is_valid is None else np.asarray(is_valid, bool)
    kept_classes = (c for c, kept in zip(classes, keep, strict=True) if kept)
    return Objects(
        boxes[keep],
        tuple(_class_name(c, class_names, what) for c in kept_classes),
        None if scores is None else np.asarray(scores)[keep],
    )


def _field(value: Any, *names: str) -> Any:
    """First of the names that a mapping or object has, or None."""
    get = value.get if isinstance(value, Mapping) else functools.partial(getattr, value)
    return next((v for v in (get(n, None) for n in names) if v is not None), None)


def _class_name(value: Any, class_names: Sequence[str], what: str) -> str:
    """Name of a class given by name or index."""
    if isinstance(value, str):
        return str(value)
    if not 0 <= int(value) < len(class_names):
        raise UserError(
            f"{what}: class index {int(value)} has no name among {tuple(class_names)}"
        )
    return class_names[int(value)]


def styled_sets(
    ground_truth: Any, predictions: Any, class_names: Sequence[str] | None
) -> list[tuple[Style, Objects]]:
    """Both sets as `Objects` with their styles; what is None is left out."""
    sets = []
    if ground_truth is not None:
        truth = as_objects(ground_truth, class_names, what="ground_truth")
        sets.append((GROUND_TRUTH, truth._replace(scores=None)))
    if predictions is not None:
        found = as_objects(predictions, class_names, what="predictions")
        sets.append((PREDICTION, found))
    return sets


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """One frame to show; every picture takes from it what it needs.

    Attributes:
        projection: `[R, A, D+E]` normalised log power of one frame.
        grid: The grid of the projection.
        ground_truth: Boxes with classes; anything that `as_objects` takes, such as
            `(boxes [N, 7], classes)` or a frame; or None.
        predictions: Boxes with scores and classes, such as `(boxes, scores, classes)`
            or one frame of `Detections`; or None.
        roi: x_min, x_max, y_min, y_max, z_min, z_max in metres (z may be left out): the
            dashed rectangle where detections count; or None.
        image: `[H, W, 3]` left front camera image, uint8 or float in [0, 1], or None.
        camera: Calibration of the image: draws the boxes on it; or None.
        title: Such as sequence, frame and weather.
        class_names: Names of class indices, see `as_objects`.
        score_threshold: Of the predictions shown, for the legend, or None.
        zoom: x and y in metres of the place that `scenes` magnifies, or None.
        track_ids: One hashable id per ground truth box, None for a box without trail; for
            recordings; or None.
        time_s: Seconds since the Unix epoch, for recordings; or None.
    """

    projection: Any
    grid: RadarGrid
    ground_truth: Any = None
    predictions: Any = None
    roi: Sequence[float] | None = None
    image: Any = None
    camera: CameraCalibration | None = None
    title: str = ""
    class_names: Sequence[str] | None = None
    score_threshold: float | None = None
    zoom: tuple[float, float] | None = None
    track_ids: Any = None
    time_s: float | None = None

    @functools.cached_property
    def sets(self) -> list[tuple[Style, Objects]]:
        """Ground truth and predictions, where given, with their styles."""
        return styled_sets(self.ground_truth, self.predictions, self.class_names)


def label_texts(objects: Objects) -> list[str]:
    """Class names, with the score where there is one."""
    if objects.scores is None:
        return list(objects.names)
    return [
        f"{name} {score:.2f}"
        for name, score in zip(objects.names, objects.scores, strict=True)
    ]


def footprints(
    boxes: Float[np.ndarray, "N 7"], points_per_edge: int = 1
) -> Float[np.ndarray, "N {4*points_per_edge+1} 2"]:
    """Outlines of boxes on the ground, starting at the front left corner.

    Args:
        boxes: In the ego frame.
        points_per_edge: Points on each edge; more than 1 where edges bend, as in a
            polar view.

    Returns:
        x and y, closed, counter-clockwise.
    """
    corners = bev_corners(boxes)
    following = np.roll(corners, -1, axis=1)
    t = np.arange(points_per_edge)[:, None] / points_per_edge
    edges = corners[:, :, None] * (1 - t) + following[:, :, None] * t  # [N, 4, P, 2]
    points = edges.reshape(len(boxes), 4 * points_per_edge, 2)
    return np.concatenate([points, corners[:, :1]], 1)


def heading_marks(boxes: Float[np.ndarray, "N 7"]) -> Float[np.ndarray, "N 2 2"]:
    """Segments that stick out of the middle of each front edge.

    Outwards, so that the echo inside the box stays visible.
    """
    front = bev_corners(boxes)[:, [0, 3]].mean(1)
    return np.stack([front, front + 0.7 * (front - boxes[:, :2])], 1)


def draw_tiles(
    ax: Axes,
    edges_x: Float[np.ndarray, "*edges_x"],
    edges_y: Float[np.ndarray, "*edges_y"],
    values: Float[np.ndarray, "rows columns"],
    color_limits: tuple[float, float] | None = None,
    cmap: Any = COLOR_MAP,
) -> Any:
    """One tile per value; the colour bar's ends are the values' own by default."""
    low, high = color_limits or color_limits_of(values)
    return ax.pcolormesh(
        edges_x, edges_y, values, cmap=cmap, vmin=low, vmax=high, rasterized=True
    )


def add_colorbar(mesh: Any, ax: Axes, label: str) -> None:
    """A colour bar as high as the axes, also where equal aspect shrinks them."""
    cax = ax.inset_axes((1.02, 0.0, 0.035, 1.0))
    ax.figure.colorbar(mesh, cax=cax, label=label)


def halo(width: float, color: str = "black") -> list:
    """Path effects: an outline that keeps lines and text legible on any map."""
    return [Stroke(linewidth=width, foreground=color), Normal()]


def new_figure(
    width_in: float, height_in: float, *, dpi: float = 110, layout: Layout = None
) -> Figure:
    """An empty figure outside pyplot's list of open figures."""
    return Figure(figsize=(width_in, height_in), dpi=dpi, layout=layout)


def color_limits_of(values: np.ndarray) -> tuple[float, float]:
    """Ends of a colour bar: noise floor (20 %) to the strongest echoes (99.9 %).

    Non-finite values are ignored; a constant map gets a range of one unit.
    """
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(finite, [20.0, 99.9])
    if high <= low:  # a few peaks on nothing, such as a heatmap
        high = finite.max()
    return (float(low), float(high)) if high > low else (float(low), float(low) + 1.0)


def picture_format(path: pathlib.Path) -> str:
    """The format of a picture from its suffix; `UserError` if there is none such."""
    suffix = path.suffix.lstrip(".").lower()
    supported = FigureCanvasBase.get_supported_filetypes()
    if suffix not in supported:
        raise UserError(
            f"cannot write a picture as {path.name!r}; suffixes: {sorted(supported)}"
        )
    return suffix


def save_figure(figure: Figure, path: str | os.PathLike, **kwargs: Any) -> pathlib.Path:
    """Writes a figure completely or not at all.

    The file appears under its name by a rename, so a reader never sees half of it.

    Args:
        figure: What to write.
        path: Target; the suffix sets the format. Folders are made.
        **kwargs: For `Figure.savefig`, such as `dpi`.

    Returns:
        The path written.

    Raises:
        UserError: matplotlib cannot write the suffix.
    """
    path = pathlib.Path(path)
    suffix = picture_format(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=suffix, **kwargs)
    return path
