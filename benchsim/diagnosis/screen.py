"""Weigh sets of effects by linear algebra alone.

All hypotheses share the products of the catalogue's columns with the nuisances marginalised (`linear.Marginal`); each
is then a small integral (`evidence`). Shape parameters are summed over their grid, a random field over its sigma, all
over the setting scale. Not for large nonlinear effects as they stand: those are fitted (`fitting`), and what contains
them is weighed again about the refitted point.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import evidence, linear, settings
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.hypothesis import Effects
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.problem import Effect, Parameter, Problem, Values

Array = NDArray[np.float64]
BENT = 0.5
"""Prior sigmas to either side at which the bend of the data by an amplitude is read: it is to say where fits begin."""


@dataclass(frozen=True)
class Node:
    """An effect at one point of its shape grid: shape values, columns of its amplitudes, ln of the prior weight."""

    shape: Mapping[str, float]
    columns: tuple[int, ...]
    log_weight: float


@dataclass(frozen=True)
class Catalogue:
    """The catalogue's columns, shapes expanded.

    Attributes
    ----------
    effects : mapping of str to Effect
    nodes : mapping of str to tuple of Node
    columns : (n, K)
        Derivative of the prediction by value**power.
    bends : (n, K)
        Second derivative, as a step to either side shows it that is large enough to matter (`BENT`); 0 where there is
        but one side.
    """

    effects: Mapping[str, Effect]
    nodes: Mapping[str, tuple[Node, ...]]
    columns: Array
    bends: Array


def _grid_weights(values: tuple[float, ...]) -> Array:
    """Trapezoid weights of a uniform prior over the range of the grid."""
    at = np.asarray(values, float)
    order = np.argsort(at)
    gaps = np.diff(at[order])
    weights = np.empty(len(at))
    weights[order] = (np.append(gaps, 0) + np.insert(gaps, 0, 0)) / 2
    return np.asarray(weights / weights.sum())


def expand(problem: Problem, at: Values) -> Catalogue:
    """Differentiate the whole catalogue at a point, every shape at all nodes of its grid."""
    nodes: dict[str, tuple[Node, ...]] = {}
    plain: list[Parameter] = []
    later: list[tuple[dict[str, float], tuple[Parameter, ...]]] = []
    for effect in problem.catalogue:
        if not evidence.shapes(effect):
            own = evidence.amplitudes(effect)
            nodes[effect.name] = (Node({}, tuple(range(len(plain), len(plain) + len(own))), 0.0),)
            plain.extend(own)
    at = {**at, **{n: v for e in problem.catalogue for n, v in evidence.fixed(e).items()}}
    count = len(plain)
    for effect in problem.catalogue:
        shape = evidence.shapes(effect)
        if not shape:
            continue
        own, found = evidence.amplitudes(effect), []
        weights = [_grid_weights(p.grid) for p in shape]
        for place in product(*(range(len(p.grid)) for p in shape)):
            values = {p.name: float(p.grid[i]) for p, i in zip(shape, place, strict=True)}
            log_weight = sum(float(np.log(w[i])) for w, i in zip(weights, place, strict=True))
            found.append(Node(values, tuple(range(count, count + len(own))), log_weight))
            later.append((values, own))
            count += len(own)
        nodes[effect.name] = tuple(found)
    points = [(at, tuple(plain)), *(({**at, **values}, own) for values, own in later)]
    parts = linear.columns_at(problem, points)
    bends = _bends(problem, points)
    return Catalogue({e.name: e for e in problem.catalogue}, nodes, np.column_stack(parts), bends)


def _bends(problem: Problem, points: Sequence[tuple[Values, Sequence[Parameter]]]) -> Array:
    """Second derivatives by amplitudes, each at its own point."""
    asked: list[tuple[Values, Parameter]] = [(at, p) for at, own in points for p in own]
    two = [(at, p) for at, p in asked if not evidence.kind(p)]
    sided = [{**at, p.name: at.get(p.name, 0.0) + sign * BENT * p.sigma} for at, p in two for sign in (-1, 1)]
    found = iter(linear.predict_each(problem, [*(at for at, _ in points), *sided]))
    middle = {id(at): next(found) for at, _ in points}
    out = np.zeros((len(problem.data), len(asked)))
    for k, (at, p) in enumerate(asked):
        if not evidence.kind(p):
            out[:, k] = (next(found) + next(found) - 2 * middle[id(at)]) / (BENT * p.sigma) ** 2
    return np.where(np.isfinite(out), out, 0.0)


def effect_terms(catalogue: Catalogue, name: str) -> list[Term]:
    """All integrals of one effect: its grid nodes times its population sigmas."""
    effect = catalogue.effects[name]
    return [
        evidence.term(
            evidence.entries(effect, node.columns, field_sigma),
            node.log_weight + log_weight,
            () if field_sigma is None else (field_sigma,),
        )
        for node in catalogue.nodes[name]
        for field_sigma, log_weight in evidence.field_grid(effect)
    ]


def join(first: Term, second: Term) -> Term:
    """Two effects together."""

    def merge(a: tuple, b: tuple) -> tuple:  # type: ignore[type-arg]
        parts: list[float] = []
        i = j = 0
        for n, m in zip(first.counts, second.counts, strict=True):
            parts += [*a[i : i + n], *b[j : j + m]]
            i, j = i + n, j + m
        return tuple(parts)

    return Term(
        merge(first.columns, second.columns),
        merge(first.sigma, second.sigma),
        (
            first.counts[0] + second.counts[0],
            first.counts[1] + second.counts[1],
            first.counts[2] + second.counts[2],
        ),
        first.log_weight + second.log_weight,
        first.field_sigma + second.field_sigma,
    )


def hypothesis_terms(catalogue: Catalogue, effects: Effects, cache: dict[str, list[Term]]) -> list[Term]:
    """All integrals of a set of effects."""
    for name in effects:
        if name not in cache:
            cache[name] = effect_terms(catalogue, name)
    terms = [Term((), (), (0, 0, 0), 0.0)]
    for name in effects:
        terms = [join(a, b) for a in terms for b in cache[name]]
    return terms


def weigh(
    about: Linear,
    columns: Array,
    scales: Array,
    weights: Array,
    hypotheses: Iterable[tuple[Effects, list[Term]]],
) -> dict[Effects, float]:
    """ln Z of hypotheses, the prior of presence not included.

    Parameters
    ----------
    about : Linear
    columns : (n, K) array
        Whitened; what the terms' column numbers mean.
    scales, weights : (m,) array
    hypotheses : iterable of (effects, terms)
    """
    listed = list(hypotheses)
    factors = settings.log_cells(about, columns, scales, weights, [t for _, ts in listed for t in ts])
    first = np.cumsum([0, *(len(ts) for _, ts in listed)])[:-1]
    total = np.logaddexp.reduceat(np.logaddexp.reduce(factors, axis=0), first)
    return {effects: float(z) for (effects, _), z in zip(listed, total, strict=True)}
