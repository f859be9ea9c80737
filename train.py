"""Trains a detector, then evaluates it: `radejax train`.

    python train.py --config quickstart
    python train.py --config radenet:official --data /data/kradar1,/data/kradar2
    python train.py --config my_config.py --config.train.batch_size=4 ...

Run the same command again to continue an interrupted run. On several hosts, start the
command once on each host with --distributed (docs/training.md, examples/slurm.sh).
"""

from radejax.cli.train import train

if __name__ == "__main__":
    train()
