"""From a problem to what is missing, where, how large, and how sure: the steps of the diagnosis in their order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from benchsim.diagnosis import (
    cross_validation,
    degeneracy,
    detection_limits,
    discrepancy,
    levels,
    location,
    new_law,
    next_experiment,
    settings,
    verdict,
)
from benchsim.diagnosis.decision import Judged, judge
from benchsim.diagnosis.degeneracy import Best
from benchsim.diagnosis.discrepancy import Attached
from benchsim.diagnosis.hypothesis import Effects, Fit, Naming
from benchsim.diagnosis.linear import factors, nuisance_posterior, predict_all, raised, whiten
from benchsim.diagnosis.naming import name
from benchsim.diagnosis.next_experiment import Alive
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Class, Diagnosis, Found, Law, Left, Residuals, Size, SplitBy
from benchsim.diagnosis.search import MATTERS
from benchsim.diagnosis.verdict import Findings

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


def diagnose(problem: Problem, progress: Progress | None = None) -> Diagnosis:
    """Say whether anything is missing from the prediction, where, what, how large, and what would settle the rest.

    Parameters
    ----------
    problem : Problem
    progress : callable, optional
        Called with what is being done and the fraction done.

    Returns
    -------
    Diagnosis

    Raises
    ------
    ValueError
        If the data are not blocks with finite numbers, or the prediction is not finite as stated.
    """
    tell = progress or (lambda what, done: None)
    return conclude(problem, name(problem, lambda what, done: tell(what, 0.6 * done)), tell)


def conclude(problem: Problem, naming: Naming, progress: Progress | None = None) -> Diagnosis:
    """Everything after the hypotheses of the catalogue have been weighed."""
    tell = progress or (lambda what, done: None)
    tell("functions without a name", 0.62)
    judged = judge(problem, naming)
    said, place, on, best, findings = judged.verdict, judged.place, judged.on, judged.best, judged.findings
    found, opened = judged.found, judged.classes
    notes = list(judged.notes)
    tell("settings left out", 0.8)
    # Where nobody stated the errors, the model that predicts best is stated already, whatever a function would fit.
    laid = (
        location.winner(findings, place) if said == "located" and not (problem.judged_forward and on.effects) else None
    )
    many = judged.folds
    law: Law | None = None
    if laid is not None:
        about = degeneracy.about(naming.linear, on if findings.stands else naming.null)
        about = replace(about, residual=laid.linear.residual, nuisance=laid.linear.nuisance)
        beside = cross_validation.folds(problem, naming, about, laid)
        law, why = new_law.law(problem, naming, on if findings.stands else naming.null, laid, beside)
        notes += [why] if why else []
        if law is None and not findings.stands and on.effects:
            # Names that predict are stated rather than a function that does not; both would count the same twice.
            laid = None
        else:
            many = beside
        if law is not None and not findings.stands:
            on, found, opened = naming.null, (), ()
    seen = naming
    if laid is not None:
        seen = replace(naming, noise=cross_validation.noise_beside(problem, naming, about, laid))
    shown = cross_validation.show(problem, many, judged.prepared)
    tell("what could be told apart", 0.93)
    grouped, ahead = _open(problem, naming, judged, said, found, opened)
    stated = on.effects == best.fit.effects
    within = best.space if stated else degeneracy.space(problem, degeneracy.about(naming.linear, on), on.setting_scale)
    sizes = detection_limits.limits(problem, within, naming.linear.names, on.effects)
    sigma = np.sqrt(np.concatenate([np.diag(c) for c in seen.noise.covariance]))
    residuals = _residuals(problem, naming, on, laid, shown, sigma)
    first = next((k for k in ("c", *seen.noise.scale) if k in seen.noise.scale), None)
    notes += _remarks(problem, seen, findings)
    known = [e.name for e in problem.catalogue] + [settings.NAME] * bool(problem.stated)
    tell("done", 1.0)
    return Diagnosis(
        verdict=said,
        effects=found,
        classes=grouped,
        location=place,
        law=law,
        rms=_rms(problem, residuals),
        held_out=None if shown is None else shown.held_out,
        pulls={p.name: float(on.values.get(p.name, 0.0) / p.sigma) for p in problem.nuisances},
        limits=sizes,
        next=ahead,
        sigma_scale=float(seen.noise.scale[first]) if first else 1.0,
        correlation=float(seen.noise.correlation.get(first, 0.0)) if first else 0.0,
        setting_scale=on.setting_scale,
        probability=best.hypotheses.present(known),
        values=dict(on.values),
        residuals=residuals,
        notes=tuple(notes),
        left=tuple(Left(n, findings.left.chance(n), findings.left.families[n].rms) for n in findings.left.alarming),
    )


def _open(
    problem: Problem,
    naming: Naming,
    judged: Judged,
    said: str,
    found: Sequence[Found],
    groups: tuple[tuple[Effects, ...], ...],
) -> tuple[tuple[Class, ...], tuple[SplitBy, ...]]:
    """Classes with what would split them, and what to record next."""
    best = judged.best
    unnamed = said in ("located", "unexplained")
    doubt = {f.name for f in found if f.confidence != "named"}
    if not groups and not unnamed and not doubt:
        return (), ()
    further = problem.next_recordings() if problem.next_recordings is not None else ()

    def rank(alive: Sequence[Alive]) -> tuple[SplitBy, ...]:
        return next_experiment.rank(problem, best.linear, best.fit.setting_scale, best.space, alive, further)

    lone = tuple(f.name for f in found)
    everyone: list[Alive] = []
    made = []
    for k, members in enumerate(groups):
        # The other classes stand at their most probable member while this one is split.
        rest = (*lone, *(e for j, g in enumerate(groups) if j != k for e in g[0]))
        alive = _alive(best, [(*m, *rest) for m in members])
        everyone += alive
        # All members are stated as open: what splits them is sought whichever of them it is.
        even = [replace(a, probability=1 / len(alive)) for a in alive]
        ranked = rank(even)
        sizes = tuple(_sizes(problem, (judged.on, *naming.fits), m, rest) for m in members)
        stated = bool(members[0]) and {*members[0]} <= {*judged.on.effects, settings.NAME}
        first = ranked[0] if ranked else None
        made.append(Class(members, _together(best, members, rest), first, sizes, stated))
    if unnamed:
        top = sorted((h for h in best.hypotheses.log_evidence.items() if h[0]), key=lambda h: -h[1])
        everyone = _alive(best, [h for h, _ in top[: levels.MEMBERS]])
    elif not groups:
        own = best.fit.effects
        everyone = _alive(best, (own, tuple(e for e in own if e not in doubt)))
    # What is open is one class: what to record next is what tells its members apart.
    return tuple(made), ranked if len(made) == 1 and not unnamed else rank(everyone)


def _sizes(problem: Problem, fits: Sequence[Fit], member: Effects, rest: Effects) -> dict[str, Size]:
    """Of a member's effects, from the first fit of just these and the rest that converged."""
    whole = {*member, *rest} - {settings.NAME}
    fit = next((f for f in fits if f.converged and set(f.effects) == whole), None)
    own = [e for e in problem.catalogue if e.name in member]
    return {k: v for e in own for k, v in verdict.sizes(e, fit).items()} if fit is not None else {}


def _together(best: Best, members: Sequence[Effects], rest: Effects) -> float:
    """That one of the members is there; with nothing among them, that none is but it and the ``rest``."""
    if () not in members:
        return best.hypotheses.probability(members)
    z = best.hypotheses.log_evidence
    listed = [z[h] for h in z if set(h) in [{*m, *rest} for m in members]]
    return float(np.exp(logsumexp(listed) - logsumexp(list(z.values())))) if listed else 0.0


def _alive(best: Best, sets: Sequence[Effects]) -> list[Alive]:
    """Sets with their shares of the probability among themselves and their amplitudes."""
    z = {frozenset(h): v for h, v in best.hypotheses.log_evidence.items()}
    values = np.array([z.get(frozenset(s), min(z.values())) for s in sets])
    shares = np.exp(values - values.max())
    shares /= shares.sum()
    return [Alive(s, float(p), degeneracy.estimate(best.space, s)) for s, p in zip(sets, shares, strict=True)]


def _residuals(
    problem: Problem, naming: Naming, on: Fit, laid: Attached | None, shown: cross_validation.Shown | None, sigma: Array
) -> Residuals:
    before = problem.data - predict_all(problem, naming.null.values)
    if laid is None:
        after = problem.data - predict_all(problem, on.values)
    else:
        # To first order: the function at its most probable, then nuisances and amplitudes fitted anew.
        base = discrepancy.absorb(problem, laid.linear)
        white, _ = whiten(problem, naming.noise.covariance, laid.attachment.basis)
        rest = base.residual - white @ laid.coefficients
        pull, _ = nuisance_posterior(base, rest, laid.scale)
        after = raised(factors(naming.noise.covariance), rest - base.nuisance @ pull)
    nothing = np.full(len(before), np.nan)
    without, found = (nothing, nothing) if shown is None else (shown.before, shown.after)
    return Residuals(before, after, without, found, sigma)


def _rms(problem: Problem, residuals: Residuals) -> Mapping[str, tuple[float, float]]:
    both = np.stack([residuals.before, residuals.after], axis=1)
    mean = {str(k): np.mean(both[problem.kind == k] ** 2, axis=0) for k in np.unique(problem.kind)}
    return {k: (float(np.sqrt(before)), float(np.sqrt(after))) for k, (before, after) in mean.items()}


def _remarks(problem: Problem, naming: Naming, findings: Findings) -> list[str]:
    """Sentences on what limits the conclusion."""
    out = []
    stated = np.concatenate([np.diag(c) for c in problem.covariance])
    seen = np.concatenate([np.diag(c) for c in naming.noise.covariance])
    for kind in np.unique(problem.kind):
        mine = problem.kind == kind
        factor = float(np.sqrt(np.mean(seen[mine] / stated[mine])))
        if factor > levels.FURTHER_OFF:
            length = naming.noise.correlation.get(str(kind), 0.0)
            shared = f", correlated over {length:.2g}" if length > 0 else ""
            out.append(
                f"Errors of kind {kind} are {factor:.2g} times as large as stated{shared}: an effect that looks like "
                "such noise would be hidden."
            )
    near = naming.fits[0].log_evidence - MATTERS
    lost = [f for f in naming.fits if f.effects and not f.converged and f.log_evidence > near]
    if lost:
        out.append(f"Not converged, so nothing rests on it: {', '.join(' + '.join(f.effects) for f in lost)}.")
    if not naming.null.converged:
        out.append("Settings alone were not followed to their end: their probability is a lower bound.")
    if len(set(problem.groups)) < cross_validation.FEWEST:
        out.append("Fewer than three settings: none can be left out to test the prediction.")
    if findings.claim is not None and findings.refuted:
        out.append(
            f"{' + '.join(findings.claim.best)} leaves more than noise, and settings left out are not clearly better "
            "predicted with it: it may stand for something else."
        )
    elif findings.claim is not None and not findings.stands:
        of = findings.free[0].attachment
        how = "" if findings.outdone is None else f", and settings left out, by {findings.outdone:.1f} sigma"
        out.append(
            f"An unknown function of {of.coordinate} ({of.element}) explains the data better than "
            f"{' + '.join(findings.claim.best)}, by {-findings.margin:.1f} in ln Z{how}."
        )
    return out
