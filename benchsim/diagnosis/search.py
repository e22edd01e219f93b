"""Which hypotheses are fitted: the null, every single effect, and what grows from the best of them.

    null → all singles → add, drop, exchange about the best until nothing gains → derivatives of what matters made exact

Where fits begin is `starts`'; what was not fitted is weighed about what was (`explored`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from benchsim.diagnosis import degeneracy, evidence, linear
from benchsim.diagnosis.explored import Begun, Search, log_z_about, strayed, whole
from benchsim.diagnosis.fitting import RENEWALS, Start, fitted, misses
from benchsim.diagnosis.hypothesis import LARGEST, Context, Effects, Hypothesis, Solved
from benchsim.diagnosis.levels import APART, COST, MEMBERS
from benchsim.diagnosis.screen import Catalogue
from benchsim.diagnosis.starts import at_fit, places, starts

Progress = Callable[[str, float], None]

IDLE = 1.5
"""ln Z by which what was weighed about a good fit of fewer effects may be behind the best and yet matter: that
linearisation is the right one unless what is added is large, and then it is not behind."""

MATTERS = COST + IDLE
"""The same of what was weighed elsewhere, or fitted without exact derivatives: what may be a member of a class is
nearer by as much."""

AT_ONCE, ROUNDS = 8, 8
"""Sets taken up for what they were weighed, and how often, at most: what is tried at all."""

TOGETHER = 10
"""Sets whose fits step together: more take memory and save little."""

NEARBY, RIVALS = 2 * APART, MEMBERS - 1
"""Separation in sigma up to which sets with one effect exchanged for another are fitted beside the best, and how many:
where the data bend, the right one of two that look alike may have been weighed wrong."""

SEEN = 2 * APART
"""Sigma from 0, at its place, from which on Laplace's method holds for an effect with a place. Of the best of many
places chance makes four."""


def search(
    context: Context,
    catalogue: Catalogue,
    null: Solved,
    stated: Solved,
    tell: Progress,
    earlier: Mapping[Effects, Begun],
) -> Search:
    """Fit whatever could matter.

    Parameters
    ----------
    context : Context
    catalogue : Catalogue
    null : Solved
    stated : Solved
        The null at the stated settings, not fitted.
    tell : callable
    earlier : mapping
        Where fits ended when the same data were searched with noise that was estimated worse: they begin there.
    """
    s = Search(context, catalogue, {(): null.fit.log_evidence}, {(): ()}, {(): null}, stated, earlier)
    # How settings act changes with what bends the data: without exact derivatives such a fit gets lost, and so does the
    # right start of several in their first steps.
    lost = [(n,) for n in s.names if n in s.bending and strayed(context, null)]
    tell("fitting single effects", 0.4)
    _fit(s, [(n,) for n in s.names if (n,) not in lost] + _wholes(s))
    _exactly(s, [replace(start, race=None) for effects in lost for start in starts(s, effects)])
    for turn in range(ROUNDS):
        tell(f"fitting {' + '.join(s.best().fit.effects) or 'settings'} and its like", 0.5 + 0.4 * turn / ROUNDS)
        _settle(s)
        chosen = _next(s)
        if not chosen:
            break
        _fit(s, chosen)
    _settle(s)
    return s


def _wholes(s: Search) -> list[Effects]:
    """Sets of effects that are there as a whole or not: one may show only beside another."""
    whole = [n for n in s.names if s.catalogue.effects[n].whole]
    return [s.ordered(c) for k in range(2, min(len(whole), LARGEST) + 1) for c in combinations(whole, k)]


def _next(s: Search) -> list[Effects]:
    """What to fit next: what was weighed near the best, what the best could do without, and what looks like it."""
    best = s.best()
    own, top = best.fit.effects, best.fit.log_evidence
    drops = [tuple(n for n in own if n != out) for out in own]
    # A smaller set that looks better from here than it was fitted ended in another valley.
    foretold = {} if misses(best) else log_z_about(s, best, drops)
    again = [e for e, z in foretold.items() if e in s.done and z > max(s.done[e].fit.log_evidence + 1, top - MATTERS)]
    hidden = strayed(s.context, best) and len(own) < LARGEST
    more = [s.ordered((*own, n)) for n in s.names if n not in own] if hidden else []
    wanted = [e for e in (*drops, *_rivals(s, best), *more) if e not in s.done]
    weighed = [e for e in s.log_z if e not in s.done and s.log_z[e] > top - _margin(s, e)]
    weighed = sorted(weighed, key=lambda e: -s.log_z[e])
    return [*again, *wanted, *[e for e in weighed if e not in wanted][:AT_ONCE]]


def _margin(s: Search, effects: Effects) -> float:
    """`MATTERS`, or `IDLE`."""
    about = s.done[s.source[effects]]
    return IDLE if len(about.fit.effects) < len(effects) and about.exact and not misses(about) else MATTERS


def _rivals(s: Search, best: Solved) -> list[Effects]:
    """Sets with one effect exchanged that could stand in for what the best has of it."""
    own = best.fit.effects
    if not own or misses(best):
        return []
    about = whole(s.context.problem, s.catalogue, s.white, best)
    within = degeneracy.space(s.context.problem, degeneracy.about(about, best.fit), best.fit.setting_scale)
    signal = degeneracy.amplitude_vector(s.context.problem, about.names, best.fit)
    near: dict[Effects, float] = {}
    for out in own:
        for new in (n for n in s.names if n not in own):
            effects = s.ordered([*(n for n in own if n != out), new])
            near[effects] = degeneracy.separation(within, signal, effects)
    close = sorted((e for e in near if near[e] < NEARBY), key=lambda e: near[e])
    return close[:RIVALS]


def _fit(s: Search, sets: Sequence[Effects]) -> None:
    """Fit sets from all their starts, some sets together, by derivatives that follow their steps; a single effect that
    explains something and gets lost so is begun anew with exact ones."""
    for some in (sets[i : i + TOGETHER] for i in range(0, len(sets), TOGETHER)):
        begun = [start for effects in some for start in starts(s, effects)]
        # Single effects are followed whatever they promise: larger sets begin at them.
        floor = -np.inf if any(len(e) == 1 for e in some) else s.best().fit.log_evidence - MATTERS
        _keep(s, fitted(s.context, begun, {e: s.prior(e) for e in some}, renewals=0, floor=floor))
        rough = [(e, s.done[e].fit) for e in some if e in s.done and len(e) == 1 and not s.done[e].fit.converged]
        for effects in [e for e, fit in rough if fit.log_evidence > s.done[()].fit.log_evidence]:
            _afresh(s, effects, [x for x in begun if x.hypothesis.names == effects])


def _afresh(s: Search, effects: Effects, begun: Sequence[Start]) -> None:
    """Follow a set that got lost with exact derivatives: from where it is, and from the stated settings, or from all of
    its starts where none is there."""
    chosen = [x for x in begun if x.race] or begun
    _exactly(s, [at_fit(s, effects, s.done[effects]), *(replace(x, race=None) for x in chosen)])


def _keep(s: Search, ends: Sequence[Solved]) -> None:
    """Keep the best end of each set, and weigh what is next to it."""
    found: dict[Effects, list[Solved]] = {}
    for end in ends:
        found.setdefault(end.fit.effects, []).append(end)
    for effects, many in found.items():
        # A place without an amplitude is as wide as its range: of several ends the evidence would take that one.
        placed = any(evidence.shapes(s.catalogue.effects[e]) for e in effects)
        was = [s.done[effects]] if effects in s.done and not any(e.exact for e in many) else []
        end = max([*many, *was], key=lambda x: -x.cost if placed else x.fit.log_evidence)
        s.done[effects] = _faint(s, end)
        s.afresh.pop(effects, None)
        s.log_z[effects], s.source[effects] = s.done[effects].fit.log_evidence, effects
    for effects in sorted(found, key=lambda e: -s.done[e].fit.log_evidence):
        _weigh_about(s, s.done[effects])


def _weigh_about(s: Search, solved: Solved) -> None:
    """Weigh what has one effect more or less than a fit about it, where no better fit has done so already.

    One less matters as much: about a null that a strong effect has bent, a pair can be weighed right and each of its
    members wrong, and then the pair's idle member would seem to be needed.
    """
    own = solved.fit.effects
    wanted = []
    for one in s.names:
        effects = s.ordered([n for n in s.names if (n in own) != (n == one)])
        if not effects or len(effects) > LARGEST or effects in s.done:
            continue
        source = s.source.get(effects)
        if source is None or s.done[source].fit.log_evidence < solved.fit.log_evidence:
            wanted.append(effects)
    for effects, z in log_z_about(s, solved, wanted).items():
        s.log_z[effects], s.source[effects] = z, own
    if misses(solved):
        return
    bending = [n for n in s.bending if n not in own and s.ordered([*own, n]) in wanted]
    for name, many in places(s, solved, bending).items():
        effects = s.ordered([*own, name])
        foretold = solved.fit.log_evidence - s.prior(own) + many[0].gain + s.prior(effects)
        s.log_z[effects] = max(s.log_z[effects], foretold)


def _settle(s: Search) -> None:
    """Make the derivatives of what matters exact."""
    for _ in range(2):
        top = s.best().fit.log_evidence
        rough = [e for e, x in s.done.items() if not x.exact and x.fit.log_evidence > top - MATTERS]
        _exactly(s, [at_fit(s, e, s.done[e]) for e in rough])


def _exactly(s: Search, begun: Sequence[Start]) -> None:
    """Follow fits with exact derivatives."""
    prior = {start.hypothesis.names: s.prior(start.hypothesis.names) for start in begun}
    _keep(s, fitted(s.context, begun, prior, renewals=RENEWALS))


def _faint(s: Search, solved: Solved) -> Solved:
    """A fit whose effect with a place is too weak to say where: its ln Z is the sum over the grid of places, about the
    best fit of the rest."""
    effects = solved.fit.effects
    faint = unseen(s.hypothesis(effects), solved)
    rest = [x for e, x in s.done.items() if set(e) <= set(effects) - faint]
    if not faint or not rest:
        return solved
    about = max(rest, key=lambda x: x.fit.log_evidence)
    summed = log_z_about(s, about, [effects])[effects]
    return replace(solved, fit=replace(solved.fit, log_evidence=summed, converged=about.fit.converged))


def unseen(h: Hypothesis, solved: Solved) -> set[str]:
    """Effects with shapes whose amplitudes, at the place that was found, are not `SEEN` away from 0.

    The sigma of an amplitude over all places says nothing of that: a plume of 13 sigma that may be wide and weak or
    narrow and strong has one of a quarter of its size.
    """
    lin = solved.fit.linear
    gram = linear.marginal(lin, lin.effect, solved.fit.setting_scale).gram
    place = {a.name: i for i, a in enumerate(h.amplitudes)}
    sigma = np.array([a.sigma**a.power for a in h.amplitudes])
    found = set()
    for e in h.effects:
        if not evidence.shapes(e):
            continue
        own = np.array([place[a.name] for a in evidence.amplitudes(e)])
        rest = np.array([i for i in range(len(sigma)) if i not in own], int)
        inner = gram[np.ix_(rest, rest)] + np.diag(sigma[rest] ** -2.0)
        left = gram[np.ix_(own, own)] - gram[np.ix_(own, rest)] @ np.linalg.solve(inner, gram[np.ix_(rest, own)])
        if float(solved.point.amplitude[own] @ left @ solved.point.amplitude[own]) < SEEN**2:
            found.add(e.name)
    return found
