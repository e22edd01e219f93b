"""Noise of a line's pixels: variance, grain and whitening on lines whose noise is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchsim.trace.speckle import measure_grain, whitener


def slanted(size, contrast, seed, rows=400, columns=40):
    """A slanted line with shot noise, and speckle whose correlation is exp(−d²/size²)."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:rows, 0:columns]
    n = (u - 12 - 0.04 * v) / np.hypot(1, 0.04)
    line = 8000.0 * (1 - 0.3 * (v / rows)) * np.exp(-(n**2) / (2 * 1.6**2))
    field = rng.standard_normal(line.shape)
    if size:
        field = gaussian_filter(field, size / 2, mode="wrap")
        field /= field.std()
    light = line * (1 + contrast * field) + rng.standard_normal(line.shape) * np.sqrt(400 + line)
    use = np.abs(n) < 8
    return u[use], v[use], v[use].astype(float), n[use], light[use], line[use]


@pytest.mark.parametrize(("size", "contrast"), [(0.0, 0.0), (1.4, 0.03), (2.0, 0.06)])
def test_whitened_noise_is_white(size, contrast):
    """rms of z within 4 of its own sigmas, 1/√(2·pixels), and 4 % for what the noise's estimate leaves.

    Of the true line as of the photograph's own smooth light; false alarm below 1e-4.
    """
    u, v, t, n, light, line = slanted(size, contrast, 5)
    grain = measure_grain(u, v, t, n, light, np.zeros(len(u)), np.zeros(len(u)))
    if size:
        assert grain.size == pytest.approx(size, rel=0.2)
        assert np.sqrt(grain.noise.speckle) == pytest.approx(contrast, rel=0.2)
    white = whitener(u, v, t, grain, np.abs(n) < 5)
    margin = 0.04 + 4 / np.sqrt(2 * len(white.index))
    assert np.sqrt(np.mean(white(light - line) ** 2)) == pytest.approx(1, abs=margin)
    own = white(grain.residual / np.sqrt(1 - grain.leverage))
    assert np.sqrt(np.mean(own**2)) == pytest.approx(1, abs=margin + 0.02)
    # Neighbours, too: their mean product is 1/√pixels about 0 where whitening works, 0.4 before it at the larger grain.
    z = white(light - line)
    assert abs(np.mean(z[1:] * z[:-1])) < 5 / np.sqrt(len(z)) + 0.03


def test_a_line_out_of_place_shows():
    """A tenth of a pixel: z well above 1, so the test above could fail."""
    u, v, t, n, light, line = slanted(1.4, 0.03, 6)
    grain = measure_grain(u, v, t, n, light, np.zeros(len(u)), np.zeros(len(u)))
    white = whitener(u, v, t, grain, np.abs(n) < 5)
    moved = line * np.exp((n**2 - (n - 0.1) ** 2) / (2 * 1.6**2))
    assert np.sqrt(np.mean(white(light - moved) ** 2)) > 1.3
