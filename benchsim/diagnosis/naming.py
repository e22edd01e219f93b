"""Weigh every explanation that the catalogue offers: noise, screening, refits, and the probability of each effect.

The null is refitted first, and the whole catalogue differentiated once, about it; then hypotheses are screened and
refitted (`search`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from benchsim.diagnosis import curvature, evidence, noise, refit, screen, settings
from benchsim.diagnosis.attachments import smooth_functions
from benchsim.diagnosis.curvature import Curvature
from benchsim.diagnosis.fits import Effects, Fit, Naming, Noise
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, Solved, whitener
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.screen import Catalogue
from benchsim.diagnosis.search import MOST, search
from benchsim.diagnosis.weighing import Table, whole

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

ROUGHLY = 3
"""Descents of the first fit of the null, which only has to come near enough to judge the noise."""

NOISE_MOVED = 0.02
"""Change of a kind's scale, or of the shared variance in units of the white one, that asks for everything anew."""


def name(
    problem: Problem, progress: Progress | None = None, *, refits: int = MOST, bends: Curvature | None = None
) -> Naming:
    """Weigh all hypotheses of the catalogue.

    Parameters
    ----------
    problem : Problem
    progress : callable, optional
        Called with what is being done and the fraction done.
    refits : int
        Most hypotheses that are refitted.
    bends : Curvature, optional
        `curvature.measure` of this prediction, where several data sets share it; default measured here.

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
    bends = bends or curvature.measure(problem)
    solved, found = _null(problem, bends)
    tell("differentiating the effects", 0.15)
    catalogue = screen.expand(problem, solved.fit.values)
    remove = _removed(problem, catalogue, solved.known.columns)
    found = noise.estimate(problem, solved.residual, remove)
    earlier: dict[Effects, Point] = {}
    context = _context(problem, found, bends)
    for attempt in range(2):
        # How effects bend does not depend on the noise.
        context = replace(_context(problem, found, bends), mixed=context.mixed)
        hopeless = refit.misses(context, solved)
        solved = refit.fit(
            context,
            Hypothesis(()),
            [solved.point] if hopeless else _starts(solved.point),
            solved.known,
            np.zeros((len(problem.data), 0)),
            screen.log_prior((), list(catalogue.effects)),
            # Where the null misses by far, what it says is that it does.
            rounds=1 if hopeless else None,
        )
        tell("weighing singles and pairs", 0.35)
        table, done = search(context, catalogue, solved, refits, tell, earlier)
        solved = done[()]
        best = max(done.values(), key=lambda s: s.fit.log_evidence if s.fit.converged else -np.inf)
        if attempt or not best.fit.effects:
            break
        again = noise.estimate(problem, best.residual, remove)
        if not _moved(found, again):
            break
        found, earlier = again, {e: s.point for e, s in done.items() if s.fit.converged}
    tell("weighing done", 1.0)
    return _naming(problem, context, catalogue, solved, table, done, found)


def _check(problem: Problem) -> None:
    if not len(problem.data) or not np.isfinite(problem.data).all():
        raise ValueError("the problem's data are empty or not finite; leave such data out")
    if (np.diff(problem.block) < 0).any():
        raise ValueError("the problem's data are not block after block; sort them by block")
    if not all(np.isfinite(c).all() for c in problem.covariance):
        raise ValueError("a covariance of the problem is not finite; leave such data out")


def _context(problem: Problem, found: Noise, bends: Curvature) -> Context:
    return Context(problem, whitener(found.covariance), *settings.grid(), bends)


def _starts(point: Point) -> list[Point]:
    """The null's: where it is, and a point on the other side of the stated settings."""
    return [point, replace(point, nuisance=-point.nuisance)]


def _null(problem: Problem, bends: Curvature) -> tuple[Solved, Noise]:
    """The null's fit from the stated settings, with a first estimate of the noise."""
    zero = Point(np.zeros(len(problem.nuisances)), np.zeros(0), np.zeros(0))
    residual = problem.data - np.concatenate(bends.plain)
    if not np.isfinite(residual).all():
        raise ValueError("the simulation predicts no finite value for some data as stated; leave such data out")
    largest = float(settings.grid()[0][-1])
    found = noise.estimate(problem, residual, bends.first * largest)
    solved = refit.fit(
        _context(problem, found, bends),
        Hypothesis(()),
        [zero],
        Known(bends.first, zero.nuisance),
        np.zeros((len(problem.data), 0)),
        rounds=ROUGHLY,
    )
    return solved, found


def _removed(problem: Problem, catalogue: Catalogue, nuisance: Array) -> Array:
    """What noise is not to be estimated from: what settings at their largest scale, effects and functions could do."""
    scaled = np.array([n.scaled for n in problem.nuisances], bool)
    largest = float(settings.grid()[0][-1])
    size = np.ones(catalogue.columns.shape[1])
    for effect in problem.catalogue:
        sigma = [p.sigma**p.power for p in evidence.amplitudes(effect)]
        for node in catalogue.nodes[effect.name]:
            size[list(node.columns)] = sigma
    return np.column_stack(
        [nuisance * np.where(scaled, largest, 1.0), catalogue.columns * size, *smooth_functions(problem)]
    )


def _moved(before: Noise, after: Noise) -> bool:
    changes = [
        np.abs(np.diag(b) / np.diag(a) - 1).max() for a, b in zip(before.covariance, after.covariance, strict=True)
    ]
    return bool(max(changes) > 2 * NOISE_MOVED)


def _naming(
    problem: Problem,
    context: Context,
    catalogue: Catalogue,
    null: Solved,
    table: Table,
    done: Mapping[Effects, Solved],
    found: Noise,
) -> Naming:
    """Put the result together."""
    listed = list(table.log_z)
    z = np.array([table.log_z[e] for e in listed])
    share = np.exp(z - logsumexp(z))
    probability = {n: float(sum(s for e, s in zip(listed, share, strict=True) if n in e)) for n in catalogue.effects}
    if problem.stated:
        probability[settings.NAME] = _stretched(context, null, table, done)
    fits: list[Fit] = sorted((s.fit for s in done.values()), key=lambda f: (not f.converged, -f.log_evidence))
    screened = sorted(((e, v, table.source[e]) for e, v in table.log_z.items() if e), key=lambda item: -item[1])
    scales, weights = settings.grid()
    return Naming(
        null.fit,
        tuple(fits),
        tuple(screened),
        probability,
        whole(context, catalogue, null),
        found,
        scales,
        weights,
    )


def _stretched(context: Context, null: Solved, table: Table, done: Mapping[Effects, Solved]) -> float:
    """P(the settings are further off than `settings.BEYOND` times what is stated)."""
    z, far = [], []
    for effects, value in table.log_z.items():
        fit = (done[effects] if effects in done else done.get(table.source[effects], null)).fit
        near, beyond = settings.parted(context.scales, fit.log_scales)
        z.append(value)
        far.append(value + beyond - np.logaddexp(near, beyond))
    return float(np.exp(logsumexp(far) - logsumexp(z)))
