"""Descent of nuisances, amplitudes and shapes together, from minimum to minimum of a second-order model.

The model (`curvature`) has its residual renewed each time, and a step is taken only if the exact objective falls. Noise
is taken larger at first and falls as the model proves right.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from benchsim.diagnosis import evidence
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, span, values
from benchsim.diagnosis.model import Model, model_about

Array = NDArray[np.float64]
Columns = Callable[[Array], Array]

STILL = 0.2
"""Gain in ln posterior that renewed derivatives may still promise in a converged fit. Names are given at margins of 3
and more; where settings are known far worse than the data, less is the rounding of the derivatives."""

DESCENT = 2e-3
"""Gain below which one descent ends."""

STEPS, SHRINKS, RENEWALS = 60, 12, 24
"""Steps on one second-order model, of the region before a step is given up, and residuals renewed in one descent."""

REACH, FAR = 1.5, 6.0
"""Prior sigmas over which a second-order model is followed before the residual is asked again, first and at most."""

TEMPERED, COOLING, WRONG = 2.0, 3.0, 7.0
"""rms residual [sigma] above which a descent begins with larger noise; by how much that falls; and how far, in its own
sigmas, the model may have missed all data together for it to fall."""

RADIUS = 3.0
"""Prior sigmas by which a first step may move a parameter."""

DAMPINGS = tuple(np.geomspace(1.0, 1e10, 21))
"""Precision added to every parameter's, in units of its prior's, to shorten a step."""


@dataclass(frozen=True)
class Prior:
    """Quadratic (1/variance) and linear parts of −ln prior, and bounds: nuisances, amplitudes, shapes in one row."""

    precision: Array
    slope: Array
    low: Array
    high: Array
    reach: Array
    """Largest step."""
    unit: Array
    """Steps are measured in these: prior sigmas; shapes have their reach instead."""

    def cost(self, theta: Array) -> float:
        return float(0.5 * self.precision @ theta**2 + self.slope @ theta)


def prior_of(context: Context, h: Hypothesis, scale: float, fields: Sequence[float]) -> Prior:
    scaled = np.array([p.scaled for p in context.problem.nuisances], bool)
    p, shapes = len(scaled), h.shapes
    precision, slope = list(np.where(scaled, scale, 1.0) ** -2.0), [0.0] * p
    low, high, reach, unit = [-np.inf] * p, [np.inf] * p, [np.inf] * p, [1.0] * p
    for a, sigma in zip(h.amplitudes, h.sigmas(fields), strict=True):
        kind = evidence.kind(a)
        precision.append(0.0 if kind == 2 else sigma**-2.0)
        slope.append(0.5 * sigma**-2.0 if kind == 2 else 0.0)
        low.append(0.0 if kind else -np.inf)
        high.append(np.inf)
        reach.append(np.inf)
        unit.append(a.sigma**a.power)
    for s in shapes:
        precision.append(0.0)
        slope.append(0.0)
        low.append(min(s.grid))
        high.append(max(s.grid))
        reach.append(0.25 * span(s))
        unit.append(np.inf)
    return Prior(*(np.array(v, float) for v in (precision, slope, low, high, reach, unit)))


def theta_of(point: Point) -> Array:
    return np.concatenate([point.nuisance, point.amplitude, point.shape])


def point_of(theta: Array, p: int, k: int) -> Point:
    return Point(theta[:p], theta[p : p + k], theta[p + k :])


def _costs_of(context: Context, h: Hypothesis, prior: Prior, thetas: Sequence[Array]) -> list[tuple[float, Array]]:
    """−ln posterior, and the exact residual, of several points."""
    problem, out = context.problem, []
    p, k = len(problem.nuisances), len(h.amplitudes)
    predicted = context.predict_each([values(problem, h, point_of(theta, p, k)) for theta in thetas])
    for theta, prediction in zip(thetas, predicted, strict=True):
        residual = problem.data - prediction
        cost = float("inf")
        if np.isfinite(residual).all():
            white = context.whiten(residual)
            cost = float(0.5 * white @ white) + prior.cost(theta)
        out.append((cost, residual))
    return out


def posterior_form(second: Array, force: Array, prior: Prior, theta: Array) -> tuple[Array, Array]:
    """Second and (less) first derivatives of −ln posterior as linearised, from those of −ln likelihood."""
    return second + np.diag(prior.precision), force - prior.precision * theta - prior.slope


@dataclass(frozen=True)
class Steps:
    """Best steps within the bounds by their damping, each worked out once: where a step is too long or proves no
    better, others are asked for with the same derivatives.

    Damping is by the nuisances' priors (Levenberg): settings that the data fix a thousand times better than their
    priors otherwise send those that they do not fix off the screen.
    """

    normal: tuple[Array, Array]
    prior: Prior
    theta: Array
    p: int
    known: dict[float, Array | None] = field(default_factory=dict)

    def damped(self, damping: float) -> Array | None:
        """None where rounding outweighs a direction's own curvature, as at a wild point: damping gives it one."""
        if damping not in self.known:
            hessian, force = self.normal
            damper = damping * np.diag(self.prior.unit**-2.0)
            try:
                self.known[damping] = _bounded(hessian + damper, force, self.prior, self.theta, self.p)
            except np.linalg.LinAlgError:
                self.known[damping] = None
        return self.known[damping]

    def within(self, radius: float = np.inf) -> tuple[Array, float]:
        """The best that is no longer than ``radius`` prior sigmas, and what it promises to gain."""

        def short(damping: float) -> Array | None:
            step = self.damped(damping)
            return None if step is None or np.abs(step / self.prior.unit).max(initial=0.0) > radius else step

        step = short(0.0)
        if step is None:
            # Steps shorten as damping grows: the least that is enough is found by halving.
            low, high = 0, len(DAMPINGS)
            while low < high:
                middle = (low + high) // 2
                tried = short(DAMPINGS[middle])
                low, high, step = (middle + 1, high, step) if tried is None else (low, middle, tried)
        if step is None:
            step = np.zeros(len(self.theta))
        hessian, force = self.normal
        return step, float(force @ step - 0.5 * step @ hessian @ step)


def _bounded(hessian: Array, force: Array, prior: Prior, theta: Array, p: int) -> Array:
    """argmax of the quadratic form, amplitudes and shapes within their bounds."""
    free, rest = hessian[:p, :p], hessian[p:, :p]
    solved = np.linalg.solve(free, np.column_stack([force[:p], rest.T])) if p else np.zeros((0, 1 + len(theta)))
    step = np.zeros(len(theta))
    if len(theta) > p:
        reduced = hessian[p:, p:] - rest @ solved[:, 1:]
        pull = force[p:] - rest @ solved[:, 0]
        largest = float(np.diag(reduced).max())
        if not largest > 0:
            raise np.linalg.LinAlgError("of the amplitudes' curvature only rounding is left")
        # A shape whose amplitude is 0 changes nothing: a slight ridge keeps it where it is.
        unit = np.sqrt(np.maximum(np.diag(reduced), 0.0) + 1e-12 * largest)
        scaled = reduced / unit[:, None] / unit + 1e-9 * np.eye(len(unit))
        low = np.maximum(prior.low - theta, -prior.reach)[p:] * unit
        high = np.minimum(prior.high - theta, prior.reach)[p:] * unit
        factor = np.linalg.cholesky(scaled)
        target = np.linalg.solve(factor, pull / unit)
        own = np.linalg.solve(factor.T, target)
        if (own < low).any() or (own > high).any():
            low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
            high = np.where(high > low, high, low + 1e-12)
            own = np.clip(lsq_linear(factor.T, target, (low, high), method="bvls").x, low, high)
        step[p:] = own / unit
    step[:p] = solved[:, 0] - solved[:, 1:] @ step[p:]
    return step


@dataclass(frozen=True)
class State:
    theta: Array
    cost: float
    residual: Array


def _tempered(prior: Prior, theta: Array, white: Array, s: float) -> float:
    """−ln posterior with noise s times larger."""
    return 0.5 * float(white @ white) / s**2 + prior.cost(theta)


def _downhill(
    model: Model, prior: Prior, theta: Array, reach: float, s: float, least: float = DESCENT
) -> tuple[Array, float, Array]:
    """Minimum of the model within ``reach`` with noise s times larger: step, cost and whitened residual there.

    Ends at a gain below ``least``. Costs no prediction.
    """
    step, radius = np.zeros(len(theta)), min(RADIUS, reach)
    residual, white = model.at(step)
    cost = _tempered(prior, theta, residual, s)
    for _ in range(STEPS):
        second, force = model.normal(residual, white)
        normal = posterior_form(second / s**2, force / s**2, prior, theta + step)
        steps = Steps(normal, prior, theta + step, model.p)
        if steps.within()[1] < least:
            break
        better = False
        for _ in range(SHRINKS):
            more, expected = steps.within(radius)
            trial = step + more
            if np.abs(trial / prior.unit).max(initial=0.0) > reach:
                radius *= 0.3
                continue
            tried = model.at(trial)
            now = _tempered(prior, theta + trial, tried[0], s)
            if now < cost:
                better = True
                break
            radius *= 0.3
        if not better:
            break
        (residual, white), step, gained, cost = tried, trial, cost - now, now
        if gained > 0.75 * expected:
            radius *= 2
        if gained < least:
            break
    return step, cost, residual


def promised_by(context: Context, h: Hypothesis, prior: Prior, state: State, known: Known, own: Array) -> float:
    """By how much the second-order model about a point, whose columns are given, lets −ln posterior fall."""
    model = model_about(context, h, state.theta, context.whiten(state.residual), known, own)
    return state.cost - _downhill(model, prior, state.theta, FAR, 1.0)[1]


def descend(
    context: Context, h: Hypothesis, prior: Prior, state: State, known: Known, own: Array, columns_at: Columns
) -> tuple[State, Array]:
    """To the minimum that stated settings lead to (`follow`); also the own columns there."""
    ((state, own, exact),) = follow(context, h, prior, [state], known, [own], columns_at)
    return state, own if exact else columns_at(state.theta)


def follow(
    context: Context,
    h: Hypothesis,
    prior: Prior,
    states: Sequence[State],
    known: Known,
    owns: Sequence[Array],
    columns_at: Columns,
    *,
    tempered: bool = True,
    renewals: int | None = None,
    least: float = DESCENT,
) -> list[tuple[State, Array, bool]]:
    """To the minima that stated settings lead to from several points; also the own columns there, and whether those
    are exact. What the points ask of the data in one turn is predicted together, which is cheaper than one by one.

    A residual of a thousand sigma says nothing about directions that nearly cancel: exact noise would follow the
    model's own errors along them. So noise is first taken as large as the residual, and falls as the second-order model
    proves to be right. Without that (``tempered`` false) it is the model's own minimum that is followed, and the data
    are asked only whether it is better. Ends after ``renewals`` of the residual (default `RENEWALS`), or at a gain
    below ``least``.
    """
    walks = [
        _walk(context, h, prior, state, known, own, columns_at, tempered, renewals or RENEWALS, least)
        for state, own in zip(states, owns, strict=True)
    ]
    ended: dict[int, tuple[State, Array, bool]] = {}
    told: dict[int, tuple[float, Array] | None] = dict.fromkeys(range(len(walks)))
    while told:
        asked: dict[int, Array] = {}
        for i, answer in told.items():
            try:
                asked[i] = walks[i].send(answer)
            except StopIteration as end:
                ended[i] = end.value
        told = dict(zip(asked, _costs_of(context, h, prior, list(asked.values())), strict=True))
    return [ended[i] for i in range(len(walks))]


def _walk(
    context: Context,
    h: Hypothesis,
    prior: Prior,
    state: State,
    known: Known,
    own: Array,
    columns_at: Columns,
    tempered: bool,
    renewals: int,
    least: float,
) -> Generator[Array, Any, tuple[State, Array, bool]]:
    """One of `follow`: gives points, and is told −ln posterior and residual at each."""
    white = context.whiten(state.residual)
    s = max(1.0, float(np.sqrt(white @ white / len(white))))
    s = s if tempered and s > TEMPERED else 1.0
    reach, exact = REACH if tempered else FAR, True
    for _ in range(renewals):
        model = model_about(context, h, state.theta, white, known, own)
        before = _tempered(prior, state.theta, white, s)
        step, promised, expected = _downhill(model, prior, state.theta, reach, s, least)
        promise, length = before - promised, float(np.abs(step / prior.unit).max(initial=0.0))
        if not length or promise < least:
            if s == 1.0:
                break
            s = max(1.0, s / COOLING)
            continue
        cost, residual = yield state.theta + step
        there = context.whiten(residual) if np.isfinite(cost) else np.full(len(white), 1e9)
        gained = before - _tempered(prior, state.theta + step, there, s)
        if gained > 0:
            state, white = State(state.theta + step, cost, residual), there
            own, exact = _own_carried(model, own, step, columns_at, state.theta)
        if gained > 0.7 * promise:
            reach = min(1.7 * reach, FAR)
        elif gained < 0.3 * promise:
            reach = 0.4 * min(reach, length)
        wrong = float(np.linalg.norm(there - expected))
        if gained > 0.3 * promise and wrong < WRONG * s:
            s = max(1.0, s / COOLING)
        if s == 1.0 and promise < 0.5 * (STILL + 0.02 * excess(white)):
            break
    return state, own, exact


def _own_carried(model: Model, own: Array, step: Array, columns_at: Columns, theta: Array) -> tuple[Array, bool]:
    """Own columns a step further, by the second derivatives where those are known; and whether they are exact."""
    if any(change is None for change in model.plain) or not own.shape[1]:
        return columns_at(theta), True
    p = model.p
    out = own.copy()
    for i, change in enumerate(model.plain):
        if change is not None:
            out[:, i] += change[0] @ step[:p] + step[p + i] * change[1]
    return out, False


def held(context: Context, h: Hypothesis, prior: Prior, points: Sequence[Point], known: Known) -> list[State]:
    """Where the nuisances descend to from several points while amplitudes and shapes all but stay: of what they do, the
    model has only what they and the nuisances do together."""
    p, thetas = len(context.problem.nuisances), [theta_of(point) for point in points]
    nothing = np.zeros((len(context.problem.data), len(thetas[0]) - p))
    loose = np.arange(len(thetas[0])) >= p
    free = replace(prior, precision=np.where(loose, 0.0, prior.precision), slope=np.where(loose, 0.0, prior.slope))
    begun = begin(context, h, free, points)
    ended = follow(context, h, free, begun, known, [nothing] * len(begun), lambda theta: nothing)
    return [replace(state, cost=state.cost - free.cost(state.theta) + prior.cost(state.theta)) for state, _, _ in ended]


def begin(context: Context, h: Hypothesis, prior: Prior, points: Sequence[Point]) -> list[State]:
    thetas = [theta_of(point) for point in points]
    return [State(t, *cost) for t, cost in zip(thetas, _costs_of(context, h, prior, thetas), strict=True)]


def still(context: Context, residual: Array) -> float:
    """`STILL`, and a fiftieth of a misfit that is beyond doubt: what misses by far need not miss exactly."""
    white = context.whiten(residual)
    return STILL + 0.02 * excess(white)


def excess(white: Array) -> float:
    """By how much −ln likelihood lies above three sigma of what noise gives."""
    n = len(white)
    return max(0.0, 0.5 * float(white @ white) - 0.5 * n - 1.5 * np.sqrt(2 * n))
