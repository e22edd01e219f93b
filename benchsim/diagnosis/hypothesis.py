"""What the fits of one problem share, and a hypothesis with its parameters sorted out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fits import Effects, Fit
from benchsim.diagnosis.problem import Effect, Parameter, Problem

Array = NDArray[np.float64]
Values = Mapping[str, float]


@dataclass(frozen=True)
class Whitener:
    """Cholesky factors of the blocks' covariances."""

    lower: tuple[Array, ...]
    logdet: float

    def __call__(self, columns: Array) -> Array:
        """L⁻¹ columns, (n,) or (n, k)."""
        return linear.lowered(self.lower, columns)

    def undone(self, white: Array) -> Array:
        """L white."""
        first = np.cumsum([0, *(len(low) for low in self.lower)])
        return np.concatenate([low @ white[a : a + len(low)] for low, a in zip(self.lower, first, strict=False)])


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
class Solved:
    """A fit, where it ended, and what its neighbours can use of it.

    Attributes
    ----------
    fit : Fit
    point : Point
    columns : (n, k)
        Derivatives of the prediction by nuisances per prior sigma, amplitudes in fit space, and shapes; whitened.
    residual : (n,)
        Data less prediction, whitened.
    cost : float
        −ln posterior there but for a constant.
    exact : bool
        Whether the columns were differentiated there.
    """

    fit: Fit
    point: Point
    columns: Array
    residual: Array
    cost: float
    exact: bool


@dataclass(frozen=True)
class Context:
    """What all fits of one problem share."""

    problem: Problem
    whiten: Whitener
    scales: Array
    weights: Array

    def columns(self, points: Sequence[tuple[Values, Sequence[Parameter]]]) -> list[Array]:
        """`linear.columns_at`, shapes stepped by 2 % of their range."""
        steps = {p.name: 0.02 * span(p) for _, parameters in points for p in parameters if p.grid}
        return linear.columns_at(self.problem, points, steps)

    def predict(self, points: Sequence[Values]) -> list[Array]:
        """`linear.predict_each`."""
        return linear.predict_each(self.problem, points)


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
