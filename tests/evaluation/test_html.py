"""The page `report.html` holds all tables and figures, and needs no other file."""

import html.parser
import re

import numpy as np
import pytest

from radejax.evaluation import html as page
from radejax.evaluation.report import Table
from radejax.visualize.style import new_figure

METRICS = {
    "run": "mine <script>",
    "radejax": "1.0",
    "options": {"roi": None},
    "split": "test",
    "is_simulated": True,
    "num_frames": 3,
    "num_ground_truth": 4,
    "num_predictions": 5,
    "left_out": {"labels: not a class": 3},
    "warnings": ["a & b"],
    "intervals": "none",
}
TABLES = [
    Table("First", ["Class", "AP"], [["a", "9.50"], ["b", "-"], ["c", "10.20"]], "one"),
    Table("Second", ["Class", "AP"], [["a", "1"], ["b", "2"]], "two", {(1, 1)}),
]
WEATHERS = ("fog", "rain", "fog")


def scenes():
    for weather in WEATHERS:
        figure = new_figure(6, 3)
        noise = np.random.default_rng(0).random((60, 60))
        figure.add_subplot().imshow(noise)
        yield page.SceneFigure(f"in {weather}", {"weather": [weather]}, figure)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    page.write_html(path, METRICS, TABLES, {"curves": new_figure(3, 3)}, scenes())
    return path


class _Elements(html.parser.HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def of(self, tag):
        return [attrs for name, attrs in self.found if name == tag]


def test_the_page_is_self_contained_and_complete(written):
    text = written.read_text()
    elements = _Elements(text)
    assert len(elements.of("img")) == 1 + len(WEATHERS)
    for image in elements.of("img"):
        assert image["src"].startswith("data:image/webp;base64,")
    links = [x.get("href") for _, x in elements.found if "href" in x]
    assert all(link.startswith("#") for link in links)
    assert "://" not in text
    assert len(elements.of("table")) == len(TABLES) + 1
    assert [x["id"] for x in elements.of("details") if "id" in x] == ["one", "two"]
    assert "<b>2</b>" in text
    assert len(elements.of("script")) == 1  # the run's name is escaped


def test_scenes_without_space_are_counted(written, tmp_path, monkeypatch):
    images = re.findall('src="([^"]*)"', written.read_text())
    monkeypatch.setattr(page, "MAX_BYTES", len(images[1]) + 10)
    page.write_html(tmp_path / "a.html", METRICS, TABLES, {}, scenes())
    text = (tmp_path / "a.html").read_text()
    assert len(_Elements(text).of("img")) == 1
    assert "2 more are only in the folder" in text
