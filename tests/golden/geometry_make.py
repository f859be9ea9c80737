"""Makes the golden files of `tests/geometry` from the reference dataset.

    python tests/golden/geometry_make.py ../shared/fixtures

The reference numbers come from the released RADE-Net code (commit 9a94d64) with
PyTorch 2.13.0 (CPU), NumPy 2.4.6 and OpenCV 5.0.0; inputs are synthetic.

geometry_encoding.npz: ego positions of 108 objects and the bins that the authors' code
    assigns to them on three grids. Ours must agree exactly.
geometry_iou.npz: 580 pairs of boxes and their overlap by float64 polygon clipping
    (`iou_*_exact`), and by the authors' code where it is reliable. Ours agrees with the
    former to 1e-12 in float64 and 5e-7 in float32, with the latter to 5e-4.
"""

import pathlib
import sys

import numpy as np


def main(fixtures: pathlib.Path) -> None:
    here = pathlib.Path(__file__).parent
    encoding = np.load(fixtures / "ground_truth" / "encoding.npz")
    np.savez_compressed(
        here / "geometry_encoding.npz",
        position=encoding["values"][:, :2],
        **{k: encoding[k] for k in encoding if k.startswith("center_")},
        in_fov=encoding["in_fov"],
        kind=encoding["kind"],
    )
    pairs = np.load(fixtures / "iou" / "rotated_iou.npz")
    np.savez_compressed(here / "geometry_iou.npz", **dict(pairs))


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
