"""`radejax demo`: a simulated frame, a small trained model, a picture."""

from __future__ import annotations

import pathlib
import tempfile

import click

from radejax.cli import entry, options

MODEL = pathlib.Path(__file__).with_name("demo_model")
"""Packed: seed 0 of the quickstart; docs/detector.md has the commands that made it."""


@click.command(cls=options.Command)
@click.option("--out", type=options.FILE, default="demo.png", show_default=True)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=1000,
    show_default=True,
    help="Of the scene; the model was trained on scenes of seed 0.",
)
def demo(out: pathlib.Path, seed: int, as_json: bool) -> None:
    """Simulate a frame, find its objects with a small trained model, draw both.

    Nothing is needed but this package. The model is that of the quickstart: it knows
    simulated frames of a coarse radar, not K-Radar's.

    Example: radejax demo --out demo.png
    """
    from radejax.core.structures import NARROW_ROI
    from radejax.data.images import front_view
    from radejax.data.kradar import KRadar
    from radejax.inference.detector import Detector
    from radejax.simulation.config import default_config
    from radejax.simulation.dataset import simulate_dataset
    from radejax.visualize import bev
    from radejax.visualize.canvas import Scene, picture_format

    picture_format(out)  # before the frame is simulated
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
        image, camera = front_view(frame)
    detector = Detector.from_checkpoint(MODEL)
    found = detector(projection)
    scene = Scene(
        projection,
        frames.grid,
        ground_truth=(frame.boxes, list(frame.classes)),
        predictions=found.to_columns(),
        score_threshold=detector.score_threshold,
        roi=NARROW_ROI,
        image=image,
        camera=camera,
        title=f"simulated frame, seed {seed}, {frame.weather}",
    )
    bev.save_figure(bev.draw_frame(scene), out)
    (boxes,) = found.to_list()
    values = {"picture": str(out), "objects": len(frame.boxes), "found": boxes}
    text = f"{len(boxes)} boxes found, {len(frame.boxes)} objects there: see {out}"
    options.echo_result(as_json, values, text)
