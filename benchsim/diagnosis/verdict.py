"""The rules: what may be claimed of what was weighed, and in which words.

All margins are differences of ln Z. An effect is *named* at P ≥ 0.99, 3 above the best attachment (where something is
left beside it: with an attachment on it) and 3 sigma from every rival; *probable* at P ≥ 0.9 with a margin of at least
0; *provisional* where it is in the model that predicts best, though its name is not certain. The verdict speaks of what
is left beside them, and takes nothing back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from benchsim.diagnosis import settings
from benchsim.diagnosis.degeneracy import Claim, Weighed
from benchsim.diagnosis.discrepancy import Attached
from benchsim.diagnosis.hypothesis import Fit
from benchsim.diagnosis.levels import APART, LEFT, LIKELY, MARGIN, MISSING, PATCH, SURE
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.remainder import Remainder
from benchsim.diagnosis.result import Found, Location, Size


@dataclass(frozen=True)
class Further:
    """What could still be added to what was found, and how much it is.

    Attributes
    ----------
    gain : float
        In ln Z.
    part : float
        Of what the names removed; infinite where there are none.
    loud : bool
        It is larger than the noise of a single datum, rms over some kind of datum.
    """

    gain: float
    part: float
    loud: bool

    @property
    def matters(self) -> bool:
        """Whether it changes the verdict: significance alone does not."""
        return self.gain > MISSING and (self.part > LEFT or self.loud)


@dataclass(frozen=True)
class Findings:
    """What the rules are applied to.

    Attributes
    ----------
    null_log_evidence : float
    claim : Claim or None
        Of the catalogue; None where no effect is likely.
    log_evidence : float
        Of the claim's best hypothesis, or of the null.
    free : tuple of Attached
        Attachments laid on the null, the most probable first.
    more : tuple of Attached
        Laid on the claim's best hypothesis; ``free`` where there is none.
    left : Remainder
        What the smooth modes leave under the best hypothesis.
    further : tuple of Further
        What a function, and what the smooth modes, could add to the best hypothesis.
    predicted, outdone : float or None
        Sigma by which the claim predicts left-out settings better than the simulation as stated, and by which the best
        function does better than the claim; None where there are too few settings to leave one out.
    apart : mapping of str to float
        By effect of a claim with several: ln Z of the claim over the best function of another element in that one's
        place.
    beside : bool
        Whether names were compared with functions on them, so that what a function adds to a claim counts.
    """

    null_log_evidence: float
    claim: Claim | None
    log_evidence: float
    free: tuple[Attached, ...]
    more: tuple[Attached, ...]
    left: Remainder
    further: tuple[Further, ...] = ()
    predicted: float | None = None
    outdone: float | None = None
    apart: Mapping[str, float] = field(default_factory=dict)
    beside: bool = False

    @property
    def margin(self) -> float:
        """`lead` of the claim over the best function alone."""
        if not self.free:
            return float("inf")
        both = max((a.log_evidence for a in self.more[:1] if self.beside), default=-np.inf)
        return lead(self.log_evidence, both, self.free[0].log_evidence, self.null_log_evidence)

    def lead(self, name: str) -> float:
        """ln Z of an effect of the claim over the best function, and over those in its place."""
        return min(self.margin, self.apart.get(name, np.inf))

    @property
    def stands(self) -> bool:
        """The names explain the data at least as well as the best function: by ln Z, or on settings left out, where a
        function has to do better by more than chance."""
        if self.claim is None or self.refuted:
            return False
        doubted = self.outdone is None or self.outdone >= APART
        return self.margin >= 0 or not doubted

    @property
    def written(self) -> bool:
        """The claim goes into the amended file though it may not be certain: it predicts better than what is stated."""
        return self.claim is not None and self.predicted is not None and self.predicted >= APART

    @property
    def something_left(self) -> bool:
        """More is missing than what is claimed, and it matters."""
        return any(f.matters for f in self.further)

    @property
    def refuted(self) -> bool:
        """The names leave something that matters, and do not predict settings left out better, as far as can be told.

        ln Z takes what they leave for noise, and what imitates a part of it would be sure: outside the catalogue an
        astigmatism for a coma of 20 sigma."""
        return self.something_left and self.predicted is not None and not self.written


def lead(names: float, both: float, function: float, nothing: float) -> float:
    """ln Z of names over a function in their place; with a function on them where they are no `levels.PATCH` on it.

    Parameters
    ----------
    names, both : float
        ln Z of what holds the names, without a function and with one.
    function, nothing : float
        Of the same without the names, with a function and without.
    """
    patch = both - function < PATCH * (function - nothing)
    return max(names - function, -np.inf if patch else both - function)


def verdict(findings: Findings, location: Location | None) -> str:
    """One of `result.VERDICTS`."""
    if findings.something_left or (findings.claim is not None and not findings.stands):
        return "located" if location is not None and location.claimed else "unexplained"
    if findings.claim is None:
        return "nothing-missing"
    return "class" if findings.claim.classes else "named"


def confidence(name: str, probability: float, findings: Findings) -> str | None:
    """ "named", "probable", "provisional", or None where it may not be said; of an effect without close rivals."""
    margin = findings.lead(name)
    if probability >= LIKELY and margin >= 0 and not findings.refuted:
        return "named" if probability >= SURE and margin >= MARGIN else "probable"
    return "provisional" if findings.written else None


def found(
    problem: Problem,
    findings: Findings,
    fit: Fit,
    hypotheses: Weighed,
    lone: tuple[str, ...],
    scale: tuple[float, float],
) -> tuple[tuple[Found, ...], tuple[str, ...]]:
    """Effects that may be said to be there, and a note on each that may not.

    Parameters
    ----------
    problem : Problem
    findings : Findings
    fit : Fit
    hypotheses : Weighed
    lone : tuple of str
        Effects of the claim that nothing close can replace.
    scale : (value, sigma)
        Of the setting errors.
    """
    out, notes = [], []
    known = {e.name: e for e in (*problem.catalogue, settings.EFFECT)}
    for name in lone:
        probability = hypotheses.probability([(name,)])
        said = confidence(name, probability, findings)
        if said is None:
            outdone = findings.lead(name) < 0
            but = (
                " among the catalogue's effects; beside a function without a name it adds too little" if outdone else ""
            )
            notes.append(f"{name} is suspected, at a probability of {probability:.2f}{but}.")
            continue
        effect = known[name]
        size = {settings.SCALE: Size(*scale, "1")} if name == settings.NAME else sizes(effect, fit)
        out.append(Found(name, effect.element, probability, said, size, effect.says, effect.remedy))
    return tuple(out), tuple(notes)


def sizes(effect: Effect, fit: Fit) -> dict[str, Size]:
    """Every parameter of an effect as fitted."""
    return {
        p.name: Size(float(fit.values.get(p.name, 0.0)), float(fit.sigma.get(p.name, float("nan"))), p.unit)
        for p in effect.parameters
    }
