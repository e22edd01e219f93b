"""How the line's width goes along it."""

from types import SimpleNamespace

import numpy as np

from benchsim.trace import line


def test_a_shape_without_width_beyond_its_profiles_does_not_spread():
    """Scenario. The shape's second moment, a spline through what was measured, is negative where nothing was; the width
    along the line follows the profiles that were."""
    t = np.linspace(0.0, 1.0, 41)
    rows = t > 0.3
    shape = SimpleNamespace(width=lambda t: np.where(t > 0.3, 1.0, -0.2))
    profiles = SimpleNamespace(stretch=0.1 * (2 * t - 1), flux=np.ones(41), flux_sigma=np.full(41, 0.1))
    zoom = line._zoom(shape, profiles, t, rows, (0.0, 1.0))
    np.testing.assert_allclose(zoom, np.exp(0.1 * (2 * t - 1)), rtol=1e-9)
