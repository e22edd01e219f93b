"""Settings that were not fitted, predicted: the choice of effect is made anew without them.

In each fold noise, setting scale, choice of effect (every single, every pair and what grows from the best of them, and
every attachment, against the null) and
amplitudes come from the other settings alone. The left-out data r, whitened with a covariance that the other settings
gave, are N(A â, 1 + N S² Nᵀ) with their own nuisances N at their priors, so χ² less the number of data has expectation
0 where nothing is missing and variance 2 n; the sum is not clipped.

All folds work on the linearisation that the whole problem was given. A point to expand about carries no information
to first order: what a fold learns of the amplitudes it learns from its own residuals. Shape parameters (a place, a
width) are an exception: they stand where the linearisation has them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from benchsim.diagnosis import noise as noises
from benchsim.diagnosis import screen
from benchsim.diagnosis.degeneracy import estimate, space
from benchsim.diagnosis.discrepancy import Attached, Prepared, kernel_root, smooth_functions, weigh, whitened
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fits import LARGEST, Effects, Naming, Noise
from benchsim.diagnosis.linear import Linear, marginal, nuisance_posterior, precision, whiten
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import HeldOut

Array = NDArray[np.float64]

FOLDS = 6
FEWEST = 3
"""Settings below which nothing can be left out."""


@dataclass(frozen=True)
class Fold:
    """One fold: which data are left out, and the problem as the other settings show it.

    Attributes
    ----------
    test : (n,) bool
    naming : Naming
        Its noise and linearisation whitened with the training settings' noise.
    linear : Linear
        The whole catalogue's amplitudes about the best fit, whitened likewise.
    """

    test: NDArray[np.bool_]
    naming: Naming
    linear: Linear


@dataclass(frozen=True)
class Prediction:
    """Left-out data of one fold before and after, whitened by ``fold``'s noise, and the chosen effects."""

    chosen: str
    scale: float
    before: Array
    after: Array


@dataclass(frozen=True)
class Shown:
    """The outcome, and the left-out residuals in the data's units with their own nuisances taken up."""

    held_out: HeldOut
    before: Array
    after: Array
    chosen: tuple[str, ...]


def folds(problem: Problem, naming: Naming, linear: Linear, laid: Attached | None = None) -> tuple[Fold, ...]:
    """Leave out every setting once, in at most `FOLDS` folds; none where there are fewer than `FEWEST` settings.

    Parameters
    ----------
    problem : Problem
    naming : Naming
    linear : Linear
        The whole catalogue's amplitudes about the best fit (`degeneracy.about`); the naming's own where nothing was
        found.
    laid : Attached, optional
        The function that stands in for what has no name. What it leaves is the noise; what it explains is not, and
        would otherwise be taken for errors that neighbours share.
    """
    if len(set(problem.groups)) < FEWEST:
        return ()
    of = in_turn(problem)[problem.block]
    raw, remove = _judged_by(problem, naming, linear, laid)
    out = []
    for f in range(int(of.max()) + 1):
        test = of == f
        fold = Fold(test, replace(naming, noise=noises.estimate(problem, raw, remove, ~test)), linear)
        at_null = beside(problem, naming, fold, naming.linear)
        out.append(
            replace(fold, naming=replace(fold.naming, linear=at_null), linear=beside(problem, naming, fold, linear))
        )
    return tuple(out)


def in_turn(problem: Problem) -> NDArray[np.intp]:
    """Fold of every block: settings one after the other, or, of records in the order of time, neighbours together.

    What neighbours in time share, be it only a season's sky, must not come from them: a mount is learnt yesterday and
    pointed tomorrow.
    """
    groups = list(dict.fromkeys(problem.groups))
    count = min(FOLDS, len(groups))
    number = {g: i * count // len(groups) if problem.judged_forward else i % count for i, g in enumerate(groups)}
    return np.array([number[g] for g in problem.groups])


def beside(problem: Problem, naming: Naming, fold: Fold, linear: Linear) -> Linear:
    """A linearisation that was whitened by a naming's noise, whitened by a fold's."""
    p = linear.nuisance.shape[1]
    all_of_it = np.column_stack([linear.residual, linear.nuisance, linear.effect])
    raw = _unwhiten(problem, naming.noise.covariance, all_of_it)
    white, logdet = whiten(problem, fold.naming.noise.covariance, raw)
    return replace(linear, residual=white[:, 0], nuisance=white[:, 1 : 1 + p], effect=white[:, 1 + p :], logdet=logdet)


def noise_beside(problem: Problem, naming: Naming, linear: Linear, laid: Attached) -> Noise:
    """Noise as all data show it beside a function: what that explains is no noise."""
    return noises.estimate(problem, *_judged_by(problem, naming, linear, laid))


def _judged_by(problem: Problem, naming: Naming, linear: Linear, laid: Attached | None) -> tuple[Array, Array]:
    """Residual about a linearisation in the data's units, and the columns that are no noise.

    Far from the data even what is smooth bends away from its columns: about the null of a mount that is 100 mrad off it
    would pass for errors of some mrad.
    """
    all_of_it = np.column_stack([linear.residual, linear.nuisance, linear.effect])
    raw = _unwhiten(problem, naming.noise.covariance, all_of_it)
    known = {q.name: q for e in problem.catalogue for q in e.parameters}
    sigma = np.concatenate(
        [np.ones(linear.nuisance.shape[1]), [known[n].sigma ** known[n].power for n in linear.names]]
    )
    functions = smooth_functions(problem)
    if laid is not None:
        a = laid.attachment
        functions.append(a.basis @ kernel_root(a, min(a.lengths)) * a.sigma)
    return raw[:, 0], np.column_stack([raw[:, 1:] * sigma, *functions])


def _unwhiten(problem: Problem, covariance: tuple[Array, ...], white: Array) -> Array:
    out = np.empty(white.shape)
    for b, c in enumerate(covariance):
        rows = problem.rows(b)
        out[rows] = np.linalg.cholesky(c) @ white[rows]
    return out


def only(linear: Linear, keep: NDArray[np.bool_]) -> Linear:
    """The rows of whole blocks; the determinant of the noise, which all hypotheses share, is left out."""
    return replace(
        linear,
        residual=linear.residual[keep],
        nuisance=linear.nuisance[keep],
        effect=linear.effect[keep],
        block=linear.block[keep],
        logdet=0.0,
    )


def best_scale(linear: Linear, naming: Naming, columns: Array) -> float:
    """Most probable setting scale with ``columns`` (unit prior variance) among the nuisances."""
    found = []
    for scale, weight in zip(naming.setting_scales, naming.scale_weights, strict=True):
        m = marginal(linear, columns, float(scale))
        inner = np.eye(columns.shape[1]) + m.gram
        gain = 0.5 * (m.projection @ np.linalg.solve(inner, m.projection) - np.linalg.slogdet(inner)[1])
        found.append(np.log(weight) - 0.5 * (m.chi2 + m.logdet) + gain)
    return float(naming.setting_scales[int(np.argmax(found))])


def excess(linear: Linear, residual: Array, test: NDArray[np.bool_], scale: float) -> float:
    """χ² of left-out data with their nuisances marginalised at the priors, less its expectation."""
    n_cols, r = linear.nuisance[test], residual[test]
    s = np.where(linear.scaled, scale, 1.0)
    factor = precision(n_cols, s)
    cross = n_cols.T @ r
    return float(r @ r - cross @ cho_solve(factor, cross)) - int(test.sum())


def choose(problem: Problem, fold: Fold, prepared: tuple[Prepared, ...]) -> tuple[Effects, Attached | None]:
    """The most probable explanation by the training settings: a set of effects, or else an attachment."""
    train = only(fold.linear, ~fold.test)
    place = {n: i for i, n in enumerate(train.names)}
    nodes = {}
    for e in problem.catalogue:
        # One node of the shape grid stands for all: its share of the prior comes with it.
        share = -sum(float(np.log(len(p.grid))) for p in e.parameters if p.grid)
        nodes[e.name] = (screen.Node({}, tuple(place[p.name] for p in e.parameters if p.name in place), share),)
    catalogue = screen.Catalogue(
        {e.name: e for e in problem.catalogue}, nodes, train.effect, np.zeros_like(train.effect)
    )
    scales, weights = fold.naming.setting_scales, fold.naming.scale_weights
    found = screen.screen(train, catalogue, train.effect, scales, weights)
    named = max(found, key=lambda h: found[h])
    found |= _larger(train, catalogue, fold, named)
    named = max(found, key=lambda h: found[h])
    # About the same point as the names: else they would be weighed on two different scales.
    plain = replace(fold.linear, effect=fold.linear.effect[:, :0], names=())
    seen = whitened(problem, prepared, fold.naming.noise.covariance, ~fold.test)
    laid = weigh(problem, fold.naming, seen, keep=~fold.test, linear=plain, log_evidence=found[()])
    if laid and laid[0].log_evidence > found[named]:
        return (), laid[0]
    return named, None


def _larger(train: Linear, catalogue: screen.Catalogue, fold: Fold, best: Effects) -> dict[Effects, float]:
    """ln Z of sets that grow from the most probable pair by what helps most, while it helps."""
    names = list(catalogue.effects)
    scales, weights = fold.naming.setting_scales, fold.naming.scale_weights
    cache: dict[str, list[Term]] = {}
    grown: dict[Effects, float] = {}
    while 2 <= len(best) < LARGEST:
        wanted = [tuple(n for n in names if n in best or n == one) for one in names if one not in best]
        listed = [(e, screen.hypothesis_terms(catalogue, e, cache)) for e in [best, *wanted]]
        weighed = screen.weigh(train, catalogue.columns, scales, weights, listed)
        z = {e: v + screen.log_prior(e, names) for e, v in weighed.items()}
        top = max(z, key=lambda e: z[e])
        if top == best:
            break
        best = top
        grown[top] = z[top]
    return grown


def sized(problem: Problem, fold: Fold, about: Linear, effects: Effects) -> tuple[Array, float]:
    """Residual of all data beside effects as large as the training settings show them, and the setting scale there."""
    train = only(about, ~fold.test)
    sigma = {p.name: p.sigma**p.power for e in problem.catalogue if e.name in effects for p in e.parameters}
    own = [i for i, n in enumerate(about.names) if n in sigma]
    size = np.array([sigma[about.names[i]] for i in own])
    scale = best_scale(train, fold.naming, train.effect[:, own] * size)
    return about.residual - about.effect @ estimate(space(problem, train, scale), effects), scale


def predict(problem: Problem, fold: Fold, prepared: tuple[Prepared, ...]) -> Prediction:
    """Choose and fit on the training settings, predict the left-out ones."""
    effects, laid = choose(problem, fold, prepared)
    linear = fold.linear
    if laid is not None:
        white, _ = whiten(problem, fold.naming.noise.covariance, laid.attachment.basis)
        return Prediction(
            laid.attachment.name, laid.scale, linear.residual, linear.residual - white @ laid.coefficients
        )
    after, scale = sized(problem, fold, linear if effects else fold.naming.linear, effects)
    return Prediction("+".join(effects), scale, fold.naming.linear.residual, after)


def show(problem: Problem, many: Sequence[Fold], prepared: tuple[Prepared, ...]) -> Shown | None:
    """Every setting left out once.

    Parameters
    ----------
    problem : Problem
    many : sequence of Fold
    prepared : tuple of Prepared

    Returns
    -------
    Shown or None
        None where there are fewer than three settings.
    """
    if not many:
        return None
    n = len(problem.data)
    before, after, chosen = np.full(n, np.nan), np.full(n, np.nan), []
    total_before = total_after = 0.0
    for fold in many:
        made = predict(problem, fold, prepared)
        chosen.append(made.chosen)
        total_before += excess(fold.naming.linear, made.before, fold.test, made.scale)
        total_after += excess(fold.linear, made.after, fold.test, made.scale)
        for source, at, out in ((made.before, fold.naming.linear, before), (made.after, fold.linear, after)):
            own = np.where(fold.test, source, 0.0)
            there = replace(at, nuisance=np.where(fold.test[:, None], at.nuisance, 0.0))
            pull, _ = nuisance_posterior(there, own, made.scale)
            left = _unwhiten(problem, fold.naming.noise.covariance, (own - there.nuisance @ pull)[:, None])[:, 0]
            out[fold.test] = left[fold.test]
    held = HeldOut(len(many), n, total_before, total_after, float(np.sqrt(2 * n)))
    return Shown(held, before, after, tuple(chosen))
