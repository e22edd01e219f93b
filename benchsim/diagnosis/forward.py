"""The model that predicts best, where nobody states the errors of the data: found by prediction alone.

Records of a mount have wrong days among them, and their errors are known from nothing but their own scatter: evidence,
which takes errors to be normal, then buys one effect after the other. Here effects are added one by one while records
that were left out are predicted better, all of one stretch of time together, for that is how a mount is used: learnt
from yesterday, pointed tomorrow. Fits are robust: with r the whitened residual of a datum and x a parameter in prior
sigmas,

    minimise  Σ 2 (√(1 + r²) − 1) + Σ x²,

of all data exactly, without a stretch by derivatives about that fit; what is left out is predicted exactly. A model is
judged by the mean of the first sum's terms over data left out. Shapes (the place of a change) stand where the diagnosis
has them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.cross_validation import FOLDS, in_turn
from benchsim.diagnosis.hypothesis import LARGEST, Effects, Fit, Hypothesis, Naming
from benchsim.diagnosis.problem import Effect, Parameter, Problem

Array = NDArray[np.float64]

ROUNDS = 8
"""Steps of a fit; those that matter converge in less."""

PER_PARAMETER = 5.0
"""Data for each number that a model fits, at least. With half as many, of sixteen heliostats three with fewer than
twenty records were given two effects that undid each other where they had not been pointed before."""

BETTER = 2.0
"""Sigma, by the scatter of the stretches' own differences, by which one more effect has to predict better."""


@dataclass(frozen=True)
class Model:
    """A set of effects, fitted to all data, and the loss of every datum where its stretch of time was left out."""

    effects: Effects
    values: Mapping[str, float]
    losses: Array


def best(problem: Problem, naming: Naming, from_these: Sequence[Effects]) -> tuple[Model, Model]:
    """Nothing, and the model that predicts best: grown from it, or from a set that evidence favours if that is better.

    Parameters
    ----------
    problem : Problem
    naming : Naming
        For the shapes of its fits.
    from_these : sequence of Effects
        Sets that evidence favours.

    Notes
    -----
    An effect that differs from place to place (targets that hang wrong, each by its own) is not among them: it says
    nothing of a place that no record is of.
    """
    known: dict[Effects, Model | None] = {}
    order = [e.name for e in problem.catalogue if not e.random_field]

    def model(effects: Sequence[str]) -> Model | None:
        key = tuple(n for n in order if n in effects)
        if key not in known:
            known[key] = _model(problem, naming, key)
        return known[key]

    def grown(now: Model) -> Model:
        while len(now.effects) < LARGEST:
            tried = [m for n in order if n not in now.effects if (m := model((*now.effects, n))) is not None]
            top = min(tried, key=lambda m: m.losses.mean(), default=now)
            if not _better(problem, now, top):
                break
            now = top
        return now

    nothing = model(())
    assert nothing is not None
    found = grown(nothing)
    for effects in from_these:
        other = model(effects)
        if other is not None and _better(problem, found, other):
            found = grown(other)
    return nothing, found


def gain(problem: Problem, before: Model, after: Model) -> tuple[float, float]:
    """By how much the mean loss falls, and its sigma by the scatter of the stretches."""
    each = np.array([part.mean() for part in _parts(problem, before.losses - after.losses)])
    return float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each)))


def _better(problem: Problem, now: Model, other: Model) -> bool:
    won, sigma = gain(problem, now, other)
    return won > BETTER * sigma


def _parts(problem: Problem, per_datum: Array) -> list[Array]:
    stretch = in_turn(problem)[problem.block]
    return [per_datum[stretch == s] for s in range(int(stretch.max()) + 1)]


def _model(problem: Problem, naming: Naming, effects: Effects) -> Model | None:
    chosen = tuple(e for e in problem.catalogue if e.name in effects)
    own = (*problem.nuisances, *(a for e in chosen for a in evidence.amplitudes(e)))
    amplitudes = len(own) - len(problem.nuisances)
    if PER_PARAMETER * amplitudes > (1 - 1 / FOLDS) * len(problem.data):
        return None
    shapes = _shapes(naming, chosen)
    if shapes is None:
        return None
    lower = linear.factors(problem.covariance)
    whole, sigma = fitted(problem, own, lower, shapes), np.array([p.sigma for p in own])
    at = np.array([whole[p.name] for p in own]) / sigma
    columns = linear.lowered(lower, linear.columns(problem, whole, own) * sigma)
    target = _white(problem, lower, whole) + columns @ at
    stretch = in_turn(problem)[problem.block]
    losses = np.empty(len(problem.data))
    for s in range(int(stretch.max()) + 1):
        out = stretch == s
        x = _linear(target[~out], columns[~out], at, own)
        losses[out] = loss(_white(problem, lower, whole | _named(own, x * sigma))[out])
    return Model(effects, whole, losses)


def _shapes(naming: Naming, chosen: Sequence[Effect]) -> dict[str, float] | None:
    """Where the shapes of some effects stand, in the most probable fit that holds them; None where none does."""
    out: dict[str, float] = {}
    for e in chosen:
        for p in evidence.shapes(e):
            fit = next((f for f in naming.fits if e.name in f.effects), None)
            if fit is None:
                return None
            out[p.name] = fit.values[p.name]
        out |= evidence.fixed(e)
    return out


def loss(white: Array) -> Array:
    """2 (√(1 + r²) − 1): r² where small, 2 |r| where large."""
    return np.asarray(2 * (np.sqrt(1 + white**2) - 1))


def _white(problem: Problem, lower: Sequence[Array], at: Mapping[str, float]) -> Array:
    return linear.lowered(lower, problem.data - linear.predict_all(problem, at))


def fitted(
    problem: Problem, parameters: Sequence[Parameter], lower: Sequence[Array], at: Mapping[str, float]
) -> dict[str, float]:
    """Robust fit of some parameters to all data; all else as in ``at``."""
    sigma = np.array([p.sigma for p in parameters])

    def values(x: Array) -> dict[str, float]:
        return {**at, **_named(parameters, x * sigma)}

    found = _robust(
        lambda x: _white(problem, lower, values(x)),
        lambda x: linear.lowered(lower, linear.columns(problem, values(x), tuple(parameters)) * sigma),
        np.array([at.get(p.name, 0.0) for p in parameters]) / sigma,
        parameters,
    )
    return values(found)


def _robust(
    white: Callable[[Array], Array], columns: Callable[[Array], Array], start: Array, parameters: Sequence[Parameter]
) -> Array:
    """Where Σ loss + Σ x² is least, of whitened residuals and derivatives of the prediction by x."""

    def rest(x: Array) -> Array:
        # The loss is applied here, so that priors stay normal.
        r = white(x)
        return np.concatenate([np.sign(r) * np.sqrt(loss(r)), x])

    def slope(x: Array) -> Array:
        r = white(x)
        steep = np.where(r == 0, 1.0, np.abs(r) / np.sqrt(1 + r**2) / np.sqrt(np.maximum(loss(r), 1e-300)))
        return np.concatenate([-columns(x) * steep[:, None], np.eye(len(x))])

    low = np.array([0.0 if p.one_sided else -np.inf for p in parameters])
    start = np.where(np.isfinite(low), np.maximum(start, 1e-3), start)
    with np.errstate(over="ignore"):  # scipy's search for a damping may begin too small by far
        return np.asarray(least_squares(rest, start, slope, bounds=(low, np.inf), max_nfev=ROUNDS, x_scale=1.0).x)


def _linear(target: Array, columns: Array, start: Array, parameters: Sequence[Parameter]) -> Array:
    """`_robust` where the prediction is linear."""
    return _robust(lambda x: target - columns @ x, lambda x: columns, start, parameters)


def _named(parameters: Sequence[Parameter], x: Array) -> dict[str, float]:
    return {p.name: float(v) for p, v in zip(parameters, x, strict=True)}


def as_fit(problem: Problem, naming: Naming, model: Model) -> Fit:
    """The model as a fit of the diagnosis': its values, and sigma by the curvature of the robust sum."""
    chosen = tuple(e for e in problem.catalogue if e.name in model.effects)
    h = Hypothesis(chosen)
    at = {**{n.name: 0.0 for n in problem.nuisances}, **model.values}
    known = linear.columns(problem, at, (*problem.nuisances, *h.amplitudes))
    known[:, : len(problem.nuisances)] *= [n.sigma for n in problem.nuisances]
    lin = linear.linearise(problem, at, h.amplitudes, naming.noise.covariance, known)
    robust = linear.linearise(problem, at, h.amplitudes, problem.covariance, known)
    white = _white(problem, linear.factors(problem.covariance), at)
    weight = (1 + white**2) ** -0.75
    size = np.array([p.sigma for p in h.amplitudes])
    columns = np.column_stack([robust.nuisance, robust.effect * size]) * weight[:, None]
    # Errors as the data show them: what is left of the sum, per datum that is not used up.
    left = float(loss(white).sum()) / max(len(white) - columns.shape[1], 1)
    spread = np.sqrt(np.diag(linear.posterior(columns / np.sqrt(max(left, 1.0)), np.ones(columns.shape[1]))))
    names = [*(n.name for n in problem.nuisances), *(a.name for a in h.amplitudes)]
    units = [*(n.sigma for n in problem.nuisances), *(a.sigma for a in h.amplitudes)]
    sigma = {n: float(s * u) for n, s, u in zip(names, spread, units, strict=True)}
    for p in h.shapes:
        sigma[p.name] = next(f.sigma[p.name] for f in naming.fits if p.name in f.values and p.name in f.sigma)
    own = [a.name for e in chosen for a in e.parameters]
    return Fit(
        h.names,
        naming.null.log_evidence,
        at,
        sigma,
        np.diag([sigma.get(n, 0.0) ** 2 for n in own]),
        1.0,
        float(white @ white),
        True,
        lin,
        naming.null.log_scales,
    )
