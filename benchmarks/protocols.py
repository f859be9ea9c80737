"""Evaluates one set of predictions in all protocols, as in docs/reports/protocol_comparison.md.

    python benchmarks/protocols.py ../shared/fixtures/kradar_eval

The folder has ground_truth.npz and predictions.npz with the columns frame, box, cls and, for
predictions, score. Both also have class_names, which cls indexes, and the weather of every frame
in frame_weather. The tables are printed as Markdown.
"""

import argparse
import pathlib

import numpy as np

from radejax.evaluation import PROTOCOLS, EvaluationSet, mean_ap
from radejax.evaluation.report import Table, number


def load(folder: pathlib.Path) -> tuple[EvaluationSet, np.ndarray]:
    """Returns the evaluation set in the narrow region, and the weather of every frame."""
    tables = []
    for name in ("ground_truth", "predictions"):
        file = np.load(folder / f"{name}.npz")
        columns = {k: file[k] for k in ("frame", "box", "score") if k in file}
        tables.append({**columns, "cls": file["class_names"][file["cls"]]})
        weather = file["frame_weather"]
    frames = {"frame": np.arange(weather.size)}
    return EvaluationSet(*tables, frames=frames, roi="narrow"), weather


def show(title: str, data: EvaluationSet, rows: dict) -> None:
    """Prints one table; `rows` maps labels to keyword arguments of `EvaluationSet.results`."""
    body = []
    for label, options in rows.items():
        results = data.results(**options)
        cells = [number(r.ap if r.is_defined else None) for r in results]
        body.append([label, *cells, number(mean_ap(results))])
    header = ["", *data.classes, "mean"]
    print(Table(title, header, body).render("markdown"))


def main() -> None:
    """Prints all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path)
    data, weather = load(parser.parse_args().folder)
    for space, iou in (("3d", 0.3), ("bev", 0.3), ("3d", 0.5)):
        rows = {
            name: {"protocol": name, "spaces": space, "iou_thresholds": iou}
            for name in PROTOCOLS
        }
        show(f"AP {space}, IoU {iou}, all weathers", data, rows)
    rows = {
        f"{name}, skip {skip}": {"protocol": name, "empty_frames": skip, "spaces": "3d"}
        for name in ("kradar_r40", "coco101", "all_point")
        for skip in ("class", "frame", "none")
    }
    show("Frame rules, AP 3d, IoU 0.3", data, rows)
    rows = {
        f"{name}, score > {cut}": {
            "protocol": name,
            "score_threshold": cut,
            "spaces": "3d",
        }
        for name in ("kradar_r40", "coco101", "all_point")
        for cut in (0.0, 0.3)
    }
    show("Score thresholds, 3D AP, IoU 0.3", data, rows)
    rain = weather == "rain"
    rows = {
        name: {"protocol": name, "spaces": "3d", "weights": rain} for name in PROTOCOLS
    }
    objects = [r.num_gt for r in data.results(weights=rain, spaces="3d")]
    show(f"Rain only (objects {objects}), AP 3d, IoU 0.3", data, rows)


if __name__ == "__main__":
    main()
