"""Makes `reduced_releases.npz`: a part of the reference data for K-Radar's reduced releases.

    python tests/golden/reduced_make.py ../shared

`../shared/fixtures/reduced_releases/` has a recipe of a 4D radar tensor and what K-Radar's own
functions (`get_cube_polar`, `get_proportional_rdr_points`, commit 97fe0a6) computed from it. The
golden file has the Doppler spectra of 80 cells as a tensor `[64, 20, 2, 2]` with the power and
Doppler of these cells `[2, 20, 2, 2]` (range, azimuth, elevation), and 50 of the points in both
layouts. `reduce_tensor` gives the same numbers to 1e-12, points to 1e-15.
"""

import pathlib
import sys

import numpy as np

from radejax.config import load_module


def main(shared: pathlib.Path) -> None:
    folder = shared / "fixtures" / "reduced_releases"
    tesseract = load_module(folder / "recipe.py").tesseract(1234)
    expected = np.load(folder / "kradar.npz")
    cells = np.linspace(0, len(expected["index"]) - 1, 200).astype(int)
    r, a, e = np.unravel_index(expected["index"][cells], (256, 107, 37))
    spectra = tesseract[:, r, e, a].reshape(64, 50, 2, 2)  # range, azimuth, elevation
    polar = np.stack([expected["power"][cells], expected["doppler"][cells]])
    np.savez_compressed(
        pathlib.Path(__file__).with_name("reduced_releases.npz"),
        tesseract=spectra.swapaxes(2, 3)[:, :20],
        polar=polar.reshape(2, 50, 2, 2)[:, :20],
        points=expected["points"][::20],
        points5=expected["points5"][::20],
    )


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
