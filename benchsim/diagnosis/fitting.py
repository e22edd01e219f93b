"""Fits of hypotheses, many at once, and their evidence where they end.

Nuisances, amplitudes (in fit space, value**power) and shapes are fitted together (`least_squares`). The evidence is
Laplace's about that point, with the exact residual: everything Gaussian in closed form, amplitudes at a boundary
integrated (`evidence`), setting scale and field sigma summed over their grids. A shape's uniform prior enters as a
Gaussian of the same height, range/√(2π) wide, and where an end of the range holds the shape, as what it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx

from benchsim.diagnosis import evidence, settings
from benchsim.diagnosis.hypothesis import Context, Effects, Fit, Hypothesis, Point, Solved, span, values
from benchsim.diagnosis.least_squares import Points, Solution, Task, minimise
from benchsim.diagnosis.levels import MARGIN
from benchsim.diagnosis.linear import Linear, posterior

Array = NDArray[np.float64]

STILL = 0.1
"""Gain in ln posterior that may still be promised where a fit is finished. Names are given at margins of 3 and more;
less costs steps."""

STEPS, SCOUTED = 40, 15
"""Most steps of a fit, and of one without exact derivatives, which is to show whether its hypothesis matters."""

HEAT = 3
"""Steps after which the most probable of the starts that race goes on alone: fewer tell no better start from a worse
one, more are taken by fits that are given up."""

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
    """Where a fit begins.

    Attributes
    ----------
    nuisance : (n, p)
        Whitened derivatives of the prediction by the nuisances, from nearby.
    scale : int
        Setting scale, by its place on the grid.
    own : mapping of str to (n,) array
        The same by the amplitudes and shapes of which they are known; the others' are made.
    race : int, optional
        Starts of a hypothesis with the same number race; default for itself.
    """

    hypothesis: Hypothesis
    point: Point
    nuisance: Array
    scale: int = 0
    own: Mapping[str, Array] = field(default_factory=dict)
    race: int | None = None


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
    context: Context,
    starts: Sequence[Start],
    log_prior: Mapping[Effects, float],
    *,
    renewals: int,
    floor: float = -np.inf,
) -> list[Solved]:
    """Follow every start to its end, or of those that race the one that is ahead after a few steps.

    Parameters
    ----------
    context : Context
    starts : sequence of Start
    log_prior : mapping
        Of the presence of each hypothesis' effects.
    renewals : int
        Most exact Jacobians of each; with 0 fits rest on derivatives that followed their steps, which is enough to see
        which matter.
    floor : float
        ln Z that a start that won its race has to promise by then to be followed further.

    Returns
    -------
    list of Solved
        One for each start or race.
    """
    if not starts:
        return []
    runs = [
        _Run(s, (s.scale, _first_term(s.hypothesis)), theta_of(s.point), -np.column_stack([s.nuisance, own]))
        for s, own in zip(starts, _own_columns(context, starts), strict=True)
    ]
    racing = [r for r in runs if r.start.race is not None]
    _advance(context, racing, 0, HEAT)
    ahead: dict[tuple[Effects, int | None], _Run] = {}
    for r in sorted(racing, key=lambda r: np.logaddexp.reduce(r.cells, axis=None)):
        ahead[r.start.hypothesis.names, r.start.race] = r
    runs = [r for r in runs if r.start.race is None or r is ahead[r.start.hypothesis.names, r.start.race]]
    moved = [r for r in runs if r.end is None or ((r.moved or not r.end.converged) and _hope(r, log_prior) > floor)]
    for _ in range(1 + AGAIN):
        _advance(context, moved, renewals, STEPS if renewals else SCOUTED)
        moved = [r for r in moved if r.moved]
    return [_solved(context, r, log_prior[r.start.hypothesis.names]) for r in runs]


@dataclass
class _Run:
    """A fit on its way: the hyper-parameters (setting scale, term) that it stands at, and what it came to."""

    start: Start
    hyper: tuple[int, int]
    theta: Array
    jacobian: Array
    end: Solution | None = None
    cells: Array = field(default_factory=lambda: np.zeros((0, 0)))
    moved: bool = False


def _hope(run: _Run, log_prior: Mapping[Effects, float]) -> float:
    """ln Z that the derivatives where a fit is promise of it."""
    return float(np.logaddexp.reduce(run.cells, axis=None)) + log_prior[run.start.hypothesis.names]


def _advance(context: Context, runs: Sequence[_Run], renewals: int, steps: int) -> None:
    """Some steps of each, and the hyper-parameters that are most probable where they lead."""
    tasks = [_task(context, r.start.hypothesis, r.hyper, r.theta, r.jacobian) for r in runs]
    found = _minimise(context, [r.start.hypothesis for r in runs], tasks, renewals, steps)
    for r, end in zip(runs, found, strict=True):
        r.end, r.theta, r.jacobian = end, end.theta, end.jacobian
        r.cells = _cells(context, r.start.hypothesis, end)
        now = _choose(r.cells)
        # Between two neighbours on the grid that are as probable the choice could swing for ever.
        r.moved = now != r.hyper and bool(np.isfinite(end.cost) and r.cells[now] > r.cells[r.hyper] + STILL)
        r.hyper = now if r.moved else r.hyper


def as_it_stands(context: Context, h: Hypothesis, point: Point, nuisance: Array) -> Solved:
    """A point that was not fitted as a fit, where the derivatives by the nuisances (n, p), not whitened, are known."""
    (own,) = context.columns([(values(context.problem, h, point), (*h.amplitudes, *h.shapes))])
    (prediction,) = context.predict([values(context.problem, h, point)])
    residual = context.whiten(context.problem.data - prediction)
    jacobian = -context.whiten(np.column_stack([nuisance, own]))
    end = Solution(theta_of(point), residual, jacobian, float(0.5 * residual @ residual), np.inf, False, True)
    as_is = _Run(Start(h, point, nuisance), (0, _first_term(h)), end.theta, jacobian, end, _cells(context, h, end))
    return _solved(context, as_is, 0.0)


def theta_of(point: Point) -> Array:
    return np.concatenate([point.nuisance, point.amplitude, point.shape])


def point_of(context: Context, h: Hypothesis, theta: Array) -> Point:
    p, k = len(context.problem.nuisances), len(h.amplitudes)
    return Point(theta[:p], theta[p : p + k], theta[p + k :])


def _own_columns(context: Context, starts: Sequence[Start]) -> list[Array]:
    """Whitened derivatives by amplitudes and shapes at the starts."""
    parameters = [(*s.hypothesis.amplitudes, *s.hypothesis.shapes) for s in starts]
    lacking = [tuple(q for q in own if q.name not in s.own) for s, own in zip(starts, parameters, strict=True)]
    at = [values(context.problem, s.hypothesis, s.point) for s in starts]
    found = iter(context.columns([(v, some) for v, some in zip(at, lacking, strict=True) if some]))
    out = []
    for s, own, some in zip(starts, parameters, lacking, strict=True):
        made = dict(zip((q.name for q in some), context.whiten(next(found)).T, strict=True)) if some else {}
        columns = [made[q.name] if q.name in made else s.own[q.name] for q in own]
        out.append(np.column_stack(columns) if columns else np.zeros((len(s.nuisance), 0)))
    return out


def _minimise(
    context: Context, hypotheses: Sequence[Hypothesis], tasks: Sequence[Task], renewals: int, steps: int
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

    return minimise(residuals, jacobians, tasks, still=_still, steps=steps, renewals=renewals)


def _prior(context: Context, h: Hypothesis, hyper: tuple[int, int]) -> tuple[Array, Array]:
    """Precision and slope of −ln prior of all parameters at a setting scale and a field sigma."""
    scaled = np.array([p.scaled for p in context.problem.nuisances], bool)
    precision, slope = list(np.where(scaled, context.scales[hyper[0]], 1.0) ** -2.0), [0.0] * len(scaled)
    for a, sigma in zip(h.amplitudes, h.sigmas(h.terms[hyper[1]].field_sigma), strict=True):
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
    every = (*context.problem.nuisances, *h.amplitudes, *h.shapes)
    for k, q in enumerate(every):
        acts[slice(None) if q.blocks is None else list(q.blocks), k] = True
    inverse, slope = _prior(context, h, hyper)
    known = getattr(context.problem.predict, "slopes", {})
    alone = np.array([q.name in known and q.blocks is not None for q in every], bool)
    alone &= bool((np.count_nonzero(jacobian[:, alone], axis=1) <= 1).all())
    start = np.clip(theta, low, high)
    return Task(start, low, high, np.array(unit), inverse, slope, acts[context.problem.block], jacobian, alone)


def _first_term(h: Hypothesis) -> int:
    """Random fields begin at their largest sigma, which lets them go where they have to."""
    terms = h.terms
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
    if not np.isfinite(end.cost):
        return np.full((len(context.scales), len(h.terms)), -np.inf)
    lin = about(context, h, end)
    columns, weight = _held(context, h, end)
    return settings.log_cells(lin, columns, context.scales, context.weights, h.terms) + weight


def _held(context: Context, h: Hypothesis, end: Solution) -> tuple[Array, float]:
    """Columns of amplitudes and shapes but for shapes that an end of their range holds, and ln of these' integrals.

    Where the posterior falls by F per unit from there on, with curvature K once all else follows, ∫ exp(−F t − ½ K t²)
    dt over t > 0 is √(π/2K) erfcx(F/√2K), over the range. A Gaussian would count what lies beyond the range as had.
    """
    p, first = len(context.problem.nuisances), len(end.theta) - len(h.shapes)
    columns, weight = -end.jacobian[:, p:], 0.0
    inside = end.jacobian[:, :first]
    for k, shape in enumerate(h.shapes, first):
        own = end.jacobian[:, k]
        force, at = float(own @ end.residual), end.theta[k]
        inward = force if at <= min(shape.grid) else -force if at >= max(shape.grid) else 0.0
        if inward <= 0.0:
            continue
        cross, precision = inside.T @ own, _prior(context, h, (0, _first_term(h)))[0][:first]
        curvature = own @ own - cross @ np.linalg.lstsq(inside.T @ inside + np.diag(precision), cross)[0]
        root = np.sqrt(2 * max(float(curvature), 1e-300))
        weight += min(0.0, float(np.log(np.sqrt(np.pi) / root * erfcx(inward / root) / span(shape))))
        columns[:, k - p] = 0.0
    return columns, weight


def _choose(cells: Array) -> tuple[int, int]:
    """Most probable setting scale, and term there."""
    scale = int(np.argmax(np.logaddexp.reduce(cells, axis=1)))
    return scale, int(np.argmax(cells[scale]))


def _solved(context: Context, run: _Run, log_prior: float) -> Solved:
    problem, p, h, end, cells = (
        context.problem,
        len(context.problem.nuisances),
        run.start.hypothesis,
        run.end,
        run.cells,
    )
    assert end is not None
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
    # Linear about the end, cells count as had what derivatives still promise; rough ones promise much in vain.
    offset = log_prior - (0.0 if end.exact else end.promise)
    done = Fit(
        h.names,
        float(np.logaddexp.reduce(cells, axis=None)) + offset,
        at,
        sigma,
        own_covariance,
        float(context.scales[run.hyper[0]]),
        float(end.residual @ end.residual),
        # Kinks of the prediction, of some thousandths of a sigma, promise what cannot be had, and data that jump, as
        # where the least tilt puts a window into the light, what comes after: the evidence counts it as had.
        end.converged or (end.exact and (end.promise < MARGIN or not h.names)),
        lin,
        np.asarray(np.logaddexp.reduce(cells, axis=1)) + offset,
    )
    return Solved(done, point, -end.jacobian, end.residual, end.cost, end.exact)


def _posterior(context: Context, h: Hypothesis, lin: Linear, columns: Array, cells: Array) -> Array:
    """Covariance of nuisances, amplitudes (fit space) and shapes, hyper-parameters mixed in."""
    terms = h.terms
    both = np.column_stack([lin.nuisance, columns])
    square, projected = both.T @ both, both.T @ lin.residual
    p, k = lin.nuisance.shape[1], len(h.amplitudes)
    if not np.isfinite(cells).any():
        return np.eye(both.shape[1])
    weights = np.exp(cells - np.logaddexp.reduce(cells, axis=None))
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
