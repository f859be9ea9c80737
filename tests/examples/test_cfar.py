"""The CFAR detector on maps with known results."""

import cfar
import numpy as np
import pytest

from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar import tensor
from radejax.simulation.radar.tensor import RadarParameters

GRID = RadarGrid.reduced(
    num_doppler=8, num_range=64, num_elevation=5, num_azimuth=56, max_range_m=75.6
)
PARAMETERS = RadarParameters(azimuth_elements=40.0, elevation_elements=12.0)
SETTINGS = cfar.CfarSettings()


def projection_of(*targets):
    """Projection of point targets (range, azimuth, dBsm) in noise."""
    range_m, azimuth, rcs_db = np.array(targets, float).reshape(-1, 3).T
    power_db = PARAMETERS.gain_db + rcs_db - 40.0 * np.log10(range_m)
    amplitude = 10.0 ** (power_db / 20.0)
    zero = np.zeros_like(range_m)
    scatterers = tensor.Scatterers(
        *(v.astype(np.float32) for v in (range_m, azimuth, zero, zero)),
        np.stack([amplitude, zero], 1).astype(np.float32),
    )
    noise = np.full((64, 8), 10 ** (PARAMETERS.noise_db / 10), np.float32)
    return np.asarray(
        tensor.simulate(
            scatterers, noise, tensor.frame_key(3), grid=GRID, parameters=PARAMETERS
        )
    )


def test_finds_cars_where_they_are():
    projection = projection_of((20.0, -0.2, 8.0), (40.0, 0.3, 8.0))
    found = cfar.detect(projection, GRID, PARAMETERS)
    cars = found["box"][found["cls"] == "Sedan"]
    for distance, azimuth in ((20.0, -0.2), (40.0, 0.3)):
        near_side = np.array([distance * np.cos(azimuth), -distance * np.sin(azimuth)])
        rear = cars[:, :2] - cars[:, 3:4] / 2 * (1.0, 0.0)
        assert np.hypot(*(rear - near_side).T).min() < 1.2


@pytest.mark.parametrize(
    ("rcs_db", "cls"),
    [
        (18.0, "Bus or Truck"),
        (4.0, "Sedan"),
        (-5.3, "Motorcycle"),
        (-12.0, "Pedestrian"),
    ],
)
def test_cross_section_chooses_the_class(rcs_db, cls):
    limits = (9.0, -5.0, -7.0, -9.0, -16.0)
    names = ("Bus or Truck", "Sedan", "Motorcycle", "Bicycle", "Pedestrian")
    settings = cfar.CfarSettings(rcs_steps=tuple(zip(names, limits, strict=True)))
    projection = projection_of((15.6, 0.0, rcs_db))
    found = cfar.detect(projection, GRID, PARAMETERS, settings)
    assert found["cls"][0] == cls


def test_noise_without_targets_gives_few_detections():
    found = cfar.detect(projection_of((15.0, 0.0, -200.0)), GRID, PARAMETERS)
    assert len(found["score"]) == 0
    assert found["box"].shape == (0, 7)


def test_near_peaks_become_one_and_scores_descend():
    projection = projection_of((30.0, 0.0, 8.0), (32.0, 0.0, 5.0), (50.0, 0.4, 8.0))
    found = cfar.detect(projection, GRID, PARAMETERS)
    assert (np.diff(found["score"]) <= 0).all()
    near = np.hypot(found["box"][:, 0] - 32.0, found["box"][:, 1]) < 6.0
    assert near.sum() == 1


class TestFit:
    def test_steps_by_hand(self):
        # Cars 8 to 12, people -8 to -4: any step between -4 and 8 makes no error, the
        # first candidate is the weakest car. People end at their lower quartile.
        names = ["Sedan"] * 5 + ["Pedestrian"] * 5
        values = [8.0, 9.0, 10.0, 11.0, 12.0, -8.0, -7.0, -6.0, -5.0, -4.0]
        steps = cfar.fit_rcs_steps(names, values)
        assert steps == (("Sedan", 8.0), ("Pedestrian", -7.0))

    def test_rare_classes_count_only_if_balanced(self):
        # A step at 11.5 keeps both trucks and takes two of six cars: 2 errors, 2/6. At
        # 20 one of two trucks is lost: 1 error, 1/2.
        names = ["Bus or Truck"] * 2 + ["Sedan"] * 6
        values = [11.5, 20.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0]
        plain = dict(cfar.fit_rcs_steps(names, values))
        even = dict(cfar.fit_rcs_steps(names, values, balanced=True))
        assert plain["Bus or Truck"] == 20.0
        assert even["Bus or Truck"] == 11.5

    def test_classes_that_overlap_keep_a_gap(self):
        names = ["Motorcycle"] * 3 + ["Bicycle"] * 3
        steps = cfar.fit_rcs_steps(names, [1.0, 2.0, 3.0, 0.0, 5.0, -9.0])
        assert steps[1][1] <= steps[0][1] - 1.0


def test_apparent_cross_section_of_a_point_is_its_own():
    projection = projection_of((20.4, 0.0, 8.0))
    box = np.array([[20.4, 0.0, -0.9, 4.0, 2.0, 1.5, 0.0], [60.0, 0, 0, 4, 2, 2, 0]])
    nowhere = np.array([[-20.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
    found = cfar.object_rcs_db(projection, box, GRID, PARAMETERS)
    # Half a bin off in range (Hann) and angle costs at most 1.4 + 1.4 dB.
    assert 5.0 < found[0] < 8.5
    assert found[1] < 0.0  # noise
    assert np.isnan(cfar.object_rcs_db(projection, nowhere, GRID, PARAMETERS)[0])
