"""RADE-Net with a further output: the velocity of every object relative to the radar.

    python examples/velocity.py

It simulates, trains and evaluates in half an hour on two cores, and draws `velocity.png`. A head, a
loss term, metrics and arrows are added without a change of the package. Doppler gives the radial
part of the velocity, and the heading of an object most of the rest. K-Radar measures Doppler modulo
3.9 m/s; the radar of this example is unambiguous up to 64 m/s.
"""

import pathlib

import click
import jax.numpy as jnp
import numpy as np

import radejax
from radejax.cli import entry
from radejax.config import Config, load_config
from radejax.core.structures import Boxes
from radejax.data.projection import decode
from radejax.losses.detection import LossOptions, Pairs, smooth_l1
from radejax.visualize.style import save_figure


def velocity_loss(pairs: Pairs, options: LossOptions) -> jnp.ndarray:
    """Smooth L1 distance of the velocities in m/s."""
    error = pairs.outputs["velocity"] - pairs.targets["velocity_mps"]
    return pairs.mean(smooth_l1(error).sum(-1), where=pairs.is_known["velocity_mps"])


def velocity_error_mps(predictions: Boxes, objects: Boxes) -> np.ndarray:
    """Error of the velocity of every matched box in m/s."""
    error = predictions.extras["velocity"] - objects.extras["velocity_mps"]
    return np.linalg.norm(error, axis=-1)


def moving_error_mps(predictions: Boxes, objects: Boxes) -> np.ndarray:
    """The same of objects that move over ground, and NaN of others."""
    error = velocity_error_mps(predictions, objects)
    return np.where(objects.extras["speed_mps"] > 1.0, error, np.nan)


def get_config(arg: str | None = None) -> Config:
    """The quickstart with an output "velocity", and without mirrored frames."""
    metrics = ("velocity:velocity_error_mps", "velocity:moving_error_mps")
    grid = {"num_doppler": 64, "max_doppler_mps": 64.0}
    return load_config(f"quickstart:{arg or ''}").replace(
        simulation={"grid": grid, "output": "projection", "image_width": 0},
        model={"outputs": {"velocity": 2}, "doppler_bins": 64},
        data={"targets": ("velocity_mps", "speed_mps"), "mirror_probability": 0.0},
        loss={
            "own_terms": ("velocity:velocity_loss",),
            "weights": {"velocity_loss": 4.0},
        },
        evaluation={"metrics": metrics},
    )


def draw(workdir: pathlib.Path, path: pathlib.Path) -> None:
    """Draws an arrow from every detected object to its place in one second."""
    detector = radejax.Detector.from_workdir(workdir)
    _, data = radejax.data_of_run(detector.saved)
    frame = max(data.split("test"), key=lambda frame: len(frame.boxes))
    projection = data.records[frame.key]
    found = detector(projection).to_boxes()
    scene = radejax.frame_scene(
        frame, decode(projection), detector.grid, predictions=found, roi="wide"
    )
    figure = radejax.draw_frame(scene)
    to, tip = found.box[:, 1::-1], found.extras["velocity"][:, ::-1]
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.004}
    figure.axes[0].quiver(*to.T, *tip.T, color="white", zorder=8, **arrows)
    save_figure(figure, path)


@click.command()
@click.option(
    "--workdir", default="runs/velocity", type=click.Path(path_type=pathlib.Path)
)
@click.option("--preset", default="", help="Option of the quickstart, such as short.")
def main(workdir: pathlib.Path, preset: str) -> None:
    """Train a detector that also predicts velocities, and draw a frame."""
    entry.set_up_jax()
    with entry.exit_codes():
        radejax.run(get_config(preset), workdir)
        draw(workdir, workdir / "velocity.png")


if __name__ == "__main__":
    main()
