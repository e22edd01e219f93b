"""Which model predicts settings that it was not fitted to: what is written into a file has to.

Evidence weighs hypotheses as if one of them were true. Where something small is always left, none is; then it goes on
adding what fits, and a free function, which fits anything, comes first. What counts there is what a model says of
settings that it has not seen (`cross_validation`): the difference of two models in left-out χ² is 2 ⟨Δ, n⟩ + what one
of them misses, so that its sigma is 2 |Δ|, Δ the whitened difference of their predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis.cross_validation import Fold, beside, excess, sized
from benchsim.diagnosis.discrepancy import Attached, prepare, weigh, whitened
from benchsim.diagnosis.fits import Effects, Fit, Naming
from benchsim.diagnosis.linear import Linear, whiten
from benchsim.diagnosis.problem import Problem

Array = NDArray[np.float64]

BETTER = 3.0
"""Sigma by which a model has to predict better to be said to."""

AS_WELL = 1.0
"""Sigma within which a simpler model predicts as well: a needless amplitude passes it in one of six cases, one that
stands out by 8 sigma fails it in one of four hundred."""


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


def function(problem: Problem, many: Sequence[Fold], laid: Attached) -> Model:
    """A function without a name, alone, fitted to the other settings."""
    one = replace(problem, attachments=(laid.attachment,))
    residual, scales = [], []
    prepared = prepare(one, many[0].naming.noise.covariance) if many else ()
    for fold in many:
        keep, plain = ~fold.test, replace(fold.linear, effect=fold.linear.effect[:, :0], names=())
        seen = whitened(one, prepared, fold.naming.noise.covariance, keep)
        fitted = weigh(one, fold.naming, seen, keep=keep, linear=plain, log_evidence=0.0)[0]
        white, _ = whiten(problem, fold.naming.noise.covariance, laid.attachment.basis)
        residual.append(fold.linear.residual - white @ fitted.coefficients)
        scales.append(fitted.scale)
    return Model(tuple(f.linear for f in many), tuple(residual), tuple(scales))


def gain(many: Sequence[Fold], before: Model, after: Model) -> tuple[float, float]:
    """By how much left-out χ² falls from one model to another, and its sigma: that of the noise, or, if it is larger,
    as the folds scatter; what neither model has adds to that and is in no noise."""
    each, power = [], 0.0
    for k, fold in enumerate(many):
        before_it = excess(before.about[k], before.residual[k], fold.test, before.scale[k])
        each.append(before_it - excess(after.about[k], after.residual[k], fold.test, after.scale[k]))
        shift = before.residual[k] - after.residual[k]
        power += excess(after.about[k], shift, fold.test, after.scale[k]) + int(fold.test.sum())
    scatter = float(np.sqrt(len(each)) * np.std(each, ddof=1))
    return float(np.sum(each)), max(2.0 * float(np.sqrt(max(power, 0.0))), scatter)


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
