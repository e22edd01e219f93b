"""How the line's width goes along it."""

from types import SimpleNamespace

import cv2
import numpy as np
from scipy.stats import norm

from benchsim.trace import line
from benchsim.trace.extract import extract_pixels

ROOM, FULL, READ = 20300.0, 12000.0, 6.0
"""Light of the board, full well [e] and read noise [e] of the camera below."""


def slanted_width(path, peak, seed):
    """Mean ln width [px] of what is not saturated of a Gaussian line of 1.1 px on a lit board, 16 bits."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:650, 0:160].astype(float)
    n = u - 40 - 0.13 * v
    light = ROOM + peak * 1.1 * np.sqrt(2 * np.pi) * (norm.cdf((n + 0.5) / 1.1) - norm.cdf((n - 0.5) / 1.1))
    charge = rng.poisson(light / 65535 * FULL) + READ * rng.standard_normal(light.shape)
    cv2.imwrite(str(path), np.clip(np.round(charge / FULL * 65535), 0, 65535).astype(np.uint16))
    trace = extract_pixels(path)
    return np.log(trace.width_px[trace.saturated == 0]).mean()


def test_saturated_profiles_do_not_make_the_others_narrower(tmp_path):
    """Scenario. Half of the profiles have a pixel that is clipped; of some of them the flux may be anything.

    The mean of four pictures of either kind scatters by 0.0005; their difference stays below 0.003, six sigma. Pooled
    by a mean, profiles were 0.005 narrower.
    """
    dim = np.mean([slanted_width(tmp_path / "dim.png", 40000.0, seed) for seed in range(4)])
    clipped = np.mean([slanted_width(tmp_path / "clipped.png", 47000.0, seed) for seed in range(4)])
    assert abs(clipped - dim) < 0.003


def test_a_shape_without_width_beyond_its_profiles_does_not_spread():
    """Scenario. The shape's second moment, a spline through what was measured, is negative where nothing was; the width
    along the line follows the profiles that were."""
    t = np.linspace(0.0, 1.0, 41)
    rows = t > 0.3
    shape = SimpleNamespace(width=lambda t: np.where(t > 0.3, 1.0, -0.2))
    profiles = SimpleNamespace(stretch=0.1 * (2 * t - 1), flux=np.ones(41), flux_sigma=np.full(41, 0.1))
    zoom = line._zoom(shape, profiles, t, rows, (0.0, 1.0))
    np.testing.assert_allclose(zoom, np.exp(0.1 * (2 * t - 1)), rtol=1e-9)
