"""Evaluate a run: `radejax evaluate`.

    python evaluate.py --workdir runs/quickstart
    python evaluate.py --workdir runs/radenet --data /other/kradar

Predictions in files and comparisons: `radejax score` and `radejax compare`.
docs/evaluation.md explains every number.
"""

from radejax.cli.evaluate import evaluate

if __name__ == "__main__":
    evaluate()
