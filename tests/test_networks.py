"""The figures of the networks have the models' shapes and legible text."""

import itertools
import pathlib
import runpy
import sys
from types import SimpleNamespace

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

IMAGES = pathlib.Path(__file__).resolve().parents[1] / "docs" / "images"
sys.path.append(str(IMAGES))  # the folder of sheet.py, which networks.py imports
networks = SimpleNamespace(**runpy.run_path(str(IMAGES / "networks.py")))
SHAPES = {
    "radenet": {"64 × 256 × 37 × 107", "32 × 14 × 512", "256 × 112 × 5"},
    "dinorade": {"720 × 1280 × 3", "256 × 112 × 10 queries", "180 × 320 × 128"},
}
PARAMETERS = {"radenet": "26.56 M", "dinorade": "21.60 M"}


@pytest.mark.parametrize("name", list(networks.SHEETS))
def test_figures_have_the_models_shapes_and_no_texts_overlap(name: str) -> None:
    config, lay_out = networks.SHEETS[name]
    sheet = lay_out(networks.Network.of(config))
    lines = {line for block in sheet.blocks for line in block.lines}
    assert SHAPES[name] <= lines
    said = " ".join([*lines, *(text for *_, text in sheet.notes)])
    assert PARAMETERS[name] in said
    figure = sheet.draw()
    renderer = FigureCanvasAgg(figure).get_renderer()
    (axes,) = figure.axes
    texts = [text.get_window_extent(renderer) for text in axes.texts]
    for one, other in itertools.combinations(texts, 2):
        assert not one.overlaps(other), (one, other)
