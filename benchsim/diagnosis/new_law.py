"""A law for what was located but has no name: sparse monomials in the winning coordinate, else the function itself.

Terms are added one at a time while their evidence grows, with amplitudes N(0, sigma²) on coordinates scaled to their
largest value. A law is published only if it predicts settings that it was not fitted to: where a function was fitted
to what it cannot describe, nothing else shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis.cross_validation import Fold, about_folds, by_fold, function
from benchsim.diagnosis.discrepancy import Attached, absorb
from benchsim.diagnosis.hypothesis import Fit, Naming
from benchsim.diagnosis.levels import APART, AS_WELL, MARGIN
from benchsim.diagnosis.linear import Linear, marginal, whiten
from benchsim.diagnosis.problem import Attachment, Problem
from benchsim.diagnosis.result import Law

Array = NDArray[np.float64]

DEGREE, TERMS = 4, 4
"""Largest degree of a monomial, and most of them: what a person can still read as a law."""

LEAST_GAIN = 0.5
"""Part of the left-out excess χ² that a law must take away, and do so by `levels.APART`."""


@dataclass(frozen=True)
class Monomial:
    """Powers of the coordinates in one component of the function."""

    component: int
    powers: tuple[int, ...]


def monomials(attachment: Attachment) -> tuple[Monomial, ...]:
    """All up to degree `DEGREE` in at most two coordinates at a time."""
    d = attachment.knots.shape[1]
    varied = np.ptp(attachment.knots, axis=0) > 0
    powers = [
        p
        for p in product(range(DEGREE + 1), repeat=d)
        if sum(p) <= DEGREE and all(v or k == 0 for k, v in zip(p, varied, strict=True))
    ]
    return tuple(Monomial(int(c), p) for c in np.unique(attachment.component) for p in powers)


def _scaled(attachment: Attachment) -> tuple[Array, Array]:
    size = np.abs(attachment.knots).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    return attachment.knots / size, size


def at_knots(attachment: Attachment, terms: Sequence[Monomial]) -> Array:
    """The monomials of scaled coordinates at the knots, (K, m)."""
    u, _ = _scaled(attachment)
    values = [np.prod(u ** np.array(t.powers), axis=1) * (attachment.component == t.component) for t in terms]
    return np.column_stack(values) if values else np.zeros((len(u), 0))


def select(attachment: Attachment, white: Array, base: Linear, scale: float) -> tuple[tuple[Monomial, ...], Array]:
    """Terms that the data ask for, and their amplitudes in scaled coordinates.

    Parameters
    ----------
    attachment : Attachment
    white : (n, K)
        Its basis, whitened.
    base : Linear
        What it is laid on, amplitudes among the nuisances.
    scale : float
        Setting scale.
    """
    candidates = monomials(attachment)
    m = marginal(base, white @ at_knots(attachment, candidates), scale)
    prior = attachment.sigma**-2.0

    def fitted(some: list[int]) -> tuple[float, Array]:
        p, inner = m.projection[some], m.gram[np.ix_(some, some)] + prior * np.eye(len(some))
        best = np.linalg.solve(inner, p)
        return float(0.5 * (p @ best - np.linalg.slogdet(inner / prior)[1])), best

    chosen: list[int] = []
    value, found = 0.0, np.zeros(0)
    while len(chosen) < min(TERMS, len(candidates)):
        k = max((k for k in range(len(candidates)) if k not in chosen), key=lambda k: (fitted([*chosen, k])[0], k))
        better, amplitudes = fitted([*chosen, k])
        if better < value + MARGIN:
            break
        chosen, value, found = [*chosen, k], better, amplitudes
    return tuple(candidates[k] for k in chosen), found


@dataclass(frozen=True)
class Gain:
    """1 − after/before of the left-out excess χ², and its sigma."""

    value: float
    sigma: float

    @property
    def holds(self) -> bool:
        return self.value >= LEAST_GAIN and self.value > APART * self.sigma


def gain(folds: Array, data: int) -> Gain:
    """Of the excess before and after and the squared norm of what was predicted, of every fold (3, folds).

    Two scatters are known: of the noise, through the product of prediction and residual, and of the folds among
    themselves (jackknife). The larger is stated.
    """
    before, after, power = folds
    if before.sum() <= 0:
        return Gain(float("-inf"), float("inf"))
    value = 1 - after.sum() / before.sum()
    noise = np.sqrt(4 * power.sum() + (1 - value) ** 2 * 2 * data) / before.sum()
    others = [(before.sum() - b, after.sum() - a) for b, a in zip(before, after, strict=True)]
    left = np.array([1 - a / b if b > 0 else 0.0 for b, a in others])
    jackknife = np.sqrt((len(left) - 1) / len(left) * ((left - left.mean()) ** 2).sum())
    return Gain(float(value), float(max(noise, jackknife)))


def law(problem: Problem, naming: Naming, on: Fit, laid: Attached, many: Sequence[Fold]) -> tuple[Law | None, str]:
    """The law of an attachment, if it predicts what was left out.

    Parameters
    ----------
    problem : Problem
    naming : Naming
    on : Fit
        The hypothesis that the attachment is laid on.
    laid : Attached
        The attachment, fitted to all data.
    many : sequence of Fold
        Of `cross_validation.folds` about ``on``'s linearisation.

    Returns
    -------
    Law or None
    str
        A sentence for the notes where it is not published; empty where it is.
    """
    if not many:
        return None, "No law is published: with fewer than three settings it could not be tested on one left out."
    attachment = laid.attachment
    before = about_folds(problem, many, on)
    gains = {
        sparse: gain(by_fold(many, before, function(problem, many, laid, on, shape)), len(problem.data))
        for sparse, shape in ((True, _monomials), (False, None))
    }
    sparse = gains[True].holds and gains[False].value - gains[True].value <= AS_WELL * gains[True].sigma
    best = gains[sparse]
    if not best.holds:
        return None, (
            f"No law is published: on left-out settings a function of {attachment.coordinate} takes away "
            f"{best.value:.2f} ± {best.sigma:.2f} of the excess."
        )
    coefficients, found = laid.coefficients, {}
    if sparse:
        white, _ = whiten(problem, naming.noise.covariance, attachment.basis)
        terms, amplitudes = select(attachment, white, absorb(problem, laid.linear), laid.scale)
        coefficients = at_knots(attachment, terms) @ amplitudes
        found = printed(attachment, terms, amplitudes)
    return Law(
        attachment.name,
        attachment.coordinate,
        found,
        best.value,
        best.sigma,
        attachment.knots,
        attachment.component,
        coefficients,
    ), ""


def _monomials(attachment: Attachment, white: Array, base: Linear, scale: float) -> Array:
    """Coefficients of the sparse law, by some of the data."""
    terms, amplitudes = select(attachment, white, base, scale)
    return at_knots(attachment, terms) @ amplitudes


def printed(attachment: Attachment, terms: Sequence[Monomial], amplitudes: Array) -> dict[str, float]:
    """Terms by the names of the coordinate's directions and, of several components, of theirs; per unit of the raw
    coordinates."""
    _, size = _scaled(attachment)
    out = {}
    for term, a in zip(terms, amplitudes, strict=True):
        factors = [n if k == 1 else f"{n}^{k}" for n, k in zip(attachment.axes, term.powers, strict=True) if k]
        key = " ".join(factors) or "1"
        out[f"{key} [{attachment.parts[term.component]}]" if attachment.parts else key] = float(
            a / np.prod(size ** np.array(term.powers))
        )
    return out
