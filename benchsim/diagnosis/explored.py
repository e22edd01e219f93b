"""What a search has weighed and fitted so far, and what can be read off it about any set of effects.

What was not fitted is weighed by linear algebra about the best fit that differs by one effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import evidence, linear, screen, settings
from benchsim.diagnosis.discrepancy import absorb
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fitting import misses
from benchsim.diagnosis.hypothesis import Context, Effects, Hypothesis, Point, Solved
from benchsim.diagnosis.levels import APART, FURTHER_OFF
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.screen import Catalogue

Array = NDArray[np.float64]

SQUARE = 0.25
"""What bends the data: at half a prior sigma its square shows by a quarter as much as itself, and by `levels.APART`."""


@dataclass(frozen=True)
class Begun:
    """Where a fit ended when the noise was estimated worse: its point, setting scale, and derivatives by the nuisances
    (n, p), not whitened."""

    point: Point
    scale: int
    nuisance: Array


@dataclass
class Search:
    """A search on its way.

    Attributes
    ----------
    log_z, source
        ln Z of every set that was weighed or fitted, and the fit about which.
    done
        Best fit of each set.
    afresh
        Those with effects, as far as they were asked for, at the stated settings (`starts`).
    terms
        Integrals of each effect.
    """

    context: Context
    catalogue: Catalogue
    log_z: dict[Effects, float]
    source: dict[Effects, Effects]
    done: dict[Effects, Solved]
    stated: Solved
    earlier: Mapping[Effects, Begun] = field(default_factory=dict)
    afresh: dict[Effects, Solved] = field(default_factory=dict)
    terms: dict[str, list[Term]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = tuple(self.catalogue.effects)
        self.white = self.context.whiten(self.catalogue.columns)
        self.bends = self.context.whiten(self.catalogue.bends)
        self.bending = frozenset(n for n in self.names if _bends(self, n))

    def prior(self, effects: Effects) -> float:
        return evidence.log_prior(effects, list(self.names))

    def hypothesis(self, effects: Effects) -> Hypothesis:
        return Hypothesis(tuple(self.catalogue.effects[e] for e in effects))

    def ordered(self, effects: Sequence[str]) -> Effects:
        return tuple(n for n in self.names if n in effects)

    def best(self) -> Solved:
        """The most probable fit that may be built on."""
        some = [s for s in self.done.values() if s.fit.converged] or list(self.done.values())
        return max(some, key=lambda s: s.fit.log_evidence)


def begun(s: Search) -> dict[Effects, Begun]:
    """Where the fits of a search ended, for one with other noise."""
    p = len(s.context.problem.nuisances)
    return {
        e: Begun(x.point, scale_of(s, x), linear.raised(s.context.lower, x.columns[:, :p]))
        for e, x in s.done.items()
        if e
    }


def strayed(context: Context, solved: Solved) -> bool:
    """Whether a fit's settings were bent, so that what they hide shows in no linearisation about it; or it misses."""
    return misses(solved) or settings.size(context.scales, solved.fit.log_scales)[0] > FURTHER_OFF


def scale_of(s: Search, solved: Solved) -> int:
    """Where a fit's setting scale is on the grid."""
    return int(np.argmin(np.abs(s.context.scales - solved.fit.setting_scale)))


def columns_of(s: Search, solved: Solved) -> dict[str, Array]:
    """A fit's whitened derivatives by what its effects have."""
    h = s.hypothesis(solved.fit.effects)
    own = solved.columns[:, len(s.context.problem.nuisances) :]
    return {q.name: own[:, i] for i, q in enumerate((*h.amplitudes, *h.shapes))}


def log_z_about(s: Search, solved: Solved, wanted: Sequence[Effects]) -> dict[Effects, float]:
    """ln Z of sets about a fit by linear algebra, prior of presence included; what both hold has its columns there."""
    h = s.hypothesis(solved.fit.effects)
    own = solved.columns[:, len(s.context.problem.nuisances) :]
    columns = np.column_stack([s.white, own])
    number = {p.name: i for i, p in enumerate((*h.amplitudes, *h.shapes), s.white.shape[1])}

    @cache
    def base(names: Effects) -> list[Term]:
        kept = Hypothesis(tuple(e for e in h.effects if e.name in names))
        there = [number[p.name] for p in (*kept.amplitudes, *kept.shapes)]
        return [replace(t, columns=tuple(there[c] for c in t.columns)) for t in kept.terms]

    listed = []
    for effects in wanted:
        more = tuple(e for e in effects if e not in h.names)
        joined = screen.hypothesis_terms(s.catalogue, more, s.terms)
        kept = base(tuple(e for e in effects if e in h.names))
        listed.append((effects, [screen.join(a, b) for a in kept for b in joined]))
    found = screen.weigh(solved.fit.linear, columns, s.context.scales, s.context.weights, listed)
    return {e: z + s.prior(e) for e, z in found.items()}


def _bends(s: Search, name: str) -> bool:
    """Whether the data answer to an effect's size by its square, not much less than by itself."""
    effect = s.catalogue.effects[name]
    if evidence.shapes(effect) or effect.whole or effect.random_field:
        return False
    at = list(s.catalogue.nodes[name][0].columns)
    lin = s.stated.fit.linear
    half = np.array([screen.BENT * a.sigma**a.power for a in evidence.amplitudes(effect)])
    both = np.column_stack([s.white[:, at] * half, 0.5 * s.bends[:, at] * half**2])
    left = np.sqrt(np.diag(linear.marginal(lin, both, s.done[()].fit.setting_scale).gram))
    first, second = left[: len(at)], left[len(at) :]
    return bool(((second > SQUARE * first) & (second > APART)).any())


def whole(problem: Problem, catalogue: Catalogue, white: Array, solved: Solved) -> Linear:
    """About a fit: the amplitudes of the whole catalogue (its columns whitened), shapes at their most probable node."""
    names: list[str] = []
    columns: list[int] = []
    m = linear.marginal(absorb(problem, solved.fit.linear), white, solved.fit.setting_scale)
    for effect in problem.catalogue:
        prior = np.diag([p.sigma ** (-2.0 * p.power) for p in evidence.amplitudes(effect)])
        gains = []
        for at in (list(n.columns) for n in catalogue.nodes[effect.name]):
            inner = m.gram[np.ix_(at, at)] + prior
            gains.append(float(m.projection[at] @ np.linalg.solve(inner, m.projection[at])))
        node = catalogue.nodes[effect.name][int(np.argmax(gains))]
        names += [p.name for p in evidence.amplitudes(effect)]
        columns += node.columns
    return replace(solved.fit.linear, effect=white[:, columns], names=tuple(names))
