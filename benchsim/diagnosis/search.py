"""Which hypotheses are refitted, and about whose fit the others are weighed.

All singles and pairs are screened about the null's fit; the most probable are refitted until no hypothesis that was
only screened could still matter. What has one effect more or less than a refitted hypothesis is weighed again about
*its* point: once a strong effect is fitted, the second is no longer hidden behind the curvature of the first. Larger
sets grow that way from the best refitted pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import classes, evidence, foresight, linear, refit, screen, starts
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fits import LARGEST, Effects, Fit
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, Solved, values
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.screen import Catalogue

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

LOOKS, FORESEEN = 12, 9.0
"""Hypotheses weighed about a bent null that are looked at by foresight before a refit is spent on them; and
`MATTERS` for what was: refits have ended up to 7 better or 3 worse."""

BORNE_OUT = 1.0
"""Difference in ln Z up to which a linearisation about a good fit and the refit it foretold check each other."""


@dataclass
class Table:
    """ln Z of all hypotheses, about whose fit each was weighed, and where foresight would have its fit begin.

    ``begin`` is empty where foresight was asked and could not say.
    """

    log_z: dict[Effects, float]
    source: dict[Effects, Effects]
    begin: dict[Effects, tuple[Point, ...]] = field(default_factory=dict)


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
    table.begin.update({e: (point,) for e, point in earlier.items() if e in table.begin})
    done: dict[Effects, Solved] = {(): null}
    foretold, tried, looks = not strayed, 1, 0
    while tried < refits + MORE:
        best = _best(done)
        left = [e for e in table.log_z if e not in done]
        if tried >= FEWEST:
            left = [e for e in left if table.log_z[e] >= best - _margin(table, done, e)]
        lost = all(refit.strayed(context, s) or not s.fit.converged for s in done.values())
        if tried <= LONE and lost:
            # Nothing fits yet: two effects at once would be sought from a point that is no place to start from.
            left = [e for e in left if len(e) == 1] or left
        if looks >= LOOKS and not (lost and refit.misses(context, null)):
            # The most probable of what was weighed about the bent null proved to be less: so is the rest.
            for e in [e for e in left if not table.source[e] and e not in table.begin]:
                del table.log_z[e], table.source[e]
            left = [e for e in left if e in table.log_z]
        if not left:
            break
        pick = max(left, key=lambda e: table.log_z[e])
        if tried >= refits:
            about = done[table.source[pick]]
            if table.log_z[pick] <= best or refit.misses(context, about):
                break
        if tried == 1 and refit.misses(context, null):
            pick = starts.together(context) or pick
        if tried == LONE and lost:
            pick = _top_two(table, done) or pick
        source = done[table.source.get(pick, ())]
        if bent and looks < LOOKS and source is null and pick not in table.begin:
            looks += 1
            _foresee(context, catalogue, [pick], table)
            continue
        tell(f"refitting {' + '.join(pick)}", 0.4 + 0.55 * min(tried / refits, 1.0))
        tried += 1
        expected = table.log_z.get(pick, -np.inf)
        solved = _refit(context, catalogue, pick, source, done, expected, table.begin.get(pick, ()))
        done[pick] = solved
        foretold &= solved.fit.log_evidence < expected + BORNE_OUT
        table.log_z[pick], table.source[pick] = solved.fit.log_evidence, source.fit.effects
        # A fit that came near says what it could do without, though nothing rests on it while it has not converged.
        if solved.fit.converged or not refit.misses(context, solved):
            if refit.misses(context, null) and solved.fit.log_evidence == max(
                s.fit.log_evidence for s in done.values()
            ):
                # What a large effect brings with it (diffraction needs a beam) is not seen about a null without it.
                catalogue = screen.expand(context.problem, solved.fit.values)
                white = context.whiten(catalogue.columns)
            _weigh_again(context, catalogue, white, solved, table, done)
    if not foretold:
        _challenge(context, catalogue, white, null, table, done)
    if bent and not refit.misses(context, null):
        _null_again(context, catalogue, table, done)
    return table, done


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


def _challenge(
    context: Context, catalogue: Catalogue, white: Array, null: Solved, table: Table, done: dict[Effects, Solved]
) -> None:
    """Refit what is close to the best fit and has one effect exchanged, if it never was."""
    best = max((s for s in done.values() if s.fit.converged), key=lambda s: s.fit.log_evidence, default=null)
    own, names = best.fit.effects, list(catalogue.effects)
    if not own or refit.misses(context, best):
        return
    about_null = whole(context, catalogue, null)
    within = classes.space(context.problem, classes.about(about_null, best.fit), best.fit.setting_scale)
    signal = classes.amplitude_vector(context.problem, about_null.names, best.fit)
    near: dict[Effects, float] = {}
    for out in own:
        for new in (n for n in names if n not in own):
            effects = tuple(n for n in names if n == new or (n in own and n != out))
            if effects not in done:
                near[effects] = classes.separation(within, signal, effects)
    for effects in sorted((e for e in near if near[e] < NEARBY), key=lambda e: near[e])[:RIVALS]:
        smaller = [s for e, s in done.items() if set(e) < set(effects) and s.fit.converged]
        source = max(smaller, key=lambda s: s.fit.log_evidence, default=null)
        expected = _log_z_about(context, catalogue, white, source, [effects])[effects]
        solved = _refit(context, catalogue, effects, source, done, expected, table.begin.get(effects, ()))
        done[effects] = solved
        table.log_z[effects], table.source[effects] = solved.fit.log_evidence, source.fit.effects


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
    foretold = foresight.foretell_all(context, [_hypothesis(catalogue, effects) for effects in some])
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


def _nearest(effects: Effects, done: Mapping[Effects, Solved]) -> Known:
    """Nuisances' columns about the fit that shares most effects."""
    return done[max(done, key=lambda e: (len(set(e) & set(effects)), -len(set(e) - set(effects))))].known


def _hypothesis(catalogue: Catalogue, effects: Effects) -> Hypothesis:
    return Hypothesis(tuple(catalogue.effects[e] for e in effects))


def _refit(
    context: Context,
    catalogue: Catalogue,
    effects: Effects,
    source: Solved,
    done: Mapping[Effects, Solved],
    expected: float,
    foreseen: tuple[Point, ...] = (),
) -> Solved:
    """Refit a hypothesis from the fit it was weighed about, checked from the stated settings.

    Where that fit is good and its linearisation foretold (``expected``) what the refit finds, the two check each other.
    """
    h = _hypothesis(catalogue, effects)
    lin = source.fit.linear
    strayed = refit.strayed(context, source)
    at = source.fit.values
    own_effects = source.fit.effects
    about = starts.ground(context, source, afar=strayed and not own_effects)
    nodes = starts.best_nodes(context, catalogue, h, about, own_effects)
    points: list[Point] = []
    for first, node in enumerate(nodes):
        amplitude: list[float] = []
        shape: list[float] = []
        for e, i in zip(h.effects, node, strict=True):
            own_amplitudes = evidence.amplitudes(e)
            if e.name in own_effects and first == 0:
                size, place = [linear.fit_value(p, at.get(p.name, 0.0)) for p in own_amplitudes], dict(at)
            elif evidence.shapes(e):
                size, place = starts.placed(context, e, catalogue.nodes[e.name][i].shape, about)
            else:
                size, place = [0.0] * len(own_amplitudes), {}
            amplitude += size
            shape += [place[p.name] for p in evidence.shapes(e)]
        nuisance = source.point.nuisance if first == 0 else np.zeros(lin.nuisance.shape[1])
        points.append(Point(nuisance, np.array(amplitude), np.array(shape)))
    known, own, p, hold = _nearest(effects, done), None, lin.nuisance.shape[1], 0
    if strayed:
        # Nuisances that were bent to hide an effect are further from the truth than as stated.
        plain = replace(points[0], nuisance=np.zeros(p))
        begun = list(foreseen)
        if not begun:
            begun = [replace(plain, amplitude=q) for q in starts.scanned(context, h, source, plain.amplitude)]
            begun = [b for b in begun if not np.array_equal(b.amplitude, plain.amplitude)]
        if h.shapes and not own_effects:
            begun += [points[1], plain]
        points, hold = [*begun, plain], len(begun)
        known = context.stated() or known
        if foreseen and refit.near(context, h, foreseen[0]):
            # Foresight came near the data from the stated settings: nothing need be led or checked from those again.
            points, hold = list(foreseen), 0
        elif hold and any(e.whole for e in h.effects):
            known = Known(context.nuisance_columns(values(context.problem, h, points[0])), points[0].nuisance)
    elif not own_effects and not h.shapes:
        chosen = [c for e, i in zip(h.effects, nodes[0], strict=True) for c in catalogue.nodes[e.name][i].columns]
        own = catalogue.columns[:, chosen]
    if not hold and any(evidence.shapes(e) and e.name not in own_effects for e in h.effects):
        # Shapes are placed with the settings integrated; where the source has them, they speak against the place.
        hold = 1
    prior = screen.log_prior(effects, list(catalogue.effects))
    sure = bool(own_effects) and source.fit.converged and not refit.misses(context, source)
    solved = refit.fit(context, h, points[:1] if sure else points, known, own, prior, hold=hold)
    if sure and not (solved.fit.converged and abs(solved.fit.log_evidence - expected) < BORNE_OUT):
        # Checked from where it ended, not begun again.
        solved = refit.fit(context, h, [solved.point, *points[1:]], solved.known, solved.own, prior)
    unseen = _unseen_shapes(h, solved.fit)
    if unseen:
        # Laplace fails where an amplitude is too small to say where: the sum over the grid stands, about the best fit
        # of the rest. It asks for no convergence in a shape that has many peaks, only for that fit's.
        rest = max((s for e, s in done.items() if set(e) <= set(effects) - unseen), key=lambda s: s.fit.log_evidence)
        if not refit.bent(rest):
            summed = _log_z_about(context, catalogue, context.whiten(catalogue.columns), rest, [effects])[effects]
            solved = replace(solved, fit=replace(solved.fit, log_evidence=summed, converged=rest.fit.converged))
    return solved


def _unseen_shapes(h: Hypothesis, fit: Fit) -> set[str]:
    """Effects with shapes whose amplitudes all stay below four sigma."""
    return {
        e.name
        for e in h.effects
        if evidence.shapes(e) and all(abs(fit.values[p.name]) < 4 * fit.sigma[p.name] for p in evidence.amplitudes(e))
    }


def _log_z_about(
    context: Context, catalogue: Catalogue, white: Array, solved: Solved, wanted: Sequence[Effects]
) -> dict[Effects, float]:
    """ln Z of hypotheses about a refitted point, prior of presence included; what both hold has its columns there."""
    h = _hypothesis(catalogue, solved.fit.effects)
    k = len(h.amplitudes)
    own = np.column_stack([solved.fit.linear.effect, context.whiten(solved.own[:, k:])])
    columns = np.column_stack([own, white])
    number = {p.name: i for i, p in enumerate((*h.amplitudes, *h.shapes))}
    cache: dict[str, list[Term]] = {}
    listed = []
    for effects in wanted:
        kept = Hypothesis(tuple(e for e in h.effects if e.name in effects))
        there = [number[p.name] for p in (*kept.amplitudes, *kept.shapes)]
        base = [replace(t, columns=tuple(there[c] for c in t.columns)) for t in kept.terms()]
        more = tuple(e for e in effects if e not in h.names)
        joined = screen.hypothesis_terms(catalogue, more, cache, own.shape[1])
        listed.append((effects, [screen.join(a, b) for a in base for b in joined]))
    found = screen.weigh(solved.fit.linear, columns, context.scales, context.weights, listed)
    return {e: z + screen.log_prior(e, list(catalogue.effects)) for e, z in found.items()}


def _weigh_again(
    context: Context,
    catalogue: Catalogue,
    white: Array,
    solved: Solved,
    table: Table,
    done: dict[Effects, Solved],
) -> None:
    """Weigh what has one effect more or less about this fit, where no better fit has done so already.

    One less matters as much: about a null that a strong effect has bent, a pair can be weighed right and each of its
    members wrong, and then the pair's idle member would seem to be needed. A refit of one less that got lost far from
    the data, while this one found its way, is undone: from here it may find it.
    """
    own, names = solved.fit.effects, list(catalogue.effects)
    good = solved.fit.converged and not refit.misses(context, solved)
    wanted = []
    for one in names if own else ():
        effects = tuple(n for n in names if (n in own) != (n == one))
        if not effects or len(effects) > LARGEST:
            continue
        if effects in done:
            was = done[effects]
            if good and one in own and not was.fit.converged and refit.misses(context, was):
                del done[effects]
                wanted.append(effects)
            continue
        source = table.source.get(effects)
        if source is None or done[source].fit.log_evidence < solved.fit.log_evidence:
            wanted.append(effects)
    for effects, z in _log_z_about(context, catalogue, white, solved, wanted).items():
        table.log_z[effects], table.source[effects] = z, own


def whole(context: Context, catalogue: Catalogue, null: Solved) -> Linear:
    """About the null: the amplitudes of the whole catalogue, shapes at their most probable node."""
    names: list[str] = []
    columns: list[int] = []
    about = starts.ground(context, null)
    for effect in context.problem.catalogue:
        h = Hypothesis((effect,))
        node = catalogue.nodes[effect.name][starts.best_nodes(context, catalogue, h, about)[0][0]]
        names += [p.name for p in evidence.amplitudes(effect)]
        columns += node.columns
    white = context.whiten(catalogue.columns[:, columns])
    return replace(null.fit.linear, effect=white, names=tuple(names))
