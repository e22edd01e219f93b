"""How visible what is concealed is, and how near the next other explanation comes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from benchsim.diagnosis import refit
from benchsim.diagnosis.classes import bounds
from benchsim.diagnosis.curvature import Curvature
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, whitener
from benchsim.diagnosis.linear import Linear, columns, fit_value, linearise, predict_all, whiten
from benchsim.diagnosis.problem import Effect, Parameter, Problem
from benchsim.diagnosis.screen import Catalogue, expand

Array = NDArray[np.float64]
Rival = tuple[str, float]
"""Names joined by +, and a distance [sigma]."""

STEP = 0.02
"""By which shapes are moved to differentiate, of their range."""


def amplitudes(effect: Effect) -> tuple[Parameter, ...]:
    """Parameters of an effect that are no shapes."""
    return tuple(p for p in effect.parameters if not p.grid)


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
        the other to imitate. A board tilted by 20 mrad is 31 sigma from its own linearisation, and would count as that
        far from itself.
        """
        sets = [{a, b} for a, b in combinations_with_replacement(self.catalogue.nodes, 2)]
        lone = [s for s in sets if not set(concealed) <= s]
        delta = self.change(values)
        best = self._nearest(delta, lone, ("", float(np.linalg.norm(delta))))
        for kept in concealed if len(concealed) == 2 else ():
            beside = [s for s in lone if kept in s]
            delta, own, limits = self._without(values, kept)
            best = self._nearest(delta, beside, best, (kept, own, limits))
        return best

    def alone(self, values: Mapping[str, float], concealed: Sequence[str]) -> float:
        """Distance [sigma] of two concealed effects from the nearest of them, refitted, by itself.

        Below 3 the data do not show that there are two, whatever the SNR of each. Infinite for fewer.
        """
        if len(concealed) < 2:
            return float("inf")
        found = []
        for kept in concealed:
            delta, own, limits = self._without(values, kept)
            found.append(self._nearest(delta, [{kept}], ("", np.inf), (kept, own, limits))[1])
        return min(found)

    def _without(self, values: Mapping[str, float], kept: str) -> tuple[Array, Array, Array]:
        """What the others change beside one concealed effect, that one's columns where it is, and how far they go."""
        effect = next(e for e in self.problem.catalogue if e.name == kept)
        there = {p.name: values[p.name] for p in effect.parameters}
        steps = {p.name: STEP * (max(p.grid) - min(p.grid)) for p in effect.parameters if p.grid}
        j = columns(self.problem, there, effect.parameters, steps)
        own = self.through(whiten(self.problem, self.problem.covariance, j)[0])
        # An effect that is there may be fitted larger than its cap; of the other sign it may not.
        low = [-fit_value(p, there[p.name]) if not p.grid and bounds(p)[0] == 0 else -np.inf for p in effect.parameters]
        limits = [(x, np.inf) for x in low]
        return self.change(values, there), own, np.array(limits)

    def _nearest(
        self, delta: Array, sets: Sequence[set[str]], best: Rival, own: tuple[str, Array, Array] | None = None
    ) -> Rival:
        """The nearest of some sets, or ``best`` where none is nearer.

        ``own`` is an effect whose columns, and how far they go, are given.
        """
        nodes = {e: [list(node.columns) for node in many] for e, many in self.catalogue.nodes.items()}
        limits = np.zeros((self.columns.shape[1], 2))
        for effect in self.problem.catalogue:
            for at in nodes[effect.name]:
                limits[at] = [bounds(p) for p in amplitudes(effect)]
        every = self.columns
        if own is not None:
            nodes[own[0]] = [list(range(len(limits), len(limits) + len(own[2])))]
            every, limits = np.column_stack([every, own[1]]), np.vstack([limits, own[2]])
        norm = np.linalg.norm(every, axis=0)
        unit = every / np.where(norm > 1e-9, norm, 1.0)
        gram, cross, whole = unit.T @ unit, unit.T @ delta, float(delta @ delta)
        limits = limits * np.where(norm > 1e-9, norm, 1.0)[:, None]
        free: list[tuple[float, str, list[int], bool]] = []
        for names in sets:
            for parts in product(*(nodes[n] for n in sorted(names))):
                at = [k for part in parts for k in part if norm[k] > 1e-9]
                size = np.linalg.lstsq(gram[np.ix_(at, at)], cross[at], rcond=1e-9)[0] if at else np.zeros(0)
                inside = bool(np.all((size >= limits[at, 0]) & (size <= limits[at, 1])))
                distance = float(np.sqrt(max(whole - float(cross[at] @ size), 0.0)))
                free.append((distance, "+".join(sorted(names)), at, inside))
        # Without its caps a rival comes nearer: the nearest of those tells where to stop.
        for distance, name, at, inside in sorted(free, key=lambda f: f[0]):
            if distance >= best[1]:
                break
            if not inside:
                low = np.minimum(limits[at, 0], 0.0)
                high = np.maximum(limits[at, 1], low + 1e-9)
                distance = float(np.linalg.norm(lsq_linear(unit[:, at], delta, bounds=(low, high)).fun))
            if distance < best[1]:
                best = (name, distance)
        return best


def refitted(problem: Problem, data: Array, bends: Curvature) -> float:
    """Distance of data from what the settings alone can do, refitted within what is stated of them.

    `Sight.change` says the same to first order. Settings that move by several sigma bend, and take up more: a beam 3 mm
    beside the axis is 10 sigma about the stated settings of Fig. 7, and 5 once they are refitted, with the mirror 1 mm
    from where it was.

    Parameters
    ----------
    problem : Problem
    data : (n,) array
        Free of noise.
    bends : Curvature
        `curvature.measure` of the problem.

    Returns
    -------
    float
        [sigma]. Too large where the fit ends in a poorer valley.
    """
    context = Context(replace(problem, data=data), whitener(problem.covariance), np.ones(1), np.ones(1), bends)
    stated = Point(np.zeros(len(problem.nuisances)), np.zeros(0), np.zeros(0))
    nothing = np.zeros((len(data), 0))
    solved = refit.fit(context, Hypothesis(()), [stated], Known(bends.first, stated.nuisance), nothing)
    return float(np.sqrt(solved.fit.chi2 + solved.point.nuisance @ solved.point.nuisance))


def _shape_names(problem: Problem) -> set[str]:
    return {p.name for e in problem.catalogue for p in e.parameters if p.grid}
