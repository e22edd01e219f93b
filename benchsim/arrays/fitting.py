"""Lines fitted with templates whose factor is free: the one fit that crossings and misalignments share.

Data z_j of prism j are whitened, so that real and imaginary parts are of unit variance; the model is a_j h_j(θ) with a
complex factor a_j (power and phase of the prism) that is eliminated: a_j = h_j^H z_j / h_j^H h_j. What is left of a
column ∂h/∂θ once h itself is projected out gives Gauss–Newton's normal matrix, whose inverse is the covariance of θ
with all a marginalised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

Whitener = Callable[[Complex], Complex]

STEP = 2e-5
"""Of numerical derivatives by angles [rad]: a hundredth of the beam's half-width."""


def whitener(density: Array, gain: float) -> Whitener:
    """Function that whitens amplitudes (..., m) of a line whose parts have covariance density (m, m) times gain."""
    factor = np.linalg.cholesky(density * gain)
    return lambda z: solve_triangular(factor, z.T, lower=True).T


@dataclass(frozen=True, eq=False)
class Fit:
    """Angles with covariance.

    Attributes
    ----------
    angles : (q,) ndarray [rad]
    covariance : (q, q) ndarray [rad²]
        Infinite where the lines do not determine the angles.
    factors : tuple of complex
        a of each prism.
    chi2 : float
    dof : int
    """

    angles: Array
    covariance: Array
    factors: tuple[complex, ...]
    chi2: float
    dof: int


def fit(data: Sequence[Complex], model: Callable[[Array], Sequence[Complex]], start: Array, farthest: float) -> Fit:
    """Most likely angles.

    Parameters
    ----------
    data : sequence of (m,) arrays
        Whitened amplitudes of each prism.
    model : function
        From angles (q,) to the whitened templates of each prism.
    start : (q,) array
        [rad]; the sun's image has to fall on the detectors there, for beyond it nothing says where to go.
    farthest : float
        Angles are kept within ± this [rad].
    """
    theta = np.array(start, float)
    damping, best = 1e-3, _at(data, model, theta)
    for _ in range(30):
        chi2, matrix, slope, _ = best
        trial = np.clip(theta + np.linalg.solve(matrix + damping * _scale(matrix), slope), -farthest, farthest)
        there = _at(data, model, trial)
        moved = trial - theta
        if there[0] <= chi2:
            theta, best, damping = trial, there, damping / 10
        else:
            damping *= 10
        # the next step is of the order of this one's square: 1e-3 sigma
        if moved @ matrix @ moved < 1e-3 or damping > 1e6:
            break
    chi2, matrix, _, factors = best
    if np.linalg.cond(matrix) < 1e12:
        covariance: Array = np.asarray(np.linalg.inv(matrix))
    else:
        covariance = np.full(matrix.shape, np.inf)
    dof = sum(2 * (len(z) - 1) for z in data) - len(theta)
    return Fit(theta, covariance, factors, chi2, dof)


def _scale(matrix: Array) -> Array:
    """What is added to the normal matrix where it has to be damped."""
    return np.diag(np.diag(matrix) + 1e-12 * np.trace(matrix) + 1e-12)


def _at(
    data: Sequence[Complex], model: Callable[[Array], Sequence[Complex]], theta: Array
) -> tuple[float, Array, Array, tuple[complex, ...]]:
    """χ², normal matrix, its right side and the factors at some angles."""
    q = len(theta)
    centre = model(theta)
    moved = [(model(theta + STEP * e), model(theta - STEP * e)) for e in np.eye(q)]
    chi2, matrix, slope, factors = 0.0, np.zeros((q, q)), np.zeros(q), []
    for j, (z, h) in enumerate(zip(data, centre, strict=True)):
        norm = np.vdot(h, h).real
        a = np.vdot(h, z) / norm if norm > 0 else 0j
        rest = z - a * h
        columns = np.array([a * (plus[j] - minus[j]) / (2 * STEP) for plus, minus in moved])
        if norm > 0:
            columns = columns - np.outer(columns @ h.conj() / norm, h)
        chi2 += float(np.vdot(rest, rest).real)
        matrix += (columns.conj() @ columns.T).real
        slope += (columns.conj() @ rest).real
        factors.append(complex(a))
    return chi2, matrix, slope, tuple(factors)
