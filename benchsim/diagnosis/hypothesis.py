"""A hypothesis with its parameters sorted out, its fit, and what all fits of one problem share and hand on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.problem import Effect, Parameter, Problem, value_of

Array = NDArray[np.float64]
Values = Mapping[str, float]
Effects = tuple[str, ...]
"""Names of the effects that a hypothesis holds, in the catalogue's order; () is the null."""

LARGEST = 4
"""Effects in one hypothesis."""


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
    """What all fits of one problem share.

    Attributes
    ----------
    problem : Problem
    lower : tuple of (n_b, n_b)
        Cholesky factors of the blocks' covariances.
    scales, weights : (m,)
        Grid of the setting scale.
    """

    problem: Problem
    lower: tuple[Array, ...]
    scales: Array
    weights: Array

    @cached_property
    def logdet(self) -> float:
        """ln of the determinant of the covariances."""
        return linear.log_determinant(self.lower)

    def whiten(self, columns: Array) -> Array:
        """L⁻¹ columns, (n,) or (n, k)."""
        return linear.lowered(self.lower, columns)

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

    @cached_property
    def names(self) -> Effects:
        return tuple(e.name for e in self.effects)

    @cached_property
    def amplitudes(self) -> tuple[Parameter, ...]:
        return tuple(p for e in self.effects for p in evidence.amplitudes(e))

    @cached_property
    def shapes(self) -> tuple[Parameter, ...]:
        return tuple(p for e in self.effects for p in evidence.shapes(e))

    @cached_property
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
        out[p.name] = value_of(p, q)
    out.update({p.name: float(s) for p, s in zip(hypothesis.shapes, point.shape, strict=True)})
    for effect in hypothesis.effects:
        out.update(evidence.fixed(effect))
    return out


@dataclass(frozen=True)
class Noise:
    """Noise as the data themselves show it.

    Attributes
    ----------
    scale : mapping of str to float
        By kind of datum: by how much the problem's sigma had to be multiplied.
    correlation : mapping of str to float
        By kind: length over which neighbours' errors are correlated beyond the problem's covariance, in the units of
        ``Problem.position``; 0: none found.
    covariance : tuple of (n_b, n_b)
        Of the blocks, with both put in.
    freedom : mapping of str to float
        By kind: numbers that the scale was estimated from; a kind that is not here is known.
    """

    scale: Mapping[str, float]
    correlation: Mapping[str, float]
    covariance: tuple[Array, ...]
    freedom: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Fit:
    """One hypothesis, refitted until nothing moves.

    Attributes
    ----------
    effects : Effects
    log_evidence : float
        ln Z, the prior of its effects' presence included; setting scale and other hyper-parameters are integrated.
    values : mapping
        Most probable value of every nuisance and of its own parameters, in their units.
    sigma : mapping
        Posterior 1 sigma of the same, hyper-parameters included.
    covariance : (k, k)
        Of its own parameters, in the catalogue's order.
    setting_scale : float
        Most probable.
    chi2 : float
        Of the data alone at ``values``.
    converged : bool
        False: nothing may be claimed from it.
    linear : Linear
        About ``values``: nuisances and its own amplitudes.
    log_scales : (m,)
        ln Z at every setting scale of the grid; ``log_evidence`` is of their sum.
    """

    effects: Effects
    log_evidence: float
    values: Mapping[str, float]
    sigma: Mapping[str, float]
    covariance: Array
    setting_scale: float
    chi2: float
    converged: bool
    linear: Linear
    log_scales: Array


@dataclass(frozen=True)
class Naming:
    """All hypotheses of the catalogue weighed.

    Attributes
    ----------
    null : Fit
    fits : tuple of Fit
        Everything refitted, the null included, most probable first; unconverged ones last.
    screened : tuple of (Effects, float, Effects)
        Every single and pair, and what grew from them, with ln Z (on the scale of ``Fit.log_evidence``) and the effects
        of the fit about which it was weighed, most probable first.
    linear : Linear
        About the null's fit: nuisances, and the amplitudes of the whole catalogue.
    noise : Noise
    setting_scales, scale_weights : (m,)
        Grid of the setting scale, and its prior weights (their sum is 1).
    """

    null: Fit
    fits: tuple[Fit, ...]
    screened: tuple[tuple[Effects, float, Effects], ...]
    linear: Linear
    noise: Noise
    setting_scales: Array
    scale_weights: Array
