"""Draws the figures of README and docs into `docs/images`.

    python docs/images/figures.py networks claims
    python docs/images/figures.py

Without names all are drawn, which simulates some data first and takes about ten minutes on two
cores. Others are of `radejax demo` (demo.png), `examples/tracking.py` (tracks.png) and
`examples/velocity.py` (velocity.png).
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Callable

import click

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "examples"))

import detection_figures  # noqa: E402
import gallery  # noqa: E402
import networks  # noqa: E402
import result_figures  # noqa: E402
import simulator_figures  # noqa: E402

FIGURES: dict[str, Callable[[pathlib.Path, pathlib.Path], None]] = {
    "networks": lambda data, out: networks.draw(out),
    "claims": lambda data, out: result_figures.draw_claims(out / "claims.png"),
    "weather": lambda data, out: result_figures.draw_weather(out / "weather.png"),
    "camera_share": lambda data, out: result_figures.draw_camera_share(
        out / "camera_share.png"
    ),
    "detections": lambda data, out: detection_figures.draw_animation(
        data, out / "detections.gif"
    ),
    "scenes": lambda data, out: detection_figures.draw_weathers(
        data, out / "scenes.png"
    ),
    "reference_points": lambda data, out: detection_figures.draw_reference_points(
        data, out / "reference_points.png"
    ),
    "simulator": lambda data, out: simulator_figures.draw(out),
    "gallery": lambda data, out: gallery.draw(data, out / "gallery"),
}

FOLDER = click.Path(file_okay=False, path_type=pathlib.Path)


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(FIGURES)))
@click.option("--out", type=FOLDER, default=ROOT / "docs" / "images")
@click.option(
    "--data",
    type=FOLDER,
    default=ROOT / "data" / "figures",
    help="Folder of the simulated data.",
)
def main(names: tuple[str, ...], out: pathlib.Path, data: pathlib.Path) -> None:
    """Draw the figures NAMES, or all."""
    out.mkdir(parents=True, exist_ok=True)
    for name in names or FIGURES:
        FIGURES[name](data, out)
        click.echo(f"drew {name}")


if __name__ == "__main__":
    main()
