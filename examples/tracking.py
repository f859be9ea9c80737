"""Tracks detections over sequences with a constant-velocity Kalman filter, and scores the tracks.

    pip install 'radejax[tracking]'
    python examples/tracking.py
    python examples/tracking.py --workdir runs/quickstart --num-sequences 8
    python examples/tracking.py --workdir runs/kradar --data /data/kradar

By default, sequences of the radar that the model was trained for are simulated at 10 frames per
second, and the model is the one that `radejax demo` uses. The tracks live in the radar frame, so
their velocities are relative to the radar, like the column "velocity_mps" of labeled frames. They
are compared with the track ids of the labels by the library TrackEval. OUT contains the table and
a figure of the tracks.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import click
import numpy as np
from scipy.optimize import linear_sum_assignment
from tqdm import tqdm

from radejax import Detector
from radejax.cli import entry
from radejax.cli.figures import MODEL
from radejax.core import files
from radejax.core.errors import UserError, require
from radejax.data.kradar import Frame, KRadar
from radejax.evaluation.report import Table, number
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset
from radejax.visualize.style import SERIES_COLORS, new_figure, save_figure

MATCH_M = 2.0
"""Distance of centers below which a track is at an object, as in nuScenes' tracking benchmark."""

MAX_GAP_S = 0.5
"""Longest time between two frames of a sequence over which tracks continue."""


class Objects(NamedTuple):
    """Objects of one frame: labeled ones, detections or tracks.

    Attributes:
        cls: Class names.
        position_m: x and y of the centers in the radar frame.
        identity: Numbers of the objects, unique in a sequence; -1 if unknown.
        velocity_mps: Relative to the radar; NaN if unknown.
    """

    cls: np.ndarray  # [N]
    position_m: np.ndarray  # [N, 2]
    identity: np.ndarray  # [N]
    velocity_mps: np.ndarray  # [N, 2]

    def take(self, rows: np.ndarray) -> Objects:
        """Returns some of the objects."""
        return Objects(*(column[rows] for column in self))


Sides = tuple[list[Objects], list[Objects]]
"""Labeled objects and tracks in every frame of a sequence."""


# Tracking -------------------------------------------------------------------------------


@dataclasses.dataclass
class Track:
    """One track with the Gaussian of its state x, y, vx, vy in the radar frame."""

    number: int
    cls: str
    mean: np.ndarray  # [4]
    covariance: np.ndarray  # [4, 4]
    num_hits: int = 1
    num_misses: int = 0


@dataclasses.dataclass
class Tracker:
    """Associates the detections of consecutive frames with constant-velocity Kalman filters.

    Attributes:
        position_m: Standard deviation of the positions of detections.
        speed_mps: Standard deviation of the velocity of a new track.
        acceleration_mps2: Standard deviation of the acceleration between two frames.
        gate: Largest squared Mahalanobis distance of a detection to a track.
        min_hits: Detections from which on a track is output.
        max_misses: Consecutive frames without a detection after which a track ends.
    """

    position_m: float = 0.5
    speed_mps: float = 25.0
    acceleration_mps2: float = 5.0
    gate: float = 13.8  # 99.9 % of true detections
    min_hits: int = 3
    max_misses: int = 4
    tracks: list[Track] = dataclasses.field(default_factory=list)
    num_started: int = 0

    def step(self, found: Objects, period_s: float) -> Objects:
        """Returns the tracks that have a detection in the next frame, `period_s` later."""
        for track in self.tracks:
            self._predict(track, period_s)
        free = set(range(len(found.cls)))
        for track, row in self._associate(found):
            self._update(track, found.position_m[row])
            free.remove(row)
        for track in self.tracks:
            track.num_misses += 1
        hit = [track for track in self.tracks if track.num_misses == 0]
        self.tracks = [x for x in self.tracks if x.num_misses <= self.max_misses]
        for row in sorted(free):
            self.num_started += 1
            mean = np.array([*found.position_m[row], 0.0, 0.0])
            variance = np.square([self.position_m] * 2 + [self.speed_mps] * 2)
            track = Track(self.num_started, found.cls[row], mean, np.diag(variance))
            self.tracks.append(track)
            hit.append(track)
        hit = [track for track in hit if track.num_hits >= self.min_hits]
        state = np.reshape([track.mean for track in hit], (-1, 4))
        numbers = np.array([track.number for track in hit], int)
        cls = np.array([track.cls for track in hit], str)
        return Objects(cls, state[:, :2], numbers, state[:, 2:])

    def _predict(self, track: Track, period_s: float) -> None:
        step = np.eye(4) + period_s * np.eye(4, k=2)
        noise = np.vstack([0.5 * period_s**2 * np.eye(2), period_s * np.eye(2)])
        track.mean = step @ track.mean
        track.covariance = step @ track.covariance @ step.T
        track.covariance += self.acceleration_mps2**2 * noise @ noise.T

    def _associate(self, found: Objects) -> Iterator[tuple[Track, int]]:
        """Yields pairs of tracks and rows with the least sum of distances."""
        cost = np.full((len(self.tracks), len(found.cls)), 2.0 * self.gate)
        for n, track in enumerate(self.tracks):
            gap = found.position_m - track.mean[:2]
            spread = track.covariance[:2, :2] + self.position_m**2 * np.eye(2)
            distance = np.einsum("ni,ij,nj->n", gap, np.linalg.inv(spread), gap)
            is_near = (distance <= self.gate) & (found.cls == track.cls)
            cost[n, is_near] = distance[is_near]
        for n, row in zip(*linear_sum_assignment(cost), strict=True):
            if cost[n, row] <= self.gate:
                yield self.tracks[n], row

    def _update(self, track: Track, position_m: np.ndarray) -> None:
        spread = track.covariance[:2, :2] + self.position_m**2 * np.eye(2)
        gain = track.covariance[:, :2] @ np.linalg.inv(spread)
        track.mean = track.mean + gain @ (position_m - track.mean[:2])
        track.covariance = track.covariance - gain @ track.covariance[:2]
        track.num_hits += 1
        track.num_misses = -1  # becomes 0 at the end of the step


def track_frames(
    found: Iterable[Objects], clock_s: Sequence[float], tracker: Tracker | None = None
) -> list[Objects]:
    """Returns the tracks in every frame of one sequence.

    Args:
        found: Detections of each frame.
        clock_s: Times of the frames.
        tracker: A tracker without tracks; None for the default one.
    """
    tracker = tracker or Tracker()
    periods_s = np.diff(clock_s, prepend=clock_s[0])
    pairs = zip(found, periods_s, strict=True)
    return [tracker.step(objects, float(period_s)) for objects, period_s in pairs]


# Frames ---------------------------------------------------------------------------------


def simulate(
    simulation: SimulationOptions, out: pathlib.Path, sequences: int, frames: int
) -> KRadar:
    """Simulates sequences of consecutive frames without images in another seed's traffic."""
    options = simulation.replace(
        seed=simulation.seed + 1000,
        scenes="procedural",
        train_sequences=0,
        test_sequences=sequences,
        sequences=None,
        frames_per_sequence=frames,
        frame_stride=1,
        vru_density_scale=1.0,
        image_width=0,
        output="projection",
    )
    return KRadar(simulate_dataset(options, out))


def consecutive(frames: Iterable[Frame]) -> list[list[Frame]]:
    """Returns the parts of sequences that have no gap longer than `MAX_GAP_S`."""
    parts: list[list[Frame]] = []
    for frame in frames:
        before = parts[-1][-1] if parts else frame
        gap_s = frame.header.timestamp_s - before.header.timestamp_s
        is_next = frame.sequence == before.sequence and gap_s <= MAX_GAP_S
        if not parts or not is_next:
            parts.append([])
        parts[-1].append(frame)
    return parts


def labeled(frames: Sequence[Frame]) -> list[Objects]:
    """Returns the labeled objects of every frame of a sequence."""
    numbers: dict[tuple[str, int], int] = {}
    found = []
    for frame in frames:
        ids = frame.columns["track_id"].tolist()
        pairs = zip(frame.classes.tolist(), ids, strict=True)
        keys = [
            # A label without an id is an object of its own.
            (cls, track_id) if track_id >= 0 else (frame.name, row)
            for row, (cls, track_id) in enumerate(pairs)
        ]
        identity = [numbers.setdefault(key, len(numbers)) for key in keys]
        velocity_mps = frame.columns["velocity_mps"]
        number = np.array(identity, int)
        found.append(Objects(frame.classes, frame.boxes[:, :2], number, velocity_mps))
    return found


def detected(
    detector: Detector, frames: Sequence[Frame], grid: RadarGrid
) -> Iterator[Objects]:
    """Yields the detections of every frame of a sequence."""
    radar = (frame.read_projection(grid) for frame in frames)
    for found in detector.stream(radar):
        boxes = found.to_boxes()
        unknown = np.full((len(boxes), 2), np.nan)
        identity = np.full(len(boxes), -1)
        yield Objects(boxes.cls, boxes.box[:, :2], identity, unknown)


# Scores ---------------------------------------------------------------------------------


def similarity(truth: Objects, tracks: Objects) -> np.ndarray:
    """Returns similarities `[N, M]` from 0 to 1: 0.5 at the distance `MATCH_M`."""
    gap = truth.position_m[:, None] - tracks.position_m[None]
    near = 1.0 - np.linalg.norm(gap, axis=-1) / (2.0 * MATCH_M)
    return np.where(truth.cls[:, None] == tracks.cls[None], near.clip(0.0), 0.0)


def sequence_data(truth: list[Objects], tracks: list[Objects]) -> dict[str, object]:
    """Returns the frames of one sequence as the input of TrackEval's metrics."""
    data: dict[str, object] = {"num_timesteps": len(truth)}
    for name, frames in (("gt", truth), ("tracker", tracks)):
        identity = np.concatenate([x.identity for x in frames])
        unique, numbers = np.unique(identity, return_inverse=True)
        ends = np.cumsum([len(x.identity) for x in frames])[:-1]
        data[f"{name}_ids"] = np.split(numbers, ends)
        data[f"num_{name}_ids"] = len(unique)
        data[f"num_{name}_dets"] = len(numbers)
    data["similarity_scores"] = list(map(similarity, truth, tracks))
    return data


def speed_errors(truth: Objects, tracks: Objects) -> np.ndarray:
    """Returns the errors of the velocities of the tracks that are at objects, in m/s."""
    near = similarity(truth, tracks)
    rows, columns = linear_sum_assignment(-near)
    is_match = near[rows, columns] >= 0.5
    gap = truth.velocity_mps[rows] - tracks.velocity_mps[columns]
    errors = np.linalg.norm(gap[is_match], axis=1)
    return errors[np.isfinite(errors)]


def score(sequences: Iterable[Sides]) -> Table:
    """Scores the tracks of sequences.

    Raises:
        UserError: TrackEval is not installed.
    """
    try:
        from trackeval.metrics import CLEAR, HOTA, Identity
    except ImportError as error:
        raise UserError(
            f"the scores need TrackEval ({error}): pip install 'radejax[tracking]'"
        ) from None
    sequences = list(sequences)
    quiet = {"PRINT_CONFIG": False}
    metrics = CLEAR(quiet), Identity(quiet), HOTA()
    every = np.concatenate([x.cls for truth, _ in sequences for x in truth])
    rows: list[list[str | int]] = []
    for cls in [*sorted(set(every.tolist())), "all"]:
        parts = [
            [[x.take((x.cls == cls) | (cls == "all")) for x in side] for side in sides]
            for sides in sequences
        ]
        data = [sequence_data(truth, tracks) for truth, tracks in parts]
        found = {}
        for metric in metrics:
            results = enumerate(map(metric.eval_sequence, data))
            found |= metric.combine_sequences(dict(results))
        pairs = (pair for sides in parts for pair in zip(*sides, strict=True))
        errors = np.concatenate(list(itertools.starmap(speed_errors, pairs)))
        counts = [sum(x[name] for x in data) for name in ("num_gt_ids", "num_gt_dets")]
        values = found["MOTA"], found["IDF1"], np.mean(found["HOTA"])
        percent = [number(100.0 * value, digits=1) for value in values]
        motp_m = 2.0 * MATCH_M * (1.0 - found["MOTP"]) if found["CLR_TP"] else None
        speed = number(np.median(errors) if errors.size else None)
        switches = int(found["IDSW"])
        rows.append([cls, *counts, *percent, number(motp_m), switches, speed])
    header = ["Class", "Tracks", "Boxes", "MOTA", "IDF1", "HOTA"]
    header += ["MOTP m", "ID switches", "Velocity error m/s"]
    title = f"tracks within {MATCH_M:g} m of objects, median error of the velocity"
    return Table(title, header, rows)


def draw(path: pathlib.Path, sequences: Mapping[str, Sides]) -> None:
    """Draws the paths of labeled objects and tracks in up to 8 sequences, by title."""
    sequences = dict(itertools.islice(sequences.items(), 8))
    figure = new_figure(2.6 * len(sequences) + 0.6, 5.2, layout="constrained")
    panels = figure.subplots(1, len(sequences), squeeze=False, sharex=True, sharey=True)
    for ax, (title, sides) in zip(panels[0], sequences.items(), strict=True):
        ax.set_title(title, fontsize=9)
        for frames, width in zip(sides, (4.0, 1.2), strict=True):
            paths = collections.defaultdict(list)
            for objects in frames:
                for identity, point in zip(
                    objects.identity.tolist(), objects.position_m, strict=True
                ):
                    paths[identity].append(point)
            for identity, points in paths.items():
                is_truth = frames is sides[0]
                color = "0.8" if is_truth else SERIES_COLORS[identity % 6]
                x_m, y_m = np.transpose(points)
                ax.plot(y_m, x_m, color=color, linewidth=width, solid_capstyle="round")
                if not is_truth:
                    ax.plot(y_m[-1], x_m[-1], ".", color=color, markersize=5)
        ax.set(aspect="equal", xlabel="y (left) [m]")
    panels[0][0].set(xlim=(25, -25), ylim=(0, 80), ylabel="x (forward) [m]")
    figure.suptitle("Paths relative to the radar: labels (gray), tracks (colors)")
    save_figure(figure, path)


@click.command()
@click.option(
    "--workdir",
    type=click.Path(exists=True, path_type=pathlib.Path),
    default=MODEL,
    help="Training run or exported model. Default: the bundled model.",
)
@click.option("--data", type=click.Path(exists=True), help="K-Radar folder, instead.")
@click.option("--labels", type=click.Path(exists=True), help="Label revision v2.1.")
@click.option("--out", type=click.Path(path_type=pathlib.Path), default="tracks")
@click.option("--num-sequences", type=click.IntRange(1), default=4)
@click.option("--num-frames", type=click.IntRange(2), default=100)
def main(
    workdir: pathlib.Path,
    data: str | None,
    labels: str | None,
    out: pathlib.Path,
    num_sequences: int,
    num_frames: int,
) -> None:
    """Track the detections of a model over sequences and score the tracks."""
    with entry.exit_codes():
        entry.set_up_jax()
        detector = Detector.from_workdir(workdir)
        if data is not None:
            frames = KRadar(data, labels, split="test")
            require(len(frames) > 0, "--data", data, "labeled frames of the test split")
        else:
            simulation = detector.saved.config.simulation
            if simulation is None:
                raise UserError(
                    f"{workdir} was not trained on simulated data; --data names sequences"
                )
            frames = simulate(simulation, out / "data", num_sequences, num_frames)
        sequences = {}
        for part in tqdm(consecutive(frames), "track", unit="sequence"):
            found = detected(detector, part, frames.grid)
            clock_s = [frame.header.timestamp_s for frame in part]
            title = f"{part[0].key}\n{part[0].environment}, {part[0].weather}"
            sequences[title] = labeled(part), track_frames(found, clock_s)
        table = score(sequences.values()).render(
            "markdown", is_simulated=frames.is_simulated
        )
        click.echo(table)
        files.write_text(out / "tracks.md", table)
        draw(out / "tracks.png", sequences)


if __name__ == "__main__":
    main()
