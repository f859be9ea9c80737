"""The tracker, its scores and the example as a whole."""

import numpy as np
import pytest
import tracking
from tracking import Objects, Tracker, track_frames

from radejax.data.kradar import KRadar
from radejax.simulation.config import SimulationOptions

GRID = {"num_doppler": 8, "num_range": 16, "num_elevation": 3, "num_azimuth": 12}


def objects(*rows):
    """Objects of rows of class, x and y."""
    cls = np.array([row[0] for row in rows], str)
    position_m = np.reshape([row[1:] for row in rows], (-1, 2)).astype(float)
    unknown = np.full(len(rows), -1), np.full((len(rows), 2), np.nan)
    return Objects(cls, position_m, *unknown)


def test_a_track_has_the_velocity_of_its_object_and_survives_a_gap():
    clock_s = 0.1 * np.arange(20)
    found = [objects(("Sedan", 60.0 - 20.0 * t, 2.0 + t)) for t in clock_s]
    found[12] = objects()
    tracks = track_frames(found, clock_s)
    assert [len(x.cls) for x in tracks] == [0, 0] + [1] * 10 + [0] + [1] * 7
    assert {n for x in tracks for n in x.identity} == {1}
    np.testing.assert_allclose(tracks[-1].velocity_mps, [[-20.0, 1.0]], atol=0.3)
    np.testing.assert_allclose(tracks[-1].position_m, [[22.0, 3.9]], atol=0.05)


def test_classes_and_far_detections_are_tracks_of_their_own():
    first = objects(("Sedan", 20, 0), ("Pedestrian", 20, 0))
    second = objects(("Pedestrian", 20, 0), ("Sedan", 60, 0))
    tracker = Tracker(min_hits=1)
    start, end = track_frames([first, second], [0.0, 0.1], tracker)
    assert (start.cls.tolist(), start.identity.tolist()) == (
        ["Sedan", "Pedestrian"],
        [1, 2],
    )
    assert (end.cls.tolist(), end.identity.tolist()) == (
        ["Pedestrian", "Sedan"],
        [2, 3],
    )


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> KRadar:
    out = tmp_path_factory.mktemp("tracking")
    return tracking.simulate(SimulationOptions(grid=GRID), out, 2, 12)


def test_labeled_boxes_as_detections_are_tracked_nearly_perfectly(frames, tmp_path):
    pytest.importorskip("trackeval")
    parts = tracking.consecutive(frames)
    assert [len(part) for part in parts] == [12, 12]
    sequences = {}
    for part in parts:
        truth = tracking.labeled(part)
        clock_s = [frame.header.timestamp_s for frame in part]
        tracks = track_frames(truth, clock_s, Tracker(min_hits=1, position_m=0.1))
        sequences[part[0].key] = truth, tracks
    table = tracking.score(sequences.values())
    every = dict(zip(table.header, table.rows[-1], strict=True))
    assert every["Class"] == "all"
    assert every["Boxes"] == sum(len(frame.boxes) for frame in frames)
    for name in ("MOTA", "IDF1", "HOTA"):
        assert 95.0 < float(every[name]) <= 100.0
    assert float(every["MOTP m"]) < 0.1
    assert float(every["Velocity error m/s"]) < 0.3
    tracking.draw(tmp_path / "tracks.png", sequences)
    assert (tmp_path / "tracks.png").stat().st_size > 10_000


def test_scores_of_errors_worked_out_by_hand():
    pytest.importorskip("trackeval")
    cars = objects(("Sedan", 10, 0), ("Sedan", 40, 0))
    truth = cars._replace(
        identity=np.array([5, 6]), velocity_mps=np.array([[3.0, 4.0], [0.0, 0.0]])
    )
    # One car is found 1 m away, with a new identity in the second of two frames.
    found = objects(("Sedan", 11, 0))._replace(velocity_mps=np.zeros((1, 2)))
    tracks = [found._replace(identity=np.array([n])) for n in (1, 2)]
    table = tracking.score([([truth, truth], tracks)])
    row = dict(zip(table.header, table.rows[0], strict=True))
    # 2 of 4 boxes are missing and one identity is switched: 1 - 3 / 4.
    assert (row["Tracks"], row["Boxes"], row["MOTA"]) == (2, 4, "25.0")
    assert row["ID switches"] == 1
    assert row["IDF1"] == "33.3"  # 1 of 4 boxes and 1 of 2 tracked ones
    assert (row["MOTP m"], row["Velocity error m/s"]) == ("1.00", "5.00")


def test_parts_end_at_gaps_and_sequences(frames):
    some = [frame for n, frame in enumerate(frames) if n not in range(3, 9)]
    assert [len(part) for part in tracking.consecutive(some)] == [3, 3, 12]


@pytest.mark.slow
def test_the_bundled_model_is_tracked(tmp_path):
    pytest.importorskip("trackeval")
    options = ["--out", str(tmp_path), "--num-sequences", "2", "--num-frames", "40"]
    tracking.main(options, standalone_mode=False)
    table = (tmp_path / "tracks.md").read_text().splitlines()
    name, *values = (x.strip() for x in table[-1].strip("|").split("|"))
    assert table[0].startswith("**Simulated data: ")
    assert name == "all"
    assert float(values[2]) > 30.0  # MOTA
    assert (tmp_path / "tracks.png").is_file()
