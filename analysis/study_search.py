"""Two questions to the search of every case of the study, whatever is said then.

Does it find the fit that begins at the truth? And is the evidence of what it finds, Laplace's and some quadrature, the
integral that it stands for? Importance sampling with exact predictions answers that without either.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import norm

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.fitting import RENEWALS, Start, fitted
from benchsim.diagnosis.hypothesis import Context, Fit, Hypothesis, Naming, Point, span
from benchsim.diagnosis.problem import Problem, fit_value

Array = NDArray[np.float64]

DRAWS, FOLLOWED = 256, 2
"""Points, and steps by which what the data hold follows what they leave free."""

HELD = 0.1
"""Posterior over prior sigma below which the data hold a direction."""


def ahead(problem: Problem, found: Naming, effects: Mapping[str, Mapping[str, float]]) -> float:
    """By how much in ln Z the fit of the concealed effects that begins at them lies above the best that was found.

    Settings begin as stated; the noise is the search's.
    """
    h = Hypothesis(tuple(e for e in problem.catalogue if e.name in effects))
    at = {name: value for own in effects.values() for name, value in own.items()}
    point = Point(
        np.zeros(len(problem.nuisances)),
        np.array([fit_value(p, at.get(p.name, 0.0)) for p in h.amplitudes]),
        np.array([at[p.name] for p in h.shapes]),
    )
    context = _context(problem, found)
    columns = linear.columns(problem, at, problem.nuisances) * np.array([p.sigma for p in problem.nuisances])
    prior = evidence.log_prior(h.names, [e.name for e in problem.catalogue])
    (end,) = fitted(context, [Start(h, point, context.whiten(columns))], {h.names: prior}, renewals=RENEWALS)
    return end.fit.log_evidence - found.fits[0].log_evidence


def sampled(problem: Problem, found: Naming, fit: Fit, seed: int = 0) -> tuple[float, float] | None:
    """By how much the evidence of a fit lies above what importance sampling gives, and the effective sample size.

    Both at the fit's most probable setting scale. Posteriors are thin bent ridges: a laser's direction may move by a
    prior sigma where a mirror's follows, and what that bends is thirty sigma of the data. So what the data leave free
    is drawn as the curvature at the fit says, what they hold is fitted to that (`FOLLOWED` steps by the derivatives of
    the fit), and drawn about where it then is; the map between has the determinant 1. None of a random field, whose
    sigma is a grid, and where the fit did not converge.
    """
    h = Hypothesis(tuple(e for e in problem.catalogue if e.name in fit.effects))
    if not fit.converged or any(e.random_field for e in h.effects):
        return None
    context, p, k = _context(problem, found), len(problem.nuisances), len(h.amplitudes)
    own = (*h.amplitudes, *h.shapes)
    # In units in which priors are simple: prior sigmas, and for shapes their range.
    unit = np.array([*(q.sigma for q in problem.nuisances), *(a.sigma for a in h.amplitudes), *map(span, h.shapes)])
    names = [q.name for q in (*problem.nuisances, *own)]
    middle = np.array([fit.values[n] for n in names]) / unit
    scale = np.array([*np.where(fit.linear.scaled, fit.setting_scale, 1.0), *np.ones(k)])
    sided = np.array([evidence.kind(a) > 0 for a in h.amplitudes], bool)
    low = np.array([*np.full(p, -np.inf), *np.where(sided, 0.0, -np.inf), *(min(s.grid) / span(s) for s in h.shapes)])
    high = np.array([*np.full(p + k, np.inf), *(max(s.grid) / span(s) for s in h.shapes)])
    fixed = {n: v for e in h.effects for n, v in evidence.fixed(e).items()}

    def white(points: Array) -> Array:
        asked = [fixed | dict(zip(names, row * unit, strict=True)) for row in np.clip(points, low, high)]
        return context.whiten(problem.data[:, None] - np.column_stack(context.predict(asked))).T

    rise = [a.power * a.sigma**a.power * v ** (a.power - 1) for a, v in zip(h.amplitudes, middle[p:], strict=False)]
    (shapes,) = context.columns([(fit.values, h.shapes)]) if h.shapes else (np.zeros((len(problem.data), 0)),)
    columns = np.column_stack(
        [fit.linear.nuisance, fit.linear.effect * np.array(rise), context.whiten(shapes) * unit[p + k :]]
    )
    prior = np.append(scale, np.full(len(h.shapes), (2 * np.pi) ** -0.5))
    value, vector = np.linalg.eigh((columns * prior).T @ (columns * prior))
    sd, turn = (1 + np.maximum(value, 0.0)) ** -0.5, prior[:, None] * vector
    held = sd < HELD
    draw = np.random.default_rng(seed).standard_normal((DRAWS, len(sd)))
    points = middle + (draw * np.where(held, 0.0, sd)) @ turn.T
    pull = np.append(scale**-2.0, np.zeros(len(h.shapes)))
    for _ in range(FOLLOWED):
        force = white(points) @ columns - pull * points
        points = points + (force @ turn * np.where(held, sd**2, 0.0)) @ turn.T
    points = points + (draw * np.where(held, sd, 0.0)) @ turn.T
    log_drawn = norm.logpdf(draw).sum(axis=1) - np.log(sd).sum() - np.linalg.slogdet(turn)[1]
    rest = points[:, : p + k] / scale
    log_prior = norm.logpdf(rest).sum(axis=1) - np.log(scale).sum() + sided.sum() * np.log(2.0)
    log_weight = log_prior - 0.5 * (white(points) ** 2).sum(axis=1) - log_drawn
    log_weight[((points < low) | (points > high)).any(axis=1) | np.isnan(log_weight)] = -np.inf
    exact = float(logsumexp(log_weight)) - np.log(DRAWS)
    exact -= 0.5 * (context.logdet + len(problem.data) * np.log(2 * np.pi))
    at = int(np.argmin(np.abs(found.setting_scales - fit.setting_scale)))
    presence = evidence.log_prior(h.names, [e.name for e in problem.catalogue])
    stated = float(fit.log_scales[at]) - presence - float(np.log(found.scale_weights[at]))
    size = float(np.exp(2 * logsumexp(log_weight) - logsumexp(2 * log_weight)))
    return stated - exact, size


def _context(problem: Problem, found: Naming) -> Context:
    return Context(problem, linear.factors(found.noise.covariance), found.setting_scales, found.scale_weights)
