"""Rails stand along the road."""

import numpy as np
import pytest

from radejax.simulation.world import environments
from radejax.simulation.world.environments import ENVIRONMENTS
from radejax.simulation.world.scene import REFLECTOR_KINDS, Road


def test_highway_has_rails_that_follow_the_road():
    rng = np.random.default_rng(0)
    found, mirrors = environments.make_surroundings(
        ENVIRONMENTS["highway"], Road(0.002), 120.0, (-6.0, 16.0), rng, -0.9
    )
    rail = found.kind == REFLECTOR_KINDS.index("rail")
    assert mirrors[0] == pytest.approx(-6.6)
    x, y, z = found.position_m[rail].T
    radius = np.hypot(x, y - 500.0)
    expected = np.array([500.0 + 6.6, 500.0 - 16.6])
    assert (np.abs(radius[:, None] - expected).min(1) < 1e-6).all()
    np.testing.assert_allclose(z, -0.3)
    # Their normals point at the road, across its direction.
    toward = np.stack([np.cos(found.normal_rad[rail]), np.sin(found.normal_rad[rail])])
    center = np.stack([-x, 500.0 - y]) / radius
    assert (np.abs((toward * center).sum(0)) > 1 - 1e-9).all()
