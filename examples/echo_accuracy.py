"""Measures how accurately the radar echo of a VRU gives its position.

    python examples/echo_accuracy.py
    python examples/echo_accuracy.py --cls Bicycle --range-bins 164
    python examples/echo_accuracy.py --cls Motorcycle --full-size

The result is a reference for detectors, not an upper bound. In simulated scenes with the radar of
the quickstart or of K-Radar, the Doppler bin of the object's body is assumed to be known. The
strongest of the 3 x 3 bins around the object's center is located, and its position between bins is
interpolated by parabolas in range and azimuth. The mean offset of the echo from the center, which
depends on the size of the object, is removed. The table lists the fraction of boxes of true size
and heading at these positions that overlap the true box with a BEV IoU above 0.3. If every object
had one such box with a random score, AP would be about the square of that fraction. A network uses
more bins, but does not know the Doppler bin.
"""

from collections.abc import Iterator

import click
import numpy as np

from radejax.cli import entry
from radejax.core.errors import UserError
from radejax.core.structures import CLASSES, NARROW_ROI
from radejax.evaluation.boxes import in_roi
from radejax.evaluation.report import Table, number
from radejax.geometry.rotated_iou import bev_iou
from radejax.simulation.config import FULL_SIZE, SimulationOptions
from radejax.simulation.simulator import SequenceSimulator, make_source

DISTANCES_M = ((5.0, 20.0), (20.0, 40.0))


def between(values: np.ndarray) -> float:
    """Returns the offset in bins, at most 0.5, of a parabola's maximum from the middle value."""
    left, middle, right = map(float, values)
    bend = left - 2.0 * middle + right
    return float(np.clip((left - right) / (2.0 * bend), -0.5, 0.5)) if bend < 0 else 0.0


def locate(power_db: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Returns the position of the strongest of the 3 x 3 bins around a bin of a map `[R, A]`."""
    row, column = np.clip(cell, 2, np.array(power_db.shape) - 3)
    beside = power_db[row - 1 : row + 2, column - 1 : column + 2]
    top = np.unravel_index(beside.argmax(), beside.shape)
    row, column = row - 1 + top[0], column - 1 + top[1]
    along = between(power_db[row - 1 : row + 2, column])
    across = between(power_db[row, column - 1 : column + 2])
    return np.array([row + along, column + across])


def measured(
    options: SimulationOptions, cls: str
) -> Iterator[tuple[np.ndarray, float, float]]:
    """Yields box and errors [m] in range and azimuth of visible objects in the narrow region."""
    grid, source = options.make_grid(), make_source(options)
    doppler_step = grid.doppler_mps[1] - grid.doppler_mps[0]
    for name in source.numbers:
        simulator = SequenceSimulator(source.make(name), options)
        frame = simulator.sequence.frame(0)
        given = simulator.radar_input(frame)
        doppler = simulator.run(given, "projection")[..., : grid.num_doppler]
        visible = simulator.is_radar_visible(frame, given)
        visible &= (frame.cls == CLASSES.index(cls)) & in_roi(frame.boxes, NARROW_ROI)
        for i in np.flatnonzero(visible):
            x, y = frame.boxes[i, :2]
            distance = np.hypot(x, y)
            velocity = frame.velocity_mps[i] - frame.ego_velocity_mps
            rate = velocity @ frame.boxes[i, :2] / distance
            bin_ = round((rate - grid.doppler_mps[0]) / doppler_step)
            power_db = doppler[..., bin_ % grid.num_doppler]
            found = locate(power_db, grid.nearest_bin(x, y))
            along, across = found - grid.ego_to_bin(x, y)
            across = across * grid.azimuth_step_rad * distance
            yield frame.boxes[i], along * grid.range_step_m, across


def overlap(boxes: np.ndarray, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Returns the BEV IoU `[N]` of true boxes with their copies moved by errors in meters."""
    bearing = np.arctan2(boxes[:, 1], boxes[:, 0])
    ahead, aside = np.cos(bearing), np.sin(bearing)
    moved = boxes.copy()
    moved[:, 0] += along * ahead + across * aside  # azimuth is positive to the right
    moved[:, 1] += along * aside - across * ahead
    return bev_iou(moved[:, None], boxes[:, None])[:, 0, 0]


def table(options: SimulationOptions, cls: str) -> Table:
    """Returns the table of errors and the fraction of overlapping boxes by distance."""
    found = np.array([[*box, *errors] for box, *errors in measured(options, cls)])
    boxes, along, across = np.split(found.reshape(-1, 9), (7, 8), axis=1)
    distance, rows = np.hypot(boxes[:, 0], boxes[:, 1]), []
    for low, high in DISTANCES_M:
        at = (low <= distance) & (distance < high)
        if not at.any():
            raise UserError(
                f"{options.train_sequences} scenes have no {cls} visible to the radar"
                f" at {low:g} to {high:g} m; increase --scenes"
            )
        center = np.mean(along[at])
        left, right = along[at, 0] - center, across[at, 0] - np.mean(across[at])
        share = np.mean(overlap(boxes[at], left, right) > 0.3)
        values = (center, np.median(np.abs(left)), np.median(np.abs(right)))
        texts = [number(value, digits=2) for value in values]
        rows.append(
            [f"{low:g}-{high:g} m", int(at.sum()), *texts, f"{100 * share:.0f} %"]
        )
    title = f"echo position of class {cls}, {options.make_grid().num_range} range bins"
    head = ["Distance", "Objects", "Echo - center m", "Range m", "Azimuth m"]
    return Table(title, [*head, "IoU > 0.3"], rows)


@click.command()
@click.option("--scenes", default=300, show_default=True, type=click.IntRange(1))
@click.option(
    "--cls", default="Pedestrian", show_default=True, type=click.Choice(CLASSES)
)
@click.option(
    "--range-bins", type=click.IntRange(8), help="Number of range bins. Default: 64."
)
@click.option(
    "--full-size", is_flag=True, help="K-Radar's grid; excludes --range-bins."
)
@click.option("--seed", default=500, show_default=True, type=click.IntRange(0))
def main(
    scenes: int, cls: str, range_bins: int | None, full_size: bool, seed: int
) -> None:
    """Print median errors of the echo position and the fraction of overlapping boxes."""
    entry.set_up_jax()
    with entry.exit_codes():
        if full_size and range_bins:
            raise UserError(
                "--full-size has 256 range bins and cannot be combined with --range-bins"
            )
        options = SimulationOptions(
            seed=seed,
            train_sequences=scenes,
            test_sequences=0,
            frames_per_sequence=1,
            vru_density_scale=5.0,
        )
        sensor = FULL_SIZE if full_size else {"grid": {"num_range": range_bins or 64}}
        found = table(options.replace(**sensor), cls)
        click.echo(found.render(is_simulated=True))


if __name__ == "__main__":
    main()
