"""The rules: what may be claimed of what was weighed, and in which words.

All margins are differences of ln Z. An effect is *named* at P ≥ 0.99, 3 above the best attachment and 3 sigma from
every rival; *probable* at P ≥ 0.9 with a margin of at least 0. The verdict speaks of what is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchsim.diagnosis.attachments import Attached
from benchsim.diagnosis.classes import LIKELY, SURE, Claim, Weighed
from benchsim.diagnosis.fits import Fit
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.remainder import Remainder
from benchsim.diagnosis.result import Found, Location, Size

NAMED_MARGIN, PROBABLE_MARGIN = 3.0, 0.0

PATCH = 0.1
"""Part of what the best function gains over the null that a name beside it has to add: less may make up for what a
function of finite resolution, taken to first order, leaves of a large misfit."""

NEEDED = 0.5
"""Part of what a name gains by itself that it has to add to a function that gains more: what adds less explains what
the function explains, only worse."""

STRETCHED = 1.5
"""Scale of the setting errors from which on no name is said: they may stand for one more thing that is missing, or for
a part of one that the catalogue lacks and the name resembles (canting of 17 sigma, taken out of the catalogue, was
beam-direction with settings 1.7 to 2.1 times as far off as stated)."""

LEFT = 0.05
"""Part of what shows that something is missing that a name may leave where nothing explains the rest. Of ten cases of
the study in which names left more than chance does, and no place for it, seven named wrongly; a name that stands for
nearly all may be right beside a model that is not perfect."""

MISSING = float(np.log(SURE / (1 - SURE)))
"""Δ ln Z at which a function without a name shows that something is missing."""


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
    left_null, left : Remainder
        What the smooth modes leave under the null, and under the best hypothesis.
    together : bool
        Whether the best hypothesis with the best function on it leaves nothing. A name that is only a patch on a
        function which does not fit is not one.
    scale : float
        Of the setting errors, under the best hypothesis.
    refuted : bool
        Whether the names leave more than `LEFT` and nothing explains it.
    """

    null_log_evidence: float
    claim: Claim | None
    log_evidence: float
    free: tuple[Attached, ...]
    more: tuple[Attached, ...]
    left_null: Remainder
    left: Remainder
    together: bool = True
    scale: float = 1.0
    refuted: bool = False

    @property
    def margin(self) -> float:
        """ln Z of the claim, with whatever function lies on it and then fits, over the best function alone."""
        if not self.free:
            return float("inf")
        alone, function = self.log_evidence, self.free[0].log_evidence
        joint = max([alone, *(a.log_evidence for a in self.more if self.together)])
        patch = joint - function < PATCH * (function - self.null_log_evidence)
        # Beside a function that gains more than the name does, the name is the patch, however much it adds.
        patch = patch or joint - alone > alone - self.null_log_evidence
        patch = patch or (function > alone and joint - function < NEEDED * (alone - self.null_log_evidence))
        return (alone if patch else joint) - function

    @property
    def stands(self) -> bool:
        """The names are at least as probable as the best attachment, the settings about where they were set, and what
        is left does not speak against the names."""
        return self.claim is not None and self.margin >= PROBABLE_MARGIN and self.scale < STRETCHED and not self.refuted

    @property
    def part_left(self) -> float:
        """Largest part of what shows that something is missing that the names leave: of what the smooth modes show if
        they still do, of ln Z if a function on the names gains."""
        modes = 0.0 if self.left.acceptable else self.left.part_of(self.left_null)
        gain = self.more[0].log_evidence - self.log_evidence if self.more else 0.0
        return max(modes, gain / max(self.log_evidence - self.null_log_evidence, 1e-300) if gain > MISSING else 0.0)

    @property
    def something_left(self) -> bool:
        """A function on top, or the smooth modes, say that more is missing than what is claimed."""
        if not self.stands:
            free = bool(self.free) and self.free[0].log_evidence - self.null_log_evidence > MISSING
            return free or not self.left_null.acceptable
        more = bool(self.more) and self.more[0].log_evidence - self.log_evidence > MISSING
        return more or not self.left.acceptable


def verdict(findings: Findings, location: Location | None) -> str:
    """One of `result.VERDICTS`."""
    if findings.claim is not None and not findings.stands:
        # An effect was likely and a function without a name is more so: something is there, under no name.
        return "located" if location is not None and location.claimed else "unexplained"
    if findings.something_left:
        return "located" if location is not None and location.claimed else "unexplained"
    if findings.claim is None:
        return "nothing-missing"
    return "class" if findings.claim.classes else "named"


def confidence(probability: float, margin: float) -> str | None:
    """ "named", "probable", or None where neither may be said; for an effect without rivals within 3 sigma."""
    if probability >= SURE and margin >= NAMED_MARGIN:
        return "named"
    if probability >= LIKELY and margin >= PROBABLE_MARGIN:
        return "probable"
    return None


def found(
    problem: Problem, findings: Findings, fit: Fit, hypotheses: Weighed
) -> tuple[tuple[Found, ...], tuple[str, ...]]:
    """The lone effects of the claim that may be said to be there, and a note on each that may not."""
    out, notes = [], []
    known = {e.name: e for e in problem.catalogue}
    claim = findings.claim
    if claim is not None and findings.margin >= PROBABLE_MARGIN and findings.scale >= STRETCHED:
        names = " and ".join((*claim.lone, *(" or ".join(" with ".join(m) for m in c) for c in claim.classes)))
        notes.append(
            f"{names} would explain it beside settings {findings.scale:.1f} times as far off as stated, "
            "which is not said: if they may be so far off, state it and diagnose again."
        )
    for name in claim.lone if claim is not None and findings.stands else ():
        probability = hypotheses.probability([(name,)])
        said = confidence(probability, findings.margin)
        if said is None:
            notes.append(f"{name} is suspected, at a probability of {probability:.2f}.")
            continue
        effect = known[name]
        out.append(Found(name, effect.element, probability, said, sizes(effect, fit), effect.says, effect.remedy))
    return tuple(out), tuple(notes)


def sizes(effect: Effect, fit: Fit) -> dict[str, Size]:
    """Every parameter of an effect as fitted."""
    return {
        p.name: Size(float(fit.values.get(p.name, 0.0)), float(fit.sigma.get(p.name, float("nan"))), p.unit)
        for p in effect.parameters
    }
