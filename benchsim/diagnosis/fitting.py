"""Fits of hypotheses, many at once, and their evidence where they end.

Nuisances, amplitudes (in fit space, value**power) and shapes are fitted together (`least_squares`). The evidence is
Laplace's about that point, with the exact residual: everything Gaussian in closed form, amplitudes at a boundary
integrated (`evidence`), setting scale and field sigma summed over their grids. A shape's uniform prior enters as a
Gaussian of the same height, range/√(2π) wide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from benchsim.diagnosis import evidence, settings
from benchsim.diagnosis.hypothesis import Context, Effects, Fit, Hypothesis, Point, Solved, span, values
from benchsim.diagnosis.least_squares import Points, Solution, Task, minimise
from benchsim.diagnosis.linear import Linear, posterior
from benchsim.diagnosis.problem import Parameter

Array = NDArray[np.float64]

STILL = 0.1
"""Gain in ln posterior that may still be promised where a fit is finished. Names are given at margins of 3 and more;
less costs steps."""

OWED = 3.0
"""Gain that a fit which finds no step may still promise, if names are to rest on it: the evidence counts it as had.
Predictions have kinks of some thousandths of a sigma, which promise what cannot be had, and data that jump, as where
the least tilt puts a window into the light, promise what comes after the jump."""

STEPS, SCOUTED = 40, 15
"""Most steps of a fit, and of one without exact derivatives, which is to show whether its hypothesis matters."""

RENEWALS = 8
"""Most exact Jacobians of a fit that matters."""

SLOW = 0.1
"""Part of a misfit beyond doubt that has to be promised for a fit to go on: what is wrong by far is not followed
through every valley."""

AGAIN = 3
"""Times that setting scale and field sigma, which stand while a fit is made, are chosen anew where it ended."""

WIDTH = 0.1
"""Unit of a shape in its range: how far its fit is damped."""


@dataclass(frozen=True)
class Start:
    """Where a fit begins, and whitened derivatives of the prediction by the nuisances (n, p) from nearby."""

    hypothesis: Hypothesis
    point: Point
    nuisance: Array
    scale: int = 0
    """Setting scale, by its place on the grid."""


def excess(white: Array) -> float:
    """By how much −ln likelihood lies above three sigma of what noise gives."""
    n = len(white)
    return max(0.0, 0.5 * float(white @ white) - 0.5 * n - 1.5 * float(np.sqrt(2 * n)))


def misses(solved: Solved) -> bool:
    """Whether a fit lies beyond what noise explains, so that its point says little about other hypotheses."""
    return excess(solved.residual) > 0


def _still(white: Array) -> float:
    """Gain that may still be promised where a fit is finished."""
    return STILL + SLOW * excess(white)


def fitted(
    context: Context, starts: Sequence[Start], log_prior: Mapping[Effects, float], *, renewals: int
) -> list[Solved]:
    """Follow every start to its end.

    Parameters
    ----------
    context : Context
    starts : sequence of Start
    log_prior : mapping
        Of the presence of each hypothesis' effects.
    renewals : int
        Most exact Jacobians of each; with 0 fits rest on derivatives that followed their steps, which is enough to see
        which matter.

    Returns
    -------
    list of Solved
        One for each start.
    """
    if not starts:
        return []
    own = _own_columns(context, starts)
    ends: list[Solution | None] = [None] * len(starts)
    hypers = [(s.scale, _first_term(s.hypothesis)) for s in starts]
    jacobians = [-np.column_stack([s.nuisance, context.whiten(j)]) for s, j in zip(starts, own, strict=True)]
    thetas = [theta_of(s.point) for s in starts]
    weighed: list[Array] = [np.zeros((0, 0))] * len(starts)
    moved = list(range(len(starts)))
    for _ in range(1 + AGAIN):
        tasks = [_task(context, starts[i].hypothesis, hypers[i], thetas[i], jacobians[i]) for i in moved]
        found = _minimise(context, [starts[i].hypothesis for i in moved], tasks, renewals)
        again = []
        for i, end in zip(moved, found, strict=True):
            ends[i] = end
            cells = weighed[i] = _cells(context, starts[i].hypothesis, end)
            now = _choose(cells)
            # Between two neighbours on the grid that are as probable the choice could swing for ever.
            if now != hypers[i] and np.isfinite(end.cost) and cells[now] > cells[hypers[i]] + STILL:
                hypers[i], thetas[i], jacobians[i] = now, end.theta, end.jacobian
                again.append(i)
        moved = again
        if not moved:
            break
    return [
        _solved(context, s.hypothesis, end, hyper, cells, log_prior[s.hypothesis.names])
        for s, end, hyper, cells in zip(starts, ends, hypers, weighed, strict=True)
        if end is not None
    ]


def as_it_stands(context: Context, h: Hypothesis, point: Point, nuisance: Array) -> Solved:
    """A point that was not fitted as a fit, where the derivatives by the nuisances (n, p), not whitened, are known."""
    (own,) = context.columns([(values(context.problem, h, point), (*h.amplitudes, *h.shapes))])
    (prediction,) = context.predict([values(context.problem, h, point)])
    residual = context.whiten(context.problem.data - prediction)
    jacobian = -context.whiten(np.column_stack([nuisance, own]))
    end = Solution(theta_of(point), residual, jacobian, float(0.5 * residual @ residual), np.inf, False, True)
    return _solved(context, h, end, (0, _first_term(h)), _cells(context, h, end), 0.0)


def theta_of(point: Point) -> Array:
    return np.concatenate([point.nuisance, point.amplitude, point.shape])


def point_of(context: Context, h: Hypothesis, theta: Array) -> Point:
    p, k = len(context.problem.nuisances), len(h.amplitudes)
    return Point(theta[:p], theta[p : p + k], theta[p + k :])


def _own_columns(context: Context, starts: Sequence[Start]) -> list[Array]:
    """Derivatives by amplitudes and shapes at the starts."""
    asked: list[tuple[Mapping[str, float], tuple[Parameter, ...]]] = [
        (values(context.problem, s.hypothesis, s.point), (*s.hypothesis.amplitudes, *s.hypothesis.shapes))
        for s in starts
    ]
    return context.columns(asked)


def _minimise(
    context: Context, hypotheses: Sequence[Hypothesis], tasks: Sequence[Task], renewals: int
) -> list[Solution]:
    problem = context.problem
    sigma = np.array([n.sigma for n in problem.nuisances])

    def at(points: Points) -> list[dict[str, float]]:
        return [values(problem, hypotheses[i], point_of(context, hypotheses[i], theta)) for i, theta in points]

    def residuals(points: Points) -> list[Array]:
        out = [problem.data - f for f in context.predict(at(points))]
        return [context.whiten(r) if np.isfinite(r).all() else r for r in out]

    def jacobians(points: Points) -> list[Array]:
        own = [(*problem.nuisances, *hypotheses[i].amplitudes, *hypotheses[i].shapes) for i, _ in points]
        found = context.columns(list(zip(at(points), own, strict=True)))
        return [-context.whiten(np.column_stack([j[:, : len(sigma)] * sigma, j[:, len(sigma) :]])) for j in found]

    steps = STEPS if renewals else SCOUTED
    return minimise(residuals, jacobians, tasks, still=_still, steps=steps, renewals=renewals)


def _prior(context: Context, h: Hypothesis, hyper: tuple[int, int]) -> tuple[Array, Array]:
    """Precision and slope of −ln prior of all parameters at a setting scale and a field sigma."""
    scaled = np.array([p.scaled for p in context.problem.nuisances], bool)
    precision, slope = list(np.where(scaled, context.scales[hyper[0]], 1.0) ** -2.0), [0.0] * len(scaled)
    for a, sigma in zip(h.amplitudes, h.sigmas(h.terms()[hyper[1]].field_sigma), strict=True):
        square = evidence.kind(a) == 2
        precision.append(0.0 if square else sigma**-2.0)
        slope.append(0.5 * sigma**-2.0 if square else 0.0)
    nothing = [0.0] * len(h.shapes)
    return np.array([*precision, *nothing]), np.array([*slope, *nothing])


def _task(context: Context, h: Hypothesis, hyper: tuple[int, int], theta: Array, jacobian: Array) -> Task:
    p = len(context.problem.nuisances)
    low = np.array([-np.inf] * p + [0.0 if evidence.kind(a) else -np.inf for a in h.amplitudes])
    low = np.append(low, [min(s.grid) for s in h.shapes])
    high = np.append(np.full(p + len(h.amplitudes), np.inf), [max(s.grid) for s in h.shapes])
    unit = [1.0] * p + [a.sigma**a.power for a in h.amplitudes] + [WIDTH * span(s) for s in h.shapes]
    acts = np.zeros((len(context.problem.names), len(theta)), bool)
    for k, q in enumerate((*context.problem.nuisances, *h.amplitudes, *h.shapes)):
        acts[slice(None) if q.blocks is None else list(q.blocks), k] = True
    inverse, slope = _prior(context, h, hyper)
    start = np.clip(theta, low, high)
    return Task(start, low, high, np.array(unit), inverse, slope, acts[context.problem.block], jacobian)


def _first_term(h: Hypothesis) -> int:
    """Random fields begin at their largest sigma, which lets them go where they have to."""
    terms = h.terms()
    return max(range(len(terms)), key=lambda i: terms[i].field_sigma)


def about(context: Context, h: Hypothesis, end: Solution) -> Linear:
    """The problem linearised about a point, own amplitudes' columns as its effects."""
    p, k = len(context.problem.nuisances), len(h.amplitudes)
    pseudo = end.residual - end.jacobian[:, : p + k] @ end.theta[: p + k]
    return Linear(
        pseudo,
        -end.jacobian[:, :p],
        np.array([n.scaled for n in context.problem.nuisances], bool),
        -end.jacobian[:, p : p + k],
        tuple(a.name for a in h.amplitudes),
        context.problem.block,
        context.logdet,
    )


def _cells(context: Context, h: Hypothesis, end: Solution) -> Array:
    p = len(context.problem.nuisances)
    if not np.isfinite(end.cost):
        return np.full((len(context.scales), len(h.terms())), -np.inf)
    return settings.log_cells(about(context, h, end), -end.jacobian[:, p:], context.scales, context.weights, h.terms())


def _choose(cells: Array) -> tuple[int, int]:
    """Most probable setting scale, and term there."""
    scale = int(np.argmax(logsumexp(cells, axis=1)))
    return scale, int(np.argmax(cells[scale]))


def _solved(
    context: Context, h: Hypothesis, end: Solution, hyper: tuple[int, int], cells: Array, log_prior: float
) -> Solved:
    problem, p = context.problem, len(context.problem.nuisances)
    point = point_of(context, h, end.theta)
    lin = about(context, h, end)
    columns = -end.jacobian[:, p:]
    covariance = _posterior(context, h, lin, columns, cells)
    at = values(problem, h, point)
    sd = np.sqrt(np.diag(covariance))
    sigma = {n.name: float(s * n.sigma) for n, s in zip(problem.nuisances, sd, strict=False)}
    slope = np.ones(len(end.theta))
    for i, (a, q) in enumerate(zip(h.amplitudes, point.amplitude, strict=True)):
        if a.power > 1:
            # Half the width of the interval q ± its sigma, seen in the value: well defined at 0 too.
            s = sd[p + i]
            slope[p + i] = (np.sqrt(q + s) - np.sqrt(max(q - s, 0.0))) / (2 * s)
    own = (*h.amplitudes, *h.shapes)
    sigma.update({a.name: float(s) for a, s in zip(own, (sd * slope)[p:], strict=True)})
    sigma.update({name: 0.0 for e in h.effects for name in evidence.fixed(e)})
    names = [a.name for a in own]
    wanted = [a.name for e in h.effects for a in e.parameters]
    place = [i for i, name in enumerate(wanted) if name in names]
    order = [names.index(wanted[i]) for i in place]
    own_covariance = np.zeros((len(wanted), len(wanted)))
    own_covariance[np.ix_(place, place)] = (covariance * slope[:, None] * slope)[p:, p:][np.ix_(order, order)]
    done = Fit(
        h.names,
        float(logsumexp(cells)) + log_prior,
        at,
        sigma,
        own_covariance,
        float(context.scales[hyper[0]]),
        float(end.residual @ end.residual),
        end.converged or (end.exact and (end.promise < OWED or not h.names)),
        lin,
        np.asarray(logsumexp(cells, axis=1)) + log_prior,
    )
    return Solved(done, point, -end.jacobian, end.residual, end.cost, end.exact)


def _posterior(context: Context, h: Hypothesis, lin: Linear, columns: Array, cells: Array) -> Array:
    """Covariance of nuisances, amplitudes (fit space) and shapes, hyper-parameters mixed in."""
    terms = h.terms()
    both = np.column_stack([lin.nuisance, columns])
    square, projected = both.T @ both, both.T @ lin.residual
    p, k = lin.nuisance.shape[1], len(h.amplitudes)
    if not np.isfinite(cells).any():
        return np.eye(both.shape[1])
    weights = np.exp(cells - logsumexp(cells))
    means, covariances, kept = [], [], []
    for i, j in zip(*np.nonzero(weights > 1e-3), strict=True):
        precision, slopes = _prior(context, h, (int(i), int(j)))
        precision[p + k :] = [2 * np.pi / span(s) ** 2 for s in h.shapes]
        # Where power 2 meets data that say nothing, its prior still bounds it.
        squares = [
            2.0 / s**4 if evidence.kind(a) == 2 else 0.0
            for a, s in zip(h.amplitudes, h.sigmas(terms[j].field_sigma), strict=True)
        ]
        precision[p : p + k] += 1e-3 * np.array(squares)
        covariance = posterior(both, precision**-0.5, square)
        means.append(covariance @ (projected - slopes))
        covariances.append(covariance)
        kept.append(weights[i, j])
    w = np.array(kept) / sum(kept)
    mean = np.einsum("i,ij->j", w, np.array(means))
    away = np.array(means) - mean
    return np.asarray(np.einsum("i,ijk->jk", w, np.array(covariances)) + np.einsum("i,ij,ik->jk", w, away, away))
