"""The noise of the lines, from the record itself: what lies between the labels.

Model of the one-sided density matrix over the detectors at frequency f, with B_i the steady light of detector i:

    Σ_ij(f) = δ_ij (w + B_i² l f^−p) + B_i B_j c f^−p

white noise, flicker of each detector's own background, and flicker of all light together. The four numbers w, l, c, p
maximise Whittle's likelihood of the remainder's Fourier coefficients in the labels' band, bins within two line widths
of a label left out. Nothing of what the simulation assumed enters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchsim.arrays.labels import Lines, differencing
from benchsim.arrays.plant import Plant

Array = NDArray[np.float64]

_GUARD = 2.0
"""Half-width of what is left out about each label [1/T]."""

_MIDDLE = 150.0
"""Frequency at which flicker is stated [Hz]."""


@dataclass(frozen=True, eq=False)
class Noise:
    """Density of the noise over detectors.

    Attributes
    ----------
    white : float
        w, one-sided [(W/m²)²/Hz].
    local, common : float
        l and c at 150 Hz, relative to the steady light [1/Hz].
    exponent : float
        p.
    steady : (m,) ndarray
        B [W/m²].
    bins : int
        Frequencies that the numbers come from.
    """

    white: float
    local: float
    common: float
    exponent: float
    steady: Array
    bins: int

    def density(self, rate: float, uneven: Array | float = 0.0) -> Array:
        """Σ (m, m) at a frequency [(W/m²)²/Hz], with what `labels.uneven` says of a label there."""
        fall = (rate / _MIDDLE) ** -self.exponent
        return np.diag(self.white + self.steady**2 * self.local * fall + uneven) + (
            self.common * fall * np.outer(self.steady, self.steady)
        )


def fit_noise(lines: Lines, plant: Plant) -> Noise:
    """Noise of a record, from what its lines leave."""
    count = lines.remainder.shape[1]
    spectrum = np.fft.rfft(lines.remainder, axis=1)
    f = np.fft.rfftfreq(count, 1 / plant.sample_rate)
    labels = np.sort(plant.rates.ravel())
    inside = (f >= labels[0]) & (f <= labels[-1])
    at = np.searchsorted(labels, f)
    nearest = np.minimum(np.abs(f - labels[np.maximum(at - 1, 0)]), np.abs(f - labels[np.minimum(at, len(labels) - 1)]))
    use = inside & (nearest > _GUARD / plant.duration)
    if (
        use.sum() < 100
    ):  # labels that crowd leave nothing between them: the bins on them have lost a part of their noise
        use = inside & (nearest > 0.5 / plant.duration)
    # per bin |r|² over this is one-sided density, differencing undone
    scale = 0.5 * count * plant.sample_rate * differencing(f[use], plant.sample_rate)
    r = (spectrum[:, use] / np.sqrt(scale)).T
    fall, b = f[use] / _MIDDLE, lines.steady

    def loss(log: Array) -> float:
        w, own, c = np.exp(log[:3])
        drop = fall[:, None] ** -log[3]
        d = w + b**2 * own * drop
        inner = np.sum(b**2 / d, axis=1)
        across = np.sum(b / d * r, axis=1)
        g = c * drop[:, 0]
        quadratic = np.sum(np.abs(r) ** 2 / d, axis=1) - g * np.abs(across) ** 2 / (1 + g * inner)
        return float(np.mean(np.sum(np.log(d), axis=1) + np.log1p(g * inner) + quadratic))

    level = float(np.mean(np.abs(r) ** 2))
    relative = level / float(np.mean(b**2))
    start = np.array([np.log(level / 10), np.log(relative / 2), np.log(relative / 2), 2.0])
    bounds = [(start[0] - 12, start[0] + 3), (start[1] - 12, start[1] + 3), (start[2] - 12, start[2] + 3), (0.0, 4.0)]
    best = minimize(loss, start, method="L-BFGS-B", bounds=bounds).x
    w, own, c = np.exp(best[:3])
    return Noise(float(w), float(own), float(c), float(best[3]), b, int(use.sum()))
