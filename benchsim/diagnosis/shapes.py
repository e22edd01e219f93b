"""How uncertain a place, a width or a period is, and the amplitude there.

The data may leave several places open, or a bent ridge of them along which a larger effect lies further off, and the
curvature at the best one says nothing of the others: of a plume of 40 sigma beside two exposures' traces it knew a
fifth of how far the place was off. For every shape the amplitudes and all nuisances are integrated as
in `linear`; what is left is a density of the few shape parameters, summed by adaptive importance sampling: points lie
evenly over the whole range, then about the best place as its curvature has it, then about where those found the
density; each counts by the density over that of all layers together (Cornuet et al. 2012,
https://doi.org/10.1111/j.1467-9469.2011.00756.x).

Not where an effect bends the data at its size: what its amplitude adds is taken as linear about none, from that size.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_normal, qmc

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.discrepancy import absorb, amplitudes
from benchsim.diagnosis.hypothesis import Fit
from benchsim.diagnosis.problem import Effect, Problem

Array = NDArray[np.float64]

POINTS, WIDER = 256, 2.0
"""Points of a layer, and how much wider than the density seems to be it is laid out."""

ROUNDS, ENOUGH = 5, 40
"""Layers, each about where the last ones found the density, until so many points count."""


def widened(problem: Problem, covariance: tuple[Array, ...], fit: Fit, effects: Collection[str]) -> Fit:
    """A fit with the `spread` of its effects that have shapes in place of what the curvature says of them.

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
        one_sided = any(evidence.kind(a) for a in evidence.amplitudes(effect))
        if effect.name in effects and evidence.shapes(effect) and not one_sided:
            sigma |= spread(problem, covariance, fit, effect)
    return replace(fit, sigma=sigma)


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
    low, high = (np.array([pick(p.grid) for p in shapes]) for pick in (min, max))
    names, k = [p.name for p in own], len(own)
    size, middle = (np.array([fit.values[p.name] for p in many]) for many in (own, shapes))
    # The pseudo-residual of a linearisation holds what its amplitudes explain: here the effect's is left out of it
    # exactly, by the prediction without it.
    without = {**fit.values, **dict.fromkeys(names, 0.0), **evidence.fixed(effect)}
    others = [i for i, name in enumerate(fit.linear.names) if name not in names]
    raw = linear.raised(
        linear.factors(covariance), np.column_stack([fit.linear.nuisance, fit.linear.effect[:, others]])
    )
    rest = amplitudes(problem, tuple(fit.linear.names[i] for i in others))
    ground = absorb(problem, linear.linearise(problem, without, rest, covariance, raw))
    # At the size it was fitted with, but at least at one sigma. From one side, at half
    # the cost of central differences.
    step = np.copysign(np.maximum(np.abs(size), [fit.sigma[n] for n in names]), size)
    unit = np.array([p.sigma for p in own])

    def density(at: Array) -> tuple[Array, Array]:
        """ln of the density at points (m, d), and the amplitudes' mean square distance from the fit's (m, k)."""
        places = [{**without, **dict(zip((p.name for p in shapes), row, strict=True))} for row in at.tolist()]
        found = linear.predict_each(
            problem, [without, *({**place, n: s} for place in places for n, s in zip(names, step, strict=True))]
        )
        columns = (np.column_stack(found[1:]) - found[0][:, None]) / np.tile(step / unit, len(at))
        # Where light just misses there is no prediction; no column is better than one that is not finite.
        white = linear.whiten(problem, covariance, np.where(np.isfinite(columns), columns, 0.0))[0]
        m = linear.marginal(ground, white, fit.setting_scale)
        of = np.arange(len(at))[:, None] * k + np.arange(k)
        root = np.linalg.inv(np.linalg.cholesky(m.gram[of[:, :, None], of[:, None, :]] + np.eye(k)))
        stands = np.einsum("mij,mj->mi", root, m.projection[of])
        log = 0.5 * (stands**2).sum(axis=1) + np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        mean = unit * np.einsum("mji,mj->mi", root, stands)
        return log, (mean - size) ** 2 + unit**2 * (root**2).sum(axis=1)

    listed = [p.name for e in problem.catalogue if e.name in fit.effects for p in e.parameters]
    place = [listed.index(p.name) for p in shapes]
    about = multivariate_normal(middle, WIDER**2 * fit.covariance[np.ix_(place, place)], allow_singular=True)
    at = qmc.scale(qmc.Sobol(len(shapes), rng=0).random(POINTS), low, high)
    log, square = density(at)
    laid = [about]
    for _ in range(ROUNDS):
        near = qmc.MultivariateNormalQMC(laid[-1].mean, laid[-1].cov, rng=len(laid)).random(POINTS)
        near = near[((near >= low) & (near <= high)).all(axis=1)]
        more, further = density(near)
        at, log, square = np.concatenate([at, near]), np.append(log, more), np.concatenate([square, further])
        drawn = logsumexp([np.full(len(at), -np.log(high - low).sum()), *(g.logpdf(at) for g in laid)], axis=0)
        share = softmax(log - drawn)
        if share @ share < 1 / ENOUGH:
            break
        # One place that has all of the weight tells no width: then the curvature's is taken there.
        alone = share @ share > 1 - 1e-9
        wide = about.cov if alone else WIDER**2 * np.cov(at.T, aweights=share).reshape(len(shapes), -1)
        laid.append(multivariate_normal(share @ at, wide, allow_singular=True))
    second = np.concatenate([share @ square, share @ (at - middle) ** 2])
    # The range ends where a catalogue's shapes do; how sure the fit is within it is known from the curvature at least.
    return {p.name: max(fit.sigma[p.name], float(np.sqrt(v))) for p, v in zip((*own, *shapes), second, strict=True)}
