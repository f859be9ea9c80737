import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.visualize import label_placement
from radejax.visualize.canvas import new_figure

FRAME = np.array([0.0, 0.0, 400.0, 400.0])


def place(anchors, prefer, obstacles=None, size=(40.0, 10.0)):
    anchors = np.asarray(anchors, float)
    return label_placement.place_labels(
        anchors if obstacles is None else np.asarray(obstacles, float),
        anchors,
        np.tile(size, (len(anchors), 1)),
        prefer,
        FRAME,
        gap=2.0,
    )


def test_free_labels_stand_where_they_should():
    anchor = [[100.0, 100.0, 110.0, 120.0]]
    np.testing.assert_allclose(place(anchor, ["left"]), [[58.0, 105.0]])
    np.testing.assert_allclose(place(anchor, ["right"]), [[112.0, 105.0]])
    np.testing.assert_allclose(place(anchor, ["above"]), [[85.0, 122.0]])


def test_label_changes_sides_at_the_border():
    np.testing.assert_allclose(
        place([[10.0, 100.0, 20.0, 120.0]], ["left"]), [[22.0, 105.0]]
    )


def test_overlap_by_hand():
    a = np.array([[0.0, 0.0, 2.0, 2.0]])
    b = np.array([[1.0, 1.0, 4.0, 3.0], [2.0, 0.0, 3.0, 1.0]])
    np.testing.assert_array_equal(label_placement._overlap(a, b), [[1.0, 0.0]])


@settings(deadline=None, max_examples=30)
@given(
    st.lists(
        st.tuples(st.floats(100, 290), st.floats(100, 290)), min_size=5, max_size=5
    )
)
def test_a_handful_of_labels_never_cover_each_other(points):
    xy = np.array(points)
    corners = place(np.concatenate([xy, xy + 8], -1), ["left", "right"] * 2 + ["left"])
    boxes = np.concatenate([corners, corners + np.array([40.0, 10.0])], -1)
    shared = label_placement._overlap(boxes, boxes)
    np.fill_diagonal(shared, 0.0)
    assert shared.max() <= 0.1 * 40.0 * 10.0  # a tenth of a label at most


def test_outlines_out_of_sight_get_no_text():
    ax = new_figure(4, 4).add_subplot()
    ax.set(xlim=(0, 10), ylim=(0, 10))
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    labels = [
        label_placement.Label(square + shift, text, "white", "left")
        for shift, text in ((4, "seen"), (40, "unseen"))
    ]
    label_placement.draw_labels(ax, labels)
    assert [t.get_text() for t in ax.texts] == ["seen"]


def test_of_texts_that_cover_each_other_the_first_is_drawn():
    places = [[0, 0, 10, 10], [5, 0, 15, 10], [14.5, 0, 24, 10], [40, 0, 50, 10]]
    # The second is covered by the first by half; the third only by the second, gone.
    is_free = label_placement._is_free(np.array(places, float))
    np.testing.assert_array_equal(is_free, [True, False, True, True])
    ax = new_figure(1.0, 0.3).add_subplot()
    ax.set(xlim=(0, 10), ylim=(0, 10))
    square = np.array([[4, 4], [6, 4], [6, 6], [4, 6]])
    texts = [f"a long text, number {i}" for i in range(60)]
    labels = [label_placement.Label(square, text, "white", "left") for text in texts]
    label_placement.draw_labels(ax, labels)
    assert 1 <= len(ax.texts) < 60
    assert ax.texts[0].get_text() == texts[0]
