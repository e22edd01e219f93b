"""Fit one hypothesis until nothing moves, and weigh it there.

Nuisances, own amplitudes (in fit space, value**power) and shape parameters descend together, from minimum to minimum
of a second-order model (`curvature`) whose residual is renewed each time; a step is taken only if the exact objective
falls. Noise is taken larger at first and falls as the model proves right. Derivatives by the hypothesis' own parameters
are recomputed after every step; those by the nuisances are carried by the second derivatives, *if* a central difference
along a random combination of all of them, one posterior sigma each, agrees there; otherwise they are recomputed.

A fit counts as converged when, with derivatives renewed, less than
`STILL` could be gained, and when a second start ends nowhere better. An unconverged fit steals the name.

The evidence is Laplace's about that point, with the exact residual: everything Gaussian in closed form, amplitudes at a
boundary integrated (`evidence`), setting scale and field sigma summed over their grids. A shape parameter's uniform
prior enters as a Gaussian of the same height, range/√(2π) wide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear
from scipy.special import logsumexp

from benchsim.diagnosis import curvature, evidence, linear, settings
from benchsim.diagnosis.curvature import Curvature
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fits import Effects, Fit
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.problem import Effect, Parameter, Problem

Array = NDArray[np.float64]
Change = tuple[Array, Array] | None
Columns = Callable[[Array], Array]

STILL = 0.2
"""Gain in ln posterior that renewed derivatives may still promise in a converged fit. Names are given at margins of 3
and more; where settings are known far worse than the data, less is the rounding of the derivatives."""

DESCENT = 2e-3
"""Gain below which one descent ends."""

AGREE = 0.05
"""Relative error of the nuisances' columns that is let pass, in a random combination of one posterior sigma each."""

STEPS, SHRINKS, RENEWALS = 60, 12, 24
"""Steps on one second-order model, of the region before a step is given up, and residuals renewed in one descent."""

REACH, FAR = 1.5, 6.0
"""Prior sigmas over which a second-order model is followed before the residual is asked again, first and at most."""

TEMPERED, COOLING, WRONG = 2.0, 3.0, 7.0
"""rms residual [sigma] above which a descent begins with larger noise; by how much that falls; and how far, in its own
sigmas, the model may have missed all data together for it to fall."""

RADIUS = 3.0
"""Prior sigmas by which a first step may move a parameter."""

ROUNDS = 8
"""Descents with derivatives renewed in between."""

SLOW = 0.1
"""Part of a misfit beyond doubt that each of them has to take away: a hypothesis that is wrong by far is not followed
through every valley."""


@dataclass(frozen=True)
class Whitener:
    """Cholesky factors of the blocks' covariances."""

    problem: Problem
    lower: tuple[Array, ...]
    logdet: float

    def __call__(self, columns: Array) -> Array:
        """L⁻¹ columns, (n,) or (n, k)."""
        out: Array = np.empty(columns.shape)
        for b, low in enumerate(self.lower):
            rows = self.problem.rows(b)
            out[rows] = solve_triangular(low, columns[rows], lower=True, check_finite=False)
        return out


def whitener(problem: Problem, covariance: Sequence[Array]) -> Whitener:
    """Factorise once."""
    lower = tuple(np.asarray(np.linalg.cholesky(c), float) for c in covariance)
    return Whitener(problem, lower, float(2 * sum(np.log(np.diag(low)).sum() for low in lower)))


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
    mixed: dict[tuple[str, tuple[tuple[str, float], ...]], tuple[Array, Array]] = field(default_factory=dict)
    bent: list[Array] = field(default_factory=list)
    count: Count = field(default_factory=Count)

    def columns(self, at: Mapping[str, float], parameters: Sequence[Parameter]) -> Array:
        """`linear.columns`, shapes stepped by 2 % of their range, predictions counted."""
        blocks = len(self.problem.names)
        self.count.predictions += sum(2 * (blocks if p.blocks is None else len(p.blocks)) for p in parameters)
        steps = {p.name: 0.02 * _range(p) for p in parameters if p.grid}
        return linear.columns(self.problem, at, tuple(parameters), steps)

    def predict(self, at: Mapping[str, float]) -> Array:
        """`linear.predict_all`, counted."""
        self.count.predictions += len(self.problem.names)
        return linear.predict_all(self.problem, at)

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


def _range(p: Parameter) -> float:
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
        shape = [(first + i, _range(p) / np.sqrt(2 * np.pi), 0) for i, p in enumerate(self.shapes)]
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
        out[p.name] = float(max(q, 0.0) ** (1 / p.power)) if p.power > 1 else float(q)
    out.update({p.name: float(s) for p, s in zip(hypothesis.shapes, point.shape, strict=True)})
    for effect in hypothesis.effects:
        out.update(evidence.fixed(effect))
    return out


@dataclass(frozen=True)
class _Prior:
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


def _prior(context: Context, h: Hypothesis, scale: float, fields: Sequence[float]) -> _Prior:
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
        reach.append(0.25 * _range(s))
        unit.append(np.inf)
    return _Prior(*(np.array(v, float) for v in (precision, slope, low, high, reach, unit)))


def _theta(point: Point) -> Array:
    return np.concatenate([point.nuisance, point.amplitude, point.shape])


def _point(theta: Array, p: int, k: int) -> Point:
    return Point(theta[:p], theta[p : p + k], theta[p + k :])


def _cost(context: Context, h: Hypothesis, prior: _Prior, theta: Array) -> tuple[float, Array]:
    """−ln posterior, and the exact residual."""
    problem = context.problem
    at = values(problem, h, _point(theta, len(problem.nuisances), len(h.amplitudes)))
    residual = problem.data - context.predict(at)
    if not np.isfinite(residual).all():
        return float("inf"), residual
    white = context.whiten(residual)
    return float(0.5 * white @ white) + prior.cost(theta), residual


def _normal(white: Array, residual: Array, prior: _Prior, theta: Array) -> tuple[Array, Array]:
    """Second and (less) first derivatives of −ln posterior as linearised."""
    hessian = white.T @ white + np.diag(prior.precision)
    return hessian, white.T @ residual - prior.precision * theta - prior.slope


def _step(
    normal: tuple[Array, Array], prior: _Prior, theta: Array, p: int, radius: float = np.inf
) -> tuple[Array, float]:
    """Best step within the bounds, none longer than ``radius`` prior sigmas, and what it promises to gain.

    Damping by the nuisances' priors (Levenberg): settings that the data fix a thousand times better than their priors
    otherwise send those that they do not fix off the screen.
    """
    hessian, force = normal
    for damping in (0.0, *np.geomspace(1.0, 1e10, 21)):
        step = _bounded(hessian + damping * np.diag(prior.unit**-2.0), force, prior, theta, p)
        if np.abs(step / prior.unit).max(initial=0.0) <= radius:
            break
    return step, float(force @ step - 0.5 * step @ hessian @ step)


def _bounded(hessian: Array, force: Array, prior: _Prior, theta: Array, p: int) -> Array:
    """argmax of the quadratic form, amplitudes and shapes within their bounds."""
    free, rest = hessian[:p, :p], hessian[p:, :p]
    solved = np.linalg.solve(free, np.column_stack([force[:p], rest.T])) if p else np.zeros((0, 1 + len(theta)))
    step = np.zeros(len(theta))
    if len(theta) > p:
        reduced = hessian[p:, p:] - rest @ solved[:, 1:]
        pull = force[p:] - rest @ solved[:, 0]
        # A shape whose amplitude is 0 changes nothing: a slight ridge keeps it where it is.
        unit = np.sqrt(np.diag(reduced) + 1e-12 * max(float(np.diag(reduced).max()), 1e-300))
        scaled = reduced / unit[:, None] / unit + 1e-9 * np.eye(len(unit))
        low = np.maximum(prior.low - theta, -prior.reach)[p:] * unit
        high = np.minimum(prior.high - theta, prior.reach)[p:] * unit
        factor = np.linalg.cholesky(scaled)
        target = solve_triangular(factor, pull / unit, lower=True)
        own = solve_triangular(factor.T, target, lower=False)
        if (own < low).any() or (own > high).any():
            low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
            high = np.where(high > low, high, low + 1e-12)
            own = np.clip(lsq_linear(factor.T, target, (low, high), method="bvls").x, low, high)
        step[p:] = own / unit
    step[:p] = solved[:, 0] - solved[:, 1:] @ step[p:]
    return step


@dataclass(frozen=True)
class _State:
    theta: Array
    cost: float
    residual: Array


@dataclass(frozen=True)
class _Model:
    """Residual and derivatives to second order about a point, all whitened.

    ``known`` and ``own`` are the derivatives there, ``second`` those by pairs of nuisances, per block, ``changes`` the
    amplitudes' M and bend (None: not needed), ``plain`` the same before whitening.
    """

    context: Context
    residual: Array
    known: Array
    own: Array
    changes: Sequence[Change]
    plain: Sequence[Change]

    def at(self, step: Array) -> tuple[Array, Array]:
        """Whitened residual and columns a step away."""
        p = self.known.shape[1]
        dx, dq = step[:p], step[p:]
        known, own = self.known.copy(), self.own.copy()
        about = self.context.curvature
        if about is not None:
            for b, (mine, second) in enumerate(zip(about.curved, self.context.second(), strict=True)):
                if len(mine):
                    known[self.context.problem.rows(b), mine] += second @ dx[mine]
        bent = 0.5 * (known - self.known) @ dx
        for i, change in enumerate(self.changes):
            if change is not None:
                moved = change[0] @ dx
                known += dq[i] * change[0]
                own[:, i] += moved + dq[i] * change[1]
                bent += dq[i] * (moved + 0.5 * dq[i] * change[1])
        return self.residual - self.known @ dx - self.own @ dq - bent, np.column_stack([known, own])


def _model(context: Context, h: Hypothesis, theta: Array, white: Array, known: Known, own: Array) -> _Model:
    """About a point whose residual is whitened already."""
    p = len(context.problem.nuisances)
    columns = context.whiten(np.column_stack([_carried(context, h, known, theta).columns, own]))
    plain: list[Change] = [*_changes(context, h, theta), *[None] * len(h.shapes)]
    changes: list[Change] = []
    for change in plain:
        both = None if change is None else context.whiten(np.column_stack([change[0], change[1]]))
        changes.append(None if both is None else (both[:, :-1], both[:, -1]))
    return _Model(context, white, columns[:, :p], columns[:, p:], changes, plain)


def _tempered(prior: _Prior, theta: Array, white: Array, s: float) -> float:
    """−ln posterior with noise s times larger."""
    return 0.5 * float(white @ white) / s**2 + prior.cost(theta)


def _downhill(model: _Model, prior: _Prior, theta: Array, reach: float, s: float) -> tuple[Array, float, Array]:
    """Minimum of the model within ``reach`` with noise s times larger: step, cost and whitened residual there.

    Costs no prediction.
    """
    step, radius = np.zeros(len(theta)), min(RADIUS, reach)
    residual, white = model.at(step)
    cost = _tempered(prior, theta, residual, s)
    for _ in range(STEPS):
        normal = _normal(white / s, residual / s, prior, theta + step)
        if _step(normal, prior, theta + step, model.known.shape[1])[1] < DESCENT:
            break
        better = False
        for _ in range(SHRINKS):
            more, expected = _step(normal, prior, theta + step, model.known.shape[1], radius)
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
        if gained < DESCENT:
            break
    return step, cost, residual


def _descend(
    context: Context, h: Hypothesis, prior: _Prior, state: _State, known: Known, own: Array, columns_at: Columns
) -> tuple[_State, Array]:
    """To the minimum that stated settings lead to; also the own columns there.

    A residual of a thousand sigma says nothing about directions that nearly cancel: exact noise would follow the
    model's own errors along them. So noise is first taken as large as the residual, and falls as the second-order model
    proves to be right.
    """
    white = context.whiten(state.residual)
    s = max(1.0, float(np.sqrt(white @ white / len(white))))
    s = s if s > TEMPERED else 1.0
    reach, exact = REACH, True
    for _ in range(RENEWALS):
        model = _model(context, h, state.theta, white, known, own)
        before = _tempered(prior, state.theta, white, s)
        step, promised, expected = _downhill(model, prior, state.theta, reach, s)
        promise, length = before - promised, float(np.abs(step / prior.unit).max(initial=0.0))
        if not length or promise < DESCENT:
            if s == 1.0:
                break
            s = max(1.0, s / COOLING)
            continue
        cost, residual = _cost(context, h, prior, state.theta + step)
        there = context.whiten(residual) if np.isfinite(cost) else np.full(len(white), 1e9)
        gained = before - _tempered(prior, state.theta + step, there, s)
        if gained > 0:
            state, white = _State(state.theta + step, cost, residual), there
            own, exact = _own_carried(model, own, step, columns_at, state.theta)
        if gained > 0.7 * promise:
            reach = min(1.7 * reach, FAR)
        elif gained < 0.3 * promise:
            reach = 0.4 * min(reach, length)
        wrong = float(np.linalg.norm(there - expected))
        if gained > 0.3 * promise and wrong < WRONG * s:
            s = max(1.0, s / COOLING)
        if s == 1.0 and promise < 0.5 * (STILL + 0.02 * _excess(white)):
            break
    return state, own if exact else columns_at(state.theta)


def _own_carried(model: _Model, own: Array, step: Array, columns_at: Columns, theta: Array) -> tuple[Array, bool]:
    """Own columns a step further, by the second derivatives where those are known; and whether they are exact."""
    if any(change is None for change in model.plain) or not own.shape[1]:
        return columns_at(theta), True
    p = model.known.shape[1]
    out = own.copy()
    for i, change in enumerate(model.plain):
        if change is not None:
            out[:, i] += change[0] @ step[:p] + step[p + i] * change[1]
    return out, False


def _held(context: Context, h: Hypothesis, prior: _Prior, state: _State, known: Known) -> _State:
    """Where the nuisances descend to while amplitudes and shapes stay."""
    p = len(context.problem.nuisances)
    nothing = np.zeros((len(state.residual), len(state.theta) - p))
    loose = np.arange(len(state.theta)) >= p
    free = replace(prior, precision=np.where(loose, 0.0, prior.precision), slope=np.where(loose, 0.0, prior.slope))
    start = replace(state, cost=_cost(context, h, free, state.theta)[0])
    return _descend(context, h, free, start, known, nothing, lambda theta: nothing)[0]


def _begin(context: Context, h: Hypothesis, prior: _Prior, point: Point) -> _State:
    theta = _theta(point)
    cost, residual = _cost(context, h, prior, theta)
    return _State(theta, cost, residual)


def _still(context: Context, residual: Array) -> float:
    """`STILL`, and a fiftieth of a misfit that is beyond doubt: what misses by far need not miss exactly."""
    white = context.whiten(residual)
    return STILL + 0.02 * _excess(white)


def _excess(white: Array) -> float:
    """By how much −ln likelihood lies above three sigma of what noise gives."""
    n = len(white)
    return max(0.0, 0.5 * float(white @ white) - 0.5 * n - 1.5 * np.sqrt(2 * n))


def misses(context: Context, solved: Solved) -> bool:
    """Whether a fit lies beyond what noise explains, so that its point says little about other hypotheses."""
    return _excess(context.whiten(solved.residual)) > 0


def _changes(context: Context, h: Hypothesis, theta: Array) -> list[Change]:
    """M of every own amplitude, as it is at this point."""
    p, k = len(context.problem.nuisances), len(h.amplitudes)
    if context.curvature is None:
        return [None] * k
    shapes = {s.name: float(x) for s, x in zip(h.shapes, theta[p + k :], strict=True)}
    out: list[Change] = []
    first = p
    for e in h.effects:
        others = {s.name: round(shapes[s.name], 2) for s in evidence.shapes(e)} | dict(evidence.fixed(e))
        for a in evidence.amplitudes(e):
            out.append(context.change(a, float(theta[first]), others))
            first += 1
    return out


def _amplitudes(context: Context, h: Hypothesis, theta: Array) -> dict[str, float]:
    p = len(context.problem.nuisances)
    return {a.name: float(q) for a, q in zip(h.amplitudes, theta[p:], strict=False)}


def _carried(context: Context, h: Hypothesis, known: Known, theta: Array) -> Known:
    """The nuisances' columns carried from where they are known to this point by second derivatives."""
    about, p = context.curvature, len(context.problem.nuisances)
    if about is None:
        return known
    now = _amplitudes(context, h, theta)
    columns = known.columns + curvature.nuisance_columns(context.problem, about, theta[:p] - known.nuisance)
    columns -= about.first
    for name, change in zip(now, _changes(context, h, theta), strict=True):
        if change is not None:
            columns += (now[name] - known.amplitude.get(name, 0.0)) * change[0]
    return Known(columns, theta[:p].copy(), now)


def _fresh(context: Context, h: Hypothesis, theta: Array, known: Known, scaled: Array) -> Known:
    """The nuisances' columns as carried, if a random combination of them holds at this point; else recomputed."""
    problem = context.problem
    nuisances = problem.nuisances
    p = len(nuisances)
    if not p or (np.array_equal(theta[:p], known.nuisance) and known.amplitude == _amplitudes(context, h, theta)):
        return known
    known = _carried(context, h, known, theta)
    at = values(problem, h, _point(theta, p, len(h.amplitudes)))
    white = context.whiten(known.columns)
    lower = np.linalg.cholesky(white.T @ white + np.diag(scaled**-2.0))
    # A fixed seed: the same data give the same diagnosis.
    signs = np.random.default_rng(len(h.names)).choice([-1.0, 1.0], p)
    draw = solve_triangular(lower, signs, lower=True, trans=1)
    step = 0.05 * draw / max(float(np.abs(draw).max()), 0.05)
    ends = [
        context.predict(
            {**at, **{n.name: at[n.name] + sign * s * n.sigma for n, s in zip(nuisances, step, strict=True)}}
        )
        for sign in (-1.0, 1.0)
    ]
    # Compared per posterior sigma: that is by how much the fit can still wander.
    unit = float(np.linalg.norm(step) / max(float(np.linalg.norm(draw)), 1e-300))
    wrong = context.whiten((ends[1] - ends[0]) / 2 / unit - known.columns @ step / unit)
    stated = context.whiten(known.columns @ step / unit)
    if np.linalg.norm(wrong) <= AGREE * max(float(np.linalg.norm(stated)), 1.0):
        return known
    columns = context.columns(at, nuisances) * np.array([n.sigma for n in nuisances])
    return Known(columns, theta[:p].copy(), _amplitudes(context, h, theta))


def about(context: Context, h: Hypothesis, point: Point, residual: Array, known: Known, own: Array) -> Linear:
    """The problem linearised about a point, own amplitudes' columns as its effects."""
    k = len(h.amplitudes)
    pseudo = residual + known.columns @ point.nuisance + own[:, :k] @ point.amplitude
    white = context.whiten(np.column_stack([pseudo, known.columns, own[:, :k]]))
    p = known.columns.shape[1]
    return Linear(
        white[:, 0],
        white[:, 1 : 1 + p],
        np.array([n.scaled for n in context.problem.nuisances], bool),
        white[:, 1 + p :],
        tuple(a.name for a in h.amplitudes),
        context.problem.block,
        context.whiten.logdet,
    )


def _log_cells(context: Context, lin: Linear, columns: Array, terms: Sequence[Term]) -> Array:
    """ln Z of every (setting scale, term), (S, T)."""
    many = settings.marginals(lin, columns, context.scales)
    gram, projection = np.stack([m.gram for m in many]), np.stack([m.projection for m in many])
    cells = evidence.log_factors(gram, projection, terms) + np.array([t.log_weight for t in terms])
    return np.asarray(cells + settings.log_null(many, context.weights)[:, None])


def _choose(cells: Array) -> tuple[int, int]:
    """Most probable setting scale, and term there."""
    scale = int(np.argmax(logsumexp(cells, axis=1)))
    return scale, int(np.argmax(cells[scale]))


def fit(
    context: Context,
    h: Hypothesis,
    starts: Sequence[Point],
    known: Known,
    own: Array | None = None,
    log_prior: float = 0.0,
    rounds: int | None = None,
    hold: bool = False,
) -> Solved:
    """Fit a hypothesis.

    Parameters
    ----------
    context : Context
    h : Hypothesis
    starts : sequence of Point
        The first is followed; the others check where it ends.
    known : Known
        Nuisances' columns at a point nearby.
    own : (n, k) array, optional
        Columns of own amplitudes and shapes at the first start; default they are differentiated.
    log_prior : float
        Of the presence of its effects.
    rounds : int, optional
        Most descents; default `ROUNDS`.
    hold : bool
        Whether a descent of the nuisances alone comes first. Amplitudes that start in the right valley would otherwise
        leave it while the noise is taken large for the sake of settings that are still far off.

    Returns
    -------
    Solved
    """
    problem, p, k = context.problem, len(context.problem.nuisances), len(h.amplitudes)
    is_scaled = np.array([n.scaled for n in problem.nuisances], bool)
    terms, parameters = h.terms(), (*h.amplitudes, *h.shapes)

    def white(a: Array, b: Array) -> Array:
        return context.whiten(np.column_stack([a, b]))

    def columns_at(theta: Array) -> Array:
        return context.columns(values(problem, h, _point(theta, p, k)), parameters)

    def chosen(theta: Array, residual: Array, known: Known, own: Array) -> tuple[int, int]:
        lin = about(context, h, _point(theta, p, k), residual, known, own)
        return _choose(_log_cells(context, lin, np.column_stack([lin.effect, context.whiten(own[:, k:])]), terms))

    theta = _theta(starts[0])
    own = columns_at(theta) if own is None else own
    residual = problem.data - context.predict(values(problem, h, starts[0]))
    known = _carried(context, h, known, theta)
    # Far from the fit the residual would ask for the largest scale: it is settled after the first descent.
    hyper = (0, chosen(theta, residual, known, own)[1])
    prior = _prior(context, h, context.scales[hyper[0]], terms[hyper[1]].field_sigma)
    state = _begin(context, h, prior, starts[0])
    if hold:
        state = _begin(context, h, prior, _point(_held(context, h, prior, state, known).theta, p, k))
        own = columns_at(state.theta)
    converged, checked, before = False, 0, np.inf
    for turn in range(rounds or ROUNDS):
        state, own = _descend(context, h, prior, state, known, own, columns_at)
        s = np.where(is_scaled, context.scales[hyper[0]], 1.0)
        known = _fresh(context, h, state.theta, known, s)
        now = chosen(state.theta, state.residual, known, own)
        # Between two neighbours on the grid that are as probable the choice could swing for ever; any point near the
        # peak will do, since the evidence sums over the grid.
        if now != hyper and turn < ROUNDS // 2:
            hyper = now
            prior = _prior(context, h, context.scales[hyper[0]], terms[hyper[1]].field_sigma)
            state = _begin(context, h, prior, _point(state.theta, p, k))
        normal = _normal(white(known.columns, own), context.whiten(state.residual), prior, state.theta)
        promise = _step(normal, prior, state.theta, p)[1]
        converged = promise < _still(context, state.residual)
        if not converged:
            missed, before = before, _excess(context.whiten(state.residual))
            if before > (1 - SLOW) * missed:
                break
            continue
        if checked >= len(starts) - 1:
            break
        checked += 1
        other = _begin(context, h, prior, starts[checked])
        if np.isfinite(other.cost):
            start = known if context.curvature is None else Known(context.curvature.first, np.zeros(p))
            other, its = _descend(context, h, prior, other, start, columns_at(other.theta), columns_at)
            if other.cost < state.cost - _still(context, state.residual):
                state, own, converged = other, its, False
                continue
        if checked >= len(starts) - 1:
            break
    return _solved(context, h, state, known, own, terms, hyper, converged, log_prior)


def _solved(
    context: Context,
    h: Hypothesis,
    state: _State,
    known: Known,
    own: Array,
    terms: Sequence[Term],
    hyper: tuple[int, int],
    converged: bool,
    log_prior: float,
) -> Solved:
    problem, p, k = context.problem, len(context.problem.nuisances), len(h.amplitudes)
    point = _point(state.theta, p, k)
    lin = about(context, h, point, state.residual, known, own)
    columns = np.column_stack([lin.effect, context.whiten(own[:, k:])])
    cells = _log_cells(context, lin, columns, terms)
    covariance = _posterior(context, h, lin, columns, cells, terms)
    at = values(problem, h, point)
    sd = np.sqrt(np.diag(covariance))
    sigma = {n.name: float(s * n.sigma) for n, s in zip(problem.nuisances, sd, strict=False)}
    slope = np.ones(p + k + len(h.shapes))
    for i, (a, q) in enumerate(zip(h.amplitudes, point.amplitude, strict=True)):
        if a.power > 1:
            # Half the width of the interval q ± its sigma, seen in the value: well defined at 0 too.
            s = sd[p + i]
            slope[p + i] = (np.sqrt(q + s) - np.sqrt(max(q - s, 0.0))) / (2 * s)
    sigma.update({a.name: float(s) for a, s in zip((*h.amplitudes, *h.shapes), (sd * slope)[p:], strict=True)})
    sigma.update({name: 0.0 for e in h.effects for name in evidence.fixed(e)})
    names = [a.name for a in (*h.amplitudes, *h.shapes)]
    wanted = [a.name for e in h.effects for a in e.parameters]
    place = [i for i, name in enumerate(wanted) if name in names]
    order = [names.index(wanted[i]) for i in place]
    own_covariance = np.zeros((len(wanted), len(wanted)))
    own_covariance[np.ix_(place, place)] = (covariance * slope[:, None] * slope)[p:, p:][np.ix_(order, order)]
    white = context.whiten(state.residual)
    done = Fit(
        h.names,
        float(logsumexp(cells)) + log_prior,
        at,
        sigma,
        own_covariance,
        float(context.scales[hyper[0]]),
        float(white @ white),
        converged,
        lin,
    )
    return Solved(done, point, known, own, state.residual)


def _posterior(
    context: Context, h: Hypothesis, lin: Linear, columns: Array, cells: Array, terms: Sequence[Term]
) -> Array:
    """Covariance of nuisances, amplitudes (fit space) and shapes, hyper-parameters mixed in."""
    weights = np.exp(cells - logsumexp(cells))
    both = np.column_stack([lin.nuisance, columns])
    square, projected = both.T @ both, both.T @ lin.residual
    p, k = lin.nuisance.shape[1], len(h.amplitudes)
    means, covariances, kept = [], [], []
    for i, j in zip(*np.nonzero(weights > 1e-3), strict=True):
        prior = _prior(context, h, context.scales[i], terms[j].field_sigma)
        precision = prior.precision.copy()
        precision[p + k :] = [2 * np.pi / _range(s) ** 2 for s in h.shapes]
        # Where power 2 meets data that say nothing, its prior still bounds it.
        squares = [
            2.0 / s**4 if evidence.kind(a) == 2 else 0.0
            for a, s in zip(h.amplitudes, h.sigmas(terms[j].field_sigma), strict=True)
        ]
        precision[p : p + k] += 1e-3 * np.array(squares)
        covariance = np.linalg.inv(square + np.diag(precision))
        means.append(covariance @ (projected - prior.slope))
        covariances.append(covariance)
        kept.append(weights[i, j])
    w = np.array(kept) / sum(kept)
    mean = np.einsum("i,ij->j", w, np.array(means))
    away = np.array(means) - mean
    return np.einsum("i,ijk->jk", w, np.array(covariances)) + np.einsum("i,ij,ik->jk", w, away, away)
