"""Fit of the simulated radar to the files of a recording, as in `radejax simulate --fit`."""

from __future__ import annotations

import itertools
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import PathLike
from radejax.data.kradar.folders import read_grid
from radejax.data.kradar.tesseract import read_power
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.config import SimulationOptions
from radejax.simulation.radar.fit import fit_radar
from radejax.simulation.simulator import SequenceSimulator, make_source
from radejax.visualize.draw import draw_comparison
from radejax.visualize.style import save_figure

FITTED = "radar.json"
"""File with the fields `grid` and `radar` of `SimulationOptions`."""


def fit_files(recordings: Sequence[PathLike], out: PathLike) -> dict[str, Any]:
    """Estimate the parameters of a radar, and draw a recording beside a simulated frame.

    Args:
        recordings: Radar tensors, or folders that contain `tesseract_*.mat`, of one radar.
            Its axes are those of the `radar_grid.json` in a folder above, or K-Radar's.
        out: Folder in which to write `radar.json` and `fit.png`.

    Returns:
        The fields of `simulation.radar`.

    Raises:
        UserError: There is no radar tensor.
        DataError: A tensor cannot be read, has other axes, is not linear power or has no
            noise to measure.
    """
    paths: list[pathlib.Path] = []
    for path in map(files.as_path, recordings):
        is_folder = path.is_dir()
        paths += files.find_files(path, "tesseract_*.mat") if is_folder else [path]
    if not paths:
        names = ", ".join(map(str, recordings))
        raise UserError(f"no radar tensors in {names}: looked for tesseract_*.mat")
    roots = sorted({folder for path in paths for folder in path.absolute().parents})
    grid = read_grid(roots)
    tensors = (read_power(path, grid) for path in paths)
    first = next(tensors)
    fields = fit_radar(itertools.chain([first], tensors), grid)
    is_kradar = grid == RadarGrid.kradar()
    section = {"grid": "kradar" if is_kradar else grid.to_dict(), "radar": fields}
    maps = {
        f"recording, {paths[0].name}": _mean_db(first),
        "simulation": _mean_db(_simulated(section)),
    }
    out = files.as_path(out)
    files.write_json(out / FITTED, section)
    save_figure(draw_comparison(maps, grid), out / "fit.png")
    return fields


def _mean_db(power: Float[np.ndarray, "D R E A"]) -> Float[np.ndarray, "R A"]:
    return 10.0 * np.log10(power.mean((0, 2), dtype=np.float64) + 1e-10)


def _simulated(section: dict[str, Any]) -> Float[np.ndarray, "D R E A"]:
    """Simulates the tensor of one procedural frame."""
    options = SimulationOptions(**section, train_sequences=1, frames_per_sequence=1)
    simulator = SequenceSimulator(
        make_source(options).make(1), options.make_grid(), options.make_parameters(), 0
    )
    given = simulator.radar_input(simulator.sequence.frame(0))
    return simulator.run(given, "tesseract")
