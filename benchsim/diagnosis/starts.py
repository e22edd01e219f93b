"""Where the fit of a set of effects begins.

A fit ends in the valley that it starts in. So every set is fitted from several starts: from a fit with one effect less,
with that effect's amplitude wherever the linearisation about that fit, bent by the amplitude's own second derivative,
has a minimum; from the effect's own single fit; and from the stated settings, since those of a smaller fit may have
been bent to hide what it lacks. Those that begin at the same settings race (`fitting.fitted`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.discrepancy import absorb
from benchsim.diagnosis.explored import Search, columns_of, scale_of, strayed
from benchsim.diagnosis.fitting import Start, as_it_stands, misses
from benchsim.diagnosis.hypothesis import Effects, Hypothesis, Point, Solved, values
from benchsim.diagnosis.problem import Effect

Array = NDArray[np.float64]

VALLEYS = 3
"""Minima of an amplitude's own curve, or best places of an effect that has a place, from which a fit begins."""

SIZES = np.linspace(-2.0, 2.0, 7)
"""Prior sigmas at which what bends the data is tried, each amplitude of an effect beside all of the others: valleys are
narrow, and of a coma of 14 sigma along one axis no start on the diagonals found its own."""

AMPLITUDES = np.concatenate([-np.geomspace(2.5, 0.02, 12), [0.0], np.geomspace(0.02, 2.5, 12)])
"""Prior sigmas at which that curve is looked at, before `POLISHED` steps to each of its minima."""

POLISHED, PARTS = 6, (1.0, 0.3, 0.1)
"""Steps, and the parts of one that are tried."""


@dataclass(frozen=True)
class Place:
    """Where an effect might begin beside a fit: its amplitudes and shapes, and the gain in ln Z foretold."""

    gain: float
    amplitude: Array
    shape: Array


def starts(s: Search, effects: Effects) -> list[Start]:
    """Where the fit of a set begins."""
    h = s.hypothesis(effects)
    if effects in s.earlier and not (len(effects) == 1 and effects[0] in s.bending):
        begun = s.earlier[effects]
        return [Start(h, begun.point, s.context.whiten(begun.nuisance), begun.scale)]
    out: list[Start] = []
    p = len(s.context.problem.nuisances)

    def begin(nuisance: Array, places: Mapping[str, Place], about: Solved, own: Mapping[str, Array]) -> None:
        # Settings as stated lead elsewhere than those of a fit, and look worse at first: the two do not race.
        race = int(about is s.stated)
        out.append(Start(h, _point(s, h, nuisance, places), about.columns[:, :p], scale_of(s, about), own, race))

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
        own = columns_of(s, parent) | _straight(s, new)
        many = places(s, parent, [new])[new][:VALLEYS]
        if (new,) in s.done and len(effects) > 1:
            many = [*many, _of(s, s.done[(new,)], new)]
        for place in many:
            begin(parent.point.nuisance, {**kept, new: place}, parent, own)
        if parent is s.stated or (len(effects) > 1 and strayed(s.context, parent)):
            for place in _either(s, h, kept, new) if new in s.bending else _anew(s, parent, new) if kept else []:
                begin(np.zeros(p), {**kept, new: place}, s.stated, own)
    for above in (x for x in s.done.values() if len(x.fit.effects) == len(effects) + 1 and not misses(x)):
        if set(effects) < set(above.fit.effects):
            out.append(at_fit(s, effects, above))
            break
    return out


def at_fit(s: Search, effects: Effects, solved: Solved) -> Start:
    """Where a fit ended, of a set that it holds."""
    h = s.hypothesis(effects)
    point = _point(s, h, solved.point.nuisance, {e: _of(s, solved, e) for e in effects})
    p = len(s.context.problem.nuisances)
    return Start(h, point, solved.columns[:, :p], scale_of(s, solved), columns_of(s, solved))


def _straight(s: Search, name: str) -> dict[str, Array]:
    """The catalogue's derivatives by an effect's amplitudes, where they are about the same at any size and place."""
    effect = s.catalogue.effects[name]
    if name in s.bending or evidence.shapes(effect):
        return {}
    at = s.catalogue.nodes[name][0].columns
    return {a.name: s.white[:, c] for a, c in zip(evidence.amplitudes(effect), at, strict=True)}


def _either(s: Search, h: Hypothesis, kept: Mapping[str, Place], name: str) -> list[Place]:
    """Amplitudes from which a fit of what acts by its square begins at the stated settings.

    Those whose predictions beside what is kept, settings integrated to first order, leave less than all about them: a
    small coma leads to none of 2 sigma.
    """
    own = evidence.amplitudes(s.catalogue.effects[name])
    axes = [SIZES[SIZES >= 0] if evidence.kind(a) else SIZES for a in own]
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) * [a.sigma**a.power for a in own]
    many = [Place(0.0, q, np.zeros(0)) for q in mesh.reshape(-1, len(own))]
    p = np.zeros(len(s.context.problem.nuisances))
    asked = [values(s.context.problem, h, _point(s, h, p, {**kept, name: place})) for place in many]
    left = s.context.whiten(s.context.problem.data[:, None] - np.column_stack(s.context.predict(asked)))
    chi2 = np.diag(linear.marginal(s.stated.fit.linear, left, s.done[()].fit.setting_scale).gram)
    chi2 = np.where(np.isfinite(chi2), chi2, np.inf).reshape(mesh.shape[:-1])
    lowest = np.flatnonzero((chi2 == minimum_filter(chi2, 3, mode="nearest")) & np.isfinite(chi2))
    return [many[i] for i in lowest[np.argsort(chi2.ravel()[lowest])]][:VALLEYS]


def _anew(s: Search, parent: Solved, name: str) -> list[Place]:
    """Where an effect might begin beside the effects of a fit, but at the stated settings."""
    own = parent.fit.effects
    if own not in s.afresh:
        point = replace(parent.point, nuisance=np.zeros_like(parent.point.nuisance))
        nuisance = linear.raised(s.context.lower, s.stated.columns[:, : len(point.nuisance)])
        s.afresh[own] = as_it_stands(s.context, s.hypothesis(own), point, nuisance)
    return places(s, s.afresh[own], [name])[name][:VALLEYS]


def _of(s: Search, solved: Solved, name: str) -> Place:
    """One effect as a fit has it."""
    h, own = s.hypothesis(solved.fit.effects), s.catalogue.effects[name].parameters
    amplitude, shape = (
        x[[p in own for p in known]]
        for x, known in ((solved.point.amplitude, h.amplitudes), (solved.point.shape, h.shapes))
    )
    return Place(0.0, amplitude, shape)


def _point(s: Search, h: Hypothesis, nuisance: Array, places: Mapping[str, Place]) -> Point:
    parts = [places[e.name] for e in h.effects]
    amplitude = np.concatenate([p.amplitude for p in parts]) if parts else np.zeros(0)
    return Point(nuisance, amplitude, np.concatenate([p.shape for p in parts]) if parts else np.zeros(0))


def places(s: Search, about: Solved, names: Sequence[str]) -> dict[str, list[Place]]:
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
        effect, nodes = s.catalogue.effects[name], s.catalogue.nodes[name]
        shapes, k = evidence.shapes(effect), len(nodes[0].columns)
        own = first + np.arange(k * len(nodes)).reshape(len(nodes), k)
        pair, first = np.concatenate([own, len(at) + own], axis=1), first + own.size
        each = valleys(effect, m.gram[pair[:, :, None], pair[:, None, :]], m.projection[pair])
        found = [
            [Place(gain + node.log_weight, q, np.array([node.shape[p.name] for p in shapes])) for gain, q in many]
            for node, many in zip(nodes, each, strict=True)
        ]
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


def valleys(effect: Effect, gram: Array, projection: Array) -> list[list[tuple[float, Array]]]:
    """Gain and amplitudes (fit space) of an effect's minima beside a fit, at each of its places, the best first.

    Products of the columns by q and by ½ q² are (m, 2 k, 2 k), of those with the residual (m, 2 k).
    """
    own, m = evidence.amplitudes(effect), len(gram)
    k = len(own)
    if effect.whole:
        return [[(0.0, np.ones(k))] for _ in range(m)]
    sigma, power = np.array([a.sigma for a in own]), np.array([a.power for a in own])
    unit, sided = sigma**power, np.array([bool(evidence.kind(a)) for a in own])
    if k > 2:
        q = np.linalg.solve(gram[:, :k, :k] + np.diag(unit**-2.0), projection[:, :k, None])[..., 0]
        q = np.where(sided, np.maximum(q, 0.1 * unit), q)
        return [[(float(0.5 * p[:k] @ x), x)] for p, x in zip(projection, q, strict=True)]
    axes, eye = [AMPLITUDES[AMPLITUDES >= 0] if one else AMPLITUDES for one in sided], np.eye(k)

    def answer(value: Array) -> Array:
        q = (value * sigma) ** power
        return np.concatenate([q, 0.5 * q**2], axis=-1)

    def cost(value: Array, gram: Array, projection: Array) -> Array:
        w = answer(value)
        bent = 0.5 * np.einsum("...ij,...j->...i", gram, w) - projection
        return np.asarray((bent * w).sum(axis=-1) + 0.5 * (value**2).sum(axis=-1))

    def curved(value: Array, gram: Array) -> tuple[Array, Array]:
        rise = unit * np.where(power == 2, 2 * value, 1.0)
        both = np.stack([rise, rise * (value * sigma) ** power], axis=1)
        slope = (both[..., None] * eye).reshape(-1, 2 * k, k)
        return slope, slope.transpose(0, 2, 1) @ gram @ slope + eye

    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    height = cost(mesh, *(np.expand_dims(x, tuple(range(1, k + 1))) for x in (gram, projection)))
    least = np.argwhere(height == minimum_filter(height, (1, *[3] * k), mode="nearest"))
    node, value = least[:, 0], mesh[tuple(least[:, 1:].T)]
    gram, projection = gram[node], projection[node]
    moves, now = np.ones(len(node), bool), cost(value, gram, projection)
    for _ in range(POLISHED):
        slope, curve = curved(value, gram)
        miss = projection - np.einsum("mij,mj->mi", gram, answer(value))
        step = np.linalg.solve(curve, (np.einsum("mik,mi->mk", slope, miss) - value)[..., None])[..., 0]
        tried = np.array([np.where(sided, np.maximum(v, 0.0), v) for v in (value + part * step for part in PARTS)])
        costs = cost(tried, gram, projection)
        best = (costs.argmin(axis=0), np.arange(len(node)))
        moves &= costs[best] < now
        if not moves.any():
            break
        value, now = np.where(moves[:, None], tried[best], value), np.where(moves, costs[best], now)
    gain = -now - 0.5 * np.linalg.slogdet(curved(value, gram)[1])[1]
    # One-sided effects begin off their boundary, where a derivative may be of the other side.
    q = (np.where(sided, np.maximum(value, 0.1), value) * sigma) ** power
    out: list[list[tuple[float, Array]]] = [[] for _ in range(m)]
    for i in np.argsort(-gain, kind="stable"):
        out[node[i]].append((float(gain[i]), q[i]))
    return out
