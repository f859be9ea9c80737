"""Makes the golden files of `tests/detection` from the reference dataset.

    python tests/golden/detection_make.py ../shared/fixtures

The reference boxes come from the released RADE-Net code (commit 9a94d64) with PyTorch
2.13.0 (CPU), NumPy 2.4.6 and OpenCV 5.0.0; inputs are synthetic.

detection_postproc.npz: per case `<case>/<name>`: the blobs from which the test rebuilds
    the maps, the peaks, the boxes before NMS in order of bins, and the rows kept by NMS
    in order of score. Indices agree exactly, box numbers to 4e-6.
detection_ties.npz: a hand-made map with equal neighbors and equal classes.
"""

import json
import pathlib
import sys

import numpy as np


def main(fixtures: pathlib.Path) -> None:
    here, source = pathlib.Path(__file__).parent, fixtures / "postproc"
    cases = {}
    for name, info in json.loads((source / "postproc.json").read_text()).items():
        arrays = np.load(source / f"{name}.npz")
        cases |= {
            f"{name}/{key}": arrays[key]
            for key in arrays
            if not key.startswith(("peak_", "boxes_after_nms"))
        }
        cases[f"{name}/width"] = np.array(info["width"])
        cases[f"{name}/stream"] = np.array(info["input_stream"])
        cases[f"{name}/wide_roi"] = np.array(info["wide_roi_filter"])
    np.savez_compressed(here / "detection_postproc.npz", **cases)
    np.savez_compressed(
        here / "detection_ties.npz", **dict(np.load(source / "ties.npz"))
    )


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
