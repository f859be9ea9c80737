"""Covered lenses in the paper's proportions."""

import csv

import pytest

from radejax.data.kradar.conditions import KRADAR_CONDITIONS
from radejax.simulation.camera import lens


def test_covered_frames_of_all_of_kradar_are_as_many_as_counted(shared):
    # DinoRADE: 7.5k partly, 4.8k heavily, 4.9k fully covered of 35k frames.
    expected = dict.fromkeys(lens.LEVELS, 0.0)
    drawn = dict.fromkeys(lens.LEVELS, 0)
    with open(shared / "data" / "kradar" / "sequences.csv") as file:
        for row in csv.DictReader(file):
            frames, number = int(row["label_files"]), int(row["seq"])
            weather = KRADAR_CONDITIONS[number].weather
            for level, share in zip(lens.LEVELS, lens.AIR[weather].cover, strict=True):
                expected[level] += share * frames
            for start in range(0, frames, lens.BLOCK_FRAMES):
                level = lens.cover_level(0, number, start, weather)
                drawn[level] += min(lens.BLOCK_FRAMES, frames - start)
    for level, count in (("partial", 7500), ("heavy", 4800), ("full", 4900)):
        assert expected[level] == pytest.approx(count, rel=0.03)
        assert drawn[level] == pytest.approx(count, rel=0.15)


def test_level_holds_for_a_block_and_good_weather_is_clear():
    block = {lens.cover_level(1, 5, i, "sleet") for i in range(lens.BLOCK_FRAMES)}
    assert len(block) == 1
    for start in range(0, 5000, 50):
        assert lens.cover_level(1, 5, start, "normal") == "clear"
