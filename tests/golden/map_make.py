"""Makes radenet_map.npz: AP of made-up boxes by the evaluation code of RADE-Net.

    python tests/golden/map_make.py ../shared/fixtures

The reference numbers come from the released RADE-Net code (commit 9a94d64); its boxes are
synthetic, not K-Radar's. Predictions are `x, y, z, l, w, h, sin, cos, score, class`, ground truth
is `x, y, z, yaw, l, w, h`. The AP are fractions, NaN for classes without objects:

    ap: [selection of frames, space, IoU, region, frame rule, method, class].
"""

import json
import pathlib
import sys

import numpy as np

AXES = {
    "selection": ("all", "first9", "no_gt_frames"),
    "dim": ("2D", "3D"),
    "iou_threshold": (0.3, 0.5),
    "roi": ("narrow", "wide"),
    "skip_frames_without_gt": (True, False),
}
METHODS = ("VOC", "K-Radar", "COCO", "PR-AUC")
CLASSES = ("Sedan", "Bus or Truck", "Pedestrian")


def main(fixtures: pathlib.Path) -> None:
    """Writes the file."""
    boxes = np.load(fixtures / "map/frames.npz")
    runs = json.loads((fixtures / "map/map_results.json").read_text())["runs"]
    shape = [len(values) for values in AXES.values()]
    ap = np.full([*shape, len(METHODS), len(CLASSES)], np.nan)
    for run in runs:
        if len(run["classes"]) > len(CLASSES):
            continue
        place = tuple(values.index(run[name]) for name, values in AXES.items())
        for m, method in enumerate(METHODS):
            found = run["results"][method]["aps"]
            ap[place][m] = [found.get(cls, np.nan) for cls in CLASSES]
    np.savez_compressed(
        pathlib.Path(__file__).with_name("radenet_map.npz"),
        ap=ap,
        pred=boxes["pred"][:, :10],
        **{name: boxes[name] for name in ("pred_frame", "gt_frame", "gt_class")},
        gt_values=boxes["gt_values"],
    )


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
