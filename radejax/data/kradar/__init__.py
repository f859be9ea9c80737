"""Reader of K-Radar's sequence folders, labels and splits."""

from radejax.data.kradar.dataset import Frame, KRadar
from radejax.data.kradar.labels import Label, read_labels

__all__ = ["Frame", "KRadar", "Label", "read_labels"]
