"""Noise as the data show it: a scale of the white part, and errors that neighbours share.

A stated sigma alone is not enough to name anything: 5 % too small, and χ² rejects half of the clean sets. For each kind
of datum, what is smooth along each stretch, and what nuisances and catalogue could do to all stretches together, is
projected out (restricted likelihood, Patterson & Thompson 1971); what is left decides between

    s² (B + t E_L),    (E_L)ᵢⱼ = σᵢ σⱼ exp(−|Δposition|/L),

B being the stated covariance there and σᵢ² its white part. The hypotheses t = 0 and s = 1 carry prior of their own, and
scale and shared part are averaged over the posterior, so that clean data are left alone.

**Splitting a stated covariance.** Its white part is what a datum does not share with its neighbours: C_ii less the
value that C_ij, j ≠ i, extrapolates to at j = i. Only the white part is scaled, and where that is downward, only as
much of it as can be taken from C. What is shared (a pose, the shape of a beam) is kept as stated: once smooth modes are
projected out nothing of it is left to judge it by. Not for errors that blocks share: those are nuisances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular, svd
from scipy.special import logsumexp

from benchsim.diagnosis.hypothesis import Noise
from benchsim.diagnosis.linear import factors, lowered
from benchsim.diagnosis.problem import Problem

Array = NDArray[np.float64]

SMOOTH = 5
"""Polynomials projected out of each stretch: offset, slope, curvature and two more."""

FEWEST = 16
"""A stretch with fewer data is not asked about its neighbours."""

VISIBLE = 0.3
"""Directions of nuisances and effects are projected out where they could displace the data by this many sigma."""

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
class _Kind:
    """All contrasts of one kind of datum, in units of their stated covariance.

    ``eigen``, ``data``, ``remove``: for no length and then every length, eigenvalues of E_L (n,), data (n,) and
    orthonormal columns (n, r) in the basis where E_L is diagonal.
    """

    eigen: tuple[Array, ...]
    data: tuple[Array, ...]
    remove: tuple[Array, ...]


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
        # At the ends there is one side only: along a straight line.
        shared[:2] = 2 * near[:2] - far[:2]
        shared[-2:] = 2 * near[-2:] - far[-2:]
        white[index] = np.clip(np.diag(c) - np.maximum(shared, 0), 1e-3 * np.diag(c), np.diag(c))
    return white


def removable(covariance: Array, white: Array) -> float:
    """Fraction of the white part that can be taken from a covariance that must stay positive."""
    root = np.sqrt(white)
    return float(np.clip(0.999 * np.linalg.eigvalsh(covariance / root[:, None] / root)[0], 0.0, 1.0))


def _smooth_contrasts(position: Array) -> Array:
    """Orthonormal contrasts free of what is smooth along a stretch, (n, n − SMOOTH)."""
    span = 2 * (position - position.min()) / max(float(np.ptp(position)), 1e-300) - 1
    smooth = np.polynomial.legendre.legvander(span, SMOOTH - 1)
    return np.asarray(np.linalg.qr(smooth, mode="complete")[0][:, SMOOTH:])


def _gather(
    problem: Problem, lines: Sequence[NDArray[np.intp]], residual: Array, remove: Array, sigma: Array, lengths: Array
) -> _Kind:
    """Contrasts of all lines; what nuisances and effects could do in all of them *together* is kept to be removed."""
    # Smooth in the data's own units: sigmas that follow the data would give what is smooth the data's own scatter.
    contrasts = [_smooth_contrasts(problem.position[i]) if len(lengths) else np.eye(len(i)) for i in lines]
    both, covariance, rotations = np.column_stack([residual, remove]), [], []
    for i, contrast in zip(lines, contrasts, strict=True):
        b = int(problem.block[i[0]])
        local = i - problem.rows(b).start
        covariance.append(contrast.T @ problem.covariance[b][local[:, None], local] @ contrast)
    factor = factors(covariance)
    both = lowered(factor, np.concatenate([c.T @ both[i] for i, c in zip(lines, contrasts, strict=True)]))
    for i, contrast, lower in zip(lines, contrasts, factor, strict=True) if len(lengths) else ():
        position, unit, turned = problem.position[i], sigma[i], []
        for length in lengths:
            shared = np.exp(-np.abs(position[:, None] - position) / length) * np.outer(unit, unit)
            half = solve_triangular(lower, contrast.T @ shared @ contrast, lower=True)
            turned.append(np.linalg.eigh(solve_triangular(lower, half.T, lower=True)))
        rotations.append(turned)
    z, x = both[:, 0], both[:, 1:]
    x = x[:, np.linalg.norm(x, axis=0) > VISIBLE]
    if x.shape[1]:
        # Not by the eigenvectors of a product: columns of 1e9 sigma would leave rounding of the directions of some.
        try:
            vector, value, _ = np.linalg.svd(x, full_matrices=False)
        except np.linalg.LinAlgError:
            # Divide and conquer gives up on some hundreds of columns that are alike; QR iteration does not.
            vector, value, _ = svd(x, full_matrices=False, lapack_driver="gesvd")
        x = vector[:, : max(len(z) // 3, 1)][:, value[: max(len(z) // 3, 1)] > VISIBLE]
    edges = np.cumsum([0, *map(len, factor)])
    eigen, turned_z, turned_x = [np.zeros(len(z))], [z], [x]
    for j in range(len(lengths)):
        eigen.append(np.concatenate([np.maximum(r[j][0], 0) for r in rotations]))
        pieces = [slice(a, b) for a, b in pairwise(edges)]
        turned_z.append(np.concatenate([r[j][1].T @ z[s] for r, s in zip(rotations, pieces, strict=True)]))
        turned_x.append(np.concatenate([r[j][1].T @ x[s] for r, s in zip(rotations, pieces, strict=True)]))
    return _Kind(tuple(eigen), tuple(turned_z), tuple(turned_x))


def _restricted(spread: Array, z: Array, x: Array) -> tuple[Array, Array, int]:
    """ln determinant, squares and number of what is left beside ``x`` where the variances are ``spread`` (m, n)."""
    inner = np.stack([x.T @ (x / s[:, None]) for s in spread])
    along = (z / spread) @ x
    logdet = np.log(spread).sum(axis=1) + np.linalg.slogdet(inner)[1]
    taken = (along * np.linalg.solve(inner, along[:, :, None])[:, :, 0]).sum(axis=1)
    return logdet, (z**2 / spread).sum(axis=1) - taken, len(z) - x.shape[1]


def _weigh(kind: _Kind, lengths: Array) -> tuple[float, Array, Array]:
    """Posterior mean of ln s; mean of s² t by length (l,); probability by length (1 + l,), the first of none."""
    logs: list[float] = []
    log_scales: list[float] = []
    cells: list[tuple[int, float]] = []
    for i in range(1 + len(lengths)):
        shares = np.zeros(1) if i == 0 else SHARED
        prior = np.log(1 - CORRELATED) if i == 0 else np.log(CORRELATED / len(lengths) / len(SHARED))
        logdets, totals, n = _restricted(1 + shares[:, None] * kind.eigen[i], kind.data[i], kind.remove[i])
        if n < 1:
            continue
        for t, logdet, total in zip(shares.tolist(), logdets.tolist(), totals.tolist(), strict=True):
            free = 0.5 * np.log(max(total / n, 1e-12))
            # The likelihood is Gaussian in ln s with variance 1/2n; its prior is too.
            variance = 1 / (2 * n)
            shrunk = free * LOG_SCALE_SIGMA**2 / (LOG_SCALE_SIGMA**2 + variance)
            for log_s, at_one in ((0.0, True), (float(shrunk), False)):
                fit = -0.5 * (2 * n * log_s + logdet + total * np.exp(-2 * log_s))
                if not at_one:
                    fit += 0.5 * np.log(variance / (LOG_SCALE_SIGMA**2 + variance))
                    fit += np.log(2 * (BELOW_ONE if log_s < 0 else 1) / (1 + BELOW_ONE))
                    fit -= 0.5 * (log_s / LOG_SCALE_SIGMA) ** 2
                logs.append(prior + np.log(0.5) + fit)
                log_scales.append(log_s)
                cells.append((i, t))
    if not logs:
        return 0.0, np.zeros(len(lengths)), np.append(1.0, np.zeros(len(lengths)))
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
    freedom: dict[str, float] = {}
    out = [c.copy() for c in problem.covariance]
    removed = cache(lambda b: removable(problem.covariance[b], white[b]))
    for name in np.unique(problem.kind):
        chosen = problem.kind == name
        own = np.flatnonzero(chosen)
        own = own[np.lexsort((problem.stretch[own], problem.block[own]))]
        new = np.diff(problem.block[own]).astype(bool) | np.diff(problem.stretch[own]).astype(bool)
        lines = np.split(own, np.flatnonzero(new) + 1)
        long = [i for i in lines if problem.stretch[i[0]] >= 0 and len(i) >= FEWEST]
        lengths = np.zeros(0)
        if long:
            spacing = float(np.median([np.median(np.diff(np.sort(problem.position[i]))) for i in long]))
            span = float(np.median([np.ptp(problem.position[i]) for i in long]))
            if spacing > 0 and span > 8 * spacing:
                lengths = np.geomspace(1.5 * spacing, span / 4, 6)
        used = [i for i in (long if len(lengths) else lines) if use is None or use[i[0]]]
        if not used:
            scale[str(name)], correlation[str(name)] = 1.0, 0.0
            continue
        kind = _gather(problem, used, residual, remove, sigma, lengths)
        log_s, shared, probability = _weigh(kind, lengths)
        freedom[str(name)] = float(len(kind.data[0]) - kind.remove[0].shape[1])
        scale[str(name)] = float(np.exp(log_s))
        found = len(lengths) > 0 and probability[0] < 0.5
        correlation[str(name)] = float(probability[1:] @ lengths / probability[1:].sum()) if found else 0.0
        for i in lines:
            b = int(problem.block[i[0]])
            local = i - problem.rows(b).start
            more = scale[str(name)] ** 2 - 1
            if more < 0:
                more *= removed(b)
            out[b][local, local] += more * white[b][local]
            if problem.stretch[i[0]] >= 0 and len(lengths):
                apart = np.abs(problem.position[i][:, None] - problem.position[i])
                extra = sum(v * np.exp(-apart / length) for v, length in zip(shared, lengths, strict=True))
                out[b][np.ix_(local, local)] += extra * sigma[i][:, None] * sigma[i]
    return Noise(scale, correlation, tuple(out), freedom)
