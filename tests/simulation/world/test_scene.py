"""World to ego, and what a frame leaves out."""

import numpy as np
import pytest

from radejax.simulation.world import scene


class TestOcclusion:
    BOX = np.array([[20.0, 0.0, 0.0, 4.0, 2.0, 2.0, 0.0]])

    @pytest.mark.parametrize(
        ("point", "expected"),
        [
            ([40.0, 0.0, 0.0], True),  # straight behind
            ([40.0, 3.0, 0.0], False),  # passes beside: 1.5 m off at the box
            ([40.0, 1.7, 0.0], True),
            ([10.0, 0.0, 0.0], False),  # in front
            ([40.0, 0.0, 4.4], False),  # over it: 1.98 m high at 18 m, 2.4 at 22
            ([-40.0, 0.0, 0.0], False),  # the other way
        ],
    )
    def test_by_hand(self, point, expected):
        blocked = scene.is_blocked(np.array([point]), self.BOX, np.array([-1]))
        assert blocked.tolist() == [expected]

    def test_turned_and_own_boxes(self):
        turned = self.BOX.copy()
        turned[0, 6] = np.pi / 2  # now 4 m across: 1.7 m off center is inside
        points = np.array([[40.0, 3.4, 0.0], [40.0, 0.0, 0.0]])
        for box, owners, expected in (
            (turned, [-1, -1], [True, True]),
            (self.BOX, [-1, -1], [False, True]),
            (self.BOX, [0, 0], [False, False]),
        ):
            blocked = scene.is_blocked(points, box, np.array(owners))
            assert blocked.tolist() == expected
