"""How uncertain a place, a width or a period is where its effect hardly stands out.

The data then leave several places open, or a bent ridge of them along which a larger effect lies further off, and the
curvature at the best one says nothing of the others. For every shape the amplitudes and all nuisances are integrated as
in `linear`; what is left is a density of the few shape parameters. Its peaks are narrow, but by how many sigma the
amplitudes stand out changes no faster than the effect does with its shape: splines carry that from some nodes to a mesh
that resolves the peaks. Points chosen by it are looked at exactly and weighed (importance sampling, self-normalised);
where that shows the splines to be wrong, they are corrected and points are chosen anew.

Not for effects that stand out by many sigma: what an amplitude adds is taken as linear, and `refit` knows better.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator, make_interp_spline
from scipy.special import logsumexp

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.discrepancy import absorb
from benchsim.diagnosis.hypothesis import Fit
from benchsim.diagnosis.problem import Effect, Parameter, Problem

Array = NDArray[np.float64]

FAINT = 8.0
"""Amplitude over its sigma from which on the best place's own curvature is believed."""

FINER, FEWEST = 3, 5
"""Nodes for every step of a shape's grid, and nodes at least."""

MESH = 8
"""Points of the mesh for every step of the nodes."""

DRAWS, HEAT = 256, 2.0
"""Points that are looked at exactly, and the power of the mesh's density by whose root they are chosen: wide enough
that what splines miss between the nodes is still among them."""

ROUNDS, ENOUGH = 5, 40
"""Choices of such points, each with what the last ones taught the mesh, until so many count."""


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
    at, density, share = _points(_Weigh.of(problem, covariance, fit, effect), low, high)
    size = np.array([fit.values[p.name] for p in own])
    second = np.concatenate([share @ ((density.mean - size) ** 2 + density.variance), share @ (at - middle) ** 2])
    # The range ends where a catalogue's shapes do; how sure the fit is within it is known from the curvature at least.
    return {p.name: max(fit.sigma[p.name], float(np.sqrt(v))) for p, v in zip((*own, *shapes), second, strict=True)}


@dataclass(frozen=True)
class _Density:
    """Of points of the shapes: by how many sigma the amplitudes stand out (m, k), what their freedom costs in ln (m,),
    and their mean and variance (m, k)."""

    stands: Array
    occam: Array
    mean: Array
    variance: Array

    @property
    def log(self) -> Array:
        return np.asarray(0.5 * (self.stands**2).sum(axis=1) + self.occam)


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

    def __call__(self, at: Array) -> _Density:
        """At points (m, d) of the shapes."""
        k = len(self.own)
        white = linear.whiten(self.problem, self.covariance, self._columns(at))[0]
        of = np.arange(len(at))[:, None] * k + np.arange(k)
        m = linear.marginal(self.ground, white, self.scale)
        unit = np.array([p.sigma for p in self.own])
        inner = m.gram[of[:, :, None], of[:, None, :]] * unit[:, None] * unit + np.eye(k)
        root = np.linalg.inv(np.linalg.cholesky(inner))
        stands = np.einsum("mij,mj->mi", root, m.projection[of] * unit)
        occam = np.log(root[:, range(k), range(k)]).sum(axis=1)
        return _Density(stands, occam, unit * np.einsum("mji,mj->mi", root, stands), unit**2 * (root**2).sum(axis=1))

    def _columns(self, at: Array) -> Array:
        """What each amplitude adds per unit at each point, (n, m k): half the cost of central differences."""
        places = [dict(zip((p.name for p in self.shapes), row, strict=True)) for row in at.tolist()]
        blocks = range(len(self.problem.names))
        points = [{**self.without, **place, p.name: self.step[p.name]} for place in places for p in self.own]
        found = linear.predictions(
            self.problem, [v for v in points for _ in blocks], [b for _ in points for b in blocks]
        )
        added = np.concatenate(found).reshape(len(points), -1) - self.level
        added /= np.array([self.step[p.name] for _ in places for p in self.own])[:, None]
        # Where light just misses there is no prediction; no column is better than one that is not finite.
        return np.where(np.isfinite(added), added, 0.0).T


def _points(weigh: _Weigh, low: Array, high: Array) -> tuple[Array, _Density, Array]:
    """Points (m, d), the density at each, and each one's share of the posterior."""
    counts = [max(FEWEST, FINER * (len(p.grid) - 1) + 1) for p in weigh.shapes]
    nodes = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    seen = weigh(_mesh(nodes))
    fine = [np.linspace(a[0], a[-1], MESH * (len(a) - 1) + 1) for a in nodes]
    values = np.column_stack([seen.stands, seen.occam]).reshape(*counts, -1)
    for i, (a, b) in enumerate(zip(nodes, fine, strict=True)):
        values = make_interp_spline(a, values, k=min(5, (len(a) - 2) // 2 * 2 + 1), axis=i)(b)
    flat = values.reshape(-1, values.shape[-1])
    spline = 0.5 * (flat[:, :-1] ** 2).sum(axis=1) + flat[:, -1]
    places, unit = _mesh(fine), np.array([a[1] - a[0] for a in nodes])
    guess, exact = spline, dict[int, float]()
    for _ in range(ROUNDS):
        log = guess / HEAT - logsumexp(guess / HEAT)
        # Systematic: as many of every part of the mesh as its share, but for a fraction; no random numbers are needed.
        drawn = np.searchsorted(np.cumsum(np.exp(log)), (np.arange(DRAWS) + 0.5) / DRAWS)
        drawn = np.minimum(drawn, len(log) - 1)
        found = weigh(places[drawn])
        share = np.exp(found.log - log[drawn] - logsumexp(found.log - log[drawn]))
        if share @ share < 1 / ENOUGH:
            break
        # Where light is lost splines ring: there they are set right by what was seen nearby.
        exact |= dict(zip(drawn.tolist(), found.log.tolist(), strict=True))
        known = np.array(list(exact))
        wrong = np.array(list(exact.values())) - spline[known]
        guess = spline + RBFInterpolator(places[known] / unit, wrong, neighbors=8, kernel="linear")(places / unit)
    return places[drawn], found, share


def _mesh(axes: Sequence[Array]) -> Array:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
