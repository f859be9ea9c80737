"""Conditions of frames, and the camera's weight by condition."""

import fusion_by_lens
import numpy as np


def test_conditions_by_hand() -> None:
    weather = np.array(["normal", "fog", "fog", "overcast"])
    found = fusion_by_lens.conditions(weather, ["clear", "clear", "full", "partial"])
    rows = {name: np.flatnonzero(mask).tolist() for name, mask in found.items()}
    assert rows == {
        "all": [0, 1, 2, 3],
        "fog": [1, 2],
        "normal": [0],
        "overcast": [3],
        "normal, overcast": [0, 3],
        "other weather, lens clear": [1],
        "lens partly covered": [3],
        "lens heavily or fully covered": [2],
    }
