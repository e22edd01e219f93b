"""Bounded nonlinear least squares for many fits at once.

Minimised is, for each task,

    ½ |r(θ)|² + ½ θᵀ P θ + gᵀ θ,      low ≤ θ ≤ high,

r the whitened residual, P (diagonal) and g the prior's. Steps are Levenberg's and Marquardt's (Madsen, Nielsen &
Tingleff 2004, *Methods for non-linear least squares problems*, for how damping follows the gain), damped in the
parameters' own units: settings that the data fix a thousand times better than their priors would otherwise send those
that they do not fix off the screen. Bounds are kept by an active set within the step.

All tasks step together, so that what they ask of the prediction is asked at once, which is several times cheaper.
Between exact derivatives the Jacobian follows what steps show of it (Broyden 1965, row by row within each row's own
parameters: Schubert 1970); exact ones are made where a step gains far less than it promised, and where a fit seems to
be finished.

Not for objectives that jump: a step over a jump only shortens the next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

Array = NDArray[np.float64]
Points = Sequence[tuple[int, Array]]
"""Number of the task, and θ."""

REACH = 3.0
"""Largest step, in units. The larger, the sooner a fit that starts far off arrives, and the more often elsewhere."""

POOR = 0.25
"""Part of the promised gain below which a step asks for exact derivatives; a lower one saves them and costs steps."""

GIVEN_UP = 1e-9
"""Step, in units, so short that exact derivatives do not lead downhill."""


@dataclass(frozen=True)
class Task:
    """One fit to be made.

    Attributes
    ----------
    start, low, high, unit : (k,)
        ``unit``: in which damping is measured, a prior's sigma.
    precision, slope : (k,)
        P and g.
    acts : (n, k) of bool
        Which parameters a datum may depend on.
    jacobian : (n, k), optional
        ∂r/∂θ near the start; default made there.
    alone : (k,) of bool, optional
        In which r is linear, and of which no two act on one datum, as errors of days are: their derivatives, right in
        ``jacobian``, stay, and they are eliminated before all others. Default none.
    """

    start: Array
    low: Array
    high: Array
    unit: Array
    precision: Array
    slope: Array
    acts: NDArray[np.bool_]
    jacobian: Array | None = None
    alone: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Solution:
    """Where a fit ended.

    Attributes
    ----------
    theta : (k,)
    residual, jacobian : (n,), (n, k)
        There; the Jacobian exact if ``exact``.
    cost : float
    promise : float
        What its derivatives promise could still be gained.
    converged : bool
        Less than `still` is promised, by exact derivatives if such were asked for.
    exact : bool
    """

    theta: Array
    residual: Array
    jacobian: Array
    cost: float
    promise: float
    converged: bool
    exact: bool


def minimise(
    residuals: Callable[[Points], Sequence[Array]],
    jacobians: Callable[[Points], Sequence[Array]],
    tasks: Sequence[Task],
    *,
    still: Callable[[Array], float],
    steps: int,
    renewals: int,
) -> list[Solution]:
    """Follow every task downhill.

    Parameters
    ----------
    residuals : callable
        r (n,) of each point; not finite where there is none.
    jacobians : callable
        ∂r/∂θ (n, k) of each point.
    tasks : sequence of Task
    still : callable
        Of a residual: the promised gain below which a fit is finished.
    steps : int
        Most steps.
    renewals : int
        Most exact Jacobians of a task after its first; with 0 a fit ends by the derivatives it has.

    Returns
    -------
    list of Solution
    """
    runs = [_Run(t, still, renewals) for t in tasks]
    for run, r in zip(runs, residuals([(i, t.start) for i, t in enumerate(tasks)]), strict=True):
        run.begin(r)
    wanting = [i for i, run in enumerate(runs) if run.jacobian is None and not run.over]
    for _ in range(2 * steps):
        if wanting:
            found = jacobians([(i, runs[i].theta) for i in wanting])
            for i, j in zip(wanting, found, strict=True):
                runs[i].renew(j)
        trials = [(i, trial) for i, run in enumerate(runs) if not run.over and (trial := run.propose()) is not None]
        if trials:
            for (i, trial), r in zip(trials, residuals(trials), strict=True):
                runs[i].learn(trial, r)
                runs[i].over |= runs[i].taken >= steps
        wanting = [i for i, run in enumerate(runs) if run.wants and not run.over]
        if not trials and not wanting:
            break
    return [run.solution() for run in runs]


class _Run:
    """A task under way."""

    def __init__(self, task: Task, still: Callable[[Array], float], renewals: int) -> None:
        self.task, self.still, self.left = task, still, renewals
        self.theta, self.jacobian = task.start, task.jacobian
        self.exact = self.wants = self.over = self.converged = False
        self.damping, self.growth, self.taken, self.promise = 1e-3, 2.0, 0, np.inf
        self.form: tuple[Array, Array] | None = None
        self.alone = np.zeros(len(task.start), bool) if task.alone is None else task.alone

    def begin(self, residual: Array) -> None:
        self.residual, self.cost = residual, self._cost(self.theta, residual)
        self.over = not np.isfinite(self.cost)

    def renew(self, jacobian: Array) -> None:
        self.left -= self.jacobian is not None
        self.jacobian, self.form, self.exact, self.wants = jacobian, None, True, False
        self.damping, self.growth = min(self.damping, 1.0), 2.0

    def _cost(self, theta: Array, residual: Array) -> float:
        if not np.isfinite(residual).all():
            return float("inf")
        prior = 0.5 * self.task.precision @ theta**2 + self.task.slope @ theta
        return float(0.5 * residual @ residual + prior)

    def _normal(self) -> tuple[Array, Array]:
        """Second and (less) first derivatives of what is minimised."""
        if self.form is None:
            assert self.jacobian is not None
            t, j, rest = self.task, self.jacobian, ~self.alone
            hessian = np.zeros((len(t.start), len(t.start)))
            hessian[rest] = j[:, rest].T @ j
            hessian[:, rest] = hessian[rest].T
            hessian[self.alone, self.alone] = np.square(j[:, self.alone]).sum(axis=0)
            hessian.flat[:: len(hessian) + 1] += t.precision
            self.form = hessian, -(j.T @ self.residual) - t.precision * self.theta - t.slope
        return self.form

    def _step(self, damping: float) -> tuple[Array, float]:
        """The best step within the bounds under some damping, and what it promises."""
        (hessian, force), t = self._normal(), self.task
        # However sharp the data, a damped step is held to its reach by bounds of its own.
        reach = REACH * t.unit if damping else np.inf
        low, high = np.maximum(t.low - self.theta, -reach), np.minimum(t.high - self.theta, reach)
        damped = hessian.copy()
        damped.flat[:: len(damped) + 1] += damping / t.unit**2
        step = bounded(damped, force, low, high, self.alone)
        return step, float(force @ step - 0.5 * step @ hessian @ step)

    def propose(self) -> Array | None:
        """Where to go next; None where the fit is finished, or waits for exact derivatives."""
        if self.wants:
            return None
        self.promise = self._step(0.0)[1]
        if self.promise < self.still(self.residual):
            self.over = self.converged = self.exact or self.left <= 0
            self.wants = not self.over
            return None
        step, self.foreseen = self._step(self.damping)
        if not self.foreseen > 0 or np.abs(step / self.task.unit).max(initial=0.0) < GIVEN_UP:
            self.wants = not self.exact and self.left > 0
            self.over = not self.wants
            return None
        return np.clip(self.theta + step, self.task.low, self.task.high)

    def learn(self, trial: Array, residual: Array) -> None:
        """Take a step if it gains, and what it shows of the derivatives."""
        self.taken += 1
        cost = self._cost(trial, residual)
        ratio = (self.cost - cost) / self.foreseen
        better = cost < self.cost
        if np.isfinite(cost) and (better or not self.exact):
            self._follow(trial - self.theta, residual - self.residual)
        if better:
            self.theta, self.residual, self.cost, self.form, self.exact = trial, residual, cost, None, False
            self.damping *= max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3) if ratio < 1 else 0.1
            self.growth = 2.0
        else:
            self.damping, self.growth = max(self.damping, 1e-6) * self.growth, 2.0 * self.growth
        self.wants = ratio < POOR and not self.exact and self.left > 0

    def _follow(self, step: Array, change: Array) -> None:
        """Broyden's update: what the step shows, and nothing across it."""
        assert self.jacobian is not None
        t, rest = self.task, np.flatnonzero(~self.alone)
        scaled, acts = step[rest] / t.unit[rest], t.acts[:, rest]
        length = acts @ scaled**2
        missed = np.where(length > 0, change - self.jacobian @ step, 0.0) / np.where(length > 0, length, 1.0)
        self.jacobian = self.jacobian.copy()
        self.jacobian[:, rest] += missed[:, None] * np.where(acts, scaled / t.unit[rest], 0.0)
        self.form = None

    def solution(self) -> Solution:
        jacobian = np.zeros(self.task.acts.shape) if self.jacobian is None else self.jacobian
        return Solution(self.theta, self.residual, jacobian, self.cost, self.promise, self.converged, self.exact)


def bounded(hessian: Array, force: Array, low: Array, high: Array, alone: NDArray[np.bool_] | None = None) -> Array:
    """argmax of fᵀ s − ½ sᵀ H s for low ≤ s ≤ high, 0 being allowed, by fixing what leaves its bounds.

    Nothing that was fixed is set free again: where several bounds act the step may fall short of the best. Of those
    ``alone`` no two have a product in H.
    """
    step = np.zeros(len(force))
    first = np.zeros(len(force), bool) if alone is None else alone
    free = np.flatnonzero(~(((low >= 0) & (force < 0)) | ((high <= 0) & (force > 0))))
    while len(free):
        step[free] = 0.0
        a, b = free[first[free]], free[~first[free]]
        across, diagonal, own = hessian[b[:, None], a], hessian[a, a], hessian[b[:, None], b]
        # Far from any fit rounding can outweigh a direction's own curvature.
        diagonal = diagonal + 1e-14 * diagonal + 1e-300
        own.flat[:: len(own) + 1] += 1e-14 * own.diagonal() + 1e-300
        rest, heard = force - hessian @ step, across / diagonal
        own, right = own - heard @ across.T, rest[b] - heard @ rest[a]
        if len(b):
            _, step[b], failed = dposv(own, right)
            if failed:
                step[b] = np.linalg.lstsq(own, right, rcond=None)[0]
        step[a] = (rest[a] - across.T @ step[b]) / diagonal
        beyond = np.maximum(low - step, step - high)[free]
        worst = int(beyond.argmax())
        if not beyond[worst] > 0:
            break
        at, free = free[worst], np.delete(free, worst)
        step[at] = low[at] if step[at] < low[at] else high[at]
    return np.minimum(np.maximum(step, low), high)


def alone(columns: Array) -> tuple[NDArray[np.intp], Array, NDArray[np.intp]]:
    """Columns of which no two act on one datum, by their entries: their products with each other are diagonal, so that
    they are eliminated before all others.

    Returns
    -------
    row, size : (m,) arrays
        Data that the entries are of, and the entries, column after column.
    first : (k,) int array
        Where each column's begin, for `numpy.add.reduceat`.
    """
    column, row = np.nonzero(columns.T)
    return row, columns[row, column], np.searchsorted(column, np.arange(columns.shape[1]))
