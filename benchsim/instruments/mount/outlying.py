"""Records that lie apart from all others, and how large the errors of the rest are.

One record with a wrong star, or a spot of another heliostat, bends every fit. Each single effect and each pair is
fitted to first order with Student's t errors (ν = 3), which such a record can hardly pull, and the most probable of
them grows by what helps; where it leaves a record further out than the generalised extreme Studentized deviate test
(Rosner 1983, https://doi.org/10.1080/00401706.1983.10487848) allows, that record is set aside. A change of the mount is
not taken for outliers: where more than a sixth of the records would go, or a run that lasts to the end or from the
beginning, none goes. A run that the mount came back from (wrong days, a spell) goes like single records.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.stats import f, norm

from benchsim.instruments.mount.records import Array

FREEDOM = 3.0
"""ν of Student's t."""

ALPHA = 0.02
"""Probability that a clean session loses a record, `GROSS` aside."""

MOST = 1 / 6
"""Part of the records that may be set aside."""

GROSS = 5.0
"""A record within this many sigma is never set aside, however many records there are."""

EFFICIENCY = 0.37
"""Of a median of absolute deviations against a standard deviation, in numbers."""

RUN = 3
"""So many neighbours in time that would all go, to the last or from the first, are a change of the mount."""

_ROUNDS = 30


@dataclass(frozen=True)
class Outlying:
    """Numbers of the records that lie apart, and the errors of the rest, rms of both components."""

    aside: tuple[int, ...]
    sigma: float


@dataclass(frozen=True)
class _Robust:
    residual: Array
    sigma: Array
    log_likelihood: float
    used: float


def outlying(
    residual: Array,
    columns: Array,
    always: Sequence[int],
    sets: Sequence[Sequence[int]],
    sigma: float | None = None,
    steps: Sequence[Sequence[int]] = (),
) -> Outlying:
    """Judge the records.

    Parameters
    ----------
    residual : (n, 2) array
        Data less prediction.
    columns : (2 n, k) array
        Derivatives times prior sigma.
    always : sequence of int
        Columns that are always fitted.
    sets : sequence of sequence of int
        Columns of every effect.
    sigma : float, optional
        Errors per component; default they are estimated.
    steps : sequence of sequence of int
        Columns of a change of the mount at each place where it may have been; at most one is there.
    """
    n = len(residual)
    data = residual.reshape(-1)

    def fitted(chosen: Sequence[int], step: Sequence[int] = ()) -> _Robust:
        own = [*always, *step, *(c for k in chosen for c in sets[k])]
        found = _robust(data, columns[:, own])
        # Schwarz's price of every number that is fitted, the place of a change among them.
        numbers = len(own) - len(always) + (2 if len(step) else 0)
        return replace(found, log_likelihood=found.log_likelihood - 0.5 * numbers * np.log(2 * n))

    numbers = range(len(sets))
    start = [c for c in [(), *((k,) for k in numbers), *combinations(numbers, 2)] if _few(sets, c, n)]
    chosen = max(start, key=lambda c: fitted(c).log_likelihood)
    best = fitted(chosen)
    at: Sequence[int] = max(steps, key=lambda s: fitted(chosen, s).log_likelihood, default=())
    if len(at) and fitted(chosen, at).log_likelihood > best.log_likelihood:
        best = fitted(chosen, at)
    else:
        at = ()
    while True:
        more = [(*chosen, k) for k in numbers if k not in chosen and _few(sets, (*chosen, k), n)]
        top = max(more, key=lambda c: fitted(c, at).log_likelihood, default=None)
        if top is None or fitted(top, at).log_likelihood <= best.log_likelihood:
            break
        chosen, best = top, fitted(top, at)
    spread = np.maximum(best.sigma, sigma or 1e-12)
    squares = (best.residual**2 / spread**2).sum(axis=1)
    size = float(np.sqrt(np.mean(best.sigma**2)))
    return Outlying(_deviates(squares, max(EFFICIENCY * (2 * n - best.used), 2.0)), size)


def _few(sets: Sequence[Sequence[int]], chosen: Sequence[int], n: int) -> bool:
    """Whether a set fits at most one number for every two records."""
    return 2 * sum(len(sets[k]) for k in chosen) <= n


def _robust(data: Array, columns: Array) -> _Robust:
    """Fit with bivariate Student's t errors by reweighting; columns carry priors of unit sigma."""
    n = len(data) // 2
    weight = np.ones(n)
    sigma = max(1.4826 * float(np.median(np.abs(data))), 1e-9)
    used = 0.0
    residual = data
    for _ in range(_ROUNDS):
        w = np.repeat(weight, 2)
        gram = (columns * w[:, None]).T @ columns
        # A little more where records agree to the last digit, so that there is an inverse.
        inner = gram + max(sigma**2, 1e-14 * float(np.trace(gram))) * np.eye(columns.shape[1])
        residual = data - columns @ np.linalg.solve(inner, (columns * w[:, None]).T @ data)
        used = float(np.trace(np.linalg.solve(inner, gram)))
        squares = (residual.reshape(-1, 2) ** 2).sum(axis=1)
        before = sigma
        # Expectation-maximisation for the scale, with the numbers that the fit has used up given back.
        left = max(2 * n - used, 1.0) / (2 * n)
        sigma = max(float(np.sqrt((weight * squares).sum() / (2 * n * left))), 1e-9)
        weight = (FREEDOM + 2) / (FREEDOM + squares / sigma**2)
        if abs(sigma / before - 1) < 1e-4:
            break
    squares = (residual.reshape(-1, 2) ** 2).sum(axis=1)
    log_likelihood = float(-((FREEDOM + 2) / 2 * np.log1p(squares / FREEDOM / sigma**2)).sum() - 2 * n * np.log(sigma))
    left = max(2 * n - used, 1.0) / (2 * n)
    bulk = np.median(np.abs(residual.reshape(-1, 2)), axis=0) / norm.ppf(0.75) / np.sqrt(left)
    return _Robust(residual.reshape(-1, 2), np.maximum(bulk, 1e-12), log_likelihood, used)


def _deviates(squares: Array, freedom: float) -> tuple[int, ...]:
    """Generalised extreme Studentized deviates of squared distances, (n,).

    Those of clean records are twice F with 2 and ``freedom`` degrees of freedom, from which sigma was estimated.
    """
    n = len(squares)
    most = int(n * MOST)
    order = np.argsort(-squares)
    gone = 0
    for k in range(1, most + 2):
        # The k-th largest of n, the k − 1 larger ones removed.
        limit = 2 * f.isf(ALPHA / (n - k + 1), 2, max(freedom - 2 * (k - 1), 2.0))
        if squares[order[k - 1]] > max(limit, GROSS**2):
            gone = k
    found = sorted(int(i) for i in order[:gone])
    run = len(found) >= RUN and found[-1] - found[0] == len(found) - 1
    changed = run and (found[0] == 0 or found[-1] == n - 1)
    return tuple(found) if gone <= most and not changed else ()
