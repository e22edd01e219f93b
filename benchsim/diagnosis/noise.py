"""Noise as the data show it: a scale of the white part, and errors that neighbours share.

A stated sigma alone is not enough to name anything: 5 % too small, and χ² rejects half of the clean sets. For each kind
of datum, what is smooth along a stretch, and what the nuisances and the catalogue could do to it, is projected out
(restricted likelihood, Patterson & Thompson 1971); what is left in stretch after stretch decides between

    s² (B + t E_L),    (E_L)ᵢⱼ = σᵢ σⱼ exp(−|Δposition|/L),

B being the stated covariance there and σᵢ² its white part. The hypotheses t = 0 and s = 1 carry prior of their own, and
scale and shared part are averaged over the posterior, so that clean data are left alone.

**Splitting a stated covariance.** Its white part is what a datum does not share with its neighbours: C_ii less the
value that C_ij, j ≠ i, extrapolates to at j = i. Only the white part is scaled, and where that is downward, only as much
of it as can be taken from C. What is shared (a pose, the shape of a beam) is kept as stated: once smooth modes are
projected out nothing of it is left to judge it by. Not for errors that blocks share: those are nuisances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from benchsim.diagnosis.fits import Noise
from benchsim.diagnosis.problem import Problem

Array = NDArray[np.float64]

SMOOTH = 5
"""Polynomials projected out of each stretch: offset, slope, curvature and two more."""

FEWEST = 16
"""A stretch with fewer data is not asked about its neighbours."""

VISIBLE = 0.3
"""Modes of nuisances and effects are projected out where they could displace a stretch by this many sigma in all."""

SHARED = np.geomspace(0.03, 30.0, 14)
"""Variance of the shared part over that of the white part."""

CORRELATED = 0.1
"""Prior of a shared part. What is smooth along a stretch cannot contradict it, so an even prior would widen every
smooth mode of clean data by a fifth; the data that do have one leave no doubt."""

LOG_SCALE_SIGMA = 0.5
"""Prior of ln s where s is not 1."""

BELOW_ONE = 0.2
"""Prior of s < 1 against s > 1: understated noise invents effects, overstated noise only hides them."""


@dataclass(frozen=True)
class _Stretch:
    """One line of neighbours: its data's numbers, and per length the eigenvalues of E_L with the squares there."""

    index: NDArray[np.intp]
    eigen: tuple[Array, ...]
    squares: tuple[Array, ...]


def white_part(covariance: Array, position: Array, stretch: NDArray[np.intp]) -> Array:
    """Variance of each datum that it shares with no neighbour, (n,); see the module."""
    white: Array = np.diag(covariance).copy()
    for s in np.unique(stretch[stretch >= 0]):
        index = np.flatnonzero(stretch == s)
        if len(index) < 5:
            continue
        index = index[np.argsort(position[index])]
        c = covariance[np.ix_(index, index)]
        n = len(index)
        near, far = np.diag(c, 1), np.diag(c, 2)
        shared = np.full(n, np.nan)
        # Even in the distance: 4/3 of the nearest less 1/3 of the next but one extrapolates to 0 up to fourth order.
        shared[2:-2] = (4 * (near[1:-2] + near[2:-1]) - (far[:-2] + far[2:])) / 6
        shared[[0, 1]], shared[[-2, -1]] = shared[2], shared[-3]
        white[index] = np.clip(np.diag(c) - np.maximum(shared, 0), 1e-3 * np.diag(c), np.diag(c))
    return white


def removable(covariance: Array, white: Array) -> float:
    """Fraction of the white part that can be taken from a covariance that must stay positive."""
    root = np.sqrt(white)
    return float(np.clip(0.999 * np.linalg.eigvalsh(covariance / root[:, None] / root)[0], 0.0, 1.0))


def _contrasts(whole: Array, position: Array, neighbours: bool) -> Array:
    """Orthonormal contrasts free of smooth and visible modes, (n, m); ``whole`` (n, k) is in white sigmas."""
    n = len(position)
    if neighbours:
        span = 2 * (position - position.min()) / max(np.ptp(position), 1e-300) - 1
        smooth = np.polynomial.legendre.legvander(span, SMOOTH - 1)
    else:
        smooth = np.zeros((n, 0))
    basis = np.linalg.qr(smooth)[0]
    rest = whole - basis @ (basis.T @ whole)
    if rest.shape[1]:
        u, s, _ = np.linalg.svd(rest, full_matrices=False)
        basis = np.column_stack([basis, u[:, (s > VISIBLE) & (np.arange(len(s)) < max(n // 2 - basis.shape[1], 0))]])
    full = np.linalg.qr(basis, mode="complete")[0]
    return np.asarray(full[:, basis.shape[1] :])


def _prepare(
    residual: Array, covariance: Array, columns: Array, sigma: Array, position: Array, lengths: Sequence[float]
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Eigenvalues of E_L in the contrasts' stated covariance, and the squares there, for every length (0: none)."""
    contrast = _contrasts(columns / sigma[:, None], position, bool(lengths))
    lower = np.linalg.cholesky(contrast.T @ (covariance / sigma[:, None] / sigma) @ contrast)
    z = solve_triangular(lower, contrast.T @ (residual / sigma), lower=True)
    eigen, squares = [np.zeros(len(z))], [z**2]
    for length in lengths:
        shared = np.exp(-np.abs(position[:, None] - position) / length)
        half = solve_triangular(lower, contrast.T @ shared @ contrast, lower=True)
        value, vector = np.linalg.eigh(solve_triangular(lower, half.T, lower=True))
        eigen.append(np.maximum(value, 0))
        squares.append((vector.T @ z) ** 2)
    return tuple(eigen), tuple(squares)


def _weigh(stretches: Sequence[_Stretch], lengths: Sequence[float]) -> tuple[float, Array, Array]:
    """Posterior mean of ln s; mean of s² t by length (l,); probability by length (1 + l,), the first of none."""
    logs: list[float] = []
    log_scales: list[float] = []
    cells: list[tuple[int, float]] = []
    for i in range(1 + len(lengths)):
        eigen = np.concatenate([s.eigen[i] for s in stretches])
        squares = np.concatenate([s.squares[i] for s in stretches])
        n = len(eigen)
        for t in (0.0,) if i == 0 else SHARED:
            prior = np.log(1 - CORRELATED) if i == 0 else np.log(CORRELATED / len(lengths) / len(SHARED))
            spread = 1 + t * eigen
            total = float((squares / spread).sum())
            free = 0.5 * np.log(max(total / n, 1e-12))
            # The likelihood is Gaussian in ln s with variance 1/2n; its prior is too.
            variance = 1 / (2 * n)
            shrunk = free * LOG_SCALE_SIGMA**2 / (LOG_SCALE_SIGMA**2 + variance)
            for log_s, at_one in ((0.0, True), (float(shrunk), False)):
                fit = -0.5 * (2 * n * log_s + float(np.log(spread).sum()) + total * np.exp(-2 * log_s))
                if not at_one:
                    fit += (
                        0.5 * np.log(variance / (LOG_SCALE_SIGMA**2 + variance)) - 0.5 * (log_s / LOG_SCALE_SIGMA) ** 2
                    )
                    fit += np.log(2 * (BELOW_ONE if log_s < 0 else 1) / (1 + BELOW_ONE))
                logs.append(prior + np.log(0.5) + fit)
                log_scales.append(log_s)
                cells.append((i, t))
    weights = np.exp(np.array(logs) - logsumexp(logs))
    shared, probability = np.zeros(len(lengths)), np.zeros(1 + len(lengths))
    for w, log_s, (i, t) in zip(weights, log_scales, cells, strict=True):
        probability[i] += w
        if i:
            shared[i - 1] += w * np.exp(2 * log_s) * t
    return float(weights @ np.array(log_scales)), shared, probability


def estimate(problem: Problem, residual: Array, remove: Array, use: NDArray[np.bool_] | None = None) -> Noise:
    """Estimate the noise from a residual.

    Parameters
    ----------
    problem : Problem
    residual : (n,) array
        Data less prediction at any point from which the truth differs by a combination of ``remove`` and what is
        smooth along each stretch.
    remove : (n, k) array
        Columns of nuisances and effects, each times its prior sigma; not whitened.
    use : (n,) bool, optional
        Data to learn from, whole blocks; what is learnt is put into all blocks. Default all.

    Returns
    -------
    Noise
    """
    white = []
    for b, c in enumerate(problem.covariance):
        rows = problem.rows(b)
        white.append(white_part(c, problem.position[rows], problem.stretch[rows]))
    stated = np.concatenate([np.diag(c) for c in problem.covariance])
    # Where hardly anything is white, the stated sigma still sets the unit.
    sigma = np.sqrt(np.maximum(np.concatenate(white), 1e-4 * stated))
    scale: dict[str, float] = {}
    correlation: dict[str, float] = {}
    out = [c.copy() for c in problem.covariance]
    for name in np.unique(problem.kind):
        chosen = problem.kind == name
        lines = [
            np.flatnonzero(chosen & (problem.block == b) & (problem.stretch == s))
            for b in range(len(problem.names))
            for s in np.unique(problem.stretch[chosen & (problem.block == b)])
        ]
        long = [i for i in lines if problem.stretch[i[0]] >= 0 and len(i) >= FEWEST]
        lengths: list[float] = []
        if long:
            spacing = float(np.median([np.median(np.diff(np.sort(problem.position[i]))) for i in long]))
            span = float(np.median([np.ptp(problem.position[i]) for i in long]))
            if spacing > 0 and span > 8 * spacing:
                lengths = list(np.geomspace(1.5 * spacing, span / 4, 6))
        used = []
        for i in long if lengths else lines:
            if use is not None and not use[i[0]]:
                continue
            rows = problem.rows(int(problem.block[i[0]]))
            local = i - rows.start
            c = problem.covariance[int(problem.block[i[0]])][np.ix_(local, local)]
            eigen, squares = _prepare(residual[i], c, remove[i], sigma[i], problem.position[i], lengths)
            if len(eigen[0]):
                used.append(_Stretch(i, eigen, squares))
        if not used:
            scale[str(name)], correlation[str(name)] = 1.0, 0.0
            continue
        log_s, shared, probability = _weigh(used, lengths)
        scale[str(name)] = float(np.exp(log_s))
        found = lengths and probability[0] < 0.5
        correlation[str(name)] = float(probability[1:] @ lengths / probability[1:].sum()) if found else 0.0
        for i in lines:
            b = int(problem.block[i[0]])
            local = i - problem.rows(b).start
            more = scale[str(name)] ** 2 - 1
            if more < 0:
                more *= removable(problem.covariance[b], white[b])
            out[b][local, local] += more * white[b][local]
            if problem.stretch[i[0]] >= 0 and lengths:
                apart = np.abs(problem.position[i][:, None] - problem.position[i])
                extra = sum(v * np.exp(-apart / length) for v, length in zip(shared, lengths, strict=True))
                out[b][np.ix_(local, local)] += extra * sigma[i][:, None] * sigma[i]
    return Noise(scale, correlation, tuple(out))
