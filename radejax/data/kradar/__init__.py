"""K-Radar on disk: sequence folders, labels, splits, as frames in order."""

from radejax.data.kradar.dataset import Frame, KRadar
from radejax.data.kradar.labels import Label, read_labels

__all__ = ["Frame", "KRadar", "Label", "read_labels"]
