"""Maximum-likelihood conic through points with known covariance.

Derivation. Points x_i scatter about points of the curve f(x; c) = c·m(x) = 0, m = (y², yz, z², y, z, 1), with
covariance Σ_i. Maximum likelihood minimises Σ r_i², r_i the distance from the foot point p_i in units of its standard
deviation (:func:`benchsim.conics.distance.foot_points`). As p_i is stationary, ∂r_i/∂c = m(p_i) / √(gᵀΣg), and
Gauss–Newton on the five directions across c (its length is free) converges in a few steps from Taubin's estimate. The
inverse of its normal matrix is the covariance of c, and the curve moves along its normal by m(p)·δc / |∇f|.

Everything is computed in coordinates in which the points have unit variance along their principal axes. A conic is a
conic in any affine frame, the likelihood does not change, and on an arc of depth h the five columns of the normal
matrix become the polynomials 1, u, …, u⁴ of the arc's coordinate: well conditioned however shallow the arc is.

Why not something simpler. *Algebraic least squares* (the smallest singular vector of m(x_i)) weighs each point with its
own |∇f|; shrinking the curve shrinks the sum, and on this bench's arcs (depth 7.5 mm on 650 mm) it collapses to a tight
ellipse or line pair. *Direct fits with a constraint on the kind* (A C − B²/4 = ∓1; Fitzgibbon 1999; O'Leary and
Zsombor-Murray 2004) minimise the same algebraic sum under a normalisation that biases them to flat ellipses or wide
hyperbolas with a small *scatter*: on Fig. 7a e = 10.6 ± 0.1 for 1.82, which the data know to ± 0.5; the tests show it.

When not to use it: on a polygon's or a distorted trace to *judge a model*. A free conic absorbs almost every effect of
the bench; its residuals say nothing about them. Outliers: one point off by k sigma moves the curve by about
5k/n sigma; use ``robust=True`` (breaks down above about 30 % of outliers).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from benchsim.bench import conic
from benchsim.bench.errors import BenchsimError
from benchsim.conics import solve
from benchsim.conics.data import Frame, check_common, check_covariance, check_points, whitening
from benchsim.conics.distance import foot_points
from benchsim.conics.fitted import Fitted

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ConicFit(Fitted):
    """A conic fitted to points alone; all of them are ``used``, unless ``robust``.

    Attributes
    ----------
    sigma : float [mm]
        The estimated sigma; nan if it was given.
    """

    sigma: float


def fit(
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    common: ArrayLike | None = None,
    robust: bool = False,
    seed: int = 0,
) -> ConicFit:
    """Fit a conic of any kind by maximum likelihood.

    Parameters
    ----------
    points : (n, 2) array [mm]
        y, z on the board.
    covariance : None, float, (n,), (n, 2, 2) or (2, 2) array
        Independent errors: one sigma or one per point [mm], of which only the part across the curve counts, or
        covariances [mm²], which may be singular. None: equal and unknown, estimated from the residuals.
    common : (n, 2, k) array, optional
        Errors that the points share, such as those of the camera's pose: displacement of every point per sigma of
        each of the k independent unit errors [mm]. They are estimated with the curve and widen its covariance. Needs
        ``covariance``.
    robust : bool
        Drop outliers: random samples of eight points give the start, points beyond 3.5 sigma are left out until the
        set no longer changes. With ``covariance=None`` sigma is taken from the median residual.
    seed : int
        Of the samples of ``robust``.

    Returns
    -------
    ConicFit

    Raises
    ------
    BenchsimError
        Fewer than 5 points (6 without a covariance, 12 with ``robust``), points not finite or all in one place,
        covariances not positive, common errors without a covariance.
    """
    estimate = covariance is None
    x = check_points(points, 12 if robust else 6 if estimate else 5)
    n = len(x)
    sigma = check_covariance(covariance, n)
    k = check_common(common, n)
    if estimate and k.shape[2]:
        raise BenchsimError("common errors are weighed against the points' own; give the covariance of the points too")
    used = _inliers(x, sigma, k, estimate, seed) if robust else np.ones(n, bool)

    frame = whitening(x[used])
    m = frame.matrix
    xw, sw, kw = frame.apply(x), m @ sigma @ m.T, np.einsum("ij,njk->nik", m, k)
    if estimate:  # unit variance in the frame keeps every number of order one; the unit cancels below
        unit = float(np.mean(sw[:, 0, 0] + sw[:, 1, 1]))
        sw = sw / unit
    else:
        unit = 1.0
    solution, covariance_c, dof, straight, shallow = _choose(xw[used], sw[used], kw[used], estimate, frame)
    chi2 = solution.chi2
    scale2 = chi2 / dof if estimate else 1.0
    c, cov = solve.unit_covariance(solution.coefficients, scale2 * covariance_c)
    feet, residual, _ = foot_points(c, xw - kw @ solution.common, sw)
    return ConicFit(
        coefficients=c, covariance=cov, frame=frame, points=x, feet=frame.undo(feet),
        residual=residual / np.sqrt(scale2) if scale2 > 0 else residual,
        curve_sigma=solve.curve_sigma(c, cov, feet, m),
        chi2=float(dof) if estimate else chi2, dof=dof, sigma_estimated=estimate,
        sigma=float(np.sqrt(scale2 / unit)) if estimate else float("nan"), straight=straight, shallow=shallow,
        used=used, common=solution.common, converged=solution.converged,
    )  # fmt: skip


def _choose(
    points: Array, covariance: Array, common: Array, estimate: bool, frame: Frame
) -> tuple[solve.Solution, Array, int, bool, bool]:
    """The conic, or the parabola where a conic would split the noise: solution, covariance, dof, straight, shallow."""
    data = points, covariance, common
    dof = len(points) - 5
    best = solve.maximise(solve.taubin(points, covariance), *data)
    scale = float(np.sqrt(best.chi2 / dof)) if estimate else 1.0
    flat = bool(np.linalg.norm(frame.matrix[1]) >= 0.99e9 * np.linalg.norm(frame.matrix[0]))
    if not flat and solve.sheets(best, covariance) >= solve.SHEETS * scale:
        return best, solve.coefficient_covariance(best), dof, False, False
    bent, bent_covariance = solve.parabola(*data)
    line = solve.line_chi2(*data)
    # two sheets that split a line's noise leave a third to a fifth of its chi2: less than five times is no gain
    enough = 5 * max(best.chi2, dof * scale**2)
    bend = stats.f.isf(0.01, 1, dof + 2) * bent.chi2 / (dof + 2) if estimate else stats.chi2.isf(0.01, 1)
    straight = flat or bool(line - bent.chi2 <= bend and line < enough)
    if not straight:
        other = solve.maximise(bent.coefficients / np.linalg.norm(bent.coefficients), *data)
        other_scale = float(np.sqrt(other.chi2 / dof)) if estimate else 1.0
        if solve.sheets(other, covariance) >= solve.SHEETS * other_scale:
            return other, solve.coefficient_covariance(other), dof, False, False
        if bent.chi2 >= enough:  # a truly thin conic: no single bend comes near it
            return best, solve.coefficient_covariance(best), dof, False, False
    return bent, bent_covariance, dof + 2, straight, True


def _inliers(x: Array, sigma: Array, common: Array, estimate: bool, seed: int) -> NDArray[np.bool_]:
    """Points within 3.5 sigma of the conic that random eights' median residual prefers, re-fitted until stable."""
    rng = np.random.default_rng(seed)
    frame = whitening(x)
    m = frame.matrix
    xw, sw, kw = frame.apply(x), m @ sigma @ m.T, np.einsum("ij,njk->nik", m, common)

    def distances(c: Array) -> Array:
        g = conic.gradient(c, xw)
        variance = np.einsum("ni,nij,nj->n", g, sw, g)
        return np.asarray(np.abs(conic.value(c, xw)) / np.sqrt(np.maximum(variance, np.finfo(float).tiny)))

    starts = [solve.taubin(xw[i], sw[i]) for i in (rng.choice(len(x), 8, replace=False) for _ in range(300))]
    best = min(starts, key=lambda c: float(np.median(distances(c))))
    d = distances(best)
    keep = np.ones(len(x), bool)
    for _ in range(20):
        spread = max(1.4826 * float(np.median(d)), 1e-15)
        # the first sets come from few points, whose own error adds to the noise
        new = d <= 3.5 * (spread if estimate else max(1.0, min(spread, 3.0)))
        if new.sum() < 12 or np.array_equal(new, keep):
            break
        keep = new
        d = distances(solve.maximise(solve.taubin(xw[keep], sw[keep]), xw[keep], sw[keep], kw[keep]).coefficients)
    return keep
