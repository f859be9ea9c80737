"""Draws the thumbnails of `docs/gallery.md` into `docs/images/gallery`.

Most are parts of other figures: of `docs/images`, or of the outputs that the notebooks contain.
"""

from __future__ import annotations

import base64
import io
import json
import pathlib
from collections.abc import Callable

import cfar_baseline
import numpy as np
import own_radar
from matplotlib.figure import Figure
from PIL import Image
from result_figures import INCONCLUSIVE, RESULTS, SUPPORTED

import radejax
from radejax.simulation.config import SimulationOptions
from radejax.visualize.draw import draw_bev
from radejax.visualize.style import new_figure

ROOT = pathlib.Path(__file__).resolve().parents[2]
SIZE = 288, 180
COLORS = 64

Part = tuple[float, float, float, float]
"""Left, upper, right and lower end of a part of a figure, as fractions of its size."""

OF_IMAGES: dict[str, tuple[str, Part]] = {
    "demo": ("demo.png", (0.0, 0.1, 0.44, 0.62)),
    "ablation": ("claims.png", (0.0, 0.0, 1.0, 0.66)),
    "fusion_by_lens": ("camera_share.png", (0.38, 0.0, 1.0, 0.41)),
    "tracking": ("tracks.png", (0.0, 0.04, 0.52, 1.0)),
    "velocity": ("velocity.png", (0.45, 0.3, 1.0, 1.0)),
    "reference_points": ("reference_points.png", (0.0, 0.06, 0.86, 1.0)),
}
"""Thumbnails from files of `docs/images`."""

OF_NOTEBOOKS: dict[str, tuple[str, int, Part]] = {
    "01_batch_inference": ("01_batch_inference", 9, (0.0, 0.05, 0.44, 0.6)),
    "02_inside_radenet": ("02_inside_radenet", 13, (0.0, 0.0, 1.0, 1.0)),
    "03_radar_camera": ("03_radar_camera", 3, (0.0, 0.06, 1.0, 1.0)),
    "04_your_kradar": ("04_your_kradar", 6, (0.0, 0.05, 0.44, 0.6)),
}
"""Thumbnails from the figure of a cell of a notebook."""


def draw(data: pathlib.Path, out: pathlib.Path) -> None:
    """Draws all thumbnails."""
    out.mkdir(exist_ok=True)
    for name, (source, part) in OF_IMAGES.items():
        _save(Image.open(ROOT / "docs" / "images" / source), part, out / f"{name}.png")
    for name, (notebook, cell, part) in OF_NOTEBOOKS.items():
        _save(_figure_of_cell(notebook, cell), part, out / f"{name}.png")
    for name, (draw_one, part) in DRAWN.items():
        file = io.BytesIO()
        draw_one(data).savefig(file, dpi=180)
        _save(Image.open(file), part, out / f"{name}.png")


def _figure_of_cell(notebook: str, cell: int) -> Image.Image:
    path = ROOT / "notebooks" / f"{notebook}.ipynb"
    outputs = json.loads(path.read_text(encoding="utf-8"))["cells"][cell]["outputs"]
    (png,) = (
        x["data"]["image/png"] for x in outputs if "image/png" in x.get("data", ())
    )
    return Image.open(io.BytesIO(base64.b64decode(png)))


def _save(image: Image.Image, part: Part, path: pathlib.Path) -> None:
    """Saves a part of a figure in few colors, in the middle of a white thumbnail."""
    box = tuple(int(x * n) for x, n in zip(part, 2 * image.size, strict=True))
    shown = image.convert("RGB").crop(box)
    shown.thumbnail(SIZE, Image.Resampling.LANCZOS)
    page = Image.new("RGB", SIZE, "white")
    page.paste(shown, ((SIZE[0] - shown.width) // 2, (SIZE[1] - shown.height) // 2))
    page.quantize(COLORS).save(path, optimize=True)


def _stored(name: str) -> dict:
    return json.loads((RESULTS.parent / name).read_text(encoding="utf-8"))


def draw_calibration(_: pathlib.Path) -> Figure:
    """Draws the calibration error of scores and of probabilities by class."""
    rows = _stored("calibration.json")["calibration_errors"]
    rows = [
        row for row in rows if row["min_score"] == min(r["min_score"] for r in rows)
    ]
    figure = new_figure(4.0, 2.5, layout="constrained")
    ax = figure.subplots()
    place = np.arange(len(rows))
    for shift, kind, color in (
        (-0.2, "score", INCONCLUSIVE),
        (0.2, "probability", SUPPORTED),
    ):
        ax.barh(place + shift, [r[kind] for r in rows], 0.38, color=color, label=kind)
    ax.set_yticks(place, [row["cls"] for row in rows])
    ax.invert_yaxis()
    ax.set_xlabel("calibration error, held-out scenes")
    ax.legend(fontsize=8)
    return figure


def draw_robustness(_: pathlib.Path) -> Figure:
    """Draws the AP at the lowest and highest value of each field of the radar."""
    found = _stored("ablations/robustness.json")["trained on realistic"]["ap"]
    fields: dict[str, list[float]] = {}
    for name, ap in found.items():
        if " " in name:
            fields.setdefault(name.split()[0], []).append(ap)
    figure = new_figure(4.0, 2.5, layout="constrained")
    ax = figure.subplots()
    for y, (low, high, *_) in enumerate(fields.values()):
        ax.plot([low, high], [y, y], color="0.75", lw=2, zorder=1)
        ax.plot(low, y, "o", color=INCONCLUSIVE, label="lowest" if y == 0 else None)
        ax.plot(high, y, "D", color=SUPPORTED, label="highest" if y == 0 else None)
    ax.axvline(found["realistic"], color="black", lw=0.8)
    ax.set_yticks(range(len(fields)), list(fields), fontsize=8)
    ax.set_xlabel("mean AP at other values of the radar")
    ax.legend(fontsize=8)
    return figure


def draw_own_radar(data: pathlib.Path) -> Figure:
    """Draws the frame with the most boxes of the simulated recording."""
    root = data / "own_radar"
    if not (root / "boxes.csv").exists():
        own_radar.simulate(root, 8)
    options = own_radar.get_config().replace(data={"roots": (str(root),)}).data
    frames = own_radar.OwnRadar.from_options(options, own_radar.CLASSES)
    frame = max(frames, key=lambda frame: len(frame.boxes))
    projection = frame.read_projection(own_radar.GRID)
    return draw_bev(radejax.frame_scene(frame, projection, own_radar.GRID)).figure


def draw_cfar(data: pathlib.Path) -> Figure:
    """Draws the detections of CFAR in the frame with the most boxes."""
    frames = _simulated(data / "cfar", test_sequences=8, image_width=0)
    frame = max(frames, key=lambda frame: len(frame.boxes))
    projection = frame.read_projection(frames.grid)
    parameters = cfar_baseline.PARAMETERS
    found = cfar_baseline.detect(projection, frames.grid, parameters)
    boxes = radejax.Boxes.one_frame(found["box"], found["cls"], found["score"])
    scene = radejax.frame_scene(
        frame,
        projection,
        frames.grid,
        predictions=boxes,
        score_threshold=0.5,
        roi="wide",
    )
    return draw_bev(scene).figure


def draw_silhouettes(data: pathlib.Path) -> Figure:
    """Draws the oracle image with the most kinds of objects."""
    frames = _simulated(data / "oracle", test_sequences=8, camera_mode="oracle")
    frame = max(frames, key=lambda frame: len(set(frame.classes)))
    pixels, _ = radejax.front_view(frame)
    figure = new_figure(4.8, 3.0)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.imshow(pixels)
    ax.axis("off")
    return figure


def _simulated(folder: pathlib.Path, **options: object) -> radejax.KRadar:
    one_frame = {"train_sequences": 0, "frames_per_sequence": 1, "output": "projection"}
    simulation = SimulationOptions(seed=1000, **one_frame, **options)
    return radejax.KRadar([radejax.simulate(simulation, folder)])


WHOLE: Part = (0.0, 0.0, 1.0, 1.0)
DRAWN: dict[str, tuple[Callable[[pathlib.Path], Figure], Part]] = {
    "calibration": (draw_calibration, WHOLE),
    "robustness": (draw_robustness, WHOLE),
    "own_radar": (draw_own_radar, WHOLE),
    "cfar_baseline": (draw_cfar, (0.1, 0.5, 0.86, 0.98)),
    "silhouettes": (draw_silhouettes, WHOLE),
}
"""Thumbnails of examples that have no figure of their own in the documentation."""
