"""`radejax demo`: a simulated frame, a small trained model, a figure."""

from __future__ import annotations

import pathlib
import tempfile

import click

from radejax.cli import entry, options

MODEL = pathlib.Path(__file__).with_name("demo_model")
"""Saved model: seed 0 of the quickstart; docs/detector.md has the commands that made it."""


@click.command(cls=options.Command)
@click.option("--out", type=options.FILE, default="demo.png", show_default=True)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=1000,
    show_default=True,
    help="Seed of the scene; the model was trained on scenes of seed 0.",
)
def demo(out: pathlib.Path, seed: int, as_json: bool) -> None:
    """Simulate a frame, detect its objects with a small trained model, draw both.

    Only this package is needed. The model is that of the quickstart: it was trained on
    simulated frames of a coarse radar, not on K-Radar's.

    Example: radejax demo --out demo.png
    """
    from radejax.core.structures import NARROW_ROI, Boxes
    from radejax.data.kradar import KRadar
    from radejax.inference.detector import Detector
    from radejax.runs.figures import frame_scene
    from radejax.simulation.config import default_config
    from radejax.simulation.dataset import simulate_dataset
    from radejax.visualize.draw import draw_frame
    from radejax.visualize.style import figure_format, save_figure

    figure_format(out)  # before the frame is simulated
    entry.set_up_jax()
    simulation = default_config() | {
        "seed": seed,
        "train_sequences": 0,
        "test_sequences": 1,
        "frames_per_sequence": 1,
        "image_width": 1280,
        "image_height": 720,
    }
    with tempfile.TemporaryDirectory() as folder:
        simulate_dataset(simulation, folder)
        frames = KRadar([folder])
        (frame,) = frames
        projection = frame.read_projection(frames.grid)
        detector = Detector.from_checkpoint(MODEL)
        found = detector(projection)
        scene = frame_scene(
            frame,
            projection,
            frames.grid,
            predictions=Boxes(**found.to_columns()),
            score_threshold=detector.score_threshold,
            roi=NARROW_ROI,
            title=f"simulated frame, seed {seed}, {frame.weather}",
        )
    save_figure(draw_frame(scene), out)
    (boxes,) = found.to_list()
    values = {"figure": str(out), "objects": len(frame.boxes), "found": boxes}
    text = f"{len(boxes)} boxes found, {len(frame.boxes)} labelled objects: see {out}"
    options.echo_result(as_json, values, text)
