"""How uncertain a place, a width or a period is where its effect hardly stands out.

The data then leave several places open, or a bent ridge of them along which a larger effect lies further off, and the
curvature at the best one says nothing of the others. For every shape the amplitudes and all nuisances are integrated as
in `linear`; what is left is a density of the few shape parameters, which a population of points follows from the range
of their grids to the posterior: sequential Monte Carlo (Del Moral et al., doi:10.1111/j.1467-9868.2006.00553.x) with
moves by differences of two other points (ter Braak, doi:10.1007/s11222-006-8769-1), which find their own scale and
directions and step between peaks.

Not for effects that stand out by many sigma: what an amplitude adds is taken as linear, and `refit` knows better.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import logsumexp

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.attachments import absorb
from benchsim.diagnosis.fits import Fit
from benchsim.diagnosis.problem import Effect, Parameter, Problem

Array = NDArray[np.float64]

FAINT = 8.0
"""Amplitude over its sigma from which on the best place's own curvature is believed."""

POINTS, MOVES, STAGES = 128, 3, 12
"""Points of the population, moves of all of them at each stage, and stages at most."""

ALIVE = 0.5
"""Part of the points that are to count after the likelihood is let in further."""

JUMPS = 0.1
"""Part of the moves that go by a whole difference, from peak to peak."""


@dataclass(frozen=True)
class _Cloud:
    """Points (m, d) in units of their ranges, their ln likelihood, the amplitudes' mean and variance (m, k) there."""

    at: Array
    log_likelihood: Array
    mean: Array
    variance: Array

    def where(self, chosen: NDArray[np.bool_], other: _Cloud) -> _Cloud:
        wide = chosen[:, None]
        return _Cloud(
            np.where(wide, other.at, self.at),
            np.where(chosen, other.log_likelihood, self.log_likelihood),
            np.where(wide, other.mean, self.mean),
            np.where(wide, other.variance, self.variance),
        )

    def take(self, index: NDArray[np.intp]) -> _Cloud:
        return _Cloud(self.at[index], self.log_likelihood[index], self.mean[index], self.variance[index])


def widened(problem: Problem, covariance: tuple[Array, ...], fit: Fit, effects: Collection[str]) -> Fit:
    """A fit with the `spread` of its faint effects in place of what the curvature says of them.

    Parameters
    ----------
    problem : Problem
    covariance : tuple of (n_b, n_b)
        Of the blocks, as estimated.
    fit : Fit
        Converged.
    effects : collection of str
        Of the fit's own, those whose sizes will be stated.
    """
    sigma = dict(fit.sigma)
    for effect in problem.catalogue:
        if effect.name in effects and faint(effect, fit):
            sigma |= spread(problem, covariance, fit, effect)
    return replace(fit, sigma=sigma)


def faint(effect: Effect, fit: Fit) -> bool:
    """Whether an effect of a fit has shapes and no amplitude that stands out."""
    own = evidence.amplitudes(effect)
    return (
        bool(evidence.shapes(effect))
        and not any(evidence.kind(a) for a in own)
        and all(abs(fit.values[a.name]) < FAINT * fit.sigma[a.name] for a in own)
    )


def spread(problem: Problem, covariance: tuple[Array, ...], fit: Fit, effect: Effect) -> dict[str, float]:
    """Posterior rms distance of an effect's parameters from where they were fitted.

    Parameters
    ----------
    problem : Problem
    covariance : tuple of (n_b, n_b)
        Of the blocks, as estimated.
    fit : Fit
        Converged, the effect among its own.
    effect : Effect
        With shapes; amplitudes neither one-sided nor of power 2.

    Returns
    -------
    dict of str to float
        By parameter, in its unit: what replaces ``fit.sigma``. It is at least as honest where the fit is not at the
        posterior's mean: the distance counts too.
    """
    own, shapes = evidence.amplitudes(effect), evidence.shapes(effect)
    low = np.array([min(p.grid) for p in shapes])
    high = np.array([max(p.grid) for p in shapes])
    middle = np.array([fit.values[p.name] for p in shapes])
    weigh = _Weigh.of(problem, covariance, fit, effect)
    # A fixed seed: the same data give the same diagnosis.
    cloud = _followed(weigh, (middle - low) / (high - low), np.random.default_rng(0))
    place = low + (high - low) * cloud.at - middle
    size = np.array([fit.values[p.name] for p in own])
    second = [*((cloud.mean - size) ** 2 + cloud.variance).mean(axis=0), *(place**2).mean(axis=0)]
    # A population may lose breadth, but the curvature at the best place is a lower bound that is known.
    return {p.name: max(fit.sigma[p.name], float(np.sqrt(v))) for p, v in zip((*own, *shapes), second, strict=True)}


@dataclass(frozen=True)
class _Weigh:
    """Likelihood of an effect's shapes about a fit, its amplitudes and all nuisances integrated."""

    problem: Problem
    covariance: tuple[Array, ...]
    ground: linear.Linear
    scale: float
    without: Mapping[str, float]
    level: Array
    step: Mapping[str, float]
    own: tuple[Parameter, ...]
    shapes: tuple[Parameter, ...]

    @staticmethod
    def of(problem: Problem, covariance: tuple[Array, ...], fit: Fit, effect: Effect) -> _Weigh:
        own, shapes = evidence.amplitudes(effect), evidence.shapes(effect)
        mine = {p.name for p in own}
        keep = [i for i, name in enumerate(fit.linear.names) if name not in mine]
        # The pseudo-residual of a linearisation holds what its amplitudes explain: here the effect's is left out of it
        # exactly, by the prediction without it.
        without = {**fit.values, **dict.fromkeys(mine, 0.0), **evidence.fixed(effect)}
        lin = fit.linear
        level = linear.predict_all(problem, without)
        rest = linear.whiten(problem, covariance, problem.data - level)[0]
        # At the size it was fitted with, but at least at one sigma: what is faint is linear so far.
        step = {
            p.name: float(np.copysign(max(abs(fit.values[p.name]), fit.sigma[p.name]), fit.values[p.name])) for p in own
        }
        known = {p.name: p for e in problem.catalogue for p in e.parameters}
        others = [known[lin.names[i]] for i in keep]
        at = np.array([fit.values[p.name] / p.sigma for p in problem.nuisances])
        sizes = np.array([linear.fit_value(p, fit.values[p.name]) for p in others])
        residual = rest + lin.nuisance @ at + lin.effect[:, keep] @ sizes
        ground = linear.Linear(
            residual,
            lin.nuisance,
            lin.scaled,
            lin.effect[:, keep],
            tuple(p.name for p in others),
            lin.block,
            lin.logdet,
        )
        return _Weigh(
            problem, covariance, absorb(problem, ground), fit.setting_scale, without, level, step, own, shapes
        )

    def __call__(self, at: Array) -> _Cloud:
        """Of points (m, d) within [0, 1]; a point outside is impossible and costs nothing."""
        k, count = len(self.own), len(at)
        out = _Cloud(at, np.full(count, -np.inf), np.zeros((count, k)), np.zeros((count, k)))
        inside = np.flatnonzero(((at >= 0) & (at <= 1)).all(axis=1))
        if not len(inside):
            return out
        places = [
            {p.name: min(p.grid) + u * (max(p.grid) - min(p.grid)) for p, u in zip(self.shapes, row, strict=True)}
            for row in at[inside].tolist()
        ]
        white = linear.whiten(self.problem, self.covariance, self._columns(places))[0]
        m = linear.marginal(self.ground, white, self.scale)
        unit = np.array([p.sigma for p in self.own])
        for j, i in enumerate(inside):
            mine = slice(j * k, (j + 1) * k)
            inner = m.gram[mine, mine] * unit[:, None] * unit + np.eye(k)
            inverse = np.linalg.inv(inner)
            pull = m.projection[mine] * unit
            out.log_likelihood[i] = 0.5 * pull @ inverse @ pull - 0.5 * np.linalg.slogdet(inner)[1]
            out.mean[i], out.variance[i] = unit * (inverse @ pull), unit**2 * np.diag(inverse)
        return out

    def _columns(self, places: Sequence[Mapping[str, float]]) -> Array:
        """What each amplitude adds per unit at each place, (n, places × k): half the cost of central differences."""
        blocks = range(len(self.problem.names))
        points = [{**self.without, **place, p.name: self.step[p.name]} for place in places for p in self.own]
        found = linear.predictions(
            self.problem, [v for v in points for _ in blocks], [b for _ in points for b in blocks]
        )
        added = np.concatenate(found).reshape(len(points), -1) - self.level
        added /= np.array([self.step[p.name] for _ in places for p in self.own])[:, None]
        # Where light just misses there is no prediction; no column is better than one that is not finite.
        return np.where(np.isfinite(added), added, 0.0).T


def _followed(weigh: _Weigh, best: Array, rng: np.random.Generator) -> _Cloud:
    """From points that are even in the range to points of the posterior, the likelihood let in step by step."""
    start = rng.uniform(size=(POINTS, len(best)))
    start[0] = best
    cloud, power = weigh(start), 0.0
    for _ in range(STAGES):
        power, share = _further(cloud.log_likelihood, power)
        cloud = cloud.take(_resampled(share, rng))
        for _ in range(MOVES):
            cloud = _moved(weigh, cloud, power, rng)
        if power >= 1:
            break
    return cloud


def _further(log_likelihood: Array, power: float) -> tuple[float, Array]:
    """The power up to which the likelihood may be let in so that enough points count, and their shares."""

    def shares(to: float) -> Array:
        w = (to - power) * log_likelihood
        return np.asarray(np.exp(w - logsumexp(w)))

    def too_few(to: float) -> float:
        return ALIVE * len(log_likelihood) - 1 / float((shares(to) ** 2).sum())

    to = 1.0 if too_few(1.0) <= 0 else float(brentq(too_few, power, 1.0, xtol=1e-6))
    return to, shares(to)


def _resampled(share: Array, rng: np.random.Generator) -> NDArray[np.intp]:
    """Systematic: every point as often as its share says, but for a fraction."""
    steps = (rng.uniform() + np.arange(len(share))) / len(share)
    return np.minimum(np.searchsorted(np.cumsum(share), steps), len(share) - 1)


def _moved(weigh: _Weigh, cloud: _Cloud, power: float, rng: np.random.Generator) -> _Cloud:
    """One Metropolis move of each half by differences of two points of the other, which keeps the density exact."""
    count, d = cloud.at.shape
    order = rng.permutation(count)
    for half in (slice(0, count // 2), slice(count // 2, count)):
        mine = np.zeros(count, bool)
        mine[order[half]] = True
        others = np.flatnonzero(~mine)
        first, second = rng.choice(others, (2, count))
        stride = np.where(rng.uniform(size=count) < JUMPS, 1.0, 2.38 / np.sqrt(2 * d))
        moved = cloud.at + stride[:, None] * (cloud.at[first] - cloud.at[second])
        moved += 1e-4 * rng.standard_normal((count, d))
        moved[~mine] = np.nan
        tried = weigh(moved)
        gain = power * (tried.log_likelihood - cloud.log_likelihood)
        cloud = cloud.where(mine & (np.log(rng.uniform(size=count)) < gain), tried)
    return cloud
