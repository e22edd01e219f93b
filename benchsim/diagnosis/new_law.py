"""A law for what was located but has no name: sparse monomials in the winning coordinate, else the function itself.

Terms are added one at a time while their evidence grows, with amplitudes N(0, sigma²) on coordinates scaled to their
largest value. A law is published only if it predicts settings that it was not fitted to: where a function was fitted
to what it cannot describe, nothing else shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis.cross_validation import Fold, best_scale, excess
from benchsim.diagnosis.discrepancy import Attached, absorb, weigh
from benchsim.diagnosis.functions import prepare, whitened
from benchsim.diagnosis.hypothesis import Fit, Naming
from benchsim.diagnosis.linear import Linear, marginal, nuisance_posterior, only, whiten
from benchsim.diagnosis.problem import Attachment, Problem
from benchsim.diagnosis.result import Law

Array = NDArray[np.float64]

DEGREE, TERMS = 4, 4
WORTH = 3.0
"""Δ ln Z that a term must bring."""

LEAST_GAIN, SIGMAS = 0.5, 3.0
"""What a law must take away of the left-out excess χ², and by how many sigma that must exceed nothing."""

_SIMPLER = 0.03
"""Gain that monomials may lose against the free function and still be preferred."""


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

    def weigh_set(chosen: list[int]) -> float:
        g, p = m.gram[np.ix_(chosen, chosen)], m.projection[chosen]
        inner = g + prior * np.eye(len(chosen))
        return float(0.5 * (p @ np.linalg.solve(inner, p) - np.linalg.slogdet(inner / prior)[1]))

    chosen: list[int] = []
    value = 0.0
    while len(chosen) < TERMS:
        trials = [(weigh_set([*chosen, k]), k) for k in range(len(candidates)) if k not in chosen]
        if not trials:
            break
        better, k = max(trials)
        if better < value + WORTH:
            break
        chosen, value = [*chosen, k], better
    if not chosen:
        return (), np.zeros(0)
    inner = m.gram[np.ix_(chosen, chosen)] + prior * np.eye(len(chosen))
    return tuple(candidates[k] for k in chosen), np.linalg.solve(inner, m.projection[chosen])


@dataclass(frozen=True)
class Gain:
    """1 − after/before of the left-out excess χ², and its sigma."""

    value: float
    sigma: float

    @property
    def holds(self) -> bool:
        return self.value >= LEAST_GAIN and self.value > SIGMAS * self.sigma


def gain(parts: Sequence[tuple[float, float, float]], data: int) -> Gain:
    """Of excess before, after, and 4 |prediction|² of every fold.

    Two scatters are known: of the noise, through the product of prediction and residual, and of the folds among
    themselves (jackknife). The larger is stated.
    """
    before, after, power = np.array(parts, float).T
    if before.sum() <= 0:
        return Gain(float("-inf"), float("inf"))
    value = 1 - after.sum() / before.sum()
    noise = np.sqrt(power.sum() + (1 - value) ** 2 * 2 * data) / before.sum()
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
    one = prepare(replace(problem, attachments=(attachment,)), naming.noise.covariance)
    parts: dict[bool, list[tuple[float, float, float]]] = {True: [], False: []}
    for fold in many:
        own = _own(fold.linear, on)
        base, train_on = absorb(problem, own), ~fold.test
        white, _ = whiten(problem, fold.naming.noise.covariance, attachment.basis)
        seen = whitened(problem, one, fold.naming.noise.covariance, train_on)
        fitted = weigh(problem, fold.naming, seen, keep=train_on, linear=own, log_evidence=0.0)[0]
        train = only(base, train_on)
        scale = best_scale(train, fold.naming, white[train_on] @ fitted.root)
        terms, amplitudes = select(attachment, white[train_on], train, scale)
        named = _named(base, own, train_on, scale, np.zeros(len(base.residual)))
        before = excess(own, base.residual - named, fold.test, scale)
        for sparse, c in ((True, at_knots(attachment, terms) @ amplitudes), (False, fitted.coefficients)):
            shift = white @ c
            shift = shift + _named(base, own, train_on, scale, shift) - named
            after = excess(own, base.residual - named - shift, fold.test, scale)
            power = excess(own, shift, fold.test, scale) + int(fold.test.sum())
            parts[sparse].append((before, after, 4 * power))
    gains = {sparse: gain(p, len(problem.data)) for sparse, p in parts.items()}
    sparse = gains[True].holds and gains[True].value >= gains[False].value - _SIMPLER
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


def _own(linear: Linear, on: Fit) -> Linear:
    """A linearisation with the amplitudes of one hypothesis alone."""
    places = [linear.names.index(n) for n in on.linear.names if n in linear.names]
    return replace(linear, effect=linear.effect[:, places], names=tuple(linear.names[i] for i in places))


def _named(base: Linear, own: Linear, keep: NDArray[np.bool_], scale: float, shift: Array) -> Array:
    """What the hypothesis' own amplitudes, learnt from some of the data once a function is taken off, do to all."""
    p = own.nuisance.shape[1]
    if base.nuisance.shape[1] == p:
        return np.zeros(len(shift))
    mean, _ = nuisance_posterior(only(base, keep), (base.residual - shift)[keep], scale)
    shift_of: Array = base.nuisance[:, p:] @ mean[p:]
    return shift_of


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
