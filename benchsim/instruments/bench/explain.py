"""How much of a trace's misfit the setting uncertainties explain.

With d(θ) the trace's signed distances from the model curve at setting errors θ, C the trace's covariance and
S the prior covariance of θ, the statistic is

    χ² = min over θ of  d(θ)ᵀ C⁻¹ d(θ) + θᵀ S⁻¹ θ .

For a linear d(θ) = d₀ − J θ it equals d₀ᵀ (C + J S Jᵀ)⁻¹ d₀, the misfit with the setting errors marginalised, and
follows a chi-squared distribution with as many degrees of freedom as there are data, whatever the settings' number. The
setting errors move the trace by millimetres, so the second order (tens of µm) is not negligible: the
minimum is found by Gauss-Newton steps with J recomputed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.place import SettingErrors
from benchsim.bench.settings import NAMES, from_vector

Array = NDArray[np.float64]
Predict = Callable[[SettingErrors], Curve]


@dataclass(frozen=True)
class Binned:
    """A trace in bins along its curve.

    Attributes
    ----------
    weights : (b, n)
        Mean over the points of each bin, inverse-variance weighted; rows sum to 1.
    s : (b,) mm
        Arc length of the bins along the trace.
    covariance : (b, b) mm²
        Of the bin means across the curve, with what all points share.
    """

    weights: Array
    s: Array
    covariance: Array


def bin_trace(s: Array, covariance: Array, *, bins: int = 64) -> Binned:
    """Bin a trace so that its points' noise is averaged; every bin holds as many points.

    Parameters
    ----------
    s : (n,) array
        Arc length [mm].
    covariance : (n, n) array
        Of the points' shifts across the curve, with what they share [mm²].
    bins : int
        At most so many; never fewer than four points a bin.
    """
    n = len(s)
    count = max(1, min(bins, n // 4))
    which = np.empty(n, int)
    which[np.argsort(s, kind="stable")] = np.arange(n) * count // n
    weights = np.zeros((count, n))
    weights[which, np.arange(n)] = 1 / np.diag(covariance)
    weights /= weights.sum(axis=1, keepdims=True)
    return Binned(weights, weights @ s, weights @ covariance @ weights.T)


@dataclass(frozen=True)
class Explained:
    """A trace against one model, before and after the setting errors.

    Attributes
    ----------
    before, after : (n,) mm
        Signed distances of the trace's points from the model, at the stated setting and at ``theta``.
    chi2_before, p_before : float
        With the trace's noise alone; ``dof`` data.
    chi2_after, p_after : float
        With the setting errors marginalised; ``dof`` data as well (see the module's derivation).
    theta, sigma : (13,) mm, rad
        Most probable setting errors and their posterior 1 sigma, in the order of ``settings.NAMES``.
    pulls : dict
        theta over its prior sigma, for the errors that may differ from zero.
    converged : bool
        Whether the minimum was reached; nothing is claimed where it was not.
    curve : Curve
        The model at ``theta``.
    """

    before: Array
    after: Array
    chi2_before: float
    p_before: float
    chi2_after: float
    p_after: float
    dof: int
    theta: Array
    sigma: Array
    pulls: dict[str, float]
    converged: bool
    curve: Curve


def explain(points: Array, binned: Binned, predict: Predict, prior: Array, *, iterations: int = 12) -> Explained:
    """Fit the setting errors within their priors; see the module's derivation.

    Parameters
    ----------
    points : (n, 2) array
        The trace on the board [mm].
    binned : Binned
        Its bins and their covariance.
    predict : callable
        Curve of the model at given setting errors.
    prior : (13,) array
        1 sigma of the setting errors; those with 0 are held.

    Returns
    -------
    Explained

    Raises
    ------
    BenchsimError
        If the model's trace is lost at the stated settings, or on the way from them to a minimum that is not reached.
    """
    free = np.flatnonzero(prior > 0)
    scale = prior[free]
    factor = cho_factor(binned.covariance, lower=True)

    def distances(x: Array) -> tuple[Array, Curve]:
        theta = np.zeros(len(NAMES))
        theta[free] = scale * x
        curve = predict(from_vector(theta))
        return signed_distance(curve, points)[0], curve

    def cost(d: Array, x: Array) -> float:
        mean = binned.weights @ d
        return float(mean @ cho_solve(factor, mean) + x @ x)

    x = np.zeros(len(free))
    before, curve = distances(x)
    after, best = before, cost(before, x)
    converged = False
    missed: BenchsimError | None = None
    hessian = np.eye(len(free))
    for _ in range(iterations):
        # Central differences of 5 % of a prior sigma: rounding and third order both stay far below a µm.
        jacobian = np.zeros((len(binned.s), len(free)))
        for k, h in enumerate(0.05 * np.eye(len(free))):
            jacobian[:, k] = binned.weights @ (distances(x + h)[0] - distances(x - h)[0]) / 0.1
        weighted = cho_solve(factor, jacobian)
        hessian = jacobian.T @ weighted + np.eye(len(free))
        step = -np.linalg.solve(hessian, weighted.T @ (binned.weights @ after) + x)
        for shrink in (1.0, 0.5, 0.25, 0.1):
            try:
                trial, trial_curve = distances(x + shrink * step)
            except BenchsimError as error:
                # So far from the stated settings the mirror misses the beam, or the light the board.
                missed = error
                continue
            value = cost(trial, x + shrink * step)
            if value <= best + 1e-9:
                break
        else:
            converged = bool(np.max(np.abs(step), initial=0.0) < 1e-3)
            break
        gain, best = best - value, value
        x, after, curve = x + shrink * step, trial, trial_curve
        if gain < 1e-4:
            converged = True
            break
    if missed is not None and not converged:
        raise missed
    theta, sigma = np.zeros(len(NAMES)), np.zeros(len(NAMES))
    theta[free] = scale * x
    sigma[free] = scale * np.sqrt(np.diag(np.linalg.inv(hessian)))
    mean = binned.weights @ before
    chi2_before, dof = float(mean @ cho_solve(factor, mean)), len(binned.s)
    return Explained(
        before=before,
        after=after,
        chi2_before=chi2_before,
        p_before=float(chi2.sf(chi2_before, dof)),
        chi2_after=best,
        p_after=float(chi2.sf(best, dof)),
        dof=dof,
        theta=theta,
        sigma=sigma,
        pulls={NAMES[i]: float(v) for i, v in zip(free, x, strict=True)},
        converged=converged,
        curve=curve,
    )
