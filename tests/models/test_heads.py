"""Tests of `radejax.models.heads`; weights/test_radenet_torch.py has torch's numbers."""

import jax
import numpy as np

from radejax.models.heads import Heads


def test_untrained_confidence_is_near_the_prior():
    prior = 0.01
    heads = Heads(num_classes=5, kind="default", heatmap_prior=prior)
    x = jax.random.normal(jax.random.key(1), (1, 8, 8, 128))
    maps, _ = jax.jit(heads.init_with_output)(jax.random.key(0), x)
    median = np.median(jax.nn.sigmoid(maps.heatmap_logits))
    assert abs(np.log(median / (1 - median)) - np.log(prior / (1 - prior))) < 1.0
