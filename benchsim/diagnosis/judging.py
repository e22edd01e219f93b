"""Names and functions without a name compete; the rules are applied to what they leave: the verdict and the place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import attachments, classes, evidence, location, remainder, verdict
from benchsim.diagnosis.attachments import Attached
from benchsim.diagnosis.classes import Claim, Space, Weighed
from benchsim.diagnosis.fits import Effects, Fit, Naming
from benchsim.diagnosis.linear import Linear, linearise, marginal, predict_all, whiten
from benchsim.diagnosis.location import Explanation
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Found, Location
from benchsim.diagnosis.shapes import widened
from benchsim.diagnosis.verdict import Findings

Array = NDArray[np.float64]

REFINED = 4
"""Attachments that are weighed about their own nuisances."""

CONCERN = 12.0
"""ln Z behind the best at which an attachment is left as it is."""


LITTLE = 0.05
"""Part of a misfit's excess χ² that a location may leave unexplained."""


@dataclass(frozen=True)
class Best:
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
    best: Best
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
    if findings.stands and said == "unexplained" and findings.part_left > verdict.LEFT:
        findings, on = replace(findings, refuted=True), naming.null
        place = _place(problem, naming, best, findings, modes, on)
        said = verdict.verdict(findings, place)
    lone = findings.claim.lone if findings.claim is not None and findings.stands else ()
    stated = widened(problem, naming.noise.covariance, best.fit, lone)
    found, more_notes = verdict.found(problem, findings, stated, best.hypotheses)
    return Judged(said, found, place, on, best, findings, prepared, (*notes, *more_notes))


def _best(problem: Problem, naming: Naming, notes: list[str]) -> Best:
    """The most probable converged hypothesis, without the effects that are not likely."""
    hypotheses = classes.weighed(naming)
    null = Best(
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
    plain = _unstretched(problem, fit, fits.values())
    if plain is not None:
        return _or_settings(problem, naming, plain, fit, notes)
    while fit.effects:
        linear, within, signal, hypotheses = _about(problem, naming, fit)
        kept = classes.likely(hypotheses, fit.effects, signal, within)
        if kept == fit.effects:
            claim = classes.claim(hypotheses, fit.effects, signal, within)
            return Best(fit, claim, hypotheses, linear, within)
        if kept in fits and _unstretched(problem, fits[kept], [fit]) is not None:
            return _or_settings(problem, naming, fit, fits[kept], notes)
        dropped = [e for e in fit.effects if e not in kept]
        if not kept:
            break
        notes.append(f"{' and '.join(dropped)}: hinted at, not likely enough to be said.")
        if kept not in fits:
            # The smaller set was never refitted: nothing may be claimed from it, the larger one keeps its place.
            claim = classes.claim(hypotheses, fit.effects, signal, within)
            return Best(fit, claim, hypotheses, linear, within)
        fit = fits[kept]
    return null


def _about(problem: Problem, naming: Naming, fit: Fit) -> tuple[Linear, Space, Array, Weighed]:
    """What claims about a fit are judged in: the catalogue linearised there, its space, the fit's amplitudes in it, and
    all hypotheses, those that differ from it by one effect put in."""
    linear = classes.about(naming.linear, fit)
    within = classes.space(problem, linear, fit.setting_scale)
    signal = classes.amplitude_vector(problem, naming.linear.names, fit)
    return linear, within, signal, classes.complete(classes.weighed(naming), fit.effects, within)


def _stretched(problem: Problem, fit: Fit) -> bool:
    return problem.stated and fit.setting_scale >= verdict.STRETCHED


def _unstretched(problem: Problem, fit: Fit, others: Iterable[Fit]) -> Fit | None:
    """Where a fit needs settings further off than names are said on: the best that holds its effects and one more,
    with settings as stated, if it is about as probable."""
    if not fit.effects or not _stretched(problem, fit):
        return None
    found = [
        f
        for f in others
        if set(f.effects) > set(fit.effects)
        and len(f.effects) == len(fit.effects) + 1
        and not _stretched(problem, f)
        and f.log_evidence > fit.log_evidence - np.log(classes.LIKELY / (1 - classes.LIKELY))
    ]
    return max(found, key=lambda f: f.log_evidence, default=None)


def _or_settings(problem: Problem, naming: Naming, fit: Fit, stretched: Fit, notes: list[str]) -> Best:
    """A claim that leaves open whether its last effect is there, or settings are further off than stated instead."""
    (more,) = set(fit.effects) - set(stretched.effects)
    linear, within, signal, hypotheses = _about(problem, naming, fit)
    # What lacks the effect stands beside the same with it: that the settings may do its part is said once.
    known = {frozenset(h) for h in hypotheses.log_evidence}
    kept = {h: z for h, z in hypotheses.log_evidence.items() if more in h or frozenset((*h, more)) not in known}
    claim = classes.claim(replace(hypotheses, log_evidence=kept), fit.effects, signal, within)
    first = stretched.log_evidence > fit.log_evidence
    if more in claim.lone:
        pair: tuple[Effects, ...] = ((), (more,)) if first else ((more,), ())
        claim = replace(claim, lone=tuple(e for e in claim.lone if e != more), classes=(*claim.classes, pair))
    notes.append(
        f"Settings {stretched.setting_scale:.1f} times as far off as stated would do in place of {more}: if they may "
        "be so far off, state it and diagnose again."
    )
    return Best(fit, claim, hypotheses, linear, within)


def _beside(problem: Problem, naming: Naming, best: Best, laid: Attached) -> Best:
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
    laid = [(a, 0) for a in attachments.weigh(problem, naming, prepared, on)]
    if on is naming.null and not on.converged and best.effects:
        # Settings that were bent on the way to no fit may be where no function shows what it can do: those that go with
        # the best names are looked from, too.
        at = {q.name: best.values[q.name] for q in problem.nuisances}
        linear = linearise(problem, at, (), naming.noise.covariance)
        known = attachments.evidence_about(problem, naming, on, linear)
        more = attachments.weigh(problem, naming, prepared, on, linear=linear, log_evidence=known)
        laid = sorted([*laid, *((a, 1) for a in more)], key=lambda own: -own[0].log_evidence)

    def key(own: tuple[Attached, int]) -> tuple[str, int]:
        return own[0].attachment.name, own[1]

    seen: set[tuple[str, int]] = set()
    # What comes first has to be checked before anything rests on it.
    while laid and (len(seen) < REFINED or key(laid[0]) not in seen):
        first = laid[0][0].log_evidence
        top = [own for own in laid if key(own) not in seen and own[0].log_evidence > first - CONCERN]
        # What explains no more than nothing does, or than names do, need not be known to a digit.
        if not top or top[0][0].log_evidence < rival - CONCERN:
            break
        seen.add(key(top[0]))
        again = attachments.refine(problem, naming, prepared, top[0][0], on, rival - verdict.NAMED_MARGIN)
        laid = [(again, own[1]) if key(own) == key(top[0]) else own for own in laid]
        laid.sort(key=lambda own: -own[0].log_evidence)
    best_of: dict[str, Attached] = {}
    for a, _ in laid:
        best_of.setdefault(a.attachment.name, a)
    return tuple(best_of.values())


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
    problem: Problem, naming: Naming, best: Best, findings: Findings, modes: remainder.Modes, on: Fit
) -> Location | None:
    """The element: of what is left if names stand and something is left, else of the whole misfit."""
    covariance = naming.noise.covariance
    rest = findings.stands and findings.something_left
    base = on if rest else naming.null
    ground = attachments.absorb(problem, base.linear)
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
            fit = fits.get(effects)
            # What is not said as a name for the settings that it needs does not say where either.
            nothing = fit is not None and not _stretched(problem, fit) and _left(problem, naming, fit, modes).acceptable
            explanations.append(Explanation(only, coordinate.get(only, ""), value, 0.0 if nothing else np.inf))
    elements = {e.element: None for e in problem.catalogue if e.name in on.effects}
    if findings.stands and not rest and len(elements) > 1:
        place: Location | None = Location(" + ".join(elements), "", False, 0.0, ())
    else:
        place = location.locate(explanations)
    if place is None:
        return None
    signal = _signal(problem, findings, rest, on)
    # Beside names that stand, settings are as far off as with them: alone they took up what they could.
    seen = (problem, ground, covariance, on.setting_scale)
    shown = {} if signal is None else location.by_kind(*seen, signal)
    return replace(place, along_trace=location.scan(*seen, signal), by_kind=shown)


def _signal(problem: Problem, findings: Findings, rest: bool, on: Fit) -> Array | None:
    """What was found, in the data's units: the names' part of the prediction, or the best function's."""
    if findings.stands and not rest:
        own = {p.name: 0.0 for e in problem.catalogue if e.name in on.effects for p in evidence.amplitudes(e)}
        return predict_all(problem, on.values) - predict_all(problem, {**on.values, **own})
    laid = findings.more if rest else findings.free
    return laid[0].attachment.basis @ laid[0].coefficients if laid else None


def _unexplained(with_it: Linear, scale: float, base: Linear, base_scale: float) -> float:
    """Half of the excess χ² that a function leaves, if that is little of what there was; else infinity."""

    def excess(lin: Linear, s: float) -> float:
        m = marginal(lin, np.zeros((len(lin.residual), 0)), s)
        return m.chi2 - m.n

    before, after = excess(base, base_scale), max(excess(with_it, scale), 0.0)
    return 0.5 * after if after < LITTLE * before else np.inf


def winner(findings: Findings, place: Location | None) -> Attached | None:
    """The best attachment of the element that was claimed."""
    laid = findings.more if findings.stands else findings.free
    return next((a for a in laid if place is not None and a.attachment.element == place.element), None)
