"""K-Radar on disk: sequence folders, labels, splits, as a sequence of frames."""

from radejax.data.kradar.dataset import Frame, KRadar
from radejax.data.kradar.labels import Label, read_labels

__all__ = ["Frame", "KRadar", "Label", "read_labels"]
