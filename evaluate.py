"""Evaluates a run, or predictions made elsewhere, or compares two: `radejax evaluate`.

    python evaluate.py --workdir runs/quickstart
    python evaluate.py --workdir runs/radenet --data /other/kradar
    python evaluate.py --predictions found.json --data /data/kradar --out results
    python evaluate.py --predictions kitti_folder --out results
    python evaluate.py --compare results_a results_b

docs/evaluation.md explains every number.
"""

from radejax.cli.evaluate import evaluate

if __name__ == "__main__":
    evaluate()
