"""The picture's noise, from the residuals: how the variance grows with the light, and how honest the centres are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.optimize import nnls

Array = NDArray[np.float64]

FALSE_ALARM = 1e-3
"""Chance that noise alone discards one profile of a ridge, per test."""

_TURNS = 10

SHOWN = 2.0
"""Sigma by which neighbours' errors have to be alike for it to count: at 3 the tail of coarse grains is cut off, and
with it a tenth of the variance of a mean; at 2 one picture of forty without any correlation gets a little."""

LEAST_POWER = 0.02
"""Of white noise of the same variance, that correlated noise keeps at every frequency: what no datum is free of."""


@dataclass(frozen=True)
class PixelNoise:
    """Variance of a pixel: ``read + shot · level + speckle · signal²``, in the units of the light squared.

    ``level`` is all light that made the pixel, the dark picture's included; ``signal`` the laser's part.
    ``floor`` keeps pixels of no measured noise from infinite weight.
    """

    read: float
    shot: float
    speckle: float
    floor: float

    def variance(self, level: Array, signal: Array) -> Array:
        """Variance at these levels; never below ``floor``."""
        return np.maximum(self.read + self.shot * np.maximum(level, 0) + self.speckle * signal**2, self.floor)


def fit_pixel_noise(residual: Array, level: Array, signal: Array, leverage: Array) -> PixelNoise:
    """Variance against light by non-negative least squares on squared residuals.

    Parameters
    ----------
    residual, level, signal : (n,) array
        Of pixels; level and signal are the model's, so that the weights do not follow the noise.
    leverage : (n,) array
        Share of its own noise that the fit followed in each pixel, 0 … 1.

    Returns
    -------
    PixelNoise
    """
    square = residual**2 / np.maximum(1 - leverage, 0.1)
    # A hot pixel or a scratch must not set the noise: six sigma of the pixels at the same level.
    order = np.argsort(level + signal)
    groups = np.array_split(order, max(1, min(60, len(order) // 50)))
    rows, target, count = [], [], []
    for g in groups:
        limit = 36 * np.median(square[g]) / 0.455
        good = g[square[g] <= limit] if limit > 0 else g
        rows.append([1.0, max(level[good].mean(), 0.0), (signal[good] ** 2).mean()])
        target.append(square[good].mean())
        count.append(len(good))
    a, b = np.array(rows), np.array(target)
    scale = np.maximum(a.max(axis=0), 1e-30)
    expected = np.maximum(b, 1e-3 * b.max())
    for _ in range(3):
        w = np.sqrt(np.array(count)) / np.maximum(expected, 1e-30)
        x = nnls(a / scale * w[:, None], b * w)[0] / scale
        expected = np.maximum(a @ x, 1e-3 * b.max())
    return PixelNoise(float(x[0]), float(x[1]), float(x[2]), float(max(1e-6 * b.max(), 1e-30)))


@dataclass(frozen=True)
class CentreNoise:
    """How the centres scatter about a smooth curve.

    Attributes
    ----------
    scale : float
        Observed scatter over the one that the pixels' noise predicts; sigmas are already multiplied by it.
    scale_sigma : float
        Its own uncertainty.
    correlation : (m,) array
        Correlation of the centres' errors at lags 0, 1, … profiles; 1, then 0 where it is not significant.
    """

    scale: float
    scale_sigma: float
    correlation: Array

    @property
    def correlation_length(self) -> float:
        """Profiles over which errors are correlated: the sum of the correlation over positive and negative lags − 1."""
        return float(2 * self.correlation[1:].sum())


def centre_noise(t: Array, offset: Array, sigma: Array, basis: Array, longest: int = 12) -> CentreNoise:
    """Scatter and correlation of centres about their own smooth curve.

    Parameters
    ----------
    t : (k,) array
        Along the curve [profiles].
    offset, sigma : (k,) array
        Centres across the curve and what their sigma is thought to be, same unit.
    basis : (k, p) array
        Of the smooth curve; p must be well below k.
    longest : int
        Longest lag looked at [profiles].

    Returns
    -------
    CentreNoise
    """
    a = basis / sigma[:, None]
    q, r = np.linalg.qr(a)
    rank = int(np.sum(np.abs(np.diag(r)) > 1e-8 * np.abs(np.diag(r)).max()))
    pull = offset / sigma - q @ (q.T @ (offset / sigma))
    k = len(pull)
    index = np.round(t - t.min()).astype(int)
    line = np.full(index.max() + longest + 2, np.nan)
    line[index] = pull
    scale2 = float(pull @ pull) / max(k - rank, 1)
    rho = np.zeros(longest + 1)
    rho[0] = 1.0
    for lag in range(1, longest + 1):
        product = line[:-lag] * line[lag:]
        pairs = np.isfinite(product)
        if pairs.sum() < 20:
            break
        # The smooth curve takes p of k degrees of freedom from every lag that it can follow.
        value = np.nanmean(product) / max(scale2, 1e-30) + rank / k
        if value < SHOWN / np.sqrt(pairs.sum()):
            break
        rho[lag] = value
    rho = _possible(rho)
    inflation = 1 + 2 * rho[1:].sum()
    scale2 = float(pull @ pull) / max(k - rank * inflation, 0.5 * k)
    return CentreNoise(np.sqrt(scale2), np.sqrt(scale2 * inflation / (2 * max(k - rank, 1))), rho)


def _possible(rho: Array) -> Array:
    """A correlation that noise may have: cut off where it is no longer significant, the measured one need not be.

    The spectrum of noise, 1 + 2 Σ ρ_l cos(l ω), is nowhere negative, or some sum of the data would have a negative
    variance. The nearest that is not has its negative parts taken off; what means of many profiles scatter by, the
    spectrum about ω = 0, stays (a taper would take a third of it from grains that are as large as the line).
    """
    reach = len(rho)

    def power(r: Array) -> Array:
        return np.asarray(np.fft.rfft(np.concatenate([r, np.zeros(14 * reach), r[:0:-1]])).real)

    for _ in range(_TURNS):
        spectrum = power(rho)
        if spectrum.min() >= LEAST_POWER:
            return rho
        rho = np.fft.irfft(np.maximum(spectrum, LEAST_POWER))[:reach]
        rho = rho / rho[0]
    # What the cut at the longest lag brings back.
    least = float(power(rho).min())
    return rho if least >= LEAST_POWER else np.append(1.0, rho[1:] * (1 - LEAST_POWER) / (1 - least))


def spline_basis(t: Array, span: tuple[float, float], step: float) -> Array:
    """Cubic B-splines with knots every ``step``, those that no datum touches left out, (k, p)."""
    pieces = max(1, round((span[1] - span[0]) / step))
    knots = np.concatenate([[span[0]] * 3, np.linspace(span[0], span[1], pieces + 1), [span[1]] * 3])
    basis = BSpline.design_matrix(np.clip(t, *span), knots, 3).toarray()
    return basis[:, np.abs(basis).sum(axis=0) > 0.5]
