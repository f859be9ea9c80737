"""Draws detections of the bundled model on simulated scenes that it was not trained on."""

from __future__ import annotations

import pathlib
from collections.abc import Iterator

import reference_points
from matplotlib.figure import Figure

import radejax
from radejax.cli.figures import MODEL
from radejax.data.kradar.dataset import Frame
from radejax.runs.figures import fullest_of_weathers
from radejax.simulation.config import SimulationOptions
from radejax.visualize.draw import draw_scenes
from radejax.visualize.recordings import animate

SCENES = SimulationOptions(
    seed=1000,
    train_sequences=0,
    test_sequences=32,  # every road and weather of the simulator twice
    frames_per_sequence=1,
    image_width=1280,
    image_height=720,
    output="projection",
)
SEQUENCES = SCENES.replace(test_sequences=7, frames_per_sequence=30)
BAD_VISIBILITY = ("fog", "lightsnow", "heavysnow")
MIN_OBJECTS = 6
COLOR_LIMITS = (
    0.64,
    0.84,
)  # of all frames of the animation, so that it does not flicker


def scene_of(
    frame: Frame, detector: radejax.Detector, title: str, roi: str
) -> radejax.Scene:
    """Detects the objects of a frame and matches them with its labels."""
    projection = frame.read_projection(detector.grid)
    return radejax.frame_scene(
        frame,
        projection,
        detector.grid,
        predictions=detector(projection).to_boxes(),
        score_threshold=detector.decode_options.score_threshold,
        roi=roi,
        title=title,
    )


def bad_visibility_sequence(frames: radejax.KRadar) -> list[Frame]:
    """Returns the first sequence in fog or snow whose first frame has enough objects."""
    sequences: dict[int, list[Frame]] = {}
    for frame in frames:
        sequences.setdefault(frame.sequence, []).append(frame)
    return next(
        sequence
        for sequence in sequences.values()
        if sequence[0].weather in BAD_VISIBILITY
        and len(sequence[0].boxes) >= MIN_OBJECTS
    )


def draw_animation(data: pathlib.Path, path: pathlib.Path) -> None:
    """Draws one sequence: camera and radar map, with what is found, missed and false."""
    sequence = bad_visibility_sequence(
        radejax.KRadar([radejax.simulate(SEQUENCES, data / "sequences")])
    )
    detector = radejax.Detector.from_workdir(MODEL)

    def figures() -> Iterator[Figure]:
        for number, frame in enumerate(sequence):
            scene = scene_of(frame, detector, "", "wide")
            assert scene.matches is not None
            truth, found = scene.matches.ground_truth, scene.matches.predictions
            title = (
                f"{frame.weather}, {frame.time}, simulated, {number / 10:.1f} s: "
                f"{(truth == 1).sum()} found, {(truth == 0).sum()} missed, "
                f"{(found == 0).sum()} false"
            )
            scene = radejax.Scene(**{**vars(scene), "title": title})
            figure = draw_scenes([scene], color_limits=COLOR_LIMITS)
            figure.set_dpi(84)
            yield figure

    animate(figures(), path, frames_per_second=5.0)


def draw_weathers(data: pathlib.Path, path: pathlib.Path) -> None:
    """Draws the frame with the most objects of each kind of weather."""
    frames = radejax.KRadar([radejax.simulate(SCENES, data / "scenes")])
    detector = radejax.Detector.from_workdir(MODEL)
    scenes = [
        scene_of(frames[i], detector, f"{name} ({frames[i].key}), simulated", "narrow")
        for name, i in fullest_of_weathers(frames).items()
    ]
    draw_scenes(scenes).savefig(path, dpi=90)


def draw_reference_points(data: pathlib.Path, path: pathlib.Path) -> None:
    """Draws the reference points on the first image."""
    frame = radejax.KRadar([radejax.simulate(SCENES, data / "scenes")])[0]
    pixels, camera = radejax.front_view(frame)
    truth = radejax.Boxes.one_frame(frame.boxes, frame.classes)
    figure, *_ = reference_points.draw(pixels, camera, truth)
    figure.savefig(path)
