"""Which hypotheses are refitted, and about whose fit the others are weighed.

All singles and pairs are screened about the null's fit; the most probable are refitted until no hypothesis that was
only screened could still matter. What has one effect more or less than a refitted hypothesis is weighed again about
*its* point: once a strong effect is fitted, the second is no longer hidden behind the curvature of the first. Larger
sets grow that way from the best refitted pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import classes, evidence, foresight, growth, refit, screen, starts
from benchsim.diagnosis.attempt import BORNE_OUT, attempt
from benchsim.diagnosis.fits import Effects
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Point, Solved
from benchsim.diagnosis.screen import Catalogue
from benchsim.diagnosis.weighing import Table, hypothesis_of, log_z_about, weigh_again, whole

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

FEWEST, MOST = 4, 10
"""Refits, the null included."""

MORE = 4
"""Refits beyond the most while what was weighed highest, about a good fit, was not refitted: nothing may be claimed of
it before."""

MATTERS = 6.0
"""ln Z behind the best at which a hypothesis that was only screened is left at that."""

IDLE = 1.5
"""The same for what was weighed about a good fit of fewer effects: that linearisation is the right one unless what is
added is large, and then it is not behind."""

LONE = 7
"""Refits, the null included, in which single effects are tried first where the null misses the data."""

RIVALS, NEARBY = 3, 6.0
"""Most sets with one effect exchanged that are refitted after the best, and the separation in sigma up to which: where
the null misses the data or a refit found more than was foretold, the right one of two that look alike may have been
weighed wrong and never tried."""

TURNS, ANEW = 3, 2
"""Times that the best fit is held against its neighbours (`growth`), each time that another came of it, and refits of
what is then more probable."""

LOOKS, FORESEEN = 12, 9.0
"""Hypotheses weighed about a bent null that are looked at by foresight before a refit is spent on them; and
`MATTERS` for what was: refits have ended up to 7 better or 3 worse."""


@dataclass
class _Walk:
    """A search on its way: what is weighed, what is fitted, and how it went."""

    context: Context
    catalogue: Catalogue
    white: Array
    table: Table
    done: dict[Effects, Solved]
    null: Solved
    bent: bool
    foretold: bool
    """Whether no refit found more than its linearisation said."""
    first: Catalogue
    """As it was differentiated about the null."""
    tried: int = 1
    looks: int = 0


def search(
    context: Context,
    catalogue: Catalogue,
    null: Solved,
    refits: int,
    tell: Progress,
    earlier: Mapping[Effects, Point],
) -> tuple[Table, dict[Effects, Solved]]:
    """Screen, refit, weigh again what contains the refitted, until nothing unfitted matters.

    ``earlier`` holds where fits ended when the same data were searched with noise that was estimated worse. The null
    that comes back among the fits may be a better one than ``null``.
    """
    white = context.whiten(catalogue.columns)
    log_z = screen.screen(null.fit.linear, catalogue, white, context.scales, context.weights)
    strayed, bent = refit.strayed(context, null), refit.bent(null)
    if strayed:
        _screen_from_afar(context, catalogue, white, log_z)
    log_z[()] = null.fit.log_evidence
    table = Table(log_z, dict.fromkeys(log_z, ()))
    if bent:
        _foresee_all(context, catalogue, table)
    else:
        _foresee_one_sided(context, catalogue, table)
    table.begin.update({e: (point,) for e, point in earlier.items() if e in table.begin})
    walk = _Walk(context, catalogue, white, table, {(): null}, null, bent, not strayed, catalogue)
    _explore(walk, refits, tell)
    again = bent and not refit.misses(context, null)
    if again:
        _null_again(context, walk.catalogue, table, walk.done)
    if not walk.foretold:
        grown: set[Effects] = set()
        for _ in range(TURNS):
            before = growth.leader(context, walk.done)
            growth.settle(context, walk.catalogue, walk.white, table, walk.done, grown)
            if not growth.better(growth.leader(context, walk.done), before):
                break
            _explore(walk, walk.tried + ANEW, tell)
        _challenge(walk)
        if again:
            _null_again(context, walk.catalogue, table, walk.done)
    _recant(walk)
    return table, walk.done


def _explore(walk: _Walk, refits: int, tell: Progress) -> None:
    """Refit what is most probable of what was only weighed, until nothing of it matters or ``refits`` are spent."""
    context, table, done, null = walk.context, walk.table, walk.done, walk.null
    while walk.tried < refits + MORE:
        best = _best(done)
        left = [e for e in table.log_z if e not in done]
        if walk.tried >= FEWEST:
            left = [e for e in left if table.log_z[e] >= best - _margin(table, done, e)]
        lost = all(refit.strayed(context, s) or not s.fit.converged for s in done.values())
        if walk.tried <= LONE and lost:
            # Nothing fits yet: two effects at once would be sought from a point that is no place to start from.
            left = [e for e in left if len(e) == 1] or left
        if walk.looks >= LOOKS and not (lost and refit.misses(context, null)):
            # The most probable of what was weighed about the bent null proved to be less: so is the rest.
            for e in [e for e in left if not table.source[e] and e not in table.begin]:
                del table.log_z[e], table.source[e]
            left = [e for e in left if e in table.log_z]
        if not left:
            break
        pick = max(left, key=lambda e: table.log_z[e])
        if walk.tried >= refits:
            about = done[table.source[pick]]
            if table.log_z[pick] <= best or refit.misses(context, about):
                break
        if walk.tried == 1 and refit.misses(context, null):
            pick = starts.together(context) or pick
        if walk.tried == LONE and lost:
            pick = _top_two(table, done) or pick
        source = done[table.source.get(pick, ())]
        if walk.bent and walk.looks < LOOKS and source is null and pick not in table.begin:
            walk.looks += 1
            _foresee(context, walk.catalogue, [pick], table)
            continue
        tell(f"refitting {' + '.join(pick)}", 0.4 + 0.55 * min(walk.tried / refits, 1.0))
        walk.tried += 1
        expected = table.log_z.get(pick, -np.inf)
        solved = attempt(context, walk.catalogue, pick, source, done, expected, table.begin.get(pick, ()))
        done[pick] = solved
        walk.foretold &= solved.fit.log_evidence < expected + BORNE_OUT
        table.log_z[pick], table.source[pick] = solved.fit.log_evidence, source.fit.effects
        # A fit that came near says what it could do without, though nothing rests on it while it has not converged.
        if solved.fit.converged or not refit.misses(context, solved):
            if refit.strayed(context, null) and solved.fit.log_evidence == max(
                s.fit.log_evidence for s in done.values()
            ):
                # What a large effect brings with it (diffraction needs a beam) is not seen about a null without it, nor
                # what settings hide about a null that they were bent for.
                walk.catalogue = screen.expand(context.problem, solved.fit.values)
                walk.white = context.whiten(walk.catalogue.columns)
            weigh_again(context, walk.catalogue, walk.white, solved, table, done)


def _null_again(context: Context, catalogue: Catalogue, table: Table, done: dict[Effects, Solved]) -> None:
    """Refit the null from the settings beside which the best effect was fitted, and keep the better.

    Settings that are off by several sigma have more than one valley: an effect that only led to a deeper one must not
    be named for it.
    """
    best = max((s for s in done.values() if s.fit.converged), key=lambda s: s.fit.log_evidence, default=done[()])
    if not best.fit.effects:
        return
    h, nuisance = Hypothesis(()), best.point.nuisance
    point, known = Point(nuisance, np.zeros(0), np.zeros(0)), refit.exact(context, h, nuisance)
    prior = screen.log_prior((), list(catalogue.effects))
    again = refit.fit(context, h, [point], known, np.zeros((len(context.problem.data), 0)), prior)
    was = done[()].fit
    if again.fit.converged and not (was.converged and was.log_evidence >= again.fit.log_evidence):
        done[()] = again
        table.log_z[()] = again.fit.log_evidence


def _top_two(table: Table, done: Mapping[Effects, Solved]) -> Effects | None:
    """The pair of those two effects that alone came nearest the data: about a null that is far off, one hides the other
    and their pair may have been weighed as low as any."""
    lone = sorted((e for e in done if len(e) == 1), key=lambda e: -done[e].fit.log_evidence)[:2]
    both = {n for e in lone for n in e}
    return next((e for e in table.log_z if len(both) == 2 and set(e) == both and e not in done), None)


def _challenge(walk: _Walk) -> None:
    """Refit what is close to the best fit and has one effect exchanged, if it never was."""
    context, catalogue, table, done, null = walk.context, walk.catalogue, walk.table, walk.done, walk.null
    best = max((s for s in done.values() if s.fit.converged), key=lambda s: s.fit.log_evidence, default=null)
    own, names = best.fit.effects, list(catalogue.effects)
    if not own or refit.misses(context, best):
        return
    near: dict[Effects, float] = {}
    # What an effect does beside another is not what it does in its place: of facets that are tilted one by one a wobble
    # only changes the tilts. So columns count that were taken about the null, too.
    for columns in (walk.first, catalogue):
        about_null = whole(context, columns, null)
        within = classes.space(context.problem, classes.about(about_null, best.fit), best.fit.setting_scale)
        signal = classes.amplitude_vector(context.problem, about_null.names, best.fit)
        for out in own:
            for new in (n for n in names if n not in own):
                effects = tuple(n for n in names if n == new or (n in own and n != out))
                if effects not in done:
                    distance = classes.separation(within, signal, effects)
                    near[effects] = min(distance, near.get(effects, np.inf))
    for effects in sorted((e for e in near if near[e] < NEARBY), key=lambda e: near[e])[:RIVALS]:
        smaller = [s for e, s in done.items() if set(e) < set(effects) and s.fit.converged]
        source = max(smaller, key=lambda s: s.fit.log_evidence, default=null)
        expected = log_z_about(context, catalogue, walk.white, source, [effects])[effects]
        solved = attempt(context, catalogue, effects, source, done, expected, table.begin.get(effects, ()))
        done[effects] = solved
        table.log_z[effects], table.source[effects] = solved.fit.log_evidence, source.fit.effects


def _recant(walk: _Walk) -> None:
    """Weigh again, about the best fit, what was weighed about one that misses the data and was never refitted.

    Far from the data a linearisation promises anything: beside a fit to within the noise such a promise, hundreds
    above it, would keep a name from being said.
    """
    context, table, done = walk.context, walk.table, walk.done
    best = max((s for s in done.values() if s.fit.converged), key=lambda s: s.fit.log_evidence, default=walk.null)
    if not best.fit.effects or refit.misses(context, best):
        return
    lost = {e for e, s in done.items() if refit.misses(context, s)}
    near = best.fit.log_evidence - MATTERS
    stale = [e for e, z in table.log_z.items() if e not in done and z > near and table.source[e] in lost]
    for effects, z in log_z_about(context, walk.catalogue, walk.white, best, stale).items():
        if z < table.log_z[effects]:
            table.log_z[effects], table.source[effects] = z, best.fit.effects


def _screen_from_afar(context: Context, catalogue: Catalogue, white: Array, log_z: dict[Effects, float]) -> None:
    """Weigh about the stated settings too, with noise `starts.AFAR` times larger.

    Where the null misses the data its settings are bent to where no linearisation holds. About the stated ones the
    errors of linearisation are some sigma, which such noise covers: what stands out of it is found however far the null
    went. A hypothesis keeps the better of its two weights; if that is too good its refit will show it.
    """
    if context.curvature is None:
        return
    residual = context.problem.data - np.concatenate(context.curvature.plain)
    lin = starts.from_afar(context, context.curvature, residual[:, None])
    far = screen.screen(lin, catalogue, white / starts.AFAR, context.scales, context.weights)
    for effects, z in far.items():
        log_z[effects] = max(log_z[effects], log_z[()] + z - far[()])


def _foresee(context: Context, catalogue: Catalogue, some: Sequence[Effects], table: Table) -> None:
    """Weigh by foresight, where it can say, in place of what a strayed fit's linearisation said."""
    foretold = foresight.foretell_all(context, [hypothesis_of(catalogue, effects) for effects in some])
    for effects, found in zip(some, foretold, strict=True):
        table.begin[effects] = () if found is None else found.points
        if found is not None:
            table.log_z[effects] = found.log_evidence + screen.log_prior(effects, list(catalogue.effects))


def _foresee_all(context: Context, catalogue: Catalogue, table: Table) -> None:
    """Single effects by foresight; by as much as one of them falls, pairs that it is in were weighed too high."""
    screened = dict(table.log_z)
    _foresee(context, catalogue, [(name,) for name in catalogue.effects], table)
    fall = {name: min(0.0, table.log_z[(name,)] - screened[(name,)]) for name in catalogue.effects}
    for effects in screened:
        if len(effects) > 1:
            table.log_z[effects] += sum(fall[name] for name in effects)


def _foresee_one_sided(context: Context, catalogue: Catalogue, table: Table) -> None:
    """By foresight, single effects that have one sign only, if from afar they look better than from 0 or than nothing.

    What starts at a boundary need not go on as it starts: charge that spills over by half a pixel widens a line, by a
    whole one it does not, and between the two is no way downhill.
    """
    some = [(e.name,) for e in catalogue.effects.values() if any(evidence.kind(a) == 1 for a in evidence.amplitudes(e))]
    foretold = foresight.foretell_all(context, [hypothesis_of(catalogue, effects) for effects in some])
    for effects, found in zip(some, foretold, strict=True):
        log_z = -np.inf if found is None else found.log_evidence + screen.log_prior(effects, list(catalogue.effects))
        if found is not None and log_z > min(table.log_z[effects], table.log_z[()]):
            table.log_z[effects], table.begin[effects] = max(log_z, table.log_z[effects]), found.points


def _best(done: Mapping[Effects, Solved]) -> float:
    """ln Z of the best fit that converged: one that did not says nothing of what others could still reach."""
    return max((s.fit.log_evidence for s in done.values() if s.fit.converged), default=-np.inf)


def _margin(table: Table, done: Mapping[Effects, Solved], effects: Effects) -> float:
    """How far behind the best a hypothesis may be and still has to be refitted."""
    source = done[table.source[effects]].fit
    best = _best(done)
    if table.begin.get(effects) and not table.source[effects]:
        return FORESEEN
    near = source.converged and source.log_evidence > best - MATTERS
    return IDLE if near and set(source.effects) < set(effects) else MATTERS
