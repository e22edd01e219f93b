"""How visible what is concealed is, and how near the next other explanation comes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement, product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from benchsim.bench.errors import BenchsimError
from benchsim.diagnosis import evidence
from benchsim.diagnosis.degeneracy import bounds
from benchsim.diagnosis.fitting import RENEWALS, Start, fitted
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Point
from benchsim.diagnosis.levels import APART
from benchsim.diagnosis.linear import Linear, columns, factors, linearise, predict_all, whiten
from benchsim.diagnosis.problem import Effect, Problem, fit_value, value_of
from benchsim.diagnosis.screen import Catalogue, expand

Array = NDArray[np.float64]
Rival = tuple[str, float]
"""Names joined by +, and a distance [sigma]."""

STEP = 0.02
"""By which shapes are moved to differentiate, of their range."""

NEAREST = 4
"""Rivals, nearest to first order, that `rival_refitted` follows."""

BEYOND = 1.02
"""By how much a fit may end beyond a cap and still count as within it."""


@dataclass(frozen=True)
class Stand:
    """What stands in for the truth: names joined by +, how far off to first order [sigma], and its parameters there."""

    names: str
    distance: float
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Kept:
    """An effect that is where it is: its columns there, nuisances marginalised, and how far its parameters go."""

    effect: Effect
    values: Mapping[str, float]
    columns: Array
    limits: Array


@dataclass(frozen=True)
class Sight:
    """A problem linearised at its stated setting, nuisances marginalised: what a change of the data is worth."""

    problem: Problem
    linear: Linear
    projector: Array
    catalogue: Catalogue
    columns: Array

    @classmethod
    def of(cls, problem: Problem) -> Sight:
        """About the stated setting."""
        linear = linearise(problem, {}, ())
        n = linear.nuisance
        # (1 + N Nᵀ)^(-1/2) applied by its projector: eigenvectors of N with 1/sqrt(1 + s²).
        u, s, _ = np.linalg.svd(n, full_matrices=False)
        projector = np.stack([u * (1 - 1 / np.sqrt(1 + s**2)), u])
        catalogue = expand(problem, {})
        white = whiten(problem, problem.covariance, catalogue.columns)[0]
        return cls(problem, linear, projector, catalogue, white - projector[0] @ (projector[1].T @ white))

    def through(self, whitened: Array) -> Array:
        """Whitened data with the nuisances marginalised: their norm is an SNR."""
        w, u = self.projector
        return whitened - w @ (u.T @ whitened)

    def change(self, values: Mapping[str, float], rest: Mapping[str, float] | None = None) -> Array:
        """What parameters change in the data, in sigma, nuisances marginalised; ``rest`` holds what stays, default
        their shapes."""
        if rest is None:
            rest = {k: v for k, v in values.items() if k in _shape_names(self.problem)}
        delta = predict_all(self.problem, values) - predict_all(self.problem, rest)
        return self.through(whiten(self.problem, self.problem.covariance, delta)[0])

    def rival(self, values: Mapping[str, float], concealed: tuple[str, ...]) -> Rival:
        """Nearest other single or pair without the truth, amplitudes, shapes and nuisances refitted [sigma].

        Shapes at the nodes of their grids; amplitudes within their caps: what no bench can have is nobody's rival. All
        is linear about the stated bench; but what holds one of two concealed effects has that one where it is, and only
        the other to imitate. A board bowed by 0.2 1/m is 200 sigma from its own linearisation on twelve settings, and
        would count as that far from itself.
        """
        found = self.nearest(values, concealed)
        return found.names, found.distance

    def nearest(self, values: Mapping[str, float], concealed: Sequence[str], but: Collection[str] = ()) -> Stand:
        """`rival` with its parameters, those left out whose names, joined by +, are in ``but``."""
        lone = [s for s in self._pairs() if not set(concealed) <= s and "+".join(sorted(s)) not in but]
        delta = self.change(values)
        best = self._nearest(delta, lone, Stand("", float(np.linalg.norm(delta))))
        for name in concealed if len(concealed) == 2 else ():
            beside = [s for s in lone if name in s]
            delta, kept = self._without(values, name)
            best = self._nearest(delta, beside, best, kept)
        return best

    def imitation(self, delta: Array) -> Rival:
        """Nearest single or pair to a change of the data (`through`) that has no name of the catalogue."""
        found = self._nearest(delta, self._pairs(), Stand("", float(np.linalg.norm(delta))))
        return found.names, found.distance

    def _pairs(self) -> list[set[str]]:
        return [{a, b} for a, b in combinations_with_replacement(self.catalogue.nodes, 2)]

    def alone(self, values: Mapping[str, float], concealed: Sequence[str]) -> float:
        """Distance [sigma] of two concealed effects from the nearest of them, refitted, by itself.

        Below 3 the data do not show that there are two, whatever the SNR of each. Infinite for fewer.
        """
        if len(concealed) < 2:
            return float("inf")
        found = []
        for kept in concealed:
            delta, own = self._without(values, kept)
            found.append(self._nearest(delta, [{kept}], Stand("", np.inf), own).distance)
        return min(found)

    def _without(self, values: Mapping[str, float], kept: str) -> tuple[Array, Kept]:
        """What the others change beside one concealed effect, and that one."""
        effect = next(e for e in self.problem.catalogue if e.name == kept)
        there = {p.name: values[p.name] for p in effect.parameters}
        steps = {p.name: STEP * (max(p.grid) - min(p.grid)) for p in effect.parameters if p.grid}
        j = columns(self.problem, there, effect.parameters, steps)
        own = self.through(whiten(self.problem, self.problem.covariance, j)[0])
        # An effect that is there may be fitted larger than its cap; of the other sign it may not.
        low = [-fit_value(p, there[p.name]) if not p.grid and bounds(p)[0] == 0 else -np.inf for p in effect.parameters]
        return self.change(values, there), Kept(effect, there, own, np.array([(x, np.inf) for x in low]))

    def _nearest(self, delta: Array, sets: Sequence[set[str]], best: Stand, kept: Kept | None = None) -> Stand:
        """The nearest of some sets, or ``best`` where none is nearer."""
        nodes = {e: [list(node.columns) for node in many] for e, many in self.catalogue.nodes.items()}
        limits = np.zeros((self.columns.shape[1], 2))
        for effect in self.problem.catalogue:
            for at in nodes[effect.name]:
                limits[at] = [bounds(p) for p in evidence.amplitudes(effect)]
        every = self.columns
        if kept is not None:
            nodes[kept.effect.name] = [list(range(len(limits), len(limits) + len(kept.limits)))]
            every, limits = np.column_stack([every, kept.columns]), np.vstack([limits, kept.limits])
        norm = np.linalg.norm(every, axis=0)
        unit = every / np.where(norm > 1e-9, norm, 1.0)
        gram, cross, whole = unit.T @ unit, unit.T @ delta, float(delta @ delta)
        limits = limits * np.where(norm > 1e-9, norm, 1.0)[:, None]
        free: list[tuple[float, set[str], list[int], Array]] = []
        for names in sets:
            for parts in product(*(nodes[n] for n in sorted(names))):
                at = [k for part in parts for k in part if norm[k] > 1e-9]
                size = np.asarray(np.linalg.lstsq(gram[np.ix_(at, at)], cross[at], rcond=1e-9)[0] if at else [], float)
                distance = float(np.sqrt(max(whole - float(cross[at] @ size), 0.0)))
                free.append((distance, names, at, size))
        # Without its caps a rival comes nearer: the nearest of those tells where to stop.
        for distance, names, at, size in sorted(free, key=lambda f: f[0]):
            if distance >= best.distance:
                break
            if not np.all((size >= limits[at, 0]) & (size <= limits[at, 1])):
                low = np.minimum(limits[at, 0], 0.0)
                high = np.maximum(limits[at, 1], low + 1e-9)
                bounded = lsq_linear(unit[:, at], delta, bounds=(low, high))
                distance, size = float(np.linalg.norm(bounded.fun)), bounded.x
            if distance < best.distance:
                sizes = dict(zip(at, size / norm[at], strict=True))
                best = Stand("+".join(sorted(names)), distance, self._values(names, sizes, kept))
        return best

    def _values(self, names: set[str], sizes: Mapping[int, float], kept: Kept | None) -> dict[str, float]:
        """Parameters of effects, from what their columns are multiplied by."""
        out: dict[str, float] = {}
        for effect in (e for e in self.problem.catalogue if e.name in names):
            if kept is not None and effect.name == kept.effect.name:
                first = self.columns.shape[1]
                for k, p in enumerate(effect.parameters, first):
                    there, change = kept.values[p.name], sizes.get(k, 0.0)
                    out[p.name] = there + change if p.grid else value_of(p, fit_value(p, there) + change)
                continue
            own = self.catalogue.nodes[effect.name]
            node = next((n for n in own if any(k in sizes for k in n.columns)), own[0])
            many = evidence.amplitudes(effect)
            out |= {p.name: value_of(p, sizes.get(k, 0.0)) for p, k in zip(many, node.columns, strict=True)}
            out |= {**node.shape, **evidence.fixed(effect)}
        return out


def refitted(problem: Problem, data: Array) -> float:
    """Distance of data from what the settings alone can do, refitted within what is stated of them.

    `Sight.change` says the same to first order. Settings that move by several sigma bend, and take up more: a beam 3 mm
    beside the axis is 10 sigma about the stated settings of Fig. 7, and 5 once they are refitted, with the mirror 1 mm
    from where it was.

    Parameters
    ----------
    problem : Problem
    data : (n,) array
        Free of noise.

    Returns
    -------
    float
        [sigma]. Too large where the fit ends in a poorer valley.
    """
    return _distance(problem, data, (), {})


def rival_refitted(sight: Sight, values: Mapping[str, float], concealed: Sequence[str]) -> Rival:
    """`Sight.rival` with amplitudes, shapes and settings fitted anew, of the `NEAREST` to first order.

    A line's width goes with the square of what widens it: beside a board tilted by 20 mrad a wavefront's curvature of
    -0.4 1/m is 12 sigma from an astigmatism to first order, and 0.2 from one of +0.4.

    Parameters
    ----------
    sight : Sight
    values : mapping
        Parameters of the concealed effects.
    concealed : sequence of str

    Returns
    -------
    tuple of str and float
        Names joined by +, and [sigma]. None is followed further once one is within `APART`. What ends beyond its caps
        counts as far off as it is to first order, within them.
    """
    data = predict_all(sight.problem, values)
    caps = {
        p.name: bounds(p) for e in sight.problem.catalogue if e.name not in concealed for p in evidence.amplitudes(e)
    }
    tried: list[Stand] = []
    for _ in range(NEAREST):
        stand = sight.nearest(values, concealed, [t.names for t in tried])
        if not stand.names:
            break
        try:
            found = _distance(sight.problem, data, stand.names.split("+"), stand.values, caps)
        except BenchsimError:  # light that misses the board on the way
            found = float("inf")
        tried.append(replace(stand, distance=found if np.isfinite(found) else stand.distance))
        if found < APART:
            break
    best = min(tried, key=lambda t: t.distance, default=stand)
    return best.names, best.distance


def _distance(
    problem: Problem,
    data: Array,
    names: Collection[str],
    begin: Mapping[str, float],
    caps: Mapping[str, tuple[float, float]] | None = None,
) -> float:
    """Distance of noiseless data from what effects and settings can do, fitted from ``begin`` [sigma].

    Infinite where a parameter of ``caps`` ends beyond them.
    """
    h = Hypothesis(tuple(e for e in problem.catalogue if e.name in names))
    context = Context(replace(problem, data=data), factors(problem.covariance), np.ones(1), np.ones(1))
    start = Point(
        np.zeros(len(problem.nuisances)),
        np.array([fit_value(p, begin[p.name]) for p in h.amplitudes]),
        # A rival's amplitude of 0 has no shape, and a period of 0 no light.
        np.array([np.clip(begin[p.name], min(p.grid), max(p.grid)) for p in h.shapes]),
    )
    stated = columns(problem, {}, problem.nuisances) * np.array([n.sigma for n in problem.nuisances])
    (solved,) = fitted(context, [Start(h, start, context.whiten(stated))], {h.names: 0.0}, renewals=RENEWALS)
    ends = {p.name: fit_value(p, solved.fit.values[p.name]) for p in h.amplitudes}
    if any(not low * BEYOND <= ends[n] <= high * BEYOND for n, (low, high) in (caps or {}).items() if n in ends):
        return float("inf")
    return float(np.sqrt(solved.fit.chi2 + solved.point.nuisance @ solved.point.nuisance))


def _shape_names(problem: Problem) -> set[str]:
    return {p.name for e in problem.catalogue for p in e.parameters if p.grid}
