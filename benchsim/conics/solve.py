"""Taubin's start and the Gauss–Newton search behind the fits; all in the points' frame (:mod:`.fit` derives it)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from benchsim.bench import conic
from benchsim.conics.distance import foot_points

Array = NDArray[np.float64]


def taubin(points: Array, covariance: Array) -> Array:
    """Taubin's estimate (PAMI 13, 1991): Σ f² least relative to Σ ∇fᵀ Σ_i ∇f, by a 5 × 5 eigenproblem.

    In whitened coordinates; good to the order of the noise over the arc's depth, and the start of the iteration.
    """
    m = conic.monomials(points)[:, :5]
    mean = m.mean(axis=0)
    y, z = points.T
    zero, one = np.zeros_like(y), np.ones_like(y)
    gy = np.stack([2 * y, z, zero, one, zero], axis=-1)
    gz = np.stack([zero, y, 2 * z, zero, one], axis=-1)
    g = np.stack([gy, gz], axis=-1)
    moment = (m - mean).T @ (m - mean) / len(m)
    noise = np.einsum("nai,nij,nbj->ab", g, covariance, g) / len(m)
    noise += 1e-12 * np.trace(noise) * np.eye(5)
    _, vectors = linalg.eigh(moment, noise)
    c = np.append(vectors[:, 0], -mean @ vectors[:, 0])
    return c / np.linalg.norm(c)


def across(c: Array) -> Array:
    """Orthonormal (6, 5) basis of the directions across c."""
    return np.linalg.svd(c[None, :])[2][1:].T


@dataclass(frozen=True)
class Solution:
    """Where a search stands.

    ``coefficients`` (6,), ``common`` (k,) and, at them: ``feet`` (n, 2), ``residual`` (n,) [sigma], its ``derivative``
    (n, 6) in the coefficients and ``load`` (n, k) in the common errors, ``chi2`` with the common errors' own.
    """

    coefficients: Array
    common: Array
    feet: Array
    residual: Array
    derivative: Array
    load: Array
    chi2: float
    converged: bool


def evaluate(c: Array, eta: Array, points: Array, covariance: Array, common: Array, converged: bool) -> Solution:
    """Feet, residuals and derivatives at coefficients c and common errors eta."""
    feet, residual, derivative = foot_points(c, points - common @ eta, covariance)
    g = conic.gradient(c, feet)
    s = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", g, covariance, g), np.finfo(float).tiny))
    load = -np.einsum("ni,nik->nk", g, common) / s[:, None]
    return Solution(c, eta, feet, residual, derivative, load, float(residual @ residual + eta @ eta), converged)


def maximise(start: Array, points: Array, covariance: Array, common: Array, iterations: int = 60) -> Solution:
    """Gauss–Newton with halved steps, in whitened coordinates."""
    k = common.shape[2]
    now = evaluate(start, np.zeros(k), points, covariance, common, False)
    for _ in range(iterations):
        basis = across(now.coefficients)
        rows = np.vstack([np.hstack([now.derivative @ basis, now.load]), np.hstack([np.zeros((k, 5)), np.eye(k)])])
        step = np.linalg.lstsq(rows, -np.concatenate([now.residual, now.common]), rcond=1e-13)[0]
        gain = float(np.sum((rows @ step) ** 2))
        best = None
        for half in range(12):
            t = 0.5**half
            c = now.coefficients + t * (basis @ step[:5])
            trial = evaluate(c / np.linalg.norm(c), now.common + t * step[5:], points, covariance, common, False)
            if trial.chi2 <= now.chi2 * (1 + 1e-12):
                best = trial
                break
        if best is None:
            # no step gains: the search is at its end if none was promised either
            return replace(now, converged=gain <= 1e-6 * max(1e-300, now.chi2))
        small = np.linalg.norm(step[:5]) < 1e-14 or gain < 1e-16 * best.chi2
        now = best
        if small:
            return replace(now, converged=True)
    return now


def line_chi2(points: Array, covariance: Array, common: Array) -> float:
    """χ² of the best straight line, whitened coordinates, where the second coordinate is across it."""
    eta = common.shape[2]
    slope = np.zeros(2 + eta)
    for _ in range(3):
        normal = np.array([-slope[1], 1.0])
        s = np.sqrt(np.maximum(np.einsum("i,nij,j->n", normal, covariance, normal), np.finfo(float).tiny))
        rows = np.column_stack([np.ones(len(points)), points[:, 0]]) / s[:, None]
        rows = np.vstack([np.hstack([rows, (common.transpose(0, 2, 1) @ normal) / s[:, None]]), np.eye(2 + eta)[2:]])
        target = np.append(points[:, 1] / s, np.zeros(eta))
        slope = np.linalg.lstsq(rows, target, rcond=None)[0]
    return float(np.sum((target - rows @ slope) ** 2))


def parabola(points: Array, covariance: Array, common: Array) -> tuple[Solution, Array]:
    """The most likely w = α + β u + γ u² and its covariance (6, 6) of rank 3: curves that only bend one way."""
    c, eta = np.array([0.0, 0, 0, 0, 1, 0]), np.zeros(common.shape[2])
    k = common.shape[2]
    free = np.zeros((6, 3))
    free[[0, 3, 5], [0, 1, 2]] = 1.0
    for _ in range(8):
        now = evaluate(c, eta, points, covariance, common, True)
        rows = np.vstack([np.hstack([now.derivative @ free, now.load]), np.hstack([np.zeros((k, 3)), np.eye(k)])])
        step = np.linalg.lstsq(rows, -np.append(now.residual, eta), rcond=1e-13)[0]
        c, eta = c + free @ step[:3], eta + step[3:]
        if np.sum((rows @ step) ** 2) <= 1e-14 * now.chi2:
            break
    spread = np.linalg.pinv(rows, rcond=1e-13)[:3]
    return evaluate(c, eta, points, covariance, common, True), free @ (spread @ spread.T) @ free.T


def coefficient_covariance(now: Solution) -> Array:
    """Covariance (6, 6) of rank 5 at a maximum, common errors marginalised."""
    basis, k = across(now.coefficients), len(now.common)
    rows = np.vstack([np.hstack([now.derivative @ basis, now.load]), np.eye(5 + k)[5:]])
    spread = np.linalg.pinv(rows, rcond=1e-13)[:5]
    return basis @ (spread @ spread.T) @ basis.T


def curve_sigma(c: Array, covariance: Array, feet: Array, matrix: Array) -> Array:
    """1 sigma (n,) of the curve along its normal on the board [mm], for a frame of that ``matrix``."""
    mono = conic.monomials(feet)
    variance = np.einsum("na,ab,nb->n", mono, covariance, mono)
    return np.sqrt(np.maximum(variance, 0.0)) / np.linalg.norm(conic.gradient(c, feet) @ matrix, axis=1)


# Sheets nearer to each other than this many sigma (1 % quantile along the points) cannot be told apart by a point.
SHEETS = 6.0


def sheets(now: Solution, covariance: Array) -> float:
    """Distance in sigma from the curve to the conic's other sheet along each point's own error, its 1 % quantile."""
    c = now.coefficients
    g = conic.gradient(c, now.feet)
    sg = np.einsum("nij,nj->ni", covariance, g)
    s = np.sqrt(np.maximum((g * sg).sum(-1), 0))
    bend = np.abs(c[0] * sg[:, 0] ** 2 + c[1] * sg[:, 0] * sg[:, 1] + c[2] * sg[:, 1] ** 2)
    with np.errstate(divide="ignore"):
        return float(np.quantile(np.where(bend > 0, s**3 / np.where(bend > 0, bend, 1.0), np.inf), 0.01))


def unit_covariance(c: Array, covariance: Array) -> tuple[Array, Array]:
    """Coefficients scaled to unit norm with A + C ≥ 0, the covariance across them."""
    unit = conic.normalise(c)
    project = (np.eye(6) - np.outer(unit, unit)) / np.linalg.norm(c)
    return unit, project @ covariance @ project.T
