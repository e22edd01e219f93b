"""The fit that the bench allows: the section of a cone whose few pose unknowns are known beforehand to a sigma.

Derivation. A free conic has five parameters, and a shallow arc fixes only three of them well. The bench's trace is the
section of the cone of reflected rays with the screen: its coefficients are a function c(θ) of the setting (mirror
position, mirror axis, laser dials, screen seat), each known beforehand, θ ~ N(μ, Π). The most likely θ minimises

    Σ r_i(c(θ))² + (θ − μ)ᵀ Π⁻¹ (θ − μ),

r_i the distances of :mod:`benchsim.conics.fit`. With θ = μ + L q, L Lᵀ = Π, and J = ∂r/∂q, the covariance of q is
(1 + JᵀJ)⁻¹; that of c follows through ∂c/∂q. The right singular vectors of J are the combinations of errors that the
trace sees, each one's sigma reduced by 1/√(1 + s²). The trace fixes five at most; the priors determine the conic's
invariants through the rest.

The function c(θ) is handed in, so that this module knows no bench. A conic is exact for r = 0; with the mirror's radius
the trace departs from one by 1e-7 mm (a polygon: 1e-5 mm): use :func:`section_of` on points of the predicted trace.

When not to use it: where the cone itself is in doubt. A missing effect is absorbed by the pose and makes confident,
wrong invariants; compare ``chi2`` with ``dof``, and ``pulls`` with 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.bench import conic
from benchsim.bench.errors import BenchsimError
from benchsim.conics.data import check_common, check_covariance, check_points, whitening
from benchsim.conics.distance import foot_points
from benchsim.conics.fit import fit
from benchsim.conics.fitted import Fitted
from benchsim.conics.solve import curve_sigma, unit_covariance

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class SectionFit(Fitted):
    """A cone's section with the setting errors that it implies.

    ``dof`` is the number of points: every parameter brings its prior. No section counts as ``straight`` or ``shallow``.

    Attributes
    ----------
    names : tuple of str
        Of the parameters.
    parameters : (k,) ndarray
        θ, in the parameters' own units.
    parameter_covariance : (k, k) ndarray
    pulls : (k,) ndarray
        (θ − μ) by the prior's sigma.
    combinations : (k, k) ndarray
        Rows: orthonormal combinations of the errors in units of their prior (of q), the best fixed first.
    remaining : (k,) ndarray
        Sigma of each combination after the fit by that before: 1 where the trace says nothing.
    """

    names: tuple[str, ...]
    parameters: Array
    parameter_covariance: Array
    pulls: Array
    combinations: Array
    remaining: Array


def section_of(predict: Callable[[Array], ArrayLike]) -> Callable[[Array], Array]:
    """Section function c(θ) from one that predicts points (n, 2) [mm] of the curve: the conic through them."""

    def section(parameters: Array) -> Array:
        return fit(predict(parameters)).board_coefficients

    return section


def fit_section(
    points: ArrayLike,
    covariance: ArrayLike | None,
    section: Callable[[Array], ArrayLike],
    prior_mean: ArrayLike,
    prior_covariance: ArrayLike,
    names: Sequence[str] = (),
    common: ArrayLike | None = None,
    iterations: int = 30,
) -> SectionFit:
    """Fit a conic that is a known function of parameters with a prior.

    Parameters
    ----------
    points, covariance, common
        As in :func:`benchsim.conics.fit.fit`; with ``covariance=None`` sigma is taken from a free conic's residuals.
    section : callable
        θ (k,) → A … F (6,) in y, z of the board [mm], any factor.
    prior_mean : (k,) array
    prior_covariance : (k, k) array, or (k,) sigmas
        Positive definite.
    names : sequence of str
        Of the parameters, for reports; default p0, p1, ….
    iterations : int
        Limit.

    Returns
    -------
    SectionFit

    Raises
    ------
    BenchsimError
        As for :func:`fit`; a prior that is not positive definite or of another length; a section that is not a conic.
    """
    x = check_points(points, 3)
    n = len(x)
    mean = np.atleast_1d(np.asarray(prior_mean, float))
    k = len(mean)
    prior = np.asarray(prior_covariance, float)
    prior = np.diag(prior**2) if prior.shape == (k,) else prior
    try:
        if prior.shape != (k, k) or not np.all(np.isfinite(mean)) or (names and len(names) != k):
            raise np.linalg.LinAlgError
        lower = np.linalg.cholesky(prior)
    except np.linalg.LinAlgError:
        raise BenchsimError(
            f"the prior of {k} parameters needs finite means, positive sigmas ({k},) or a positive definite ({k}, {k}) "
            f"covariance, and as many names; leave out parameters that are known exactly"
        ) from None
    if covariance is None:
        covariance = fit(x).sigma
    sigma, shared = check_covariance(covariance, n), check_common(common, n)
    frame = whitening(x)
    m = frame.matrix
    xw, sw, kw = frame.apply(x), m @ sigma @ m.T, np.einsum("ij,njk->nik", m, shared)
    to_frame = conic.transform_matrix(m, -m @ frame.origin)
    j = kw.shape[2]

    def coefficients(q: Array, like: Array | None) -> Array:
        c = np.asarray(section(mean + lower @ q), float)
        if c.shape != (6,) or not np.all(np.isfinite(c)) or not np.any(c[:5]):
            raise BenchsimError(
                "the section at these parameters is not a conic; check that the rays still meet the screen"
            )
        c = to_frame @ c
        c /= np.linalg.norm(c)
        return -c if like is not None and c @ like < 0 else c

    def evaluate(q: Array, eta: Array, like: Array | None) -> tuple[Array, Array, Array, Array, float]:
        c = coefficients(q, like)
        feet, r, d = foot_points(c, xw - kw @ eta, sw)
        return c, feet, r, d, float(r @ r + q @ q + eta @ eta)

    def slopes(q: Array, c: Array) -> Array:
        h = 1e-2
        return np.stack(
            [(coefficients(q + h * e, c) - coefficients(q - h * e, c)) / (2 * h) for e in np.eye(k)], axis=1
        )

    q, eta = np.zeros(k), np.zeros(j)
    c, feet, r, d, chi2 = evaluate(q, eta, None)
    converged = False
    for _ in range(iterations):
        g = conic.gradient(c, feet)
        s = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", g, sw, g), np.finfo(float).tiny))
        slope = slopes(q, c)
        rows = np.hstack([d @ slope, -np.einsum("ni,nik->nk", g, kw) / s[:, None]])
        step = -np.linalg.lstsq(np.vstack([rows, np.eye(k + j)]), np.concatenate([r, q, eta]), rcond=None)[0]
        if converged:
            break
        for half in range(12):
            t = 0.5**half
            trial = evaluate(q + t * step[:k], eta + t * step[k:], c)
            if trial[4] <= chi2 * (1 + 1e-12):
                break
        else:
            break
        # the last pass only takes the derivatives where the search ended
        converged = bool(chi2 - trial[4] < 1e-9 * (1 + trial[4]) and np.linalg.norm(step) < 1e-3)
        q, eta = q + t * step[:k], eta + t * step[k:]
        c, feet, r, d, chi2 = trial

    full = np.linalg.inv(np.eye(k + j) + rows.T @ rows)
    cov_q = full[:k, :k]
    c, cov = unit_covariance(c, slope @ cov_q @ slope.T)
    left, directions = np.linalg.eigh(cov_q)
    theta = mean + lower @ q
    return SectionFit(
        coefficients=c, covariance=cov, frame=frame, points=x, feet=frame.undo(feet), residual=r,
        curve_sigma=curve_sigma(c, cov, feet, m),
        chi2=chi2, dof=n, used=np.ones(n, bool),
        names=tuple(names) or tuple(f"p{i}" for i in range(k)), parameters=theta,
        parameter_covariance=lower @ cov_q @ lower.T, pulls=(theta - mean) / np.sqrt(np.diag(prior)),
        combinations=directions.T, remaining=np.sqrt(left), common=eta, converged=converged,
    )  # fmt: skip
