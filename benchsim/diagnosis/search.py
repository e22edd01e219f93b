"""Which hypotheses are fitted: the null, every single effect, and what grows from the best of them.

    null → all singles → add, drop, exchange about the best until nothing gains → derivatives of what matters made exact

A fit ends in the valley that it starts in. So every set is fitted from several starts: from a fit with one effect less,
with that effect's amplitude wherever the linearisation about that fit, bent by the amplitude's own second derivative,
has a minimum; from the effect's own single fit; and from the stated settings, since those of a smaller fit may have been
bent to hide what it lacks. What was not fitted is weighed by linear algebra about the best fit that differs by one
effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from benchsim.diagnosis import classes, evidence, linear, screen, settings
from benchsim.diagnosis.attachments import absorb
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fits import LARGEST, Effects
from benchsim.diagnosis.fitting import Start, fitted, misses
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Point, Solved
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.screen import Catalogue

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

MATTERS, IDLE = 6.0, 1.5
"""ln Z behind the best at which what was only weighed is left at that, and the same for what was weighed about a good
fit of fewer effects: that linearisation is the right one unless what is added is large, and then it is not behind."""

AT_ONCE, ROUNDS = 8, 8
"""Sets fitted together, and how often, at most: what is tried at all."""

NEARBY, RIVALS = 6.0, 3
"""Separation in sigma up to which sets with one effect exchanged for another are fitted beside the best, and how many:
where the data bend, the right one of two that look alike may have been weighed wrong."""

VALLEYS = 3
"""Minima of an amplitude's own curve, or best places of an effect that has a place, from which a fit begins."""

AMPLITUDES = np.concatenate([-np.geomspace(2.5, 0.02, 12), [0.0], np.geomspace(0.02, 2.5, 12)])
"""Prior sigmas at which that curve is looked at, before `POLISHED` steps to each of its minima."""

POLISHED = 6

BENT = 1.3
"""Mean setting scale from which on a fit's settings are taken to hide an effect: then every effect is tried beside it,
and from the stated settings. It costs time only; a tilt's settings hid a coma of 9 sigma at 1.37."""

SQUARE, NOTICED, QUARTER = 0.25, 3.0, 0.25
"""What bends the data: at half a prior sigma its square shows by a quarter as much as itself, and by 3 sigma; and the
prior sigmas to either side from which it begins."""

RENEWALS = 8
"""Most exact Jacobians of a fit that matters."""

EXACT = 6.0
"""ln Z behind the best within which derivatives are made exact: what may be a member of a class, and some."""


@dataclass(frozen=True)
class Place:
    """Where an effect might begin beside a fit: its amplitudes and shapes, and the gain in ln Z foretold."""

    gain: float
    amplitude: Array
    shape: Array


@dataclass(frozen=True)
class Begun:
    """Where a fit ended when the noise was estimated worse: its point, setting scale, and derivatives by the nuisances
    (n, p), not whitened."""

    point: Point
    scale: int
    nuisance: Array


@dataclass
class Search:
    """A search on its way.

    Attributes
    ----------
    log_z, source
        ln Z of every set that was weighed or fitted, and the fit about which.
    done
        Best fit of each set.
    """

    context: Context
    catalogue: Catalogue
    log_z: dict[Effects, float]
    source: dict[Effects, Effects]
    done: dict[Effects, Solved]
    stated: Solved
    earlier: Mapping[Effects, Begun] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = tuple(self.catalogue.effects)
        self.white = self.context.whiten(self.catalogue.columns)
        self.bends = self.context.whiten(self.catalogue.bends)
        self.bending = frozenset(n for n in self.names if _bends(self, n))

    def prior(self, effects: Effects) -> float:
        return screen.log_prior(effects, list(self.names))

    def hypothesis(self, effects: Effects) -> Hypothesis:
        return Hypothesis(tuple(self.catalogue.effects[e] for e in effects))

    def ordered(self, effects: Sequence[str]) -> Effects:
        return tuple(n for n in self.names if n in effects)

    def best(self) -> Solved:
        """The most probable fit that may be built on."""
        some = [s for s in self.done.values() if s.fit.converged] or list(self.done.values())
        return max(some, key=lambda s: s.fit.log_evidence)


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
    first = [(n,) for n in s.names] + _wholes(s)
    tell("fitting single effects", 0.4)
    _fit(s, first)
    if strayed(context, null):
        # How settings act changes with what bends the data: without exact derivatives such a fit gets lost.
        _exactly(s, [(n,) for n in s.names if n in s.bending])
    for turn in range(ROUNDS):
        tell(f"fitting {' + '.join(s.best().fit.effects) or 'settings'} and its like", 0.5 + 0.4 * turn / ROUNDS)
        _settle(s)
        chosen = _next(s)
        if not chosen:
            break
        _fit(s, chosen)
    _settle(s)
    return s


def begun(s: Search) -> dict[Effects, Begun]:
    """Where the fits of a search ended, for one with other noise."""
    p = len(s.context.problem.nuisances)
    return {
        e: Begun(x.point, _scale(s, x), s.context.whiten.undone(x.columns[:, :p])) for e, x in s.done.items() if e
    }


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


def strayed(context: Context, solved: Solved) -> bool:
    """Whether a fit's settings were bent, so that what they hide shows in no linearisation about it; or it misses."""
    return misses(solved) or settings.size(context.scales, solved.fit.log_scales)[0] > BENT


def _margin(s: Search, effects: Effects) -> float:
    """`MATTERS`, or `IDLE`."""
    about = s.done[s.source[effects]]
    return IDLE if len(about.fit.effects) < len(effects) and about.exact and not misses(about) else MATTERS


def _rivals(s: Search, best: Solved) -> list[Effects]:
    """Sets with one effect exchanged that could stand in for what the best has of it."""
    own = best.fit.effects
    if not own or misses(best):
        return []
    about = whole(s.context, s.catalogue, best)
    within = classes.space(s.context.problem, classes.about(about, best.fit), best.fit.setting_scale)
    signal = classes.amplitude_vector(s.context.problem, about.names, best.fit)
    near: dict[Effects, float] = {}
    for out in own:
        for new in (n for n in s.names if n not in own):
            effects = s.ordered([*(n for n in own if n != out), new])
            near[effects] = classes.separation(within, signal, effects)
    close = sorted((e for e in near if near[e] < NEARBY), key=lambda e: near[e])
    return close[:RIVALS]


def _fit(s: Search, sets: Sequence[Effects]) -> None:
    """Fit sets from all their starts together, by derivatives that follow their steps."""
    starts = [start for effects in sets for start in _starts(s, effects)]
    ends = fitted(s.context, starts, {e: s.prior(e) for e in sets}, renewals=0)
    _keep(s, ends)


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
        s.log_z[effects], s.source[effects] = s.done[effects].fit.log_evidence, effects
    for effects in sorted(found, key=lambda e: -s.done[e].fit.log_evidence):
        _weigh_about(s, s.done[effects])


def _starts(s: Search, effects: Effects) -> list[Start]:
    """Where the fit of a set begins."""
    h = s.hypothesis(effects)
    if effects in s.earlier:
        begun = s.earlier[effects]
        return [Start(h, begun.point, s.context.whiten(begun.nuisance), begun.scale)]
    out: list[Start] = []
    p = len(s.context.problem.nuisances)
    if sum(s.catalogue.effects[e].whole for e in effects) > 1:
        ones = {e: Place(0.0, np.ones(len(evidence.amplitudes(s.catalogue.effects[e]))), np.zeros(0)) for e in effects}
        out.append(Start(h, _point(s, h, np.zeros(p), ones), s.stated.columns[:, :p]))
    parents = [tuple(n for n in effects if n != new) for new in effects]
    parents = sorted((e for e in parents if e in s.done), key=lambda e: -s.done[e].fit.log_evidence)[:2]
    sources = [s.done[e] for e in parents]
    if len(effects) == 1 and strayed(s.context, s.done[()]):
        sources.append(s.stated)
    for parent in sources:
        (new,) = (n for n in effects if n not in parent.fit.effects)
        kept = {e: _of(s, parent, e) for e in parent.fit.effects}
        many = _places(s, parent, [new])[new][:VALLEYS]
        if (new,) in s.done and len(effects) > 1:
            many = [*many, _of(s, s.done[(new,)], new)]
        if parent is s.stated and new in s.bending:
            many = [*many, *_either(s, new)]
        for place in many:
            point = _point(s, h, parent.point.nuisance, {**kept, new: place})
            out.append(Start(h, point, parent.columns[:, :p], _scale(s, parent)))
        if len(effects) > 1 and strayed(s.context, parent):
            point = _point(s, h, np.zeros(p), {**kept, new: many[-1]})
            out.append(Start(h, point, s.stated.columns[:, :p]))
    for above in (x for x in s.done.values() if len(x.fit.effects) == len(effects) + 1 and not misses(x)):
        if set(effects) < set(above.fit.effects):
            point = _point(s, h, above.point.nuisance, {e: _of(s, above, e) for e in effects})
            out.append(Start(h, point, above.columns[:, :p], _scale(s, above)))
            break
    return out


def _either(s: Search, name: str) -> list[Place]:
    """Amplitudes of either sign, from which a fit of what acts by its square begins."""
    sides = [(1.0,) if evidence.kind(a) else (-1.0, 1.0) for a in evidence.amplitudes(s.catalogue.effects[name])]
    unit = np.array([a.sigma**a.power for a in evidence.amplitudes(s.catalogue.effects[name])])
    return [Place(0.0, QUARTER * np.array(signs) * unit, np.zeros(0)) for signs in product(*sides)]


def _scale(s: Search, solved: Solved) -> int:
    """Where a fit's setting scale is on the grid."""
    return int(np.argmin(np.abs(s.context.scales - solved.fit.setting_scale)))


def _of(s: Search, solved: Solved, name: str) -> Place:
    """One effect as a fit has it."""
    h = s.hypothesis(solved.fit.effects)
    number = {a.name: i for i, a in enumerate(h.amplitudes)}, {a.name: i for i, a in enumerate(h.shapes)}
    effect = s.catalogue.effects[name]
    amplitude = [solved.point.amplitude[number[0][a.name]] for a in evidence.amplitudes(effect)]
    shape = [solved.point.shape[number[1][a.name]] for a in evidence.shapes(effect)]
    return Place(0.0, np.array(amplitude), np.array(shape))


def _point(s: Search, h: Hypothesis, nuisance: Array, places: Mapping[str, Place]) -> Point:
    parts = [places[e.name] for e in h.effects]
    amplitude = np.concatenate([p.amplitude for p in parts]) if parts else np.zeros(0)
    return Point(nuisance, amplitude, np.concatenate([p.shape for p in parts]) if parts else np.zeros(0))


def _places(s: Search, about: Solved, names: Sequence[str]) -> dict[str, list[Place]]:
    """Where effects might begin beside a fit, most promising first.

    The residual that amplitudes q leave is r − J q − ½ B q², nuisances and the fit's own amplitudes integrated to first
    order: a polynomial, whose minima are found on a grid. A width answers to either sign of a defocus alike, so that at
    q = 0 it has no slope at all.
    """
    if not names:
        return {}
    lin, out = absorb(s.context.problem, about.fit.linear), {}
    at = np.array([c for n in names for node in s.catalogue.nodes[n] for c in node.columns])
    m = linear.marginal(lin, np.column_stack([s.white[:, at], s.bends[:, at]]), about.fit.setting_scale)
    first = 0
    for name in names:
        effect, found = s.catalogue.effects[name], []
        shapes = evidence.shapes(effect)
        for node in s.catalogue.nodes[name]:
            own = np.arange(first, first + len(node.columns))
            pair, first = np.concatenate([own, len(at) + own]), first + len(own)
            many = _valleys(effect, m.gram[np.ix_(pair, pair)], m.projection[pair])
            shape = np.array([node.shape[p.name] for p in shapes])
            found.append([Place(gain + node.log_weight, q, shape) for gain, q in many])
        if shapes:
            # Of a grid of places those that are better than all about them.
            gain = np.reshape([many[0].gain for many in found], [len(p.grid) for p in shapes])
            found = [[found[i][0] for i in np.flatnonzero(gain == maximum_filter(gain, 3, mode="nearest"))]]
        out[name] = sorted(found[0], key=lambda x: -x.gain)
    return out


def _valleys(effect: screen.Effect, gram: Array, projection: Array) -> list[tuple[float, Array]]:
    """Gain and amplitudes (fit space) of an effect's minima beside a fit."""
    own = evidence.amplitudes(effect)
    k = len(own)
    unit = np.array([a.sigma**a.power for a in own])
    prior = np.diag(unit**-2.0)
    if effect.whole:
        return [(0.0, np.ones(k))]
    if k > 2:
        q = np.linalg.solve(gram[:k, :k] + prior, projection[:k])
        q = np.array([max(x, 0.1 * u) if evidence.kind(a) else x for x, a, u in zip(q, own, unit, strict=True)])
        return [(float(0.5 * projection[:k] @ q), q)]
    axes = [AMPLITUDES[AMPLITUDES >= 0] if evidence.kind(a) else AMPLITUDES for a in own]
    power, low = np.array([a.power for a in own]), np.array([0.0 if evidence.kind(a) else -np.inf for a in own])

    def cost(value: Array) -> Array:
        q = (value * np.array([a.sigma for a in own])) ** power
        w = np.concatenate([q, 0.5 * q**2], axis=-1)
        return 0.5 * np.einsum("...i,ij,...j", w, gram, w) - w @ projection + 0.5 * (value**2).sum(axis=-1)

    def slopes(value: Array) -> Array:
        q, unit = (value * np.array([a.sigma for a in own])) ** power, np.array([a.sigma for a in own]) ** power
        return np.vstack([np.eye(k), np.diag(q)]) * (unit * np.where(power == 2, 2 * value, 1.0))

    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    height, out = cost(mesh), []
    for i in np.argwhere(height == minimum_filter(height, 3, mode="nearest")):
        value = mesh[tuple(i)]
        for _ in range(POLISHED):
            q = (value * np.array([a.sigma for a in own])) ** power
            slope = slopes(value)
            force = slope.T @ (projection - gram @ np.concatenate([q, 0.5 * q**2])) - value
            step = np.linalg.solve(slope.T @ gram @ slope + np.eye(k), force)
            tried = [np.maximum(value + part * step, low) for part in (1.0, 0.3, 0.1)]
            best = min(tried, key=lambda v: float(cost(v)))
            if not cost(best) < cost(value):
                break
            value = best
        slope = slopes(value)
        gain = -float(cost(value)) - 0.5 * float(np.linalg.slogdet(slope.T @ gram @ slope + np.eye(k))[1])
        # One-sided effects begin off their boundary, where a derivative may be of the other side.
        start = np.where(low == 0, np.maximum(value, 0.1), value) * np.array([a.sigma for a in own])
        out.append((gain, start**power))
    return sorted(out, key=lambda x: -x[0])


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
    for name, many in _places(s, solved, bending).items():
        effects = s.ordered([*own, name])
        foretold = solved.fit.log_evidence - s.prior(own) + many[0].gain + s.prior(effects)
        s.log_z[effects] = max(s.log_z[effects], foretold)


def log_z_about(s: Search, solved: Solved, wanted: Sequence[Effects]) -> dict[Effects, float]:
    """ln Z of sets about a fit by linear algebra, prior of presence included; what both hold has its columns there."""
    h = s.hypothesis(solved.fit.effects)
    own = solved.columns[:, len(s.context.problem.nuisances) :]
    columns = np.column_stack([own, s.white])
    number = {p.name: i for i, p in enumerate((*h.amplitudes, *h.shapes))}
    cache: dict[str, list[Term]] = {}
    listed = []
    for effects in wanted:
        kept = Hypothesis(tuple(e for e in h.effects if e.name in effects))
        there = [number[p.name] for p in (*kept.amplitudes, *kept.shapes)]
        base = [replace(t, columns=tuple(there[c] for c in t.columns)) for t in kept.terms()]
        more = tuple(e for e in effects if e not in h.names)
        joined = screen.hypothesis_terms(s.catalogue, more, cache, own.shape[1])
        listed.append((effects, [screen.join(a, b) for a in base for b in joined]))
    found = screen.weigh(solved.fit.linear, columns, s.context.scales, s.context.weights, listed)
    return {e: z + s.prior(e) for e, z in found.items()}


def _settle(s: Search) -> None:
    """Make the derivatives of what matters exact."""
    for _ in range(2):
        top = s.best().fit.log_evidence
        _exactly(s, [e for e, x in s.done.items() if not x.exact and x.fit.log_evidence > top - EXACT])


def _exactly(s: Search, sets: Sequence[Effects]) -> None:
    """Follow fits from where they ended with exact derivatives."""
    p, some = len(s.context.problem.nuisances), [s.done[e] for e in sets]
    starts = [Start(s.hypothesis(x.fit.effects), x.point, x.columns[:, :p], _scale(s, x)) for x in some]
    _keep(s, fitted(s.context, starts, {e: s.prior(e) for e in sets}, renewals=RENEWALS))


def _bends(s: Search, name: str) -> bool:
    """Whether the data answer to an effect's size by its square, not much less than by itself."""
    effect = s.catalogue.effects[name]
    if evidence.shapes(effect) or effect.whole or effect.random_field:
        return False
    at = list(s.catalogue.nodes[name][0].columns)
    lin = s.stated.fit.linear
    half = np.array([screen.BENT * a.sigma**a.power for a in evidence.amplitudes(effect)])
    both = np.column_stack([s.white[:, at] * half, 0.5 * s.bends[:, at] * half**2])
    left = np.sqrt(np.diag(linear.marginal(lin, both, s.done[()].fit.setting_scale).gram))
    first, second = left[: len(at)], left[len(at) :]
    return bool(((second > SQUARE * first) & (second > NOTICED)).any())


SEEN = 6.0
"""Sigma from 0, at its place, from which on Laplace's method holds for an effect with a place. Of the best of many
places chance makes four."""


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


def whole(context: Context, catalogue: Catalogue, solved: Solved) -> Linear:
    """About a fit: the amplitudes of the whole catalogue, shapes at their most probable node."""
    names: list[str] = []
    columns: list[int] = []
    white = context.whiten(catalogue.columns)
    m = linear.marginal(absorb(context.problem, solved.fit.linear), white, solved.fit.setting_scale)
    for effect in context.problem.catalogue:
        def gain(node: screen.Node) -> float:
            at = list(node.columns)
            inner = m.gram[np.ix_(at, at)] + np.diag([p.sigma ** (-2.0 * p.power) for p in evidence.amplitudes(effect)])
            return float(m.projection[at] @ np.linalg.solve(inner, m.projection[at]))

        node = max(catalogue.nodes[effect.name], key=gain)
        names += [p.name for p in evidence.amplitudes(effect)]
        columns += node.columns
    return replace(solved.fit.linear, effect=white[:, columns], names=tuple(names))
