"""What a batch of detections shows of itself."""

import jax
import jax.numpy as jnp
import numpy as np

from radejax.core.structures import Detections


def _detections(classes: list[list[int]]) -> Detections:
    cls = jnp.array(classes)
    return Detections(
        boxes=jnp.ones((*cls.shape, 7)),
        scores=jnp.where(cls >= 0, 0.5, 0.0),
        classes=cls,
        is_valid=cls >= 0,
        num_truncated=jnp.zeros(len(classes), jnp.int32),
    )


def test_repr_counts_what_is_found_and_no_padding() -> None:
    found = _detections([[0, 2, -1], [0, -1, -1]])
    text = "Detections(2 frames of 3 places: 2 Sedan, 1 Pedestrian)"
    assert repr(found) == text
    assert repr(jax.tree.map(np.asarray, found)) == text
    assert repr(_detections([[-1, -1]])) == "Detections(1 frames of 2 places: none)"
    renamed = found.replace(class_names=("car", "lorry", "person"))
    assert "2 car, 1 person" in repr(renamed)


def test_repr_of_what_has_no_values_is_a_shape() -> None:
    found, seen = _detections([[0, -1]]), []

    @jax.jit
    def traced(detections: Detections) -> Detections:
        seen.append(repr(detections))
        return detections

    traced(found)
    one_frame = jax.tree.map(lambda leaf: leaf[0], found)
    abstract = jax.eval_shape(lambda: found)
    assert seen == [repr(abstract)] == ["Detections(boxes (1, 2, 7))"]
    assert repr(one_frame) == "Detections(boxes (2, 7))"
    assert "None" in repr(jax.tree.map(lambda _: None, found))
