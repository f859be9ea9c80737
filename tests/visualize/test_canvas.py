from types import SimpleNamespace

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.core.structures import Detections
from radejax.visualize import canvas

BOXES = np.arange(14.0).reshape(2, 7)


@pytest.mark.parametrize(
    "value",
    [
        (BOXES, [0.5, 0.25], [0, 2]),
        [BOXES, [0.5, 0.25], ["Sedan", "Pedestrian"]],
        {"boxes": BOXES, "scores": [0.5, 0.25], "classes": [0, 2]},
        {"box": BOXES, "score": [0.5, 0.25], "cls": ["Sedan", "Pedestrian"]},
        SimpleNamespace(boxes=BOXES, scores=[0.5, 0.25], classes=np.array([0, 2])),
        Detections(
            boxes=np.concatenate([BOXES, BOXES[:1]]),
            scores=np.array([0.5, 0.25, 0.0]),
            classes=np.array([0, 2, -1]),
            is_valid=np.array([True, True, False]),
            num_truncated=np.array(0),
        ),
        canvas.Objects(BOXES, ("Sedan", "Pedestrian"), np.array([0.5, 0.25])),
    ],
)
def test_as_objects_reads_whatever_holds_boxes(value):
    objects = canvas.as_objects(value)
    np.testing.assert_array_equal(objects.boxes, BOXES)
    assert objects.names == ("Sedan", "Pedestrian")
    assert canvas.label_texts(objects) == ["Sedan 0.50", "Pedestrian 0.25"]


def test_as_objects_without_scores_or_objects():
    objects = canvas.as_objects((BOXES, ["a", "b"]))
    assert objects.scores is None
    assert canvas.label_texts(objects) == ["a", "b"]
    assert canvas.as_objects(None).boxes.shape == (0, 7)
    assert canvas.as_objects(([], [])).boxes.shape == (0, 7)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ((BOXES,), "2|two|boxes, classes"),
        ({"classes": [0]}, "has no 'boxes'"),
        ((BOXES[None], [0, 1]), r"\[N, 7\]"),
        ((BOXES, [0.5], [0, 1]), "2 boxes but 1 scores"),
        ((BOXES, [0, 5]), "class index 5 has no name"),
    ],
)
def test_malformed_objects_are_named(value, message):
    with pytest.raises(UserError, match=message):
        canvas.as_objects(value, what="predictions")


def test_color_limits_ignore_what_is_not_finite():
    values = np.linspace(0.0, 1.0, 1001)
    low, high = canvas.color_limits_of(np.append(values, [np.nan, np.inf]))
    assert (low, high) == pytest.approx((0.2, 0.999))
    assert canvas.color_limits_of(np.eye(100)[0]) == (0.0, pytest.approx(0.901, 1e-3))
    assert canvas.color_limits_of(np.eye(2000)[0]) == (0.0, 1.0)
    assert canvas.color_limits_of(np.full(5, 3.0)) == (3.0, 4.0)
    assert canvas.color_limits_of(np.array([np.nan])) == (0.0, 1.0)


def test_save_makes_folders_and_leaves_no_parts(tmp_path):
    figure = canvas.new_figure(2, 2)
    path = canvas.save_figure(figure, tmp_path / "a" / "b.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    canvas.save_figure(figure, tmp_path / "a" / "b.pdf")
    assert {p.name for p in path.parent.iterdir()} == {"b.png", "b.pdf"}


def test_failed_save_keeps_the_old_picture(tmp_path, monkeypatch):
    figure = canvas.new_figure(2, 2)
    path = canvas.save_figure(figure, tmp_path / "b.png")
    before = path.read_bytes()

    def fail(target, **_):
        target.write_bytes(b"half")
        raise RuntimeError("interrupted")

    monkeypatch.setattr(figure, "savefig", fail)
    with pytest.raises(RuntimeError, match="interrupted"):
        canvas.save_figure(figure, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["b.png"]


def test_unknown_suffix_is_refused(tmp_path):
    with pytest.raises(UserError, match="png"):
        canvas.save_figure(canvas.new_figure(2, 2), tmp_path / "a.xyz")


def test_radar_colors_keep_white_and_red_visible():
    """WCAG contrast of at least 1.5 between white and the strongest echo."""

    def luminance(rgb):
        rgb = np.asarray(rgb[:3])
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    brightest = luminance(canvas.COLOR_MAP(1.0))
    assert 1.05 / (brightest + 0.05) > 1.5
    # Monotone in brightness: readable in grey and under colour blindness.
    steps = [luminance(canvas.COLOR_MAP(v)) for v in np.linspace(0, 1, 20)]
    assert (np.diff(steps) > 0).all()
