"""The report of an evaluation as one HTML file, `report.html`, without external files."""

from __future__ import annotations

import base64
import io
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import jinja2

from radejax.core import files
from radejax.core.files import JsonObject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_BYTES = 9_000_000
"""Scenes are left out if the file would be larger."""

_TEMPLATE = pathlib.Path(__file__).with_name("report.html")


class SceneFigure(NamedTuple):
    """Figure of one frame in a report.

    Attributes:
        title: Sequence, frame and mistakes.
        tags: Values by which the page selects figures, by what they are, such as "weather".
        figure: The figure.
    """

    title: str
    tags: Mapping[str, Sequence[str]]
    figure: Figure


def write_html(
    path: pathlib.Path,
    metrics: JsonObject,
    tables: Sequence[object],
    curves: Mapping[str, Figure],
    scenes: Iterable[SceneFigure],
) -> None:
    """Writes the page, of less than 10 MB, with all tables and figures inside.

    Args:
        path: File to write.
        metrics: Content of metrics.json.
        tables: Tables of the report, see `report.Table`.
        curves: Figures of curves by name.
        scenes: Figures of frames in descending order of importance. Those for which the
            file has no space are counted in it.
    """
    images = {name: _data_url(figure) for name, figure in curves.items()}
    space = MAX_BYTES - sum(map(len, images.values()))
    figures = []
    num_left_out = 0
    for scene in scenes:
        image = _data_url(scene.figure)
        if len(image) > space:
            num_left_out += 1
            continue
        space -= len(image)
        figures.append((scene.title, scene.tags, image))
    template = jinja2.Template(
        files.read_text(_TEMPLATE),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    content: JsonObject = {"metrics": metrics, "tables": tables, "curves": images}
    content |= {"figures": figures, "num_left_out": num_left_out}
    files.write_text(path, template.render(content))


def _data_url(figure: Figure) -> str:
    """Returns a figure as the URL of an image that the page contains."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="webp", dpi=100, pil_kwargs={"quality": 80})
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
