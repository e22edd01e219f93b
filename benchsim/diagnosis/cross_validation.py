"""Settings that were not fitted, predicted: the choice of effect is made anew without them.

In each fold noise, setting scale, choice of effect (every set that the search weighed, and every attachment, against
the null) and amplitudes come from the other settings alone. The left-out data r, whitened with a covariance that the
other settings gave, are N(A â, 1 + N S² Nᵀ) with their own nuisances N at their priors, so χ² less the number of data
has expectation 0 where nothing is missing and variance 2 n; the sum is not clipped.

All folds work on the linearisation that the whole problem was given. A point to expand about carries no information
to first order: what a fold learns of the amplitudes it learns from its own residuals. Shape parameters (a place, a
width) are an exception: they stand where the linearisation has them.

Which model is written into a file is decided here too. Evidence weighs hypotheses as if one of them were true; where
something small is always left, none is, and it goes on adding what fits. The difference of two models in left-out χ² is
2 ⟨Δ, n⟩ and what one of them misses, so that its sigma is 2 |Δ|, Δ the whitened difference of their predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from benchsim.diagnosis import noise as noises
from benchsim.diagnosis import screen, settings
from benchsim.diagnosis.degeneracy import estimate, space
from benchsim.diagnosis.discrepancy import Attached, absorb, amplitudes, weigh
from benchsim.diagnosis.evidence import Term, log_prior
from benchsim.diagnosis.functions import Prepared, kernel_root, prepare, smooth_functions, whitened
from benchsim.diagnosis.hypothesis import Effects, Fit, Naming, Noise
from benchsim.diagnosis.levels import AS_WELL
from benchsim.diagnosis.linear import Linear, factors, nuisance_posterior, only, precision, raised, whiten
from benchsim.diagnosis.problem import Attachment, Problem
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
    count, forward = min(FOLDS, len(groups)), problem.judged_forward
    number = {g: i * count // len(groups) if forward else i % count for i, g in enumerate(groups)}
    return np.array([number[g] for g in problem.groups])


def beside(problem: Problem, naming: Naming, fold: Fold, linear: Linear) -> Linear:
    """A linearisation that was whitened by a naming's noise, whitened by a fold's."""
    p = linear.nuisance.shape[1]
    all_of_it = np.column_stack([linear.residual, linear.nuisance, linear.effect])
    raw = raised(factors(naming.noise.covariance), all_of_it)
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
    raw = raised(factors(naming.noise.covariance), all_of_it)
    own = [p.sigma**p.power for p in amplitudes(problem, linear.names)]
    sigma = np.concatenate([np.ones(linear.nuisance.shape[1]), own])
    functions = smooth_functions(problem)
    if laid is not None:
        a = laid.attachment
        functions.append(a.basis @ kernel_root(a, min(a.lengths)) * a.sigma)
    return raw[:, 0], np.column_stack([raw[:, 1:] * sigma, *functions])


def best_scale(linear: Linear, naming: Naming, columns: Array) -> float:
    """Most probable setting scale with ``columns`` (unit prior variance) among the nuisances."""
    k = columns.shape[1]
    every = Term(tuple(range(k)), (1.0,) * k, (k, 0, 0), 0.0)
    cells = settings.log_cells(linear, columns, naming.setting_scales, naming.scale_weights, [every])
    return float(naming.setting_scales[int(np.argmax(cells))])


def excess(linear: Linear, residual: Array, test: NDArray[np.bool_], scale: float) -> float:
    """χ² of left-out data with their nuisances marginalised at the priors, less its expectation."""
    n_cols, r = linear.nuisance[test], residual[test]
    s = np.where(linear.scaled, scale, 1.0)
    factor = precision(n_cols, s)
    cross = n_cols.T @ r
    return float(r @ r - cross @ cho_solve(factor, cross)) - int(test.sum())


Choices = Sequence[tuple[Effects, list[Term]]]
"""Sets of effects to choose from, and their integrals over the columns of the whole catalogue."""


def choices(problem: Problem, fold: Fold) -> Choices:
    """Every set that the search weighed, about the linearisation of the folds."""
    place = {n: i for i, n in enumerate(fold.linear.names)}
    nodes = {}
    for e in problem.catalogue:
        # One node of the shape grid stands for all: its share of the prior comes with it.
        share = -sum(float(np.log(len(p.grid))) for p in e.parameters if p.grid)
        nodes[e.name] = (screen.Node({}, tuple(place[p.name] for p in e.parameters if p.name in place), share),)
    none = np.zeros((0, 0))
    catalogue = screen.Catalogue({e.name: e for e in problem.catalogue}, nodes, none, none)
    cache: dict[str, list[Term]] = {}
    weighed = [(), *(effects for effects, _, _ in fold.naming.screened)]
    return [(effects, screen.hypothesis_terms(catalogue, effects, cache)) for effects in weighed]


def choose(
    problem: Problem, fold: Fold, prepared: tuple[Prepared, ...], sets: Choices
) -> tuple[Effects, Attached | None]:
    """The most probable explanation by the training settings: a set of effects, or else an attachment."""
    train, known = only(fold.linear, ~fold.test), [e.name for e in problem.catalogue]
    scales, weights = fold.naming.setting_scales, fold.naming.scale_weights
    found = screen.weigh(train, train.effect, scales, weights, sets)
    found = {effects: z + log_prior(effects, known) for effects, z in found.items()}
    named = max(found, key=lambda h: found[h])
    # About the same point as the names: else they would be weighed on two different scales.
    plain = replace(fold.linear, effect=fold.linear.effect[:, :0], names=())
    seen = whitened(problem, prepared, fold.naming.noise.covariance, ~fold.test)
    laid = weigh(problem, fold.naming, seen, keep=~fold.test, linear=plain, log_evidence=found[()])
    if laid and laid[0].log_evidence > found[named]:
        return (), laid[0]
    return named, None


def sized(problem: Problem, fold: Fold, about: Linear, effects: Effects) -> tuple[Array, float]:
    """Residual of all data beside effects as large as the training settings show them, and the setting scale there."""
    train = only(about, ~fold.test)
    sigma = {p.name: p.sigma**p.power for e in problem.catalogue if e.name in effects for p in e.parameters}
    own = [i for i, n in enumerate(about.names) if n in sigma]
    size = np.array([sigma[about.names[i]] for i in own])
    scale = best_scale(train, fold.naming, train.effect[:, own] * size)
    return about.residual - about.effect @ estimate(space(problem, train, scale), effects), scale


def predict(problem: Problem, fold: Fold, prepared: tuple[Prepared, ...], sets: Choices) -> Prediction:
    """Choose and fit on the training settings, predict the left-out ones."""
    effects, laid = choose(problem, fold, prepared, sets)
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
    sets = choices(problem, many[0])
    for fold in many:
        made = predict(problem, fold, prepared, sets)
        chosen.append(made.chosen)
        total_before += excess(fold.naming.linear, made.before, fold.test, made.scale)
        total_after += excess(fold.linear, made.after, fold.test, made.scale)
        for source, at, out in ((made.before, fold.naming.linear, before), (made.after, fold.linear, after)):
            own = np.where(fold.test, source, 0.0)
            there = replace(at, nuisance=np.where(fold.test[:, None], at.nuisance, 0.0))
            pull, _ = nuisance_posterior(there, own, made.scale)
            left = raised(factors(fold.naming.noise.covariance), own - there.nuisance @ pull)
            out[fold.test] = left[fold.test]
    held = HeldOut(len(many), n, total_before, total_after, float(np.sqrt(2 * n)))
    return Shown(held, before, after, tuple(chosen))


@dataclass(frozen=True)
class Model:
    """What a model says of the left-out settings.

    Attributes
    ----------
    about : tuple of Linear
        Of every fold, with the nuisances that are marginalised.
    residual : tuple of (n,)
        Whitened.
    scale : tuple of float
        Setting scale.
    """

    about: tuple[Linear, ...]
    residual: tuple[Array, ...]
    scale: tuple[float, ...]


def stated(problem: Problem, many: Sequence[Fold]) -> Model:
    """The simulation as stated, settings fitted."""
    return _of(problem, many, [f.naming.linear for f in many], ())


def named(problem: Problem, naming: Naming, many: Sequence[Fold], fit: Fit) -> Model:
    """A hypothesis with the sizes that the other settings give its effects, about its own fit."""
    return _of(problem, many, [beside(problem, naming, fold, fit.linear) for fold in many], fit.effects)


def _of(problem: Problem, many: Sequence[Fold], about: Sequence[Linear], effects: Effects) -> Model:
    found = [sized(problem, fold, at, effects) for fold, at in zip(many, about, strict=True)]
    return Model(tuple(about), tuple(r for r, _ in found), tuple(scale for _, scale in found))


def about_folds(problem: Problem, many: Sequence[Fold], fit: Fit) -> Model:
    """`named`, about the point that the folds were given."""
    return _of(problem, many, [fold.linear for fold in many], fit.effects)


Shape = Callable[[Attachment, Array, Linear, float], Array]
"""Coefficients of a function from its whitened basis, what it is laid on, and the setting scale."""


def function(problem: Problem, many: Sequence[Fold], laid: Attached, on: Fit, shape: Shape | None = None) -> Model:
    """A function without a name beside a hypothesis' amplitudes, all as the other settings show them.

    With ``shape`` its coefficients are that's, not those of the Gaussian process.
    """
    attachment = laid.attachment
    one = replace(problem, attachments=(attachment,))
    prepared = prepare(one, many[0].naming.noise.covariance) if many else ()
    about, residual, scales = [], [], []
    for fold in many:
        keep, covariance = ~fold.test, fold.naming.noise.covariance
        places = [fold.linear.names.index(n) for n in on.linear.names if n in fold.linear.names]
        own = replace(
            fold.linear, effect=fold.linear.effect[:, places], names=tuple(fold.linear.names[i] for i in places)
        )
        seen = whitened(one, prepared, covariance, keep)
        fitted = weigh(one, fold.naming, seen, keep=keep, linear=own, log_evidence=0.0)[0]
        white, _ = whiten(problem, covariance, attachment.basis)
        base, p = absorb(problem, own), own.nuisance.shape[1]
        train = only(base, keep)
        found = fitted.coefficients if shape is None else shape(attachment, white[keep], train, fitted.scale)
        left = own.residual - white @ found
        mean, _ = nuisance_posterior(train, left[keep], fitted.scale)
        about.append(own)
        residual.append(left - base.nuisance[:, p:] @ mean[p:])
        scales.append(fitted.scale)
    return Model(tuple(about), tuple(residual), tuple(scales))


def gain(many: Sequence[Fold], before: Model, after: Model) -> tuple[float, float]:
    """By how much left-out χ² falls from one model to another, and its sigma: that of the noise, or, if it is larger,
    as the folds scatter; what neither model has adds to that and is in no noise."""
    first, second, power = by_fold(many, before, after)
    each = first - second
    scatter = float(np.sqrt(len(each)) * np.std(each, ddof=1))
    return float(each.sum()), max(2.0 * float(np.sqrt(max(power.sum(), 0.0))), scatter)


def by_fold(many: Sequence[Fold], before: Model, after: Model) -> Array:
    """Left-out excess χ² of two models, and the squared norm of their difference there, of every fold, (3, folds)."""
    out = np.zeros((3, len(many)))
    for k, fold in enumerate(many):
        shift = before.residual[k] - after.residual[k]
        out[0, k] = excess(before.about[k], before.residual[k], fold.test, before.scale[k])
        out[1, k] = excess(after.about[k], after.residual[k], fold.test, after.scale[k])
        out[2, k] = excess(after.about[k], shift, fold.test, after.scale[k]) + int(fold.test.sum())
    return out


def simplest(problem: Problem, naming: Naming, many: Sequence[Fold], fits: Sequence[Fit]) -> Fit:
    """The best-predicting of several hypotheses, or a part of it that predicts as well.

    Parameters
    ----------
    problem : Problem
    naming : Naming
    many : sequence of Fold
    fits : sequence of Fit
        Converged; the first is taken where nothing can be left out.
    """
    if not many or len(fits) < 2:
        return fits[0]
    models = [named(problem, naming, many, f) for f in fits]
    won = [gain(many, models[0], m)[0] for m in models]
    best = int(np.argmax(won))
    for k in sorted(range(len(fits)), key=lambda k: (len(fits[k].effects), -won[k])):
        lost, sigma = gain(many, models[k], models[best])
        if set(fits[k].effects) <= set(fits[best].effects) and lost <= AS_WELL * sigma:
            return fits[k]
    return fits[best]
