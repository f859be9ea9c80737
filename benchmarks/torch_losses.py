"""The detection losses in PyTorch, for comparison only.

They are those of `radejax.losses.detection` with the options that the benchmarked configs have:
targets of a fixed sigma, boxes at the objects' own bins, the square root of the Wasserstein
distance, and every loss divided by its own value. Every row of the ground truth is an object.
"""

import torch
from torch.nn import functional

LOWEST, HIGHEST = -13.815509557963774, 13.802317976102996
"""Logits of the probabilities to which the focal loss clips, as `radejax.losses.focal` has them."""


class Losses:
    """Losses of one batch of frames.

    Args:
        c: `config.loss`.
        targets: Arrays by name: `boxes` `[B, N, 8]`, `classes` `[B, N]`, `bins` `[B, N, 2]` of the
            objects' centers, and `centers` `[B, N, 2]`, x and y of these bins in meters.
        columns: Number of azimuth bins; those that maps have beyond them are padding.
        device: "cpu" or "cuda".
    """

    def __init__(self, c, targets, columns, device):
        self.c, self.columns = c, columns
        given = {name: torch.tensor(x, device=device) for name, x in targets.items()}
        self.boxes, self.centers = given["boxes"], given["centers"]
        self.classes, self.bins = given["classes"].long(), given["bins"].long()

    def __call__(self, logits, params):
        """Takes `[B, C, R, A]` and `[B, 8, R, A]`; returns the loss and the plain weighted sum."""
        logits, params = logits[..., : self.columns].float(), params.float()
        frames = torch.arange(len(self.bins), device=logits.device)[:, None]
        found = params[frames, :, self.bins[..., 0], self.bins[..., 1]]
        found = torch.cat([self.centers + found[..., :2], found[..., 2:]], -1)
        smooth = functional.smooth_l1_loss(found, self.boxes, reduction="none")
        terms = {
            "focal": focal(logits, self.heatmap(*logits.shape[1:])),
            "gwd": (1 - 1 / (self.c["gwd_tau"] + distance(found, self.boxes))).mean(),
            "smooth_l1": smooth.mean(),
        }
        weights = self.c["weights"]
        total = sum(weights[n] * x / x.detach() for n, x in terms.items())
        return total, sum(weights[n] * x for n, x in terms.items()).detach()

    def heatmap(self, classes, rows, columns):
        """Returns targets `[B, C, R, A]`: the clipped sum of Gaussians at the objects' bins."""
        sigma = self.c["heatmap_sigma_bins"]
        range_profile = profile(self.bins[..., 0], rows, sigma)
        azimuth_profile = profile(self.bins[..., 1], columns, sigma)
        one_hot = functional.one_hot(self.classes, classes).float()
        summed = torch.einsum(
            "bnr,bna,bnc->bcra", range_profile, azimuth_profile, one_hot
        )
        return summed.clamp(max=1)


def profile(center, size, sigma):
    """Returns Gaussians over `size` bins, `[B, N]` centers -> `[B, N, size]`."""
    steps = torch.arange(size, device=center.device) - center[..., None]
    return torch.exp(-0.5 * (steps / sigma) ** 2)


def focal(logits, target):
    logits = logits.clamp(LOWEST, HIGHEST)
    hit = -functional.logsigmoid(logits) * torch.sigmoid(-logits) ** 2
    miss = -functional.logsigmoid(-logits) * torch.sigmoid(logits) ** 2
    loss = torch.where(target >= 1, hit, miss * (1 - target) ** 4)
    return loss.sum() / (target >= 1).sum()


def distance(a, b):
    """Returns the Wasserstein distance of the Gaussians of boxes `[..., 8]`.

    The trace of (S1 S2^2 S1)^(1/2) is (|P|^2 + 2 |det P|)^(1/2) for P = S1 S2.
    """
    (a_xx, a_xy, a_yy), (b_xx, b_xy, b_yy) = map(root, (a, b))
    xx, xy = a_xx * b_xx + a_xy * b_xy, a_xx * b_xy + a_xy * b_yy
    yx, yy = a_xy * b_xx + a_yy * b_xy, a_xy * b_xy + a_yy * b_yy
    square = xx**2 + xy**2 + yx**2 + yy**2 + 2 * (xx * yy - xy * yx).abs()
    sizes = a_xx**2 + 2 * a_xy**2 + a_yy**2 + b_xx**2 + 2 * b_xy**2 + b_yy**2
    offset = ((a[..., :2] - b[..., :2]) ** 2).sum(-1)
    return (offset + sizes - 2 * square.sqrt()).clamp(min=1e-12).sqrt()


def root(boxes):
    """Returns xx, xy and yy of the matrix with half length and half width as eigenvalues."""
    length, width, sin, cos = (boxes[..., i] for i in (3, 4, 6, 7))
    return (
        (length * cos**2 + width * sin**2) / 2,
        (length - width) * sin * cos / 2,
        (length * sin**2 + width * cos**2) / 2,
    )
