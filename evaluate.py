"""Evaluates a run: `radejax evaluate`.

    python evaluate.py --workdir runs/quickstart
    python evaluate.py --workdir runs/radenet --data /other/kradar

`radejax score` evaluates predictions in files, and `radejax compare` compares results.
docs/protocols.md defines every metric.
"""

from radejax.cli.evaluate import evaluate

if __name__ == "__main__":
    evaluate()
