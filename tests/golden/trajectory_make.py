"""Makes `trajectory.npz`: what steps of the authors' training gave.

    python tests/golden/trajectory_make.py ../shared/fixtures

The reference numbers are those of twelve optimizer steps of the released RADE-Net and four of
DinoRADE (commit 9a94d64) on six frames of random objects, with PyTorch on a CPU; README of the
reference dataset, section 14. Losses, rates and norms of the gradient by step, statistics of all
tensors at the end, and parts of the maps and tokens are kept as they are.

    boxes, classes: the objects, `[6, 5, 7]` and `[6, 5]`; rows after the last are NaN and -1.
    radenet/..., dinorade/...: the arrays of the two trainings.
"""

import pathlib
import sys

import numpy as np

from radejax.config import load_module

SEED = 1234
UNUSED = ("keys", "versions", "parameters", "parameter_grad_norms")


def main(fixtures: pathlib.Path) -> None:
    """Writes the file."""
    recipe = load_module(fixtures / "trajectory_recipe.py")
    frames = recipe.frames(SEED)
    boxes = np.full((len(frames), 5, 7), np.nan)
    classes = np.full(boxes.shape[:2], -1)
    for i, objects in enumerate(frames):
        for j, o in enumerate(objects):
            boxes[i, j] = [*(o[name] for name in "xyzlwh"), o["yaw"]]
            classes[i, j] = recipe.CLASSES.index(o["class"])
    arrays = {"boxes": boxes, "classes": classes}
    for kind in ("radenet", "dinorade"):
        file = np.load(fixtures / f"trajectory/{kind}_official.npz")
        arrays |= {f"{kind}/{name}": file[name] for name in file if name not in UNUSED}
    np.savez_compressed(pathlib.Path(__file__).with_name("trajectory.npz"), **arrays)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
