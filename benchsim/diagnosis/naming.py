"""Weigh every explanation that the catalogue offers: noise, fits, and the probability of each effect.

The null is fitted first, and the whole catalogue differentiated once, about it; then hypotheses are weighed and fitted
(`search`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import evidence, linear, noise, screen, settings
from benchsim.diagnosis.explored import Begun, Search, begun, whole
from benchsim.diagnosis.fitting import RENEWALS, Start, as_it_stands, fitted
from benchsim.diagnosis.functions import smooth_functions
from benchsim.diagnosis.hypothesis import Context, Effects, Fit, Hypothesis, Naming, Noise, Point, Solved
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.screen import Catalogue
from benchsim.diagnosis.search import search

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

NOISE_MOVED = 0.02
"""Change of a kind's scale, or of the shared variance in units of the white one, that asks for everything anew."""


def name(problem: Problem, progress: Progress | None = None) -> Naming:
    """Weigh all hypotheses of the catalogue.

    Parameters
    ----------
    problem : Problem
    progress : callable, optional
        Called with what is being done and the fraction done.

    Returns
    -------
    Naming

    Raises
    ------
    ValueError
        If the data are not blocks with finite numbers, or the simulation cannot predict them as stated.
    """
    tell = progress or (lambda what, done: None)
    _check(problem)
    tell("fitting the settings", 0.0)
    nothing = Point(np.zeros(len(problem.nuisances)), np.zeros(0), np.zeros(0))
    sigma = np.array([n.sigma for n in problem.nuisances])
    as_stated = linear.predict_all(problem, {})
    if not np.isfinite(as_stated).all():
        raise ValueError("the simulation predicts no finite value for some data as stated; leave such data out")
    columns = linear.columns(problem, {}, problem.nuisances) * sigma
    found = noise.estimate(problem, problem.data - as_stated, columns * settings.LARGEST)
    context = _context(problem, found)
    (rough,) = _null(context, [nothing], columns)
    tell("differentiating the effects", 0.15)
    catalogue = screen.expand(problem, rough.fit.values)
    remove = _removed(problem, catalogue, linear.columns(problem, rough.fit.values, problem.nuisances) * sigma)
    found = noise.estimate(problem, problem.data - linear.predict_all(problem, rough.fit.values), remove)
    earlier: dict[Effects, Begun] = {}
    point = rough.point
    for attempt in range(2):
        context = _context(problem, found)
        solved = max(_null(context, [point, nothing], columns), key=lambda s: s.fit.log_evidence)
        stated = as_it_stands(context, Hypothesis(()), nothing, columns)
        tell("weighing singles and pairs", 0.35)
        seen = search(context, catalogue, solved, stated, tell, earlier)
        best = seen.best()
        if attempt or not best.fit.effects:
            break
        again = noise.estimate(problem, problem.data - linear.predict_all(problem, best.fit.values), remove)
        if not _moved(found, again):
            break
        found, earlier = again, begun(seen)
        point = seen.done[()].point
    tell("weighing done", 1.0)
    return _naming(problem, seen, found)


def _check(problem: Problem) -> None:
    if not len(problem.data) or not np.isfinite(problem.data).all():
        raise ValueError("the problem's data are empty or not finite; leave such data out")
    if (np.diff(problem.block) < 0).any():
        raise ValueError("the problem's data are not block after block; sort them by block")
    if not all(np.isfinite(c).all() for c in problem.covariance):
        raise ValueError("a covariance of the problem is not finite; leave such data out")


def _context(problem: Problem, found: Noise) -> Context:
    return Context(problem, linear.factors(found.covariance), *settings.grid(any(p.scaled for p in problem.nuisances)))


def _null(context: Context, points: Sequence[Point], columns: Array) -> list[Solved]:
    """The null's fits from some points; derivatives by the nuisances are those about the stated settings."""
    h, white = Hypothesis(()), context.whiten(columns)
    prior: dict[Effects, float] = {(): evidence.log_prior((), [e.name for e in context.problem.catalogue])}
    return fitted(context, [Start(h, point, white) for point in points], prior, renewals=RENEWALS)


def _removed(problem: Problem, catalogue: Catalogue, nuisance: Array) -> Array:
    """What noise is not to be estimated from: what settings at their largest scale, effects and functions could do."""
    scaled = np.array([n.scaled for n in problem.nuisances], bool)
    size = np.ones(catalogue.columns.shape[1])
    for effect in problem.catalogue:
        sigma = [p.sigma**p.power for p in evidence.amplitudes(effect)]
        for node in catalogue.nodes[effect.name]:
            size[list(node.columns)] = sigma
    return np.column_stack(
        [nuisance * np.where(scaled, settings.LARGEST, 1.0), catalogue.columns * size, *smooth_functions(problem)]
    )


def _moved(before: Noise, after: Noise) -> bool:
    changes = [
        np.abs(np.diag(b) / np.diag(a) - 1).max() for a, b in zip(before.covariance, after.covariance, strict=True)
    ]
    return bool(max(changes) > 2 * NOISE_MOVED)


def _naming(problem: Problem, seen: Search, found: Noise) -> Naming:
    """Put the result together."""
    fits: list[Fit] = sorted((s.fit for s in seen.done.values()), key=lambda f: (not f.converged, -f.log_evidence))
    screened = sorted(((e, v, seen.source[e]) for e, v in seen.log_z.items() if e), key=lambda item: -item[1])
    null = seen.done[()]
    linear = whole(problem, seen.catalogue, seen.white, null)
    return Naming(null.fit, tuple(fits), tuple(screened), linear, found, seen.context.scales, seen.context.weights)
