"""Fit one hypothesis until nothing moves, and weigh it there.

Nuisances, own amplitudes (in fit space, value**power) and shape parameters descend together (`descent`). Between
descents the derivatives are renewed: those by the hypothesis' own parameters always, those by the nuisances, which are
carried by second derivatives, only where a central difference along a random combination of all of them, one posterior
sigma each, disagrees.

A fit counts as converged when, with derivatives renewed, less than `descent.STILL` could be gained, or nothing is
gained of what is promised (`OWED` at most), and when a second start ends nowhere better. An unconverged fit steals the
name.

The evidence is Laplace's about that point, with the exact residual: everything Gaussian in closed form, amplitudes at a
boundary integrated (`evidence`), setting scale and field sigma summed over their grids. A shape parameter's uniform
prior enters as a Gaussian of the same height, range/√(2π) wide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from benchsim.diagnosis import evidence, settings
from benchsim.diagnosis.descent import (
    TEMPERED,
    State,
    Steps,
    begin,
    descend,
    excess,
    held,
    point_of,
    posterior_form,
    prior_of,
    promised_by,
    still,
    theta_of,
)
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fits import Fit
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, Solved, span, values
from benchsim.diagnosis.linear import Linear, posterior
from benchsim.diagnosis.model import carried, sizes_of

Array = NDArray[np.float64]

AGREE = 0.05
"""Relative error of the nuisances' columns that is let pass, in a random combination of one posterior sigma each."""

ROUNDS, SETTLED = 16, 4
"""Descents with derivatives renewed in between, and those in which scale and term may change."""

STALLED = 0.5
"""Part of what the last derivatives promised that the next promise too: then the settings' columns are made anew, and
how they bend."""

WORTH = 2.0
"""Gain of a descent on second derivatives made anew from which on they are made anew right after it once more: they
cost what hundreds of predictions do. One that gains less than `still` ends there, whatever is promised (`OWED`)."""

OWED = 3.0
"""Gain in ln posterior that a fit which moves no more may still promise, if names are to rest on it: the evidence
counts it as had. Where data jump, as where the least tilt puts a window into the light, the derivatives of what comes
after the jump promise it before."""

SLOW = 0.1
"""Part of a misfit beyond doubt that each of them has to take away: a hypothesis that is wrong by far is not followed
through every valley."""

BENT = 1.4
"""Most probable setting scale from which a fit's settings are taken to hide an effect, until others that begin at the
stated ones have ended no better. The price is time in two of a hundred clean sets of six settings; a tilt and a coma of
15 sigma each were imitated at 1.46."""


def misses(context: Context, solved: Solved) -> bool:
    """Whether a fit lies beyond what noise explains, so that its point says little about other hypotheses."""
    return excess(context.whiten(solved.residual)) > 0


def near(context: Context, h: Hypothesis, point: Point) -> bool:
    """Whether a point, fitted or not, is as near the data as a descent with the noise as it is may begin."""
    white = context.whiten(context.problem.data - context.predict(values(context.problem, h, point)))
    return float(white @ white) <= TEMPERED**2 * len(white)


def bent(solved: Solved) -> bool:
    """Whether a fit left the stated settings to be near the data.

    Settings can imitate a strong effect to within the noise where they may be wrong by some stated sigma; what they
    hide there, no linearisation about them shows.
    """
    return solved.fit.setting_scale >= BENT


def strayed(context: Context, solved: Solved) -> bool:
    """Whether a fit is no place for others to grow from."""
    return misses(context, solved) or bent(solved)


def exact(context: Context, h: Hypothesis, theta: Array) -> Known:
    """Nuisances' columns differentiated at a point: nuisances, amplitudes and shapes in one row."""
    p = len(context.problem.nuisances)
    at = values(context.problem, h, point_of(theta, p, len(h.amplitudes)))
    return Known(context.nuisance_columns(at), theta[:p].copy(), sizes_of(context, h, theta))


def _fresh(context: Context, h: Hypothesis, theta: Array, known: Known, scaled: Array) -> Known:
    """The nuisances' columns as carried, if a random combination of them holds at this point; else recomputed."""
    problem = context.problem
    nuisances = problem.nuisances
    p = len(nuisances)
    if not p or (np.array_equal(theta[:p], known.nuisance) and known.amplitude == sizes_of(context, h, theta)):
        return known
    known = carried(context, h, known, theta)
    at = values(problem, h, point_of(theta, p, len(h.amplitudes)))
    white = context.whiten(known.columns)
    precision = white.T @ white + np.diag(scaled**-2.0)
    # Far from a fit columns can be so long that rounding outweighs the priors; only a direction is drawn from this.
    try:
        lower = np.linalg.cholesky(precision + 1e-12 * float(np.diag(precision).max()) * np.eye(p))
    except np.linalg.LinAlgError:
        return exact(context, h, theta)
    # A fixed seed: the same data give the same diagnosis.
    signs = np.random.default_rng(len(h.names)).choice([-1.0, 1.0], p)
    draw = solve_triangular(lower, signs, lower=True, trans=1)
    step = 0.05 * draw / max(float(np.abs(draw).max()), 0.05)
    ends = [
        context.predict(
            {**at, **{n.name: at[n.name] + sign * s * n.sigma for n, s in zip(nuisances, step, strict=True)}}
        )
        for sign in (-1.0, 1.0)
    ]
    # Compared per posterior sigma: that is by how much the fit can still wander.
    unit = float(np.linalg.norm(step) / max(float(np.linalg.norm(draw)), 1e-300))
    wrong = context.whiten((ends[1] - ends[0]) / 2 / unit - known.columns @ step / unit)
    stated = context.whiten(known.columns @ step / unit)
    if np.linalg.norm(wrong) <= AGREE * max(float(np.linalg.norm(stated)), 1.0):
        return known
    return exact(context, h, theta)


def about(context: Context, h: Hypothesis, point: Point, residual: Array, known: Known, own: Array) -> Linear:
    """The problem linearised about a point, own amplitudes' columns as its effects."""
    k = len(h.amplitudes)
    pseudo = residual + known.columns @ point.nuisance + own[:, :k] @ point.amplitude
    white = context.whiten(np.column_stack([pseudo, known.columns, own[:, :k]]))
    p = len(context.problem.nuisances)
    return Linear(
        white[:, 0],
        white[:, 1 : 1 + p],
        np.array([n.scaled for n in context.problem.nuisances], bool),
        white[:, 1 + p :],
        tuple(a.name for a in h.amplitudes),
        context.problem.block,
        context.whiten.logdet,
    )


def log_evidence(context: Context, lin: Linear, columns: Array, terms: Sequence[Term]) -> float:
    """ln Z of a linearised hypothesis, without the prior of its presence."""
    return float(logsumexp(_log_cells(context, lin, columns, terms)))


def _log_cells(context: Context, lin: Linear, columns: Array, terms: Sequence[Term]) -> Array:
    """ln Z of every (setting scale, term), (S, T)."""
    many = settings.marginals(lin, columns, context.scales)
    gram, projection = np.stack([m.gram for m in many]), np.stack([m.projection for m in many])
    cells = evidence.log_factors(gram, projection, terms) + np.array([t.log_weight for t in terms])
    return np.asarray(cells + settings.log_null(many, context.weights)[:, None])


def _choose(cells: Array) -> tuple[int, int]:
    """Most probable setting scale, and term there."""
    scale = int(np.argmax(logsumexp(cells, axis=1)))
    return scale, int(np.argmax(cells[scale]))


def fit(
    context: Context,
    h: Hypothesis,
    starts: Sequence[Point],
    known: Known,
    own: Array | None = None,
    log_prior: float = 0.0,
    rounds: int | None = None,
    hold: int = 0,
) -> Solved:
    """Fit a hypothesis.

    Parameters
    ----------
    context : Context
    h : Hypothesis
    starts : sequence of Point
        The first is followed; the others check where it ends.
    known : Known
        Nuisances' columns at a point nearby.
    own : (n, k) array, optional
        Columns of own amplitudes and shapes at the first start; default they are differentiated.
    log_prior : float
        Of the presence of its effects.
    rounds : int, optional
        Most descents; default `ROUNDS`.
    hold : int
        From so many of the starts a descent of the nuisances alone comes first, and the one that ends lowest is
        followed. Amplitudes that start in the right valley would otherwise leave it while the noise is taken large for
        the sake of settings that are still far off.

    Returns
    -------
    Solved
    """
    problem, p, k = context.problem, len(context.problem.nuisances), len(h.amplitudes)
    is_scaled = np.array([n.scaled for n in problem.nuisances], bool)
    terms, parameters = h.terms(), (*h.amplitudes, *h.shapes)

    def white(a: Array, b: Array) -> Array:
        return context.whiten(np.column_stack([a, b]))

    def columns_at(theta: Array) -> Array:
        return context.columns(values(problem, h, point_of(theta, p, k)), parameters)

    def chosen(theta: Array, residual: Array, known: Known, own: Array) -> tuple[int, int]:
        lin = about(context, h, point_of(theta, p, k), residual, known, own)
        return _choose(_log_cells(context, lin, np.column_stack([lin.effect, context.whiten(own[:, k:])]), terms))

    theta = theta_of(starts[0])
    own = columns_at(theta) if own is None else own
    residual = problem.data - context.predict(values(problem, h, starts[0]))
    known = carried(context, h, known, theta)
    # Far from the fit the residual would ask for the largest scale: it is settled after the first descent.
    hyper = (0, chosen(theta, residual, known, own)[1])
    prior = prior_of(context, h, context.scales[hyper[0]], terms[hyper[1]].field_sigma)
    if hold:
        state = min(held(context, h, prior, starts[:hold], known), key=lambda s: s.cost)
        own, starts = columns_at(state.theta), starts[hold - 1 :]
    else:
        (state,) = begin(context, h, prior, starts[:1])
    converged, checked, before, stalled, promise, anew = False, 0, np.inf, False, np.inf, False
    for turn in range(rounds or ROUNDS):
        last, cost = state.theta, state.cost
        state, own = descend(context, h, prior, state, known, own, columns_at)
        gained = cost - state.cost
        still_there = anew and gained < still(context, state.residual)
        s = np.where(is_scaled, context.scales[hyper[0]], 1.0)
        anew = stalled and not (anew and gained < WORTH)
        if stalled:
            known = exact(context, h, state.theta)
            if anew:
                context = context.bending_at(values(problem, h, point_of(state.theta, p, k)), h.effects)
        else:
            known = _fresh(context, h, state.theta, known, s)
        now = chosen(state.theta, state.residual, known, own)
        # Between two neighbours on the grid that are as probable the choice could swing for ever; any point near the
        # peak will do, since the evidence sums over the grid.
        if now != hyper and turn < SETTLED:
            hyper, still_there = now, False
            prior = prior_of(context, h, context.scales[hyper[0]], terms[hyper[1]].field_sigma)
            (state,) = begin(context, h, prior, [point_of(state.theta, p, k)])
        columns, left = white(known.columns, own), context.whiten(state.residual)
        normal = posterior_form(columns.T @ columns, columns.T @ left, prior, state.theta)
        promised, promise = promise, Steps(normal, prior, state.theta, p).within()[1]
        if stalled:
            # Where the data bend strongly, derivatives of first order promise what cannot be had.
            promise = min(promise, promised_by(context, h, prior, state, known, own))
        stalled = p > 0 and promise > STALLED * promised
        # Predictions have kinks of some thousandths of a sigma: where settings are known badly, those promise what
        # cannot be had, however derivatives are made; nor need derivatives of first order lead downhill at all.
        converged = still_there or promise < still(context, state.residual)
        if not converged:
            unmoved = np.array_equal(state.theta, last) and turn > 0
            if unmoved and not p:
                break
            stalled |= unmoved
            missed, before = before, excess(context.whiten(state.residual))
            if before > (1 - SLOW) * missed:
                break
            continue
        if checked >= len(starts) - 1:
            break
        checked += 1
        (other,) = begin(context, h, prior, starts[checked : checked + 1])
        if np.isfinite(other.cost):
            other, its = descend(
                context, h, prior, other, context.stated() or known, columns_at(other.theta), columns_at
            )
            if other.cost < state.cost - still(context, state.residual):
                # Derivatives made anew were so where the fit was, not where it goes on.
                state, own, converged, anew = other, its, False, False
                continue
        if checked >= len(starts) - 1:
            break
    converged &= not h.names or promise < max(OWED, still(context, state.residual))
    return _solved(context, h, state, known, own, terms, hyper, converged, log_prior)


def _solved(
    context: Context,
    h: Hypothesis,
    state: State,
    known: Known,
    own: Array,
    terms: Sequence[Term],
    hyper: tuple[int, int],
    converged: bool,
    log_prior: float,
) -> Solved:
    problem, p, k = context.problem, len(context.problem.nuisances), len(h.amplitudes)
    point = point_of(state.theta, p, k)
    lin = about(context, h, point, state.residual, known, own)
    columns = np.column_stack([lin.effect, context.whiten(own[:, k:])])
    cells = _log_cells(context, lin, columns, terms)
    covariance = _posterior(context, h, lin, columns, cells, terms)
    at = values(problem, h, point)
    sd = np.sqrt(np.diag(covariance))
    sigma = {n.name: float(s * n.sigma) for n, s in zip(problem.nuisances, sd, strict=False)}
    slope = np.ones(p + k + len(h.shapes))
    for i, (a, q) in enumerate(zip(h.amplitudes, point.amplitude, strict=True)):
        if a.power > 1:
            # Half the width of the interval q ± its sigma, seen in the value: well defined at 0 too.
            s = sd[p + i]
            slope[p + i] = (np.sqrt(q + s) - np.sqrt(max(q - s, 0.0))) / (2 * s)
    sigma.update({a.name: float(s) for a, s in zip((*h.amplitudes, *h.shapes), (sd * slope)[p:], strict=True)})
    sigma.update({name: 0.0 for e in h.effects for name in evidence.fixed(e)})
    names = [a.name for a in (*h.amplitudes, *h.shapes)]
    wanted = [a.name for e in h.effects for a in e.parameters]
    place = [i for i, name in enumerate(wanted) if name in names]
    order = [names.index(wanted[i]) for i in place]
    own_covariance = np.zeros((len(wanted), len(wanted)))
    own_covariance[np.ix_(place, place)] = (covariance * slope[:, None] * slope)[p:, p:][np.ix_(order, order)]
    white = context.whiten(state.residual)
    done = Fit(
        h.names,
        float(logsumexp(cells)) + log_prior,
        at,
        sigma,
        own_covariance,
        float(context.scales[hyper[0]]),
        float(white @ white),
        converged,
        lin,
        np.asarray(logsumexp(cells, axis=1)) + log_prior,
    )
    return Solved(done, point, known, own, state.residual)


def _posterior(
    context: Context, h: Hypothesis, lin: Linear, columns: Array, cells: Array, terms: Sequence[Term]
) -> Array:
    """Covariance of nuisances, amplitudes (fit space) and shapes, hyper-parameters mixed in."""
    weights = np.exp(cells - logsumexp(cells))
    both = np.column_stack([lin.nuisance, columns])
    square, projected = both.T @ both, both.T @ lin.residual
    p, k = lin.nuisance.shape[1], len(h.amplitudes)
    means, covariances, kept = [], [], []
    for i, j in zip(*np.nonzero(weights > 1e-3), strict=True):
        prior = prior_of(context, h, context.scales[i], terms[j].field_sigma)
        precision = prior.precision.copy()
        precision[p + k :] = [2 * np.pi / span(s) ** 2 for s in h.shapes]
        # Where power 2 meets data that say nothing, its prior still bounds it.
        squares = [
            2.0 / s**4 if evidence.kind(a) == 2 else 0.0
            for a, s in zip(h.amplitudes, h.sigmas(terms[j].field_sigma), strict=True)
        ]
        precision[p : p + k] += 1e-3 * np.array(squares)
        covariance = posterior(both, precision**-0.5, square)
        means.append(covariance @ (projected - prior.slope))
        covariances.append(covariance)
        kept.append(weights[i, j])
    w = np.array(kept) / sum(kept)
    mean = np.einsum("i,ij->j", w, np.array(means))
    away = np.array(means) - mean
    return np.einsum("i,ijk->jk", w, np.array(covariances)) + np.einsum("i,ij,ik->jk", w, away, away)
