"""How uncertain a place, a width or a period is where its effect hardly stands out.

The data then leave several places open, or a bent ridge of them along which a larger effect lies further off, and the
curvature at the best one says nothing of the others. For every shape the amplitudes and all nuisances are integrated as
in `linear`; what is left is a density of the few shape parameters, summed over nodes that lie as close as the effect
changes with its shape. A peak between nodes counts at its nearest one, which is less far off than a `FAINT` effect's
place is uncertain.

Not for effects that stand out by many sigma: what an amplitude adds is taken as linear, and `fitting` knows better.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.discrepancy import absorb, amplitudes
from benchsim.diagnosis.hypothesis import Fit
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.screen import grid_weights

Array = NDArray[np.float64]

FAINT = 8.0
"""Amplitude over its sigma from which on the best place's own curvature is believed."""

FINER = 4
"""Nodes for every step of a shape's grid."""


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
    axes = [np.linspace(min(p.grid), max(p.grid), FINER * (len(p.grid) - 1) + 1) for p in shapes]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    log_prior = np.log(reduce(np.multiply.outer, [grid_weights(a) for a in axes])).ravel()
    names = [p.name for p in own]
    size = np.array([fit.values[n] for n in names])
    # The pseudo-residual of a linearisation holds what its amplitudes explain: here the effect's is left out of it
    # exactly, by the prediction without it.
    without = {**fit.values, **dict.fromkeys(names, 0.0), **evidence.fixed(effect)}
    others = [i for i, name in enumerate(fit.linear.names) if name not in names]
    known = linear.raised(
        linear.factors(covariance), np.column_stack([fit.linear.nuisance, fit.linear.effect[:, others]])
    )
    rest = amplitudes(problem, tuple(fit.linear.names[i] for i in others))
    ground = absorb(problem, linear.linearise(problem, without, rest, covariance, known))
    # At the size it was fitted with, but at least at one sigma: what is faint is linear so far. From one side, at half
    # the cost of central differences.
    step = np.copysign(np.maximum(np.abs(size), [fit.sigma[n] for n in names]), size)
    places = [{**without, **dict(zip((p.name for p in shapes), row, strict=True))} for row in at.tolist()]
    found = linear.predict_each(
        problem, [without, *({**place, n: s} for place in places for n, s in zip(names, step, strict=True))]
    )
    k, unit = len(own), np.array([p.sigma for p in own])
    columns = (np.column_stack(found[1:]) - found[0][:, None]) / np.tile(step / unit, len(at))
    # Where light just misses there is no prediction; no column is better than one that is not finite.
    white = linear.whiten(problem, covariance, np.where(np.isfinite(columns), columns, 0.0))[0]
    m = linear.marginal(ground, white, fit.setting_scale)
    of = np.arange(len(at))[:, None] * k + np.arange(k)
    root = np.linalg.inv(np.linalg.cholesky(m.gram[of[:, :, None], of[:, None, :]] + np.eye(k)))
    stands = np.einsum("mij,mj->mi", root, m.projection[of])
    share = softmax(log_prior + 0.5 * (stands**2).sum(axis=1) + np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1))
    mean, variance = unit * np.einsum("mji,mj->mi", root, stands), unit**2 * (root**2).sum(axis=1)
    second = np.concatenate(
        [share @ ((mean - size) ** 2 + variance), share @ (at - np.array([fit.values[p.name] for p in shapes])) ** 2]
    )
    # The range ends where a catalogue's shapes do; how sure the fit is within it is known from the curvature at least.
    return {p.name: max(fit.sigma[p.name], float(np.sqrt(v))) for p, v in zip((*own, *shapes), second, strict=True)}
