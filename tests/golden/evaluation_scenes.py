"""Makes evaluation_scenes.npz: random scenes and their AP by the slow implementation.

    python tests/golden/evaluation_scenes.py

Scenes: tests/evaluation/scenes.py (made up, no K-Radar data), seeds below. Expected AP:
tests/evaluation/reference.py with shapely 2.2.0 and NumPy 2.4.6. Agreement reached by
radejax.evaluation: 1e-9.
"""

import pathlib
import sys

import numpy as np

HERE = pathlib.Path(__file__).parent
PROTOCOLS = (
    "kradar_r40",
    "kradar_r40_corrected",
    "kradar_r11",
    "voc11",
    "recall41",
    "coco101",
    "auc",
    "all_point",
)
SEEDS, IOUS, CUTS = (101, 102, 103), (0.3, 0.5), (0.0, 0.35)
CLASSES = ("Sedan", "Bus or Truck", "Pedestrian")


def main() -> None:
    """Writes the file."""
    sys.path.insert(0, str(HERE.parent / "evaluation"))
    import reference
    import scenes

    arrays = {
        "protocols": np.array(PROTOCOLS),
        "classes": np.array(CLASSES),
        "ious": np.array(IOUS),
        "cuts": np.array(CUTS),
    }
    for index, seed in enumerate(SEEDS):
        truth, found, frames = scenes.random_scene(
            seed, num_frames=40, num_objects=120, num_classes=3, ties=index != 1
        )
        for name, table in (("truth", truth), ("found", found)):
            for column, values in table.items():
                arrays[f"{index}_{name}_{column}"] = values
        arrays[f"{index}_num_frames"] = np.array(len(frames["frame"]))
        arrays[f"{index}_ap"] = np.array(
            [
                reference.average_precision(
                    protocol, truth, found, cls, space, iou, classes=CLASSES, cut=cut
                )
                for protocol in PROTOCOLS
                for cut in CUTS
                for space in ("bev", "3d")
                for iou in IOUS
                for cls in CLASSES
            ]
        ).reshape(len(PROTOCOLS), len(CUTS), 2, len(IOUS), len(CLASSES))
    np.savez_compressed(HERE / "evaluation_scenes.npz", **arrays)


if __name__ == "__main__":
    main()
