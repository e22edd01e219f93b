"""What the fits of one problem share, and a hypothesis with its parameters sorted out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from benchsim.diagnosis import curvature, evidence, linear
from benchsim.diagnosis.curvature import Curvature
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fits import Effects, Fit
from benchsim.diagnosis.problem import Effect, Parameter, Problem

Array = NDArray[np.float64]
Change = tuple[Array, Array] | None
T = TypeVar("T")
R = TypeVar("R")
Mixed = dict[tuple[str, tuple[tuple[str, float], ...]], tuple[Array, Array]]


@dataclass(frozen=True)
class Whitener:
    """Cholesky factors of the blocks' covariances."""

    lower: tuple[Array, ...]
    logdet: float

    def __call__(self, columns: Array) -> Array:
        """L⁻¹ columns, (n,) or (n, k)."""
        return linear.lowered(self.lower, columns)


def whitener(covariance: Sequence[Array]) -> Whitener:
    """Factorise once."""
    lower = linear.factors(covariance)
    return Whitener(lower, float(2 * sum(np.log(np.diag(low)).sum() for low in lower)))


@dataclass(frozen=True)
class Point:
    """Nuisances in prior sigmas, amplitudes in fit space, shapes in their units."""

    nuisance: Array
    amplitude: Array
    shape: Array


@dataclass(frozen=True)
class Known:
    """Derivatives by the nuisances per prior sigma (n, p), not whitened, and where they hold.

    ``amplitude`` holds the amplitudes there that are not 0, in fit space.
    """

    columns: Array
    nuisance: Array
    amplitude: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Solved:
    """A fit and what its neighbours can use: the point, its derivatives, its exact residual (none whitened)."""

    fit: Fit
    point: Point
    known: Known
    own: Array
    residual: Array


@dataclass
class Count:
    """Predictions of single blocks, counted."""

    predictions: int = 0


@dataclass(frozen=True)
class Context:
    """What all fits of one problem share."""

    problem: Problem
    whiten: Whitener
    scales: Array
    weights: Array
    curvature: Curvature | None = None
    mixed: Mixed = field(default_factory=dict)
    bent: list[Array] = field(default_factory=list)
    count: Count = field(default_factory=Count)

    def columns(self, at: Mapping[str, float], parameters: Sequence[Parameter]) -> Array:
        """`linear.columns`, shapes stepped by 2 % of their range, predictions counted."""
        return self.columns_each([at], parameters)[0]

    def columns_each(self, points: Sequence[Mapping[str, float]], parameters: Sequence[Parameter]) -> list[Array]:
        """`columns` at several points, predicted together."""
        blocks = len(self.problem.names)
        needed = sum(2 * (blocks if p.blocks is None else len(p.blocks)) for p in parameters)
        self.count.predictions += needed * len(points)
        steps = {p.name: 0.02 * span(p) for p in parameters if p.grid}
        return linear.columns_at(self.problem, [(at, tuple(parameters)) for at in points], steps)

    def nuisance_columns(self, at: Mapping[str, float]) -> Array:
        """`columns` of all nuisances, per prior sigma."""
        nuisances = self.problem.nuisances
        return self.columns(at, nuisances) * np.array([n.sigma for n in nuisances])

    def stated(self) -> Known | None:
        """Nuisances' columns about the stated settings, where they were measured."""
        return None if self.curvature is None else Known(self.curvature.first, np.zeros(len(self.problem.nuisances)))

    def predict(self, at: Mapping[str, float]) -> Array:
        """`linear.predict_all`, counted."""
        return self.predict_each([at])[0]

    def predict_each(self, points: Sequence[Mapping[str, float]]) -> list[Array]:
        """`predict` at several points, together."""
        self.count.predictions += len(self.problem.names) * len(points)
        return linear.predict_each(self.problem, points)

    def bending_at(self, at: Mapping[str, float], effects: Sequence[Effect]) -> Context:
        """The same for one hypothesis, with second derivatives measured about a point of it.

        Effects with shapes keep what was measured about the stated settings, and so do those that are there as a whole.
        """
        if self.curvature is None:
            return self
        own = {
            a.name: (a, tuple(sorted(evidence.fixed(e).items())))
            for e in effects
            if not e.whole and not evidence.shapes(e)
            for a in evidence.amplitudes(e)
        }
        found, changes, count = curvature.again(self.problem, self.curvature, at, [a for a, _ in own.values()])
        self.count.predictions += count
        mixed = self.mixed | {(name, own[name][1]): change for name, change in changes.items()}
        return replace(self, curvature=found, bent=[], mixed=mixed)

    def second(self) -> tuple[Array, ...]:
        """The curvature's second derivatives, whitened, per block."""
        if not self.bent and self.curvature is not None:
            for low, bend in zip(self.whiten.lower, self.curvature.second, strict=True):
                n, m = bend.shape[:2]
                flat = bend.reshape(n, m * m)
                white = solve_triangular(low, flat, lower=True, check_finite=False) if m else flat
                self.bent.append(white.reshape(n, m, m))
        return tuple(self.bent)

    def change(self, parameter: Parameter, amplitude: float, others: Mapping[str, float]) -> Change:
        """M (n, p) of an amplitude and its bend (n,), measured once; None where it is too small to matter."""
        if self.curvature is None or abs(amplitude) < 0.02 * parameter.sigma**parameter.power:
            return None
        key = (parameter.name, tuple(sorted(others.items())))
        if key not in self.mixed:
            found, bend, count = curvature.mixed(self.problem, self.curvature, parameter, amplitude, others)
            self.count.predictions += count
            self.mixed[key] = curvature.spread_out(self.problem, self.curvature, found), bend
        return self.mixed[key]


def each(context: Context, call: Callable[[Context, T], R], items: Sequence[T]) -> list[R]:
    """``call(context, item)`` of each, through `Problem.spread`; what is measured for them is kept in the context.

    None sees what another measured: the same comes of it on any number of processes.
    """
    # A pool cannot be sent to another process, nor perhaps ``further``; attachments are large.
    sent = replace(context, problem=replace(context.problem, spread=map, further=None, attachments=()))
    out: list[R] = []
    for found, mixed, predictions in context.problem.spread(partial(_apart, sent, call), items):
        out.append(found)
        context.mixed.update(mixed)
        context.count.predictions += predictions
    return out


def _apart(context: Context, call: Callable[[Context, T], R], item: T) -> tuple[R, Mixed, int]:
    """A call, what was measured for it, and the predictions that it took."""
    own = replace(context, mixed=dict(context.mixed), count=Count())
    found = call(own, item)
    return found, {k: change for k, change in own.mixed.items() if k not in context.mixed}, own.count.predictions


def span(p: Parameter) -> float:
    return float(max(p.grid) - min(p.grid))


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects with its parameters sorted out."""

    effects: tuple[Effect, ...]

    @property
    def names(self) -> Effects:
        return tuple(e.name for e in self.effects)

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        return tuple(p for e in self.effects for p in evidence.amplitudes(e))

    @property
    def shapes(self) -> tuple[Parameter, ...]:
        return tuple(p for e in self.effects for p in evidence.shapes(e))

    def terms(self) -> list[Term]:
        """Integrals over amplitudes and shapes; columns: amplitudes, then shapes."""
        out: list[tuple[list[tuple[int, float, int]], float, tuple[float, ...]]] = [([], 0.0, ())]
        first = 0
        for e in self.effects:
            own = range(first, first + len(evidence.amplitudes(e)))
            first += len(own)
            out = [
                (
                    [*done, *evidence.entries(e, own, field_sigma)],
                    log_w + more,
                    fields if field_sigma is None else (*fields, field_sigma),
                )
                for done, log_w, fields in out
                for field_sigma, more in evidence.field_grid(e)
            ]
        shape = [(first + i, span(p) / np.sqrt(2 * np.pi), 0) for i, p in enumerate(self.shapes)]
        return [evidence.term([*done, *shape], log_w, fields) for done, log_w, fields in out]

    def sigmas(self, fields: Sequence[float]) -> Array:
        """Prior sigma of every amplitude's value, the population's in random fields."""
        left = list(fields)
        out: list[float] = []
        for e in self.effects:
            sigma = left.pop(0) if e.random_field else None
            out += [p.sigma if sigma is None else sigma for p in evidence.amplitudes(e)]
        return np.array(out)


def values(problem: Problem, hypothesis: Hypothesis, point: Point) -> dict[str, float]:
    """A point in the parameters' units."""
    out = {p.name: float(x * p.sigma) for p, x in zip(problem.nuisances, point.nuisance, strict=True)}
    for p, q in zip(hypothesis.amplitudes, point.amplitude, strict=True):
        out[p.name] = linear.value_of(p, q)
    out.update({p.name: float(s) for p, s in zip(hypothesis.shapes, point.shape, strict=True)})
    for effect in hypothesis.effects:
        out.update(evidence.fixed(effect))
    return out
