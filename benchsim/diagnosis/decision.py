"""Names and functions without a name compete; the rules are applied to what they leave: the verdict and the place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchsim.diagnosis import (
    cross_validation,
    degeneracy,
    discrepancy,
    forward,
    levels,
    location,
    remainder,
    settings,
    verdict,
)
from benchsim.diagnosis.cross_validation import Fold
from benchsim.diagnosis.degeneracy import Best, Weighed
from benchsim.diagnosis.discrepancy import Attached
from benchsim.diagnosis.functions import Prepared, prepare
from benchsim.diagnosis.hypothesis import Effects, Fit, Naming
from benchsim.diagnosis.linear import factors, nuisance_posterior, raised, whiten
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import CONFIDENCES, Found, Location
from benchsim.diagnosis.shapes import widened
from benchsim.diagnosis.verdict import Findings, Further

CONCERN = 12.0
"""ln Z behind the best at which an attachment is left as it is."""


@dataclass(frozen=True)
class Judged:
    """What is said, before it is tested on settings left out.

    ``on`` is the hypothesis that is stated, the null where no name is; ``best`` is the catalogue's in either case.
    ``folds`` are those of `cross_validation` about ``best``; ``classes`` what is left open.
    """

    verdict: str
    found: tuple[Found, ...]
    classes: tuple[tuple[Effects, ...], ...]
    place: Location | None
    on: Fit
    best: Best
    findings: Findings
    prepared: tuple[Prepared, ...]
    folds: tuple[Fold, ...]
    notes: tuple[str, ...]


def judge(problem: Problem, naming: Naming) -> Judged:
    """Let names and functions without a name compete, look for what is left, and apply the rules."""
    notes: list[str] = []
    alone = degeneracy.weighed(naming, problem.stated)
    best = degeneracy.best(problem, naming, alone, notes)
    prepared = prepare(problem, naming.noise.covariance)
    free = _weigh(problem, naming, prepared, naming.null, best.fit)
    more = _weigh(problem, naming, prepared, best.fit, best.fit) if best.fit.effects else free
    gain = more[0].log_evidence - best.fit.log_evidence if more else 0.0
    beside = gain > levels.MISSING and not problem.judged_forward
    if beside:
        # What has no name is there besides: which names are, is asked beside it.
        first, notes = best, []
        functions = {laid[0].attachment.name for laid in (free, more)}
        weighed = degeneracy.weighed(_beside(problem, naming, prepared, functions, first.fit), problem.stated)
        best = degeneracy.best(problem, naming, weighed, notes)
        gone = [e for e in first.fit.effects if e not in best.fit.effects]
        if gone:
            notes.append(f"{' and '.join(gone)}: not said, since a function without a name explains it better.")
        free = _weigh(problem, naming, prepared, naming.null, best.fit)
        more = _weigh(problem, naming, prepared, best.fit, best.fit) if best.fit.effects else free
    modes = remainder.modes(problem, naming.linear, naming.noise.covariance)
    many = cross_validation.folds(problem, naming, degeneracy.about(naming.linear, best.fit))
    left_null = remainder.left(problem, naming, naming.null, modes)
    left = remainder.left(problem, naming, best.fit, modes) if best.fit.effects else left_null
    findings = Findings(
        naming.null.log_evidence,
        best.claim,
        best.fit.log_evidence,
        free,
        more,
        left,
        _further(problem, naming, best, more, left_null, left),
        apart=_apart(problem, naming, prepared, best, more if beside else ()),
        beside=beside,
    )
    if best.fit.effects and many:
        findings = _predicted(problem, naming, many, findings, best)
    place = None
    if findings.claim is not None or findings.something_left:
        place = location.place(problem, naming, alone, best, findings, modes)
    claimed = place is not None and place.claimed
    said = verdict.verdict(findings, place)
    on = naming.null
    lone: tuple[str, ...] = ()
    opened: tuple[tuple[Effects, ...], ...] = ()
    if findings.claim is not None and (findings.stands or findings.written or problem.judged_forward):
        if not problem.judged_forward or not many:
            on, lone, opened = _written(problem, naming, best, findings, many, notes)
        else:
            findings, on, lone, opened = _forward(problem, naming, best, findings, notes)
        # Where records are predicted best by nothing, what else is likely by evidence alone is not asked.
        if on.effects or not problem.judged_forward:
            opened = (*opened, *_besides(best, lone, opened))
        if said in ("named", "class"):
            said = "class" if opened else "named"
    elif said == "nothing-missing":
        opened = _doubted(problem, best.hypotheses)
        said = "class" if opened else said
    fitted = [e for e in lone if e != settings.NAME] if any(f is on for f in naming.fits) else []
    if beside and on is best.fit and more[0].log_evidence > on.log_evidence:
        # What is there besides has its part of the data, in the sizes too.
        on = discrepancy.fitted_with(problem, naming, on, more[0])
    stated = widened(problem, naming.noise.covariance, on, fitted)
    scale = settings.size(naming.setting_scales, on.log_scales)
    found, more_notes = verdict.found(problem, findings, stated, best.hypotheses, lone, scale)
    if said == "named" and not found:
        # Something shows, but no name of it may be said.
        said = "located" if claimed else "unexplained"
    return Judged(said, found, opened, place, on, best, findings, prepared, many, (*notes, *more_notes))


def _written(
    problem: Problem,
    naming: Naming,
    best: Best,
    findings: Findings,
    many: tuple[Fold, ...],
    notes: list[str],
) -> tuple[Fit, tuple[str, ...], tuple[tuple[Effects, ...], ...]]:
    """The model that is stated, its effects without rivals, and what is open beside them.

    What is certain by the rules stays; of the rest, what settings left out are predicted as well without is not
    stated.
    """
    assert findings.claim is not None
    lone, opened, effects = findings.claim.lone, findings.claim.classes, best.fit.effects
    sure = {e for e in lone if verdict.confidence(e, best.hypotheses.probability([(e,)]), findings) in CONFIDENCES[:2]}
    others = [
        f
        for f in naming.fits
        if f.converged
        and f.effects != effects
        and sure <= {*f.effects, settings.NAME}
        and set(f.effects) <= set(effects)
    ]
    if not many:
        return best.fit, lone, opened
    fit = cross_validation.simplest(problem, naming, many, [best.fit, *others])
    if fit.effects == effects:
        return fit, lone, opened
    instead = " + ".join(fit.effects) or "nothing"
    notes.append(f"{' + '.join(effects)} fits best; left-out settings are predicted as well by {instead}.")
    still = tuple(g for g in opened if set(g[0]) <= {*fit.effects, settings.NAME})
    if not fit.effects:
        still = (((), best.effects),)
    taken = {e for g in still for e in g[0]}
    kept = (*fit.effects, *(e for e in lone if e == settings.NAME))
    return fit, tuple(e for e in kept if e not in taken), still


def _forward(
    problem: Problem, naming: Naming, best: Best, findings: Findings, notes: list[str]
) -> tuple[Findings, Fit, tuple[str, ...], tuple[tuple[Effects, ...], ...]]:
    """`_written` where nobody stated the errors: a mount's records are judged by their own scatter, and evidence, which
    takes that for normal, is not what decides; what is stated is the model that predicts best (`forward`)."""
    claim = findings.claim
    assert claim is not None
    likely = [f.effects for f in naming.fits if f.converged and f.effects != best.fit.effects][:2]
    nothing, model = forward.best(problem, naming, [best.fit.effects, *likely])
    fit = forward.as_fit(problem, naming, model)
    won, sigma = forward.gain(problem, nothing, model)
    findings = replace(findings, predicted=won / max(sigma, 1e-12))
    if fit.effects == best.fit.effects:
        return findings, fit, claim.lone, claim.classes
    instead = " + ".join(fit.effects) or "nothing"
    notes.append(f"{' + '.join(best.effects)} fits best; records left out are predicted better by {instead}.")
    if not fit.effects:
        return findings, fit, (), (((), best.effects),)
    at = degeneracy.about(naming.linear, fit)
    signal = degeneracy.amplitude_vector(problem, naming.linear.names, fit)
    claim = degeneracy.claim(best.hypotheses, fit.effects, signal, degeneracy.space(problem, at, fit.setting_scale))
    return findings, fit, claim.lone, claim.classes


def _predicted(problem: Problem, naming: Naming, many: tuple[Fold, ...], findings: Findings, best: Best) -> Findings:
    """By how much the claim predicts left-out settings better than what is stated, and the best function than it."""
    as_stated, with_names = (
        cross_validation.stated(problem, many),
        cross_validation.named(problem, naming, many, best.fit),
    )
    won, sigma = cross_validation.gain(many, as_stated, with_names)
    outdone = None
    if findings.free and findings.margin < 0:
        alone = cross_validation.function(problem, many, findings.free[0], naming.null)
        lost, spread = cross_validation.gain(many, with_names, alone)
        outdone = lost / max(spread, 1e-12)
    return replace(findings, predicted=won / max(sigma, 1e-12), outdone=outdone)


def _further(
    problem: Problem,
    naming: Naming,
    best: Best,
    more: tuple[Attached, ...],
    left_null: remainder.Remainder,
    left: remainder.Remainder,
) -> tuple[Further, ...]:
    """What the best function, and what the smooth modes, add to the best hypothesis: how sure, and how large."""
    noise = np.sqrt(np.concatenate([np.diag(c) for c in naming.noise.covariance]))
    usual = {str(k): float(np.median(noise[problem.kind == k])) for k in np.unique(problem.kind)}
    own = bool(best.fit.effects)
    out = []
    if more:
        white, _ = whiten(problem, naming.noise.covariance, more[0].attachment.basis)
        base = discrepancy.absorb(problem, more[0].linear)
        shift = white @ more[0].coefficients
        pull, _ = nuisance_posterior(base, shift, more[0].scale)
        seen = shift - base.nuisance @ pull
        raw = raised(factors(naming.noise.covariance), seen)
        removed = _removed(best)
        part = float(shift @ seen) / max(removed, 1e-300) if own else np.inf
        loud = any(np.sqrt(np.mean(raw[problem.kind == k] ** 2)) > s for k, s in usual.items())
        out.append(Further(more[0].log_evidence - best.fit.log_evidence, part, loud))
    shown = {n: left.families[n].rms for n in left.alarming}
    loud = any(rms > usual[n] for n, rms in shown.items() if n in usual)
    out.append(Further(left.odds, left.part_of(left_null) if own else np.inf, loud))
    return tuple(out)


def _removed(best: Best) -> float:
    """χ² that the names' part of the prediction is worth, beside settings."""
    own = best.space.places(best.fit.effects)
    size = best.signal[own]
    return float(size @ best.space.gram[np.ix_(own, own)] @ size)


def _besides(
    best: Best, lone: tuple[str, ...], opened: tuple[tuple[Effects, ...], ...]
) -> tuple[tuple[Effects, ...], ...]:
    """Whether one more effect is there than what is stated, or what the data cannot tell from it, where that is more
    likely than not, but not `LIKELY`."""
    spoken = {*lone, settings.NAME} | {e for members in opened for m in members for e in m}
    others = best.hypotheses.present(e for e in best.space.index if e not in spoken)
    more = max(others, key=lambda e: others[e], default="")
    if not more or others[more] < levels.SUSPECTED:
        return ()
    group = next((g for g in best.claim.classes if (more,) in g), ((more,),)) if best.claim else ((more,),)
    return ((*group[: levels.MEMBERS - 1], ()),)


def _doubted(problem: Problem, hypotheses: Weighed) -> tuple[tuple[Effects, ...], ...]:
    """Alternatives to nothing, where nothing is best but may not be said: settings, or an effect that is suspected."""
    suspects: list[Effects] = []
    p = hypotheses.present(e.name for e in problem.catalogue)
    name = max(p, key=lambda e: p[e], default="")
    if name and p[name] >= levels.SUSPECTED:
        suspects.append((name,))
    if problem.stated and hypotheses.probability([(settings.NAME,)]) >= levels.UNSURE:
        suspects.append((settings.NAME,))
    z = hypotheses.log_evidence
    least = min((z.get(h, np.inf) for h in suspects), default=np.inf)
    # What is more probable than an alternative is one too.
    others = [h for h in z if len(h) == 1 and h not in suspects and z[h] > least]
    listed = sorted([(), *suspects, *others], key=lambda h: -z.get(h, -np.inf))[: levels.MEMBERS]
    return (tuple(listed),) if suspects else ()


def _beside(problem: Problem, naming: Naming, prepared: tuple[Prepared, ...], names: set[str], first: Fit) -> Naming:
    """The hypotheses that were fitted, each with the evidence that it has with the best of some functions on it.

    Where something without a name is left, sets that are compared without it are told apart by how much of it they
    imitate: light that wanders in every exposure would be taken for a plume. A function of a name's own element does
    not take its place if the name alone does half of that or more: it says no other thing, only less. Then it does not
    count on sets that lack such a name of those that come ``first`` without functions.
    """
    some = tuple(p for p in prepared if p.attachment.name in names)
    fits = {f.effects: f for f in (naming.null, *naming.fits) if f.converged or not f.effects}
    element = {e.name: e.element for e in problem.catalogue}
    # Of a hundred sets the roots would be a gigabyte.
    nothing = np.zeros((0, 0))
    laid: dict[tuple[Effects, str], Attached] = {}
    for effects, fit in fits.items():
        for a in discrepancy.weigh(problem, naming, some, fit):
            laid[effects, a.attachment.name] = replace(a, root=nothing)

    def counted(effects: Effects) -> Attached | None:
        lacks = {element[e] for e in first.effects if e not in effects}
        alone = fits[effects].log_evidence
        half = alone + 2 * (first.log_evidence - alone)
        own = [a for (e, _), a in laid.items() if e == effects and a.log_evidence > alone]
        own = [a for a in own if a.attachment.element not in lacks or a.log_evidence > half]
        return max(own, key=lambda a: a.log_evidence, default=None)

    def best(effects: Effects) -> float:
        on = counted(effects)
        return fits[effects].log_evidence if on is None else on.log_evidence

    checked: set[Effects] = set()
    # What comes first has to be checked before anything rests on it, with what could stand in its place, and what says
    # less before more is said: its settings are further from where they belong beside a function.
    while (top := max(fits, key=best)) not in checked:
        near = [e for e in fits if (set(e) <= set(top) or best(top) - best(e) < levels.COST) and e not in checked]
        for key in [key for key in laid if key[0] in near]:
            laid[key] = replace(discrepancy.refine(problem, naming, some, laid[key], fits[key[0]]), root=nothing)
        checked.update(near)

    def both(fit: Fit) -> Fit:
        on = counted(fit.effects)
        return fit if on is None else discrepancy.weighed_with(fit, on)

    return replace(naming, null=both(fits[()]), fits=tuple(both(f) for f in fits.values()), screened=())


def _weigh(
    problem: Problem, naming: Naming, prepared: tuple[Prepared, ...], on: Fit, best: Fit
) -> tuple[Attached, ...]:
    """All attachments on one hypothesis, those that could matter beside the best about their own nuisances."""
    rival = max(on.log_evidence, best.log_evidence)
    laid = {a.attachment.name: a for a in discrepancy.weigh(problem, naming, prepared, on)}
    seen: set[str] = set()
    # What comes first has to be checked before anything rests on it.
    while laid:
        order = sorted(laid, key=lambda n: -laid[n].log_evidence)
        first = laid[order[0]].log_evidence
        # What explains no more than nothing does, or than names do, need not be known to a digit.
        top = [n for n in order if n not in seen and laid[n].log_evidence > max(first, rival) - CONCERN]
        if not top or (len(seen) >= levels.MEMBERS and order[0] in seen):
            break
        seen.add(top[0])
        worth = rival - levels.MARGIN
        laid[top[0]] = discrepancy.refine(problem, naming, prepared, laid[top[0]], on, worth)
    return tuple(sorted(laid.values(), key=lambda a: -a.log_evidence))


def _apart(
    problem: Problem,
    naming: Naming,
    prepared: tuple[Prepared, ...],
    best: Best,
    more: tuple[Attached, ...],
) -> dict[str, float]:
    """By how much each of several names beats, beside the others, the best function of another element in its place.

    A function of its own element says no other thing than the name, only less. What is there besides them all
    (``more``) is there in either case."""
    alone, both = best.fit.log_evidence, max((a.log_evidence for a in more[:1]), default=-np.inf)
    fits = {f.effects: f for f in naming.fits if f.converged}
    element = {e.name: e.element for e in problem.catalogue}
    out: dict[str, float] = {}
    for e in best.fit.effects if len(best.fit.effects) > 1 else ():
        rest = fits.get(tuple(n for n in best.fit.effects if n != e))
        if rest is None:
            continue
        other = tuple(p for p in prepared if p.attachment.element != element[e])
        laid = discrepancy.weigh(problem, naming, other, rest)
        if laid and max(alone, both) - laid[0].log_evidence < levels.MARGIN:
            laid = _weigh(problem, naming, other, rest, best.fit)
        if laid:
            out[e] = verdict.lead(alone, both, laid[0].log_evidence, rest.log_evidence)
    return out
