"""Which hypotheses are fitted: the null, every single effect, and what grows from the best of them.

    null → all singles → add, drop, exchange about the best until nothing gains → derivatives of what matters made exact

A fit ends in the valley that it starts in. So every set is fitted from several starts: from a fit with one effect less,
with that effect's amplitude wherever the linearisation about that fit, bent by the amplitude's own second derivative,
has a minimum; from the effect's own single fit; and from the stated settings, since those of a smaller fit may have
been bent to hide what it lacks. What was not fitted is weighed by linear algebra about the best fit that differs by one
effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from benchsim.diagnosis import degeneracy, evidence, linear, screen, settings
from benchsim.diagnosis.discrepancy import absorb
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fitting import RENEWALS, Start, as_it_stands, fitted, misses
from benchsim.diagnosis.hypothesis import LARGEST, Context, Effects, Hypothesis, Point, Solved, values
from benchsim.diagnosis.places import Place, unseen, valleys, whole
from benchsim.diagnosis.screen import Catalogue

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

MATTERS, IDLE = 6.0, 1.5
"""ln Z behind the best from which on what was only weighed is left at that, and what was fitted without exact
derivatives (what may be a member of a class is nearer); and the same for what was weighed about a good
fit of fewer effects: that linearisation is the right one unless what is added is large, and then it is not behind."""

AT_ONCE, ROUNDS = 8, 8
"""Sets taken up for what they were weighed, and how often, at most: what is tried at all."""

TOGETHER = 10
"""Sets whose fits step together: more take memory and save little."""

NEARBY, RIVALS = 6.0, 3
"""Separation in sigma up to which sets with one effect exchanged for another are fitted beside the best, and how many:
where the data bend, the right one of two that look alike may have been weighed wrong."""

VALLEYS = 3
"""Minima of an amplitude's own curve, or best places of an effect that has a place, from which a fit begins."""

BENT = 1.3
"""Mean setting scale from which on a fit's settings are taken to hide an effect: then every effect is tried beside it,
and from the stated settings. It costs time only; a tilt's settings hid a coma of 9 sigma at 1.37."""

SQUARE, NOTICED = 0.25, 3.0
"""What bends the data: at half a prior sigma its square shows by a quarter as much as itself, and by 3 sigma."""

SIZES = (0.25, 0.5, 1.0, 2.0)
"""Prior sigmas to either side at which what bends the data is tried."""


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
        return evidence.log_prior(effects, list(self.names))

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
        e: Begun(x.point, _scale(s, x), linear.raised(s.context.lower, x.columns[:, :p]))
        for e, x in s.done.items()
        if e
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
    """Fit sets from all their starts, some sets together, by derivatives that follow their steps."""
    for some in (sets[i : i + TOGETHER] for i in range(0, len(sets), TOGETHER)):
        starts = [start for effects in some for start in _starts(s, effects)]
        # Single effects are followed whatever they promise: larger sets begin at them.
        floor = -np.inf if any(len(e) == 1 for e in some) else s.best().fit.log_evidence - MATTERS
        _keep(s, fitted(s.context, starts, {e: s.prior(e) for e in some}, renewals=0, floor=floor))


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

    def begin(nuisance: Array, places: Mapping[str, Place], about: Solved, own: Mapping[str, Array]) -> None:
        # Settings as stated lead elsewhere than those of a fit, and look worse at first: the two do not race.
        race = int(about is s.stated)
        out.append(Start(h, _point(s, h, nuisance, places), about.columns[:, :p], _scale(s, about), own, race))

    if sum(s.catalogue.effects[e].whole for e in effects) > 1:
        ones = {e: Place(0.0, np.ones(len(evidence.amplitudes(s.catalogue.effects[e]))), np.zeros(0)) for e in effects}
        begin(np.zeros(p), ones, s.stated, {})
    parents = [tuple(n for n in effects if n != new) for new in effects]
    parents = sorted((e for e in parents if e in s.done), key=lambda e: -s.done[e].fit.log_evidence)[:2]
    sources = [s.done[e] for e in parents]
    if len(effects) == 1 and strayed(s.context, s.done[()]):
        sources.append(s.stated)
    for parent in sources:
        (new,) = (n for n in effects if n not in parent.fit.effects)
        kept = {e: _of(s, parent, e) for e in parent.fit.effects}
        own = _columns(s, parent) | _straight(s, new)
        many = _places(s, parent, [new])[new][:VALLEYS]
        if (new,) in s.done and len(effects) > 1:
            many = [*many, _of(s, s.done[(new,)], new)]
        for place in many:
            begin(parent.point.nuisance, {**kept, new: place}, parent, own)
        if parent is s.stated or (len(effects) > 1 and strayed(s.context, parent)):
            for place in _either(s, h, kept, new) if new in s.bending else _anew(s, parent, new) if kept else []:
                begin(np.zeros(p), {**kept, new: place}, s.stated, own)
    for above in (x for x in s.done.values() if len(x.fit.effects) == len(effects) + 1 and not misses(x)):
        if set(effects) < set(above.fit.effects):
            start = Start(
                h,
                _point(s, h, above.point.nuisance, {e: _of(s, above, e) for e in effects}),
                above.columns[:, :p],
                _scale(s, above),
                _columns(s, above),
            )
            out.append(start)
            break
    return out


def _columns(s: Search, solved: Solved) -> dict[str, Array]:
    """A fit's whitened derivatives by what its effects have."""
    h = s.hypothesis(solved.fit.effects)
    own = solved.columns[:, len(s.context.problem.nuisances) :]
    return {q.name: own[:, i] for i, q in enumerate((*h.amplitudes, *h.shapes))}


def _straight(s: Search, name: str) -> dict[str, Array]:
    """The catalogue's derivatives by an effect's amplitudes, where they are about the same at any size and place."""
    effect = s.catalogue.effects[name]
    if name in s.bending or evidence.shapes(effect):
        return {}
    at = s.catalogue.nodes[name][0].columns
    return {a.name: s.white[:, c] for a, c in zip(evidence.amplitudes(effect), at, strict=True)}


def _either(s: Search, h: Hypothesis, kept: Mapping[str, Place], name: str) -> list[Place]:
    """Amplitudes of either sign from which a fit of what acts by its square begins at the stated settings.

    Those whose predictions beside what is kept, settings integrated to first order, leave least: a small coma leads to
    none of 2 sigma.
    """
    own = evidence.amplitudes(s.catalogue.effects[name])
    sides = [(1.0,) if evidence.kind(a) else (-1.0, 1.0) for a in own]
    unit = np.array([a.sigma**a.power for a in own])
    many = [Place(0.0, size * np.array(signs) * unit, np.zeros(0)) for size in SIZES for signs in product(*sides)]
    p = np.zeros(len(s.context.problem.nuisances))
    asked = [values(s.context.problem, h, _point(s, h, p, {**kept, name: place})) for place in many]
    left = s.context.whiten(s.context.problem.data[:, None] - np.column_stack(s.context.predict(asked)))
    chi2 = np.diag(linear.marginal(s.stated.fit.linear, left, s.done[()].fit.setting_scale).gram)
    return [many[i] for i in np.argsort(chi2) if np.isfinite(chi2[i])][:VALLEYS]


def _anew(s: Search, parent: Solved, name: str) -> list[Place]:
    """Where an effect might begin beside the effects of a fit, but at the stated settings."""
    point = replace(parent.point, nuisance=np.zeros_like(parent.point.nuisance))
    nuisance = linear.raised(s.context.lower, s.stated.columns[:, : len(point.nuisance)])
    about = as_it_stands(s.context, s.hypothesis(parent.fit.effects), point, nuisance)
    return _places(s, about, [name])[name][:VALLEYS]


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
            many = valleys(effect, m.gram[np.ix_(pair, pair)], m.projection[pair])
            shape = np.array([node.shape[p.name] for p in shapes])
            found.append([Place(gain + node.log_weight, q, shape) for gain, q in many])
        if shapes:
            # Of a grid of places those that are better than all about them with the same sign: beside a place the
            # other sign imitates what is there, and no fit leads from one to the other.
            grid = [len(p.grid) for p in shapes]
            gain, sign = (
                np.reshape(x, grid) for x in zip(*((m[0].gain, np.sign(m[0].amplitude[0])) for m in found), strict=True)
            )
            of = [np.where(sign == one, gain, -np.inf) for one in (-1, 1)]
            best = sum((g == maximum_filter(g, 3, mode="nearest")) & np.isfinite(g) for g in of)
            found = [[found[i][0] for i in np.flatnonzero(best)]]
        out[name] = sorted(found[0], key=lambda x: -x.gain)
    return out


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
        _exactly(s, [e for e, x in s.done.items() if not x.exact and x.fit.log_evidence > top - MATTERS])


def _exactly(s: Search, sets: Sequence[Effects]) -> None:
    """Follow fits from where they ended with exact derivatives."""
    p, some = len(s.context.problem.nuisances), [s.done[e] for e in sets]
    starts = [Start(s.hypothesis(x.fit.effects), x.point, x.columns[:, :p], _scale(s, x), _columns(s, x)) for x in some]
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
