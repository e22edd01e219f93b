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
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import f, norm

from benchsim.diagnosis import least_squares
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
    """Of one fit, or of each of several: residuals (n, 2), sigma (2,), ln of the likelihood, numbers used up."""

    residual: Array
    sigma: Array
    log_likelihood: Array
    used: Array


def outlying(
    residual: Array,
    columns: Array,
    always: Sequence[int],
    sets: Sequence[Sequence[int]],
    sigma: float | None = None,
    steps: Sequence[Sequence[int]] = (),
    local: Array | None = None,
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
    local : (2 n, m) array, optional
        Columns that are always fitted, too, of which no two act on one datum: what the records of a day share.
    """
    n = len(residual)
    data = residual.reshape(-1)
    alone = np.zeros((2 * n, 0)) if local is None else local

    numbers = range(len(sets))

    def best_of(many: Sequence[Sequence[int]], steps: Sequence[Sequence[int]] = ((),)) -> tuple[int, _Robust]:
        """Number of the most probable of sets beside steps, and its fit."""
        own = [[*always, *step, *(c for k in chosen for c in sets[k])] for chosen in many for step in steps]
        found = _robust(data, columns, own, alone)
        # Schwarz's price of every number that is fitted, the place of a change among them.
        paid = [
            len(o) - len(always) + (2 if len(step) else 0) for o, step in zip(own, [*steps] * len(many), strict=True)
        ]
        top = int(np.argmax(found.log_likelihood - 0.5 * np.log(2 * n) * np.array(paid)))
        price = 0.5 * np.log(2 * n) * paid[top]
        one = _Robust(found.residual[top], found.sigma[top], found.log_likelihood[top] - price, found.used[top])
        return top, one

    start = [c for c in [(), *((k,) for k in numbers), *combinations(numbers, 2)] if _few(sets, c, n)]
    top, best = best_of(start)
    chosen: Sequence[int] = start[top]
    at: Sequence[int] = ()
    if steps:
        top, changed = best_of([chosen], steps)
        if changed.log_likelihood > best.log_likelihood:
            best, at = changed, steps[top]
    while more := [(*chosen, k) for k in numbers if k not in chosen and _few(sets, (*chosen, k), n)]:
        top, larger = best_of(more, [at])
        if larger.log_likelihood <= best.log_likelihood:
            break
        chosen, best = more[top], larger
    spread = np.maximum(best.sigma, sigma or 1e-12)
    squares = (best.residual**2 / spread**2).sum(axis=1)
    size = float(np.sqrt(np.mean(best.sigma**2)))
    return Outlying(_deviates(squares, max(float(EFFICIENCY * (2 * n - best.used)), 2.0)), size)


def _few(sets: Sequence[Sequence[int]], chosen: Sequence[int], n: int) -> bool:
    """Whether a set fits at most one number for every two records."""
    return 2 * sum(len(sets[k]) for k in chosen) <= n


def _robust(data: Array, columns: Array, sets: Sequence[Sequence[int]], local: Array) -> _Robust:
    """Fits of sets of columns with bivariate Student's t errors by reweighting; columns carry priors of unit sigma.

    Those that are ``local`` have products with each other on the diagonal alone: they are eliminated.
    """
    n, most = len(data) // 2, max(map(len, sets))
    # Short sets are filled up with a column of nothing.
    whole = np.column_stack([columns, np.zeros(2 * n)])
    place = np.array([[*own, *[columns.shape[1]] * (most - len(own))] for own in sets], np.intp)
    weight, residual = np.ones((len(sets), n)), np.tile(data, (len(sets), 1))
    sigma, used = np.full(len(sets), max(1.4826 * float(np.median(np.abs(data))), 1e-9)), np.zeros(len(sets))
    going = np.arange(len(sets))
    row, size, first = least_squares.alone(local)
    of = np.diff(first, append=len(row))
    for _ in range(_ROUNDS):
        a = whole[:, place[going]].transpose(1, 0, 2)
        doubled = np.repeat(weight[going], 2, axis=1)
        weighted = (a * doubled[:, :, None]).transpose(0, 2, 1)
        gram, eye = weighted @ a, np.eye(most)
        # A little more where records agree to the last digit, so that there is an inverse.
        ridge = np.maximum(sigma[going] ** 2, 1e-14 * np.trace(gram, axis1=1, axis2=2))
        heavy = doubled[:, row] * size
        own = np.add.reduceat(heavy * size, first, axis=1) + ridge[:, None]
        cross = np.add.reduceat(heavy[:, :, None] * a[:, row], first, axis=1)
        heard = np.add.reduceat(heavy * data[row], first, axis=1) / own
        beside = cross / own[:, :, None]
        inverse = np.linalg.inv(gram + ridge[:, None, None] * eye - cross.transpose(0, 2, 1) @ beside)
        x = inverse @ (weighted @ data[:, None] - cross.transpose(0, 2, 1) @ heard[:, :, None])
        residual[going] = data - (a @ x)[:, :, 0]
        shared = heard - (beside @ x)[:, :, 0]
        residual[going[:, None], row] -= size * np.repeat(shared, of, axis=1)
        free = (
            np.trace(inverse, axis1=1, axis2=2) + (1 / own).sum(axis=1) + ((beside @ inverse) * beside).sum(axis=(1, 2))
        )
        used[going] = most + len(of) - ridge * free
        squares = (residual[going].reshape(len(going), n, 2) ** 2).sum(axis=2)
        before = sigma[going]
        # Expectation-maximisation for the scale, with the numbers that the fit has used up given back.
        left = np.maximum(2 * n - used[going], 1.0)
        sigma[going] = now = np.maximum(np.sqrt((weight[going] * squares).sum(axis=1) / left), 1e-9)
        weight[going] = (FREEDOM + 2) / (FREEDOM + squares / now[:, None] ** 2)
        going = going[np.abs(now / before - 1) >= 1e-4]
        if not len(going):
            break
    residual = residual.reshape(len(sets), n, 2)
    squares = (residual**2).sum(axis=2)
    log_likelihood = -((FREEDOM + 2) / 2 * np.log1p(squares / FREEDOM / sigma[:, None] ** 2)).sum(axis=1)
    left = np.maximum(2 * n - used, 1.0) / (2 * n)
    bulk = np.median(np.abs(residual), axis=1) / norm.ppf(0.75) / np.sqrt(left)[:, None]
    return _Robust(residual, np.maximum(bulk, 1e-12), log_likelihood - 2 * n * np.log(sigma), used)


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
