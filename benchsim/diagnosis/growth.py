"""What the best fit of a search is held against before it is believed, where the data bend.

Fits that bend have valleys, and a search that grows from one fit to the next ends in the valley that it began in. The
best set is fitted once more without each of its effects and with amplitudes of the other sign; sets that share all but
one effect with it, and were lost, are begun again from where it found its way; an effect with a place is placed anew
beside the others, and one that bends the data is exchanged for others that do. Where even the best left the stated
settings or misses the data, what else came near by itself is put beside it, and every other single effect is sought
beside it from the stated settings (`foresight`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import evidence, foresight, linear, refit, screen, starts
from benchsim.diagnosis.attachments import with_columns
from benchsim.diagnosis.attempt import attempt
from benchsim.diagnosis.fits import LARGEST, Effects
from benchsim.diagnosis.foresight import Foretold
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, Solved, each, values
from benchsim.diagnosis.linear import fit_value
from benchsim.diagnosis.problem import Effect, Parameter
from benchsim.diagnosis.screen import Catalogue
from benchsim.diagnosis.weighing import Table, hypothesis_of, log_z_about, weigh_again

Array = NDArray[np.float64]

REACH = 30.0
"""ln Z behind the best up to which the set without one of its effects is fitted anew: linearised about the larger set,
a coma without the astigmatism that stood in for half of it was weighed 16 too low."""

GAIN = 0.5
"""ln Z by which a fit begun again has to be better to take the old one's place."""

JOINED, SOUGHT, EXCHANGED = 2, 2, 2
"""Most sets that are joined with what came near by itself where the best strayed; that foresight seeks with an effect
exchanged; and that are begun again from the best with one effect exchanged."""

LEAD = 9.0
"""ln Z over the null from which on sets are grown from the best where it strayed: what gains less beside settings that
are off explains little more than they do."""

PROMISING = 9.0
"""ln Z behind the best at which a set that foresight looked at is fitted: fits have ended up to 7 better."""

HOPELESS = 4.0
"""rms residual [sigma] of the best fit beyond which it is left as it is."""

SCANNED = (0.1, 0.3, 0.6, 1.0, 1.6)
"""Amplitudes [prior sigma] from which the one is chosen that an exchanged effect begins with."""

BEGIN, EVEN, SEEN = 0.3, 0.25, 3.0
"""Amplitude [prior sigma] from which one that bends the data is fitted beside the best, and what its second order there
has to be, settings marginalised: of the first, and in sigma. Of 40 amplitudes two are so, one of coma and one of
astigmatism; each costs two fits."""

BENDING = 10.0
"""Second order of an amplitude, at its size, from which on it is tried with the other sign [sigma of the data]."""


def settle(
    context: Context,
    catalogue: Catalogue,
    white: Array,
    table: Table,
    done: dict[Effects, Solved],
    grown: set[Effects],
) -> None:
    """Hold the best of the fits against its neighbours.

    Parameters
    ----------
    context : Context
    catalogue : Catalogue
    white : array
        Its columns, whitened.
    table : Table
        Of the search; weights about new fits are put in.
    done : dict
        Of the search; fits are put in, and better ones take the place of old ones.
    grown : set
        Sets that others were grown from already; put in.
    """

    def keep(found: Iterator[Solved]) -> None:
        for solved in found:
            effects = solved.fit.effects
            was = done.get(effects)
            if was is not None and not _better(solved, was):
                continue
            done[effects] = solved
            table.log_z[effects] = solved.fit.log_evidence
            table.source.setdefault(effects, ())
            if solved.fit.converged or not refit.misses(context, solved):
                weigh_again(context, catalogue, white, solved, table, done)

    best = leader(context, done)
    if not best.fit.effects or _hopeless(best):
        return
    keep(_other_signs(context, catalogue, best))
    keep(_without_each(context, catalogue, white, leader(context, done), done))
    if refit.strayed(context, leader(context, done)):
        keep(_joined(context, catalogue, leader(context, done), done))
    best = leader(context, done)
    ahead = best.fit.log_evidence > done[()].fit.log_evidence + LEAD
    if ahead and refit.strayed(context, best) and best.fit.effects not in grown:
        grown.add(best.fit.effects)
        keep(_grown(context, catalogue, best, done))
    keep(_exchanged(context, catalogue, leader(context, done), done))
    keep(_placed_anew(context, catalogue, leader(context, done)))
    keep(_bent_otherwise(context, catalogue, leader(context, done), done))


def leader(context: Context, done: Mapping[Effects, Solved]) -> Solved:
    """The most probable fit that converged near the data; of all where none did.

    One that converged where it misses the data is no better to go on from than one that came near and was cut off.
    """
    near = [s for s in done.values() if s.fit.converged and not refit.misses(context, s)]
    return max(near or done.values(), key=lambda s: s.fit.log_evidence)


def better(new: Solved, old: Solved) -> bool:
    """Whether a leader is worth going on from where another was."""
    return new.fit.effects != old.fit.effects or _better(new, old)


def _hopeless(best: Solved) -> bool:
    """Whether even the best misses the data by so much that it says nothing of what they hold."""
    return best.fit.chi2 > HOPELESS**2 * len(best.residual)


def _better(new: Solved, old: Solved) -> bool:
    if new.fit.converged != old.fit.converged:
        return new.fit.converged
    return new.fit.log_evidence > old.fit.log_evidence + GAIN


def _prior(catalogue: Catalogue, effects: Effects) -> float:
    return screen.log_prior(effects, list(catalogue.effects))


def _at(h: Hypothesis, sizes: Mapping[str, float], places: Mapping[str, float], nuisance: Array) -> Point:
    """A point from amplitudes in fit space and shapes by name."""
    return Point(
        nuisance, np.array([sizes[a.name] for a in h.amplitudes]), np.array([places[s.name] for s in h.shapes])
    )


def _sizes(h: Hypothesis, solved: Solved) -> dict[str, float]:
    return {a.name: fit_value(a, solved.fit.values.get(a.name, 0.0)) for a in h.amplitudes}


def _other_signs(context: Context, catalogue: Catalogue, best: Solved) -> Iterator[Solved]:
    """The same set from the other side of its amplitudes."""
    h = hypothesis_of(catalogue, best.fit.effects)
    turned = _turned(context, h, _sizes(h, best), best)
    prior = _prior(catalogue, h.names)
    yield from each(context, _fitted, [_from_stated(context, h, point, best, prior) for point in turned])


def _turned(context: Context, h: Hypothesis, sizes: Mapping[str, float], best: Solved) -> list[Point]:
    """Points at the stated settings with the signs of an effect's amplitudes turned, of those that bend what they do
    beyond the noise: a line is as wide behind a defocus of either sign."""
    zero = np.zeros_like(best.point.nuisance)
    out = []
    for e in h.effects:
        if e.whole or evidence.shapes(e) or len(evidence.amplitudes(e)) > foresight.SIDES:
            continue
        signs = [(1.0, -1.0) if _bends(context, e, a, sizes[a.name]) else (1.0,) for a in evidence.amplitudes(e)]
        for turn in list(product(*signs))[1:]:
            own = {a.name: s * sizes[a.name] for a, s in zip(evidence.amplitudes(e), turn, strict=True)}
            out.append(_at(h, {**sizes, **own}, best.fit.values, zero))
    return out


def _bends(context: Context, effect: Effect, a: Parameter, size: float) -> bool:
    change = None if evidence.kind(a) else context.change(a, size, dict(evidence.fixed(effect)))
    return change is not None and float(np.linalg.norm(context.whiten(change[1]))) * size**2 > BENDING


@dataclass(frozen=True)
class _Begin:
    """Where a set is fitted from: a point, the nuisances' columns nearby, and the prior of its presence.

    ``stated``: they are not those that go with the point, so that they descend from there alone first (`refit.fit`,
    ``hold``).
    """

    hypothesis: Hypothesis
    point: Point
    known: Known
    prior: float
    stated: bool


def _fitted(context: Context, b: _Begin) -> Solved:
    return refit.fit(context, b.hypothesis, [b.point], b.known, None, b.prior, hold=int(b.stated))


def _from_stated(context: Context, h: Hypothesis, point: Point, best: Solved, prior: float) -> _Begin:
    return _Begin(h, point, context.stated() or best.known, prior, stated=True)


def _without_each(
    context: Context, catalogue: Catalogue, white: Array, best: Solved, done: Mapping[Effects, Solved]
) -> Iterator[Solved]:
    """The best set without one of its effects, where that may be as good."""
    own = best.fit.effects
    smaller = [tuple(n for n in own if n != e) for e in own] if len(own) > 1 else []
    expected = log_z_about(context, catalogue, white, best, smaller) if smaller else {}
    begun: list[_Begin] = []
    for effects in smaller:
        if expected[effects] < best.fit.log_evidence - REACH:
            continue
        h, prior = hypothesis_of(catalogue, effects), _prior(catalogue, effects)
        sizes, was = _sizes(h, best), done.get(effects)
        turned = _turned(context, h, sizes, best)
        if not turned and was is not None and was.fit.converged and not refit.strayed(context, was):
            continue
        here = _at(h, sizes, best.fit.values, best.point.nuisance)
        plain = replace(here, nuisance=np.zeros_like(here.nuisance))
        begun.append(_Begin(h, here, best.known, prior, stated=False))
        begun += [_from_stated(context, h, p, best, prior) for p in (plain, *turned)]
    yield from sorted(each(context, _fitted, begun), key=lambda s: (s.fit.converged, s.fit.log_evidence), reverse=True)


def _exchanged(
    context: Context, catalogue: Catalogue, best: Solved, done: Mapping[Effects, Solved]
) -> Iterator[Solved]:
    """Sets with one effect exchanged that were lost, begun where the best is."""
    own = set(best.fit.effects)
    lost = [s for s in done.values() if not s.fit.converged or refit.strayed(context, s)]
    lost = [s for s in lost if len(s.fit.effects) == len(own) > 1 and len(own & set(s.fit.effects)) == len(own) - 1]
    for effects in [s.fit.effects for s in sorted(lost, key=lambda s: -s.fit.log_evidence)[:EXCHANGED]]:
        h = hypothesis_of(catalogue, effects)
        (effect,) = (e for e in h.effects if e.name not in own)
        if evidence.shapes(effect) or effect.whole:
            continue
        points = [_at(h, _sizes(h, best) | sizes, best.fit.values, best.point.nuisance) for sizes in _scan(effect)]
        cost = [_misfit(context, h, p) for p in points]
        chosen = points[int(np.argmin(cost))]
        yield refit.fit(context, h, [chosen], best.known, None, _prior(catalogue, effects), hold=1)


def _placed_anew(context: Context, catalogue: Catalogue, best: Solved) -> Iterator[Solved]:
    """The best set with an effect that has a place put where the others of the set and the settings, as they are, leave
    room for it.

    Alone it was placed where it stood in for the others, too, or beside settings that had been bent to hide it (a plume
    of 22 sigma came out with the other sign, 160 mm off), and from there a descent does not come back.
    """
    h, prior = hypothesis_of(catalogue, best.fit.effects), _prior(catalogue, best.fit.effects)
    begun: list[_Begin] = []
    for e in h.effects:
        if not evidence.shapes(e):
            continue
        own = evidence.amplitudes(e)
        others = np.array([a not in own for a in h.amplitudes])
        without = {**best.fit.values, **{a.name: 0.0 for a in own}}
        linear, sizes = best.fit.linear, best.point.amplitude * others
        seen = context.whiten(context.problem.data - context.predict(without))
        seen = seen + linear.nuisance @ best.point.nuisance + linear.effect @ sizes
        sigma = np.array([a.sigma**a.power for a in h.amplitudes])
        there = with_columns(replace(linear, residual=seen), (linear.effect * sigma)[:, others])
        about = starts.Ground(there, without, best.fit.setting_scale)
        for (node,) in starts.best_nodes(context, catalogue, Hypothesis((e,)), about):
            size, place = starts.placed(context, e, catalogue.nodes[e.name][node].shape, about)
            at = _sizes(h, best) | {a.name: q for a, q in zip(own, size, strict=True)}
            point = _at(h, at, {**best.fit.values, **place}, best.point.nuisance)
            begun.append(_Begin(h, point, best.known, prior, stated=True))
    yield from each(context, _fitted, begun)


def _scan(effect: Effect) -> list[dict[str, float]]:
    """Amplitudes of one effect, one at a time, over their range."""
    out = []
    for a in evidence.amplitudes(effect):
        for size in SCANNED:
            for sign in (1.0,) if evidence.kind(a) else (1.0, -1.0):
                out.append({a.name: sign * (size * a.sigma) ** a.power})
    return out


def _misfit(context: Context, h: Hypothesis, point: Point) -> float:
    residual = context.problem.data - context.predict(values(context.problem, h, point))
    white = context.whiten(residual)
    return float(white @ white) if np.isfinite(white).all() else float("inf")


def _joined(context: Context, catalogue: Catalogue, best: Solved, done: Mapping[Effects, Solved]) -> Iterator[Solved]:
    """The best set and what else came near with settings about as stated, from the latter's fit."""
    own = set(best.fit.effects)
    others = [s for s in done.values() if s.fit.effects and s.fit.converged and not refit.bent(s)]
    others = [s for s in others if not own & set(s.fit.effects)]
    for other in sorted(others, key=lambda s: -s.fit.log_evidence)[:JOINED]:
        both = tuple(n for n in catalogue.effects if n in own or n in other.fit.effects)
        if len(both) <= LARGEST and (both not in done or refit.strayed(context, done[both])):
            yield attempt(context, catalogue, both, other, done, -np.inf)


def _grown(context: Context, catalogue: Catalogue, best: Solved, done: Mapping[Effects, Solved]) -> Iterator[Solved]:
    """The best set and one more effect, both sought from the stated settings.

    What shows by its square beside itself (`_even`) is fitted from a size of either sign and the stated settings: of a
    coma of 15 sigma beside the tilt that hid it neither a column nor foresight saw enough, and a descent from 0 stayed
    in the other sign's valley.
    """
    own = best.fit.effects
    if len(own) >= LARGEST or any(catalogue.effects[e].whole for e in own):
        return
    news = [new for new in catalogue.effects if new not in own]
    for effects, foretold in _sought(context, catalogue, best, own, news, done):
        yield attempt(context, catalogue, effects, best, done, -np.inf, foretold.points)
    begun = []
    for e in (catalogue.effects[n] for n in news):
        if evidence.shapes(e) or e.whole:
            continue
        h = hypothesis_of(catalogue, tuple(n for n in catalogue.effects if n in own or n == e.name))
        here = {a.name: 0.0 for a in h.amplitudes} | _sizes(h, best)
        for a, sign in product(_even(context, e), (1.0, -1.0)):
            size = {a.name: sign * BEGIN * a.sigma}
            point = _at(h, here | size, best.fit.values, np.zeros_like(best.point.nuisance))
            begun.append(_Begin(h, point, context.stated() or best.known, _prior(catalogue, h.names), stated=False))
    yield from each(context, _fitted, begun)


def _even(context: Context, effect: Effect) -> list[Parameter]:
    """Amplitudes of either sign whose second order, at `BEGIN`, settings leave visible beside the first."""
    stated = context.stated()
    if stated is None:
        return []
    nuisance, out = context.whiten(stated.columns), []
    sigma = np.ones(nuisance.shape[1])
    factor = linear.precision(nuisance, sigma)
    for a in evidence.amplitudes(effect):
        size, fixed = BEGIN * a.sigma, dict(evidence.fixed(effect))
        change = None if evidence.kind(a) else context.change(a, size, fixed)
        if change is None:
            continue
        both = np.column_stack([size * context.columns(fixed, (a,))[:, 0], size**2 * change[1]])
        both = context.whiten(both)
        left = linear.through(nuisance, sigma, both, factor, nuisance.T @ both, both.T @ both)
        first, second = np.sqrt(np.diag(left))
        if second > max(SEEN, EVEN * first):
            out.append(a)
    return out


def _bent_otherwise(
    context: Context, catalogue: Catalogue, best: Solved, done: Mapping[Effects, Solved]
) -> Iterator[Solved]:
    """The best set with an effect that bends the data exchanged for another that does, sought from the stated settings.

    What widens a line as the square of its size shows in no column about a fit without it, so that it is neither
    weighed right there nor seen to be near: beside a sheared grid a coma of 13 sigma was never tried, and was an
    astigmatism.
    """
    own = best.fit.effects
    if len(own) < 2 or any(catalogue.effects[e].whole for e in own):
        return
    sizes = _sizes(hypothesis_of(catalogue, own), best)
    begun: list[_Begin] = []
    for e in (catalogue.effects[n] for n in own):
        if not any(_bends(context, e, a, sizes[a.name]) for a in evidence.amplitudes(e)):
            continue
        others = [n for n in catalogue.effects.values() if n.name not in own and not evidence.shapes(n) and not n.whole]
        news = [n.name for n in others if any(_bends(context, n, a, a.sigma**a.power) for a in evidence.amplitudes(n))]
        for effects, foretold in _sought(context, catalogue, best, tuple(n for n in own if n != e.name), news, done):
            if foretold.log_evidence > best.fit.log_evidence - PROMISING:
                h, prior = hypothesis_of(catalogue, effects), _prior(catalogue, effects)
                begun += [_from_stated(context, h, point, best, prior) for point in foretold.points]
    yield from each(context, _fitted, begun)


def _sought(
    context: Context,
    catalogue: Catalogue,
    best: Solved,
    kept: Effects,
    news: Sequence[str],
    done: Mapping[Effects, Solved],
) -> list[tuple[Effects, Foretold]]:
    """Some effects of the best set and each of others beside them, by foresight: the most promising, the prior of
    presence included."""
    sets = [tuple(n for n in catalogue.effects if n in kept or n == new) for new in news]
    sets = [e for e in sets if e not in done or refit.strayed(context, done[e])]
    at = {
        a.name: fit_value(a, best.fit.values[a.name]) for e in kept for a in evidence.amplitudes(catalogue.effects[e])
    }
    held = {e: _placed(catalogue.effects[e], best.fit.values) for e in kept}
    hypotheses = [Hypothesis(tuple(held.get(n, catalogue.effects[n]) for n in effects)) for effects in sets]
    found: list[tuple[Effects, Foretold]] = []
    for effects, f in zip(sets, foresight.foretell_all(context, hypotheses, at), strict=True):
        if f is not None:
            shape = np.array([best.fit.values[p.name] for p in hypothesis_of(catalogue, effects).shapes])
            points = tuple(replace(point, shape=shape) for point in f.points)
            found.append((effects, Foretold(f.log_evidence + _prior(catalogue, effects), points)))
    return sorted(found, key=lambda own: -own[1].log_evidence)[:SOUGHT]


def _placed(effect: Effect, at: Mapping[str, float]) -> Effect:
    """An effect whose place, width and period are where a fit has them."""
    return replace(effect, parameters=tuple(replace(p, grid=(at[p.name],)) if p.grid else p for p in effect.parameters))
