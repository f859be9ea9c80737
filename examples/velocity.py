"""RADE-Net with a further output: the velocity of every object relative to the radar.

    python examples/velocity.py            # simulates, trains, evaluates, draws
    radejax train --config examples/velocity.py --workdir runs/velocity

A head, a loss term, a metric and an arrow; nothing in the package is changed. Doppler gives the
radial part, and the heading of the box most of the rest.
"""

import pathlib

import jax.numpy as jnp
import numpy as np

import radejax
from radejax.config import Config, load_config
from radejax.core.structures import Boxes
from radejax.losses.detection import LossOptions, Pairs, smooth_l1
from radejax.runs import figures
from radejax.visualize.style import save_figure


def velocity_loss(pairs: Pairs, options: LossOptions) -> jnp.ndarray:
    """Smooth L1 distance of the velocities in m/s."""
    error = pairs.outputs["velocity"] - pairs.targets["velocity_mps"]
    return pairs.mean(smooth_l1(error).sum(-1), where=pairs.is_known["velocity_mps"])


def velocity_error_mps(predictions: Boxes, objects: Boxes) -> np.ndarray:
    """Error of the velocity of every matched box in m/s."""
    error = predictions.extras["velocity"] - objects.extras["velocity_mps"]
    return np.linalg.norm(error, axis=-1)


def get_config(arg: str | None = None) -> Config:
    """The quickstart with a velocity output; frames are not mirrored."""
    config = load_config(f"quickstart:{arg}" if arg else "quickstart")
    weights = {**config.loss.weights, "velocity_loss": 2.0}
    return config.replace(
        model={"outputs": {"velocity": 2}},
        data={"targets": ("velocity_mps",), "mirror_probability": 0.0},
        loss={"own_terms": ("velocity:velocity_loss",), "weights": weights},
        evaluation={"metrics": ("velocity:velocity_error_mps",)},
    )


def draw(workdir: pathlib.Path) -> None:
    """Draws an arrow from every detection to its place in a second."""
    detector = radejax.Detector.from_workdir(workdir)
    _, data = radejax.data_of_run(detector.saved)
    frame = max(data.split("test"), key=lambda frame: len(frame.boxes))
    found = detector(data.records[frame.key]).to_boxes()
    scene = figures.frame_scene(frame, data.records[frame.key], detector.grid)
    figure = radejax.draw_frame(scene)
    x, y = found.box[:, :2].T
    figure.axes[0].quiver(-y, x, *np.flip(found.extras["velocity"] * [1, -1], 1).T)
    save_figure(figure, workdir / "velocity.png")
