"""The prediction to second order in the nuisances, so that its derivatives are known everywhere near.

Setting errors move data by a thousand sigma and then nearly cancel each other: derivatives taken at one point are wrong
by many sigma at another, and a fit that keeps them wanders off along the directions that nearly cancel. With second
derivatives, measured once about the stated settings,

    J(x) = J₀ + H x + Σₐ q_a M_a ,

x the nuisances in prior sigmas, q_a the amplitudes (value**power) and M_a the change of the nuisances' columns per unit
of it, which is also the change of the amplitude's column per nuisance. Residuals stay exact; only the direction of
steps and the width of posteriors rest on this. Not for predictions that bend to third order within a few prior sigma.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis.linear import fit_value, predictions, value_of, whiten
from benchsim.diagnosis.problem import Parameter, Problem

Array = NDArray[np.float64]

STEP = 1.0
"""Of the differences, in prior sigmas: what is wanted is the behaviour over a few of them."""

CLOSE, AMPLITUDE = 0.3, 0.1
"""The same of settings and amplitudes about a point where a fit already is."""

FLAT = 0.05
"""A nuisance that bends the data by less than this many sigma over one prior sigma, alone or as all others are moved by
theirs, is taken to act linearly."""


@dataclass(frozen=True)
class Curvature:
    """First and second derivatives by the nuisances per prior sigma, about the stated settings.

    Attributes
    ----------
    first : (n, p)
    curved : per block, (m_b,) int
        Nuisances that act nonlinearly there.
    second : per block, (n_b, m_b, m_b)
    plain : per block, (n_b,)
        The prediction there.
    steps : per block, (n_b, m_b)
        Prediction with one curved nuisance moved by `STEP`, less ``plain``.
    """

    first: Array
    curved: tuple[NDArray[np.intp], ...]
    second: tuple[Array, ...]
    plain: tuple[Array, ...]
    steps: tuple[Array, ...]


def measure(problem: Problem) -> Curvature:
    """Differentiate twice."""
    nuisances, blocks = problem.nuisances, range(len(problem.names))
    acting = [[k for k, p in enumerate(nuisances) if p.blocks is None or b in p.blocks] for b in blocks]
    tasks = [(b, k, sign) for b in blocks for k in acting[b] for sign in (1.0, -1.0)]
    values = [{nuisances[k].name: sign * STEP * nuisances[k].sigma} for _, k, sign in tasks]
    plain = tuple(predictions(problem, [{}] * len(blocks), list(blocks)))
    found = predictions(problem, values, [b for b, _, _ in tasks])
    first = np.zeros((len(problem.data), len(nuisances)))
    bend = np.zeros_like(first)
    alone: dict[tuple[int, int, float], Array] = {}
    for (b, k, sign), f in zip(tasks, found, strict=True):
        rows, change = problem.rows(b), _finite(np.asarray(f) - plain[b])
        first[rows, k] += sign * change / (2 * STEP)
        bend[rows, k] += change / STEP**2
        alone[b, k, sign] = change
    others = _with_others(problem, acting, alone)
    white = whiten(problem, problem.covariance, np.column_stack([bend, others]))[0]
    p = len(nuisances)
    curved, second, steps, pairs = [], [], [], []
    for b in blocks:
        rows = problem.rows(b)
        own = [k for k in acting[b] if max(np.linalg.norm(white[rows, j]) for j in (k, p + k)) > 2 * FLAT]
        curved.append(np.array(own, np.intp))
        h = np.zeros((len(plain[b]), len(own), len(own)))
        for i, k in enumerate(own):
            h[:, i, i] = bend[rows, k]
        second.append(h)
        steps.append(np.stack([alone[b, k, 1.0] for k in own], axis=1) if own else np.zeros((len(plain[b]), 0)))
        pairs += [(b, i, j) for i in range(len(own)) for j in range(i)]
    both = [
        {nuisances[curved[b][i]].name: STEP * nuisances[curved[b][i]].sigma}
        | {nuisances[curved[b][j]].name: STEP * nuisances[curved[b][j]].sigma}
        for b, i, j in pairs
    ]
    found = predictions(problem, both, [b for b, _, _ in pairs])
    for (b, i, j), f in zip(pairs, found, strict=True):
        mixed = _finite(np.asarray(f) - plain[b] - steps[b][:, i] - steps[b][:, j]) / STEP**2
        second[b][:, i, j] = second[b][:, j, i] = mixed
    return Curvature(first, tuple(curved), tuple(second), plain, tuple(steps))


def again(
    problem: Problem, about: Curvature, at: Mapping[str, float], parameters: Sequence[Parameter]
) -> tuple[Curvature, dict[str, tuple[Array, Array]], int]:
    """Second derivatives about another point.

    Parameters
    ----------
    problem : Problem
    about : Curvature
        Of the stated settings; what it says of them is kept but for ``second``.
    at : mapping of parameter → value
        The point, in the parameters' units.
    parameters : sequence of Parameter
        Amplitudes.

    Returns
    -------
    curvature : Curvature
    changes : dict
        M (n, p) of each amplitude by its name, and its bend (n,).
    count : int
        Predictions made.
    """
    nuisances, blocks = problem.nuisances, range(len(problem.names))
    unit = {a.name: AMPLITUDE * a.sigma**a.power for a in parameters}

    def moved(b: int, settings: Mapping[int, float], amplitudes: Mapping[str, float]) -> dict[str, float]:
        out = dict(at)
        for i, s in settings.items():
            n = nuisances[about.curved[b][i]]
            out[n.name] = at.get(n.name, 0.0) + s * CLOSE * n.sigma
        for a in parameters:
            if a.name in amplitudes:
                q = fit_value(a, at[a.name]) + amplitudes[a.name] * unit[a.name]
                out[a.name] = value_of(a, q)
        return out

    each = [range(len(about.curved[b])) for b in blocks]
    tasks: list[tuple[int, dict[int, float], dict[str, float]]] = [(b, {}, {}) for b in blocks]
    tasks += [(b, {i: sign}, {}) for b in blocks for i in each[b] for sign in (1.0, -1.0)]
    tasks += [(b, {i: 1.0, j: 1.0}, {}) for b in blocks for i in each[b] for j in range(i)]
    for name in unit:
        tasks += [(b, {}, {name: s}) for b in blocks for s in (1.0, 2.0)]
        tasks += [(b, {i: 1.0}, {name: 1.0}) for b in blocks for i in each[b]]
    found = predictions(problem, [moved(*t) for t in tasks], [b for b, _, _ in tasks])
    known = {(b, *s.items(), *q.items()): np.asarray(f) for (b, s, q), f in zip(tasks, found, strict=True)}
    second = [np.zeros_like(s) for s in about.second]
    changes = {name: (np.zeros_like(about.first), np.zeros(len(problem.data))) for name in unit}
    for b in blocks:
        plain, up, rows = known[(b,)], {i: known[b, (i, 1.0)] for i in each[b]}, problem.rows(b)
        for i in each[b]:
            second[b][:, i, i] = _finite(up[i] + known[b, (i, -1.0)] - 2 * plain) / CLOSE**2
            for j in range(i):
                both = _finite(known[b, (i, 1.0), (j, 1.0)] - up[i] - up[j] + plain) / CLOSE**2
                second[b][:, i, j] = second[b][:, j, i] = both
        for name, (m, bend) in changes.items():
            more = known[b, (name, 1.0)]
            bend[rows] = _finite(known[b, (name, 2.0)] - 2 * more + plain) / unit[name] ** 2
            for i in each[b]:
                change = _finite(known[b, (i, 1.0), (name, 1.0)] - more - up[i] + plain)
                m[rows, about.curved[b][i]] = change / (CLOSE * unit[name])
    return replace(about, second=tuple(second)), changes, len(tasks)


def _with_others(
    problem: Problem,
    acting: list[list[int]],
    alone: dict[tuple[int, int, float], Array],
) -> Array:
    """How much of each nuisance's step is different where all others are moved too, (n, p).

    The signs come from a fixed seed: the same data give the same diagnosis.
    """
    nuisances, blocks = problem.nuisances, range(len(problem.names))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(nuisances))
    tasks = [(b, k) for b in blocks for k in (-1, *acting[b])]
    values = [{nuisances[j].name: signs[j] * STEP * nuisances[j].sigma for j in acting[b] if j != k} for b, k in tasks]
    found = predictions(problem, values, [b for b, _ in tasks])
    moved = {task: np.asarray(f) for task, f in zip(tasks, found, strict=True)}
    out = np.zeros((len(problem.data), len(nuisances)))
    for b in blocks:
        for k in acting[b]:
            out[problem.rows(b), k] = _finite(moved[b, -1] - moved[b, k] - alone[b, k, signs[k]]) / STEP**2
    return out


def _finite(change: Array) -> Array:
    """A change; 0 where one step leaves what can be predicted (light beside the mirror): nothing is known of it there.

    Steps of fits are taken on exact predictions, so what is lost is their speed.
    """
    return change if np.isfinite(change).all() else np.zeros_like(change)


def mixed(
    problem: Problem, about: Curvature, parameter: Parameter, amplitude: float, others: Mapping[str, float]
) -> tuple[tuple[Array, ...], Array, int]:
    """Change of the curved nuisances' columns per unit of an amplitude, per block (n_b, m_b), and its own bend, (n,).

    Parameters
    ----------
    problem : Problem
    about : Curvature
    parameter : Parameter
    amplitude : float
        value**power at which it is measured; its sign and size should be those of interest.
    others : mapping
        Shape parameters that the amplitude needs.

    Returns
    -------
    changes : per block, (n_b, m_b)
    bend : (n,)
        Second derivative by the amplitude.
    count : int
        Predictions made.
    """

    def with_amplitude(q: float) -> dict[str, float]:
        return {**others, parameter.name: value_of(parameter, q)}

    on = with_amplitude(amplitude)
    tasks = [(b, i) for b in range(len(problem.names)) for i in (-2, -1)]
    tasks += [(b, i) for b in range(len(problem.names)) for i in range(len(about.curved[b]))]
    nuisances = problem.nuisances
    values = [
        with_amplitude(amplitude / 2)
        if i == -2
        else on | ({} if i < 0 else {nuisances[about.curved[b][i]].name: STEP * nuisances[about.curved[b][i]].sigma})
        for b, i in tasks
    ]
    out = [np.zeros_like(s) for s in about.steps]
    alone: dict[tuple[int, int], Array] = {}
    for (b, i), f in zip(tasks, predictions(problem, values, [b for b, _ in tasks]), strict=True):
        if i < 0:
            alone[b, i] = np.asarray(f)
        else:
            out[b][:, i] = _finite(np.asarray(f) - alone[b, -1] - about.steps[b][:, i]) / (STEP * amplitude)
    blocks = range(len(problem.names))
    bend = [4 * _finite(alone[b, -1] - 2 * alone[b, -2] + about.plain[b]) / amplitude**2 for b in blocks]
    return tuple(out), np.concatenate(bend), len(tasks)


def nuisance_columns(problem: Problem, about: Curvature, nuisance: Array) -> Array:
    """J₀ + H x, (n, p)."""
    out = about.first.copy()
    for b, own in enumerate(about.curved):
        if len(own):
            rows = problem.rows(b)
            out[rows, own] += about.second[b] @ nuisance[own]
    return out


def spread_out(problem: Problem, about: Curvature, change: tuple[Array, ...]) -> Array:
    """M_a as (n, p)."""
    out = np.zeros_like(about.first)
    for b, own in enumerate(about.curved):
        if len(own):
            out[problem.rows(b), own] = change[b]
    return out
