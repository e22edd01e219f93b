"""From a problem to what is missing, where, how large, and how sure: the steps of the diagnosis in their order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import attachments, classes, following, held_out, laws, limits, location, remainder, verdict
from benchsim.diagnosis.attachments import Attached
from benchsim.diagnosis.classes import Claim, Space, Weighed
from benchsim.diagnosis.curvature import Curvature
from benchsim.diagnosis.fits import Effects, Fit, Naming
from benchsim.diagnosis.following import Alive
from benchsim.diagnosis.linear import Linear, marginal, nuisance_posterior, predict_all, whiten
from benchsim.diagnosis.location import Explanation
from benchsim.diagnosis.naming import name
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Class, Diagnosis, Found, Law, Location, Residuals, SplitBy
from benchsim.diagnosis.shapes import widened
from benchsim.diagnosis.verdict import Findings

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

REFINED = 4
"""Attachments that are weighed about their own nuisances."""

CONCERN = 12.0
"""ln Z behind the best at which an attachment is left as it is."""


def diagnose(problem: Problem, progress: Progress | None = None, *, bends: Curvature | None = None) -> Diagnosis:
    """Say whether anything is missing from the prediction, where, what, how large, and what would settle the rest.

    Parameters
    ----------
    problem : Problem
    progress : callable, optional
        Called with what is being done and the fraction done.
    bends : Curvature, optional
        `curvature.measure` of this prediction, where several data sets share it; default measured here.

    Returns
    -------
    Diagnosis

    Raises
    ------
    ValueError
        If the data are not blocks with finite numbers, or the prediction is not finite as stated.
    """
    tell = progress or (lambda what, done: None)
    return conclude(problem, name(problem, lambda what, done: tell(what, 0.6 * done), bends=bends), tell)


LITTLE = 0.05
"""Part of a misfit's excess χ² that a location may leave unexplained."""

LOUD = 1.3
"""Errors over stated ones from which on a remark is due."""


@dataclass(frozen=True)
class _Best:
    """The hypothesis that the catalogue stands by: its fit, its claim, and the space about it."""

    fit: Fit
    claim: Claim | None
    hypotheses: Weighed
    linear: Linear
    space: Space


@dataclass(frozen=True)
class Judged:
    """What is said, before it is tested on settings left out.

    ``on`` is the hypothesis that stands, the null where no name does; ``best`` is the catalogue's in either case.
    """

    verdict: str
    found: tuple[Found, ...]
    place: Location | None
    on: Fit
    best: _Best
    findings: Findings
    prepared: tuple[attachments.Prepared, ...]
    notes: tuple[str, ...]


def judge(problem: Problem, naming: Naming) -> Judged:
    """Let names and functions without a name compete, look for what is left, and apply the rules."""
    notes: list[str] = []
    best = _best(problem, naming, notes)
    prepared = attachments.prepare(problem, naming.noise.covariance)
    free = _weigh(problem, naming, prepared, naming.null, best.fit)
    more = free if best.claim is None else _weigh(problem, naming, prepared, best.fit, best.fit)
    modes = remainder.modes(problem, naming.linear, naming.noise.covariance)
    findings = Findings(
        naming.null.log_evidence,
        best.claim,
        best.fit.log_evidence,
        free,
        more,
        _left(problem, naming, naming.null, modes),
        _left(problem, naming, best.fit, modes),
        best.claim is None or not more or _with(problem, naming, more[0], modes)[1].acceptable,
        best.fit.setting_scale if problem.stated else 1.0,
    )
    if findings.stands and more and more[0].log_evidence - best.fit.log_evidence > verdict.MISSING:
        best = _beside(problem, naming, best, more[0])
        findings = replace(findings, claim=best.claim)
    on = best.fit if findings.stands else naming.null
    missing = findings.claim is not None or findings.something_left
    place = _place(problem, naming, best, findings, modes, on) if missing else None
    said = verdict.verdict(findings, place)
    lone = findings.claim.lone if findings.claim is not None and findings.stands else ()
    stated = widened(problem, naming.noise.covariance, best.fit, lone)
    found, more_notes = verdict.found(problem, findings, stated, best.hypotheses)
    return Judged(said, found, place, on, best, findings, prepared, (*notes, *more_notes))


def conclude(problem: Problem, naming: Naming, tell: Progress) -> Diagnosis:
    """Everything after the hypotheses of the catalogue have been weighed."""
    tell("functions without a name", 0.62)
    judged = judge(problem, naming)
    said, place, on, best, findings = judged.verdict, judged.place, judged.on, judged.best, judged.findings
    notes = list(judged.notes)
    tell("settings left out", 0.8)
    laid = _winner(findings, place) if said == "located" else None
    about = classes.about(naming.linear, on)
    if laid is not None:
        about = replace(about, residual=laid.linear.residual, nuisance=laid.linear.nuisance)
    many = held_out.folds(problem, naming, about)
    shown = held_out.show(problem, many, judged.prepared)
    law: Law | None = None
    if laid is not None:
        law, why = laws.law(problem, naming, on, laid, many)
        notes += [why] if why else []
    tell("what could be told apart", 0.93)
    grouped, ahead = _open(problem, best, findings, said)
    within = best.space if findings.stands else classes.space(problem, naming.linear, naming.null.setting_scale)
    sizes = limits.limits(problem, within, naming.linear.names, on.effects)
    residuals = _residuals(problem, naming, on, laid, shown)
    first = next((k for k in ("c", *naming.noise.scale) if k in naming.noise.scale), None)
    notes += _remarks(problem, naming, best, findings, said)
    tell("done", 1.0)
    return Diagnosis(
        verdict=said,
        effects=judged.found,
        classes=grouped,
        location=place,
        law=law,
        rms=_rms(problem, residuals),
        held_out=None if shown is None else shown.held_out,
        pulls={p.name: float(on.values.get(p.name, 0.0) / p.sigma) for p in problem.nuisances},
        limits=sizes,
        next=ahead,
        sigma_scale=float(naming.noise.scale[first]) if first else 1.0,
        correlation=float(naming.noise.correlation.get(first, 0.0)) if first else 0.0,
        setting_scale=on.setting_scale,
        probability=naming.probability,
        values=dict(on.values),
        residuals=residuals,
        notes=tuple(notes),
    )


def _best(problem: Problem, naming: Naming, notes: list[str]) -> _Best:
    """The most probable converged hypothesis, without the effects that are not likely."""
    hypotheses = classes.weighed(naming)
    null = _Best(
        naming.null,
        None,
        hypotheses,
        naming.linear,
        classes.space(problem, naming.linear, naming.null.setting_scale),
    )
    fits = {f.effects: f for f in naming.fits if f.converged and f.effects}
    if not fits:
        return null
    fit = max(fits.values(), key=lambda f: f.log_evidence)
    while fit.effects:
        linear = classes.about(naming.linear, fit)
        within = classes.space(problem, linear, fit.setting_scale)
        signal = classes.amplitude_vector(problem, naming.linear.names, fit)
        hypotheses = classes.complete(classes.weighed(naming), fit.effects, within)
        kept = classes.likely(hypotheses, fit.effects, signal, within)
        if kept == fit.effects:
            claim = classes.claim(hypotheses, fit.effects, signal, within)
            return _Best(fit, claim, hypotheses, linear, within)
        dropped = [e for e in fit.effects if e not in kept]
        if not kept:
            break
        notes.append(f"{' and '.join(dropped)}: hinted at, not likely enough to be said.")
        if kept not in fits:
            # The smaller set was never refitted: nothing may be claimed from it, the larger one keeps its place.
            claim = classes.claim(hypotheses, fit.effects, signal, within)
            return _Best(fit, claim, hypotheses, linear, within)
        fit = fits[kept]
    return null


def _beside(problem: Problem, naming: Naming, best: _Best, laid: Attached) -> _Best:
    """The claim where a function without a name lies on it: what that can imitate does not tell rivals apart."""
    white, _ = whiten(problem, naming.noise.covariance, laid.attachment.basis)
    linear = attachments.with_columns(best.linear, white @ laid.root)
    within = classes.space(problem, linear, best.fit.setting_scale)
    signal = classes.amplitude_vector(problem, naming.linear.names, best.fit)
    claim = classes.claim(best.hypotheses, best.fit.effects, signal, within)
    return replace(best, claim=claim, linear=linear, space=within)


def _weigh(
    problem: Problem, naming: Naming, prepared: tuple[attachments.Prepared, ...], on: Fit, best: Fit
) -> tuple[Attached, ...]:
    """All attachments on one hypothesis, those that could matter beside the best about their own nuisances."""
    rival = max(on.log_evidence, best.log_evidence)
    laid = list(attachments.weigh(problem, naming, prepared, on))
    seen: set[str] = set()
    for _ in range(REFINED):
        top = [a for a in laid if a.attachment.name not in seen and a.log_evidence > laid[0].log_evidence - CONCERN]
        # What explains no more than nothing does, or than names do, need not be known to a digit.
        if not top or top[0].log_evidence < rival - CONCERN:
            break
        seen.add(top[0].attachment.name)
        again = attachments.refine(problem, naming, prepared, top[0], on, rival - verdict.NAMED_MARGIN)
        laid = [again if a.attachment.name == again.attachment.name else a for a in laid]
        laid.sort(key=lambda a: -a.log_evidence)
    return tuple(laid)


def _left(problem: Problem, naming: Naming, fit: Fit, modes: remainder.Modes) -> remainder.Remainder:
    free = naming.noise.freedom
    return remainder.remainder(attachments.absorb(problem, fit.linear), modes, fit.setting_scale, free)


def _with(
    problem: Problem, naming: Naming, laid: Attached, modes: remainder.Modes
) -> tuple[Linear, remainder.Remainder]:
    """The problem with a function on it, and what the smooth modes leave then."""
    white, _ = whiten(problem, naming.noise.covariance, laid.attachment.basis)
    with_it = attachments.with_columns(attachments.absorb(problem, laid.linear), white @ laid.root)
    return with_it, remainder.remainder(with_it, modes, laid.scale, naming.noise.freedom)


def _place(
    problem: Problem, naming: Naming, best: _Best, findings: Findings, modes: remainder.Modes, on: Fit
) -> Location | None:
    """The element: of what is left if names stand and something is left, else of the whole misfit."""
    covariance = naming.noise.covariance
    rest = findings.stands and findings.something_left
    base = on if rest else naming.null
    ground = attachments.absorb(problem, base.linear)
    stretches = location.scan(problem, ground, covariance, base.setting_scale)
    explanations = []
    coordinate: dict[str, str] = {}
    for laid in findings.more if rest else findings.free:
        a = laid.attachment
        coordinate.setdefault(a.element, a.coordinate)
        with_it, rest_of_it = _with(problem, naming, laid, modes)
        left = 0.0 if rest_of_it.acceptable else _unexplained(with_it, laid.scale, ground, base.setting_scale)
        explanations.append(Explanation(a.element, a.coordinate, laid.log_evidence, left))
    if not rest:
        element = {e.name: e.element for e in problem.catalogue}
        fits = {f.effects: f for f in naming.fits if f.converged}
        for effects, value in best.hypotheses.log_evidence.items():
            of = {element[e] for e in effects}
            if len(of) != 1:
                continue
            only = of.pop()
            nothing = effects in fits and _left(problem, naming, fits[effects], modes).acceptable
            explanations.append(Explanation(only, coordinate.get(only, ""), value, 0.0 if nothing else np.inf))
    if findings.stands and not rest and len({e.element for e in problem.catalogue if e.name in on.effects}) > 1:
        return None
    return location.locate(explanations, stretches)


def _unexplained(with_it: Linear, scale: float, base: Linear, base_scale: float) -> float:
    """Half of the excess χ² that a function leaves, if that is little of what there was; else infinity."""

    def excess(lin: Linear, s: float) -> float:
        m = marginal(lin, np.zeros((len(lin.residual), 0)), s)
        return m.chi2 - m.n

    before, after = excess(base, base_scale), max(excess(with_it, scale), 0.0)
    return 0.5 * after if after < LITTLE * before else np.inf


def _winner(findings: Findings, place: Location | None) -> Attached | None:
    """The best attachment of the element that was claimed."""
    laid = findings.more if findings.stands else findings.free
    return next((a for a in laid if place is not None and a.attachment.element == place.element), None)


def _open(
    problem: Problem, best: _Best, findings: Findings, said: str
) -> tuple[tuple[Class, ...], tuple[SplitBy, ...]]:
    """Classes with what would split them, and what to record next."""
    groups = best.claim.classes if best.claim is not None and findings.stands else ()
    unnamed = said in ("located", "unexplained")
    if not groups and not unnamed:
        return (), ()
    further = problem.further() if problem.further is not None else ()
    lone = best.claim.lone if best.claim is not None and findings.stands else ()
    everyone: list[Alive] = []
    made = []
    for k, members in enumerate(groups):
        # The other classes stand at their most probable member while this one is split.
        rest = (*lone, *(e for j, g in enumerate(groups) if j != k for e in g[0]))
        alive = _alive(best, [(*m, *rest) for m in members])
        everyone += alive
        # All members are stated as open: what splits them is sought whichever of them it is.
        even = [replace(a, probability=1 / len(alive)) for a in alive]
        ranked = following.rank(problem, best.linear, _scale(best), best.space, even, further)
        probability = best.hypotheses.probability(members)
        made.append(Class(members, probability, ranked[0] if ranked else None))
    if unnamed:
        top = sorted((h for h in best.hypotheses.log_evidence.items() if h[0]), key=lambda h: -h[1])[: classes.MEMBERS]
        everyone = _alive(best, [h for h, _ in top])
    return tuple(made), following.rank(problem, best.linear, _scale(best), best.space, everyone, further)


def _scale(best: _Best) -> float:
    return best.fit.setting_scale


def _alive(best: _Best, sets: Sequence[Effects]) -> list[Alive]:
    """Sets with their shares of the probability among themselves and their amplitudes."""
    z = {frozenset(h): v for h, v in best.hypotheses.log_evidence.items()}
    values = np.array([z.get(frozenset(s), min(z.values())) for s in sets])
    shares = np.exp(values - values.max())
    shares /= shares.sum()
    return [Alive(s, float(p), classes.estimate(best.space, s)) for s, p in zip(sets, shares, strict=True)]


def _residuals(
    problem: Problem, naming: Naming, on: Fit, laid: Attached | None, shown: held_out.Shown | None
) -> Residuals:
    before = problem.data - predict_all(problem, naming.null.values)
    if laid is None:
        after = problem.data - predict_all(problem, on.values)
    else:
        # To first order: the function at its most probable, then nuisances and amplitudes fitted anew.
        base = attachments.absorb(problem, laid.linear)
        white, _ = whiten(problem, naming.noise.covariance, laid.attachment.basis)
        rest = base.residual - white @ laid.coefficients
        pull, _ = nuisance_posterior(base, rest, laid.scale)
        after = np.empty(len(rest))
        for b, c in enumerate(naming.noise.covariance):
            rows = problem.rows(b)
            after[rows] = np.linalg.cholesky(c) @ (rest - base.nuisance @ pull)[rows]
    sigma = np.sqrt(np.concatenate([np.diag(c) for c in naming.noise.covariance]))
    nothing = np.full(len(before), np.nan)
    return Residuals(
        before,
        after,
        nothing if shown is None else shown.before,
        nothing if shown is None else shown.after,
        sigma,
    )


def _rms(problem: Problem, residuals: Residuals) -> Mapping[str, tuple[float, float]]:
    def one(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return {
        str(k): (one(residuals.before[problem.kind == k]), one(residuals.after[problem.kind == k]))
        for k in np.unique(problem.kind)
    }


def _remarks(problem: Problem, naming: Naming, best: _Best, findings: Findings, said: str) -> list[str]:
    """Sentences on what limits the conclusion."""
    out = []
    stated = np.concatenate([np.diag(c) for c in problem.covariance])
    seen = np.concatenate([np.diag(c) for c in naming.noise.covariance])
    for kind in np.unique(problem.kind):
        mine = problem.kind == kind
        factor = float(np.sqrt(np.mean(seen[mine] / stated[mine])))
        if factor > LOUD:
            length = naming.noise.correlation.get(str(kind), 0.0)
            shared = f", correlated over {length:.2g}" if length > 0 else ""
            out.append(
                f"Errors of kind {kind} are {factor:.2g} times as large as stated{shared}: an effect that looks like "
                "such noise would be hidden."
            )
    lost = [f for f in naming.fits if not f.converged]
    if lost:
        names = ", ".join(" + ".join(f.effects) or "the null" for f in lost)
        out.append(f"Not converged, so nothing rests on it: {names}.")
    if len(set(problem.groups)) < held_out.FEWEST:
        out.append("Fewer than three settings: none can be left out to test the prediction.")
    if findings.claim is not None and findings.scale >= verdict.STRETCHED and findings.left.acceptable:
        out.append(
            f"{' + '.join(findings.claim.best)} would explain the data if the settings were {findings.scale:.2g} times "
            "as far off as stated: either those statements are wrong, or something else is missing."
        )
    elif findings.claim is not None and not findings.stands:
        of = findings.free[0].attachment
        out.append(
            f"{' + '.join(findings.claim.best)} is the nearest name, but an unknown function of {of.coordinate} "
            f"({of.element}) explains the data better, by {-findings.margin:.1f} in ln Z."
        )
    if said == "nothing-missing":
        top, p = max(naming.probability.items(), key=lambda item: item[1], default=("", 0.0))
        if p >= 0.5:
            out.append(f"{top} is suspected, at a probability of {p:.2f}.")
    if said in ("unexplained", "located") and not (findings.left if findings.stands else findings.left_null).acceptable:
        left = findings.left if findings.stands else findings.left_null
        out.append(f"Smooth misfit that chance would leave with a probability of {left.p:.1e}.")
    return out
