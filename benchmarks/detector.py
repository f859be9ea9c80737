"""From a full-size tensor in host memory to boxes: time, and each stage's share.

    python benchmarks/detector.py [--input projection] [--json detector.json]

RADE-Net as `configs/radenet.py` describes it, random weights, K-Radar's sensor: a
tesseract is 64 x 256 x 37 x 107 float32, 259 MB. `radejax benchmark` measures a run.
"""

import argparse
import json
import pathlib

from radejax.core.config import load_config
from radejax.inference.benchmark import as_table, measure, untrained

CONFIG = pathlib.Path(__file__).resolve().parents[1] / "configs" / "radenet.py"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 10])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--input", choices=["tesseract", "projection"], nargs="+")
    parser.add_argument("--dtype", choices=["float32", "bfloat16"], default="float32")
    parser.add_argument("--json", type=pathlib.Path, help="Also write the rows there.")
    args = parser.parse_args()
    detector = untrained(load_config(str(CONFIG)), dtype=args.dtype)
    rows = []
    for kind in args.input or ["tesseract", "projection"]:
        found = measure(
            detector,
            args.batch,
            repeats=args.repeats,
            tesseract=kind == "tesseract",
        )
        print(f"\n{as_table(found)}, {args.dtype}")
        rows += [{**row, "dtype": args.dtype} for row in found]
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
