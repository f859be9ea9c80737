"""Computes the simulated columns of the tables in `docs/simulated_radar.md`.

    python docs/images/simulator_statistics.py --labels labels_v2_1.zip

K-Radar's labels are not part of this repository, and the result,
`docs/reports/simulator_statistics.json`, has numbers only. Maps `[R, A]` are means of the power
over Doppler and elevation in dB.
"""

from __future__ import annotations

import collections
import json
import pathlib
import tempfile
from collections.abc import Iterator
from typing import NamedTuple

import click
import numpy as np
from jaxtyping import Float
from simulator_figures import GRID, NOISE_ROWS, REAL_PROFILE_DB

from radejax.core.structures import CLASSES
from radejax.simulation.config import FULL_SIZE, RadarOptions, SimulationOptions
from radejax.simulation.simulator import SequenceSimulator, make_source
from radejax.simulation.world.own_scenes import SceneObject, write_scenes
from radejax.simulation.world.scene import turned

OUT = pathlib.Path(__file__).resolve().parents[1] / "reports/simulator_statistics.json"
COLOR_STEP_DB = 0.23
"""Step of the colors of K-Radar's map, to which simulated noise is rounded as well."""

NUM_ECHOES = 6
"""Number of echoes of a map whose leakage and width are measured."""

STRONGEST_SHARE = 0.01
"""Share of the bins that K-Radar's files `rpc_1p` keep, and from which the power of a car is."""

NEAR_M, FAR_M = 10.0, 100.0
"""Range in which echoes are looked for."""

QUARTILES = ("leakage of echoes above 5 dB", "azimuth bins within 10 dB of these peaks")
CARS = "cars at 10 to 20 m over the noise"
SLOPE = "cars from 3 to 21 m, per decade"

Map = Float[np.ndarray, "R A"]


class Car(NamedTuple):
    """A car that the radar sees, and its power over the noise, NaN if it has no point."""

    distance_m: float
    power_db: float


def noise_statistics(level_db: Map) -> Iterator[tuple[str, float]]:
    """Yields level, profile over range, spread and correlations of the noise."""
    noise_db = np.median(level_db[NOISE_ROWS])
    yield "noise at 30 to 95 m", noise_db
    for low, high in REAL_PROFILE_DB:
        rows = (GRID.range_m >= low) & (GRID.range_m < high)
        band_db = np.median(level_db[rows]) - noise_db
        yield f"{low} to {high} m over the noise", band_db
    part = level_db[(GRID.range_m > 66) & (GRID.range_m < 94)]
    part = np.round(part / COLOR_STEP_DB) * COLOR_STEP_DB
    yield "spread of a row over azimuth", np.median(part.std(1))
    whole, rows = part - part.mean(), part - part.mean(1, keepdims=True)
    yield (
        "correlation of azimuth bins in a row",
        _correlation(rows[:, 1:], rows[:, :-1]),
    )
    yield "correlation of range bins, of a map", _correlation(whole[1:], whole[:-1])
    yield "the same without the means of rows", _correlation(rows[1:], rows[:-1])


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def echo_statistics(level_db: Map) -> Iterator[tuple[str, float]]:
    """Yields the strongest echo of a map, and leakage and width of echoes above 5 dB.

    The noise of a row is the median of the rows 5 to 10 bins before and after it. The leakage
    is the median power over this noise beyond 10 degrees from the peak, relative to the peak.
    The width is the number of azimuth bins of the row within 10 dB of the peak.
    """
    azimuth_deg = np.rad2deg(GRID.azimuth_rad)
    parts = [
        np.r_[level_db[max(i - 10, 0) : max(i - 4, 1)], level_db[i + 5 : i + 11]]
        for i in range(len(level_db))
    ]
    noise_db = np.array([np.median(part) for part in parts])[:, None]
    excess = 10 ** (level_db / 10) - 10 ** (noise_db / 10)
    is_in = (GRID.range_m > NEAR_M) & (GRID.range_m < FAR_M)
    above_db = np.where(is_in[:, None], level_db - noise_db, -np.inf)
    yield f"strongest echo beyond {NEAR_M:.0f} m", above_db.max()
    for _ in range(NUM_ECHOES):
        row, column = np.unravel_index(above_db.argmax(), above_db.shape)
        if above_db[row, column] < 5.0:
            return
        peak = excess[row, column]
        is_far = np.abs(azimuth_deg - azimuth_deg[column]) > 10
        share = max(np.median(excess[row, is_far]) / peak, 1e-6)
        yield QUARTILES[0], 10 * np.log10(share)
        yield QUARTILES[1], float((excess[row] > 0.1 * peak).sum())
        above_db[max(row - 3, 0) : row + 4] = -np.inf


def find_cars(
    power: Float[np.ndarray, "D R E A"],
    boxes: Float[np.ndarray, "N 7"],
    noise_db: float,
) -> Iterator[Car]:
    """Yields the cars of a frame with the power that K-Radar's `get_pw_dist.py` computes.

    That is the mean power of points in a cube around the center of the box, whose edge is the
    length of the box. Points are the strongest 1 % of the bins, by their mean over Doppler
    without the first bin.
    """
    cube = power[1:].mean(0, dtype=np.float64)
    r, e, a = np.nonzero(cube > np.quantile(cube, 1 - STRONGEST_SHARE))
    elevation_rad, azimuth_rad = GRID.elevation_rad[e], GRID.azimuth_rad[a]
    ground_m = GRID.range_m[r] * np.cos(elevation_rad)
    x_m, y_m = ground_m * np.cos(azimuth_rad), -ground_m * np.sin(azimuth_rad)
    points_m = np.stack([x_m, y_m, GRID.range_m[r] * np.sin(elevation_rad)], 1)
    for box in boxes:
        offset_m = turned(points_m - box[:3], -box[6])
        is_in = (np.abs(offset_m) < box[3] / 2).all(1)
        mean = cube[r, e, a][is_in].mean() if is_in.any() else np.nan
        yield Car(float(np.hypot(*box[:2])), 10 * np.log10(mean) - noise_db)


def describe(options: SimulationOptions) -> dict[str, list[float]]:
    """Simulates the frames of options, and returns what the table prints of each statistic.

    These are the median, and lowest and highest or quartiles; of cars median or slope, and
    number of those with points and of all.
    """
    found = collections.defaultdict(list)
    cars: list[Car] = []
    source = make_source(options)
    for number in source.numbers:
        simulator = SequenceSimulator(source.make(number), options)
        for spec in source.frames(number):
            frame = simulator.sequence.frame(spec.scene_idx)
            given = simulator.radar_input(frame)
            power = simulator.run(given, "tesseract")
            level_db = 10 * np.log10(power.mean((0, 2), dtype=np.float64))
            is_real = np.abs(given.scatterers.amplitude).sum(1) > 0
            found["point scatterers"].append(float(is_real.sum()))
            for name, value in (
                *noise_statistics(level_db),
                *echo_statistics(level_db),
            ):
                found[name].append(float(value))
            is_car = frame.cls == CLASSES.index("Sedan")
            is_car &= simulator.is_radar_visible(frame, given)
            noise_db = np.median(level_db[NOISE_ROWS])
            cars += find_cars(power, frame.boxes[is_car], noise_db)
            click.echo(f"{options.scenes}, sequence {number}, frame {spec.name}")
    rows = {}
    for name, values in found.items():
        ends = (25, 75) if name in QUARTILES else (0, 100)
        rows[name] = np.percentile(values, (50, *ends)).round(3).tolist()
    near = [car.power_db for car in cars if 10 <= car.distance_m < 20]
    rows[CARS] = [round(float(np.nanmedian(near)), 3), *_counts(near)]
    fitted = np.array([car for car in cars if 3 <= car.distance_m < 21])
    kept = fitted[~np.isnan(fitted[:, 1])]
    slope = np.polyfit(np.log10(kept[:, 0]), kept[:, 1], 1)[0]
    rows[SLOPE] = [round(float(slope), 3), *_counts(fitted[:, 1])]
    return rows


def _counts(powers_db: list[float] | np.ndarray) -> tuple[int, int]:
    return int(np.isfinite(powers_db).sum()), len(powers_db)


def write_drives(path: pathlib.Path) -> None:
    """Write scenes like K-Radar's drives: a car ahead of a standing radar that drives away.

    Box and speed are medians of K-Radar's `tools/radar_film/targ_obj.pickle`. Each drive has
    its own car and parameters of the radar. The surroundings are the default ones, urban.
    """
    rows = [
        SceneObject(
            frame=f"{drive}/{index}",
            cls="Sedan",
            x=distance_m,
            y=0.3,
            z=0.1,
            l=4.3,
            w=2.16,
            h=1.78,
            yaw=0.0,
            track_id=1,
            vx_mps=2.3,
        )
        for drive in range(1, 11)
        for index, distance_m in enumerate((4, 5, 7, 9, 11, 13, 15, 17))
    ]
    write_scenes(path, rows)


@click.command()
@click.option("--labels", required=True, help="Folder or zip of K-Radar's labels.")
@click.option("--out", type=click.Path(path_type=pathlib.Path), default=OUT)
def main(labels: str, out: pathlib.Path) -> None:
    """Simulate 162 full-size frames, and write their statistics."""
    scenes = SimulationOptions(**FULL_SIZE, scenes=labels, frames_per_sequence=1)
    procedural = SimulationOptions(
        **FULL_SIZE, seed=3, train_sequences=16, test_sequences=0, frames_per_sequence=1
    )
    ideal = scenes.replace(
        radar=RadarOptions(preset="ideal"), sequences=tuple(range(1, 58, 8))
    )
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "drives.csv"
        write_drives(path)
        columns = {
            "label scenes": scenes,
            "procedural scenes": procedural,
            "ideal": ideal,
            "simulated drives": scenes.replace(scenes=str(path), frames_per_sequence=0),
        }
        result = {name: describe(options) for name, options in columns.items()}
    out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
