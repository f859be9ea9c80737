"""Conditions of frames, and the camera's weight by condition."""

import fusion_by_lens
import numpy as np
import pytest


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


def test_share_by_condition_with_intervals_over_sequences() -> None:
    rng = np.random.default_rng(0)
    sequence = np.repeat(np.arange(50), 4)
    is_fog = sequence % 2 == 1
    share = 0.5 - 0.1 * is_fog + 0.02 * rng.standard_normal(200)
    share[:3] = np.nan  # without an image
    groups = {"all": np.ones(200, bool), "fog": is_fog, "snow": np.zeros(200, bool)}
    rows = list(fusion_by_lens.share_rows(share, sequence, groups, 200))
    whole, fog, snow = rows
    assert (whole["frames"], fog["frames"], snow["frames"]) == (197, 100, 0)
    assert whole["share"] == pytest.approx(np.nanmean(share))
    assert fog["share"] == pytest.approx(share[is_fog].mean())
    assert fog["difference"] == pytest.approx(fog["share"] - whole["share"])
    assert -0.08 < fog["difference low"] < fog["difference"] < -0.03
    assert fog["difference high"] < -0.03
    assert (whole["difference"], whole["difference high"]) == (0.0, 0.0)
    assert np.isnan([snow["share"], snow["share low"]]).all()
    # Sequences are resampled as a whole, not frames.
    steady = np.where(np.isin(sequence, [0, 2, 4]), 0.9, 0.1)
    (row,) = fusion_by_lens.share_rows(steady, sequence, {"all": groups["all"]}, 500)
    assert row["share high"] - row["share low"] > 0.08
