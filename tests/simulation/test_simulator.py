"""Radar frames of a sequence: where objects are, the radar map is bright."""

from __future__ import annotations

import numpy as np
import pytest

from radejax.simulation.config import SimulationOptions
from radejax.simulation.simulator import SequenceSimulator, make_source
from radejax.simulation.world.traffic import make_sequence

OPTIONS = SimulationOptions(label_distance_m=60.0).replace(radar={"preset": "ideal"})


def simulator(weather="normal", **radar):
    rng = np.random.default_rng(0)
    scene = make_sequence(1, ("urban", "day", weather), 5, rng)
    return SequenceSimulator(scene, OPTIONS.replace(radar=radar))


@pytest.fixture(scope="module")
def urban():
    return simulator()


def test_visible_objects_stand_out_of_the_noise(urban):
    brightness, floor = [], []
    for index in range(5):
        frame = urban.sequence.frame(index)
        given = urban.radar_input(frame)
        projection = urban.run(given)
        visible = urban.is_radar_visible(frame, given)
        peak = projection[..., :16].max(-1)
        floor.append(np.median(peak))
        for box in frame.boxes[visible]:
            toward = box[:2] * (1.0 - box[3] / 2 / np.hypot(*box[:2]))
            r, a = urban.grid.nearest_bin(*toward)
            near = peak[max(r - 2, 0) : r + 4, max(a - 2, 0) : a + 3]
            brightness.append(near.max())
    stands_out = np.array(brightness) > np.mean(floor) + 6.0 / 184.3
    assert len(brightness) > 10
    assert stands_out.mean() > 0.85


def radar_frame(made, index):
    return made.run(made.radar_input(made.sequence.frame(index)))


def test_frames_repeat_and_differ(urban):
    again = simulator()
    np.testing.assert_array_equal(radar_frame(urban, 2), radar_frame(again, 2))
    assert np.abs(radar_frame(urban, 2) - radar_frame(urban, 3)).max() > 0.01


def test_hidden_weak_and_outside_objects_are_not_visible(urban):
    frame = urban.sequence.frame(0)
    given = urban.radar_input(frame)
    visible = urban.is_radar_visible(frame, given)
    inside = urban.grid.in_field_of_view(frame.boxes[:, 0], frame.boxes[:, 1])
    assert visible.any()
    assert not visible[~inside].any()
    assert not visible[given.lit < 0.15].any()
    deaf = simulator(gain_db=100.0)
    assert not deaf.is_radar_visible(frame, deaf.radar_input(frame)).any()


def test_rain_weakens_targets(urban):
    frame = urban.sequence.frame(0)
    dry, wet = urban.radar_input(frame), simulator("rain").radar_input(frame)
    boxes = frame.boxes
    inside = urban.grid.in_field_of_view(boxes[:, 0], boxes[:, 1])
    difference = (dry.snr_db - wet.snr_db)[inside]
    # The wet radome costs 2 dB; the wet road mirrors better and gives some of it back.
    assert (difference > 1.0).all()
    assert np.median(difference) > 1.9
    assert difference.max() < 4.0


def test_labels_are_in_the_lidar_frame(urban):
    frame = urban.sequence.frame(1)
    labels = urban.labels(frame, urban.radar_input(frame))
    by_id = {label.track_id: label for label in labels}
    distance = np.hypot(frame.boxes[:, 0], frame.boxes[:, 1])
    assert len(labels) == (distance < 60.0).sum()
    for n in np.flatnonzero(distance < 60.0):
        box = by_id[urban.sequence.tracks.track_id[frame.track[n]]].box
        position = np.add(box[:3], (-2.54, 0.3, 0.7))
        np.testing.assert_allclose(position, frame.boxes[n, :3])


def test_training_sequences_come_first_and_sensors_count_their_own_frames():
    source = make_source(SimulationOptions(train_sequences=2, test_sequences=1))
    assert source.numbers == [1, 2, 3]
    splits = [{spec.split for spec in source.frames(n)} for n in source.numbers]
    assert splits == [{"train"}, {"train"}, {"test"}]
    first, second = source.frames(1)[:2]
    assert np.subtract(second.indices, first.indices).tolist() == [1] * 5
    assert second.timestamp_s - first.timestamp_s == pytest.approx(0.1)
    assert first.name == f"{first.indices[0]:05d}_00001"
    offsets = {source.frames(n)[0].indices[0] for n in source.numbers}
    assert len(offsets) > 1


def test_vru_density_scale_changes_training_scenes_only():
    options = SimulationOptions(train_sequences=6, test_sequences=6)
    natural = make_source(options)
    added = make_source(options.replace(vru_density_scale=4.0))

    def classes(source, numbers):
        return np.concatenate([source.make(n).tracks.cls for n in numbers])

    train, test = range(1, 7), range(7, 13)
    few, many = ((classes(source, train) >= 2).sum() for source in (natural, added))
    assert many > 2 * few
    np.testing.assert_array_equal(classes(natural, test), classes(added, test))
