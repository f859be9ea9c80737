"""Makes the golden files of `tests/losses` from the reference dataset.

    python tests/golden/losses_make.py ../shared/fixtures

The reference numbers come from the released RADE-Net code (commit 9a94d64) with
PyTorch 2.13.0 (CPU) and NumPy 2.4.6, in float32 and (`_f64`) float64 on the same
inputs; inputs are synthetic.

losses_gwd.npz: 229 pairs of boxes with distances, losses and gradients.
losses_cases.npz: per case `<case>/<name>`: ground truth boxes, loss values, targets and
    gradients around the objects. The full-size maps are rebuilt from a seed by the test.
    Tolerances reached: targets 1.2e-7, losses 1e-6 relative, gradients 3e-6 of their
    maximum.
losses_focal.npz: focal loss of single bins on a grid of predictions and targets.
"""

import json
import pathlib
import sys

import numpy as np

CLASSES = ("Sedan", "Bus or Truck", "Pedestrian", "Motorcycle", "Bicycle")
MAX_OBJECTS = 12
KEEP = (
    "target_channel_sum",
    "target_num_ones",
    "target_patches",
    "patch_frame_object",
    "grad_focal_heatmap_patches",
    "grad_cells",
    "grad_gwd_regression_at_cells",
    "grad_smooth_l1_regression_at_cells",
    "grad_total_regression_at_cells",
    "grad_total_heatmap_channel_stats",
)
PAIRS = (
    *("kind", "pred", "gt", "sigma_pred_f64", "sigma_gt_f64"),
    *("gwd_f64", "gwd_grad_f64", "gwd_closed_form_grad_f64"),
    *("loss_none_f64", "loss_sqrt_f64", "loss_log_f64"),
    *("grad_none_f64", "grad_sqrt_f64", "grad_log_f64"),
)


def main(fixtures: pathlib.Path) -> None:
    here = pathlib.Path(__file__).parent
    pairs = np.load(fixtures / "gwd" / "gwd_pairs.npz")
    np.savez_compressed(
        here / "losses_gwd.npz", **{name: pairs[name] for name in PAIRS}
    )
    np.savez_compressed(
        here / "losses_focal.npz",
        **dict(np.load(fixtures / "losses" / "focal_pointwise.npz")),
    )
    cases = {}
    for name, info in json.loads((fixtures / "losses/losses.json").read_text()).items():
        arrays = np.load(fixtures / "losses" / f"{name}.npz")
        cases |= {f"{name}/{key}": arrays[key] for key in KEEP if key in arrays}
        cases |= {f"{name}/{k}": v for k, v in objects_of(info["frames"]).items()}
        cases[f"{name}/sigma_mode"] = np.array(info["sigma_mode"])
        cases[f"{name}/sigma_cells"] = np.array(float(info["sigma"] or 3))
        cases[f"{name}/stream"] = np.array(info["input_stream"])
        for part in ("focal", "gwd", "smooth_l1"):
            cases[f"{name}/{part}"] = np.array(info["components"][part])
    np.savez_compressed(here / "losses_cases.npz", **cases)


def objects_of(frames: list[list[dict]]) -> dict[str, np.ndarray]:
    """Padded ground truth; padding rows hold NaN, which must not leak."""
    boxes = np.full((len(frames), MAX_OBJECTS, 8), np.nan, np.float32)
    classes = np.full((len(frames), MAX_OBJECTS), -1, np.int32)
    is_valid = np.zeros((len(frames), MAX_OBJECTS), bool)
    for frame, objects in enumerate(frames):
        for row, o in enumerate(objects):
            heading = [np.sin(o["yaw"]), np.cos(o["yaw"])]
            boxes[frame, row] = [o[k] for k in "xyzlwh"] + heading
            classes[frame, row] = CLASSES.index(o["class"])
            is_valid[frame, row] = True
    return {"boxes": boxes, "classes": classes, "is_valid": is_valid}


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
