"""Loss functions: focal, Gaussian Wasserstein distance, and their weighted sum."""

from radejax.losses import detection, focal, gwd

__all__ = ["detection", "focal", "gwd"]
