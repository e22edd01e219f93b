"""Foot points and distances of points from a conic, in the metric of each point's own covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim.bench import conic

Array = NDArray[np.float64]


def foot_points(
    coefficients: Array, points: Array, covariance: Array, iterations: int = 25
) -> tuple[Array, Array, Array]:
    """Most likely true points on the conic, and each point's distance from it in standard deviations.

    The foot p of x minimises (x − p)ᵀ Σ⁻¹ (x − p) on the conic f = 0. Linearising f at the last p gives
    p ← x − Σ g (f(p) + g·(x − p)) / (gᵀ Σ g), g = ∇f(p); the first step is Sampson's approximation, the limit the
    geometric distance (Kanatani and Sugaya, "Compact algorithm for strictly ML ellipse fitting", ICPR 2008). Only
    Σ g appears, so Σ may be singular (a sigma across the curve alone). The error shrinks each step by about
    distance × curvature. Points near the centre of curvature, where it does not shrink, keep Sampson's step.

    Parameters
    ----------
    coefficients : (6,) array
    points : (n, 2) array
    covariance : (n, 2, 2) array
        In the points' unit, squared.

    Returns
    -------
    feet : (n, 2) ndarray
    residual : (n,) ndarray
        Signed distance [sigma]; positive where f > 0.
    derivative : (n, 6) ndarray
        ∂ residual / ∂ coefficients. Exact at a converged foot, which is itself stationary.
    """
    p = points
    first = None
    # where the noise is across a direction that the curve follows, nothing can be learned: the floor keeps that finite
    floor = np.finfo(float).tiny
    for _ in range(iterations):
        g = conic.gradient(coefficients, p)
        sg = np.einsum("nij,nj->ni", covariance, g)
        s2 = np.maximum((g * sg).sum(-1), floor)
        miss = conic.value(coefficients, p) + (g * (points - p)).sum(-1)
        new = points - sg * (miss / s2)[:, None]
        step = np.max(np.abs(new - p), axis=-1)
        if first is None:
            first = (new, miss / np.sqrt(s2), conic.monomials(p) / np.sqrt(s2)[:, None])
        p = new
        if not np.any(step > 1e-13 * (1 + np.max(np.abs(p), axis=-1))):
            break
    g = conic.gradient(coefficients, p)
    s = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", g, covariance, g), floor))
    residual = (conic.value(coefficients, p) + (g * (points - p)).sum(-1)) / s
    derivative = conic.monomials(p) / s[:, None]
    lost = ~np.isfinite(residual) | ~(step < 1e-6 * (1 + np.max(np.abs(p), axis=-1)))
    if np.any(lost) and first is not None:
        p, residual, derivative = p.copy(), residual.copy(), derivative.copy()
        p[lost], residual[lost], derivative[lost] = first[0][lost], first[1][lost], first[2][lost]
    return p, residual, derivative
