"""Where the fit of a hypothesis begins.

A descent ends in the valley that it starts in. What fits grow from is the fit of fewer effects, whose linearisation
says where shapes (a place, a width) should lie, or, where that fit misses the data, exact predictions over the
plausible range of the amplitudes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from benchsim.diagnosis import evidence, linear, screen, settings
from benchsim.diagnosis.curvature import Curvature
from benchsim.diagnosis.fits import Effects
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Solved
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.problem import Effect
from benchsim.diagnosis.screen import Catalogue

Array = NDArray[np.float64]

AFAR = 10.0
"""By how much noise is enlarged about the stated settings, where a misfit of settings by 2 sigma leaves some sigma of
curvature."""

SCANNED = (0.0, 0.2, 0.5, 1.0, 1.6, 2.2)
"""Amplitudes, in prior sigmas, from which a fit is begun where what it grows from misses the data."""

MEASURED = 0.5
"""Amplitude, in prior sigmas, at which its effect on the settings' columns is measured for that."""

PLACES = 40
"""Shapes that are tried about a node, and again about the best of them."""


@dataclass(frozen=True)
class Ground:
    """What shapes are placed about: a point with its linearisation, the setting scale there, and by how much noise is
    enlarged."""

    linear: Linear
    values: Mapping[str, float]
    scale: float
    noise: float = 1.0

    def white(self, context: Context, columns: Array) -> Array:
        """Whitened columns in that noise."""
        return context.whiten(columns) / self.noise


def ground(context: Context, source: Solved, afar: bool = False) -> Ground:
    """About a fit, or ``afar``: about the stated settings with noise `AFAR` times larger.

    Settings that were bent to hide what turns light at one place leave a residual that has other places and the other
    sign. About the stated ones the place is the right one, if coarse.
    """
    if not afar or context.curvature is None:
        return Ground(source.fit.linear, source.fit.values, source.fit.setting_scale)
    residual = context.problem.data - np.concatenate(context.curvature.plain)
    stated = {**source.fit.values, **{n.name: 0.0 for n in context.problem.nuisances}}
    return Ground(from_afar(context, context.curvature, residual[:, None]), stated, float(context.scales[0]), AFAR)


def scanned(context: Context, h: Hypothesis, source: Solved, amplitude: Array) -> list[Array]:
    """Amplitudes, in fit space, from which to start where a fit misses the data; the most promising first.

    A width answers to a defocus of either sign alike, so that a descent from 0 may end in the wrong valley. Amplitudes
    of effects that the fit lacks are tried over their plausible range, with exact predictions about the stated
    settings, whose errors are integrated to first order with the columns that they have beside the effect (light that
    is bent across the beam is bent otherwise where the beam is set otherwise). Noise is taken `AFAR` times larger to
    cover what first order leaves; where another amplitude is best with the noise as it is, that one is a start too.
    """
    if context.curvature is None:
        return [amplitude]
    far, near, first = amplitude.copy(), amplitude.copy(), 0
    at = {q.name: source.fit.values[q.name] for e in h.effects if e.name in source.fit.effects for q in e.parameters}
    for e in h.effects:
        own = evidence.amplitudes(e)
        mine, first = slice(first, first + len(own)), first + len(own)
        if e.name in source.fit.effects or evidence.shapes(e) or len(own) > 2:
            continue
        if e.whole:
            far[mine] = near[mine] = 1.0
            continue
        axes = [np.array(SCANNED if evidence.kind(a) else (*(-x for x in SCANNED[:0:-1]), *SCANNED)) for a in own]
        points = [q * np.array([a.sigma**a.power for a in own]) for q in map(np.array, product(*axes))]
        values = [
            {**at, **evidence.fixed(e), **{a.name: linear.value_of(a, x) for a, x in zip(own, q, strict=True)}}
            for q in points
        ]
        changes = [context.change(a, MEASURED * a.sigma**a.power, dict(evidence.fixed(e))) for a in own]
        beside = [
            sum((x * c[0] for x, c in zip(q, changes, strict=True) if c is not None), context.curvature.first)
            for q in points
        ]
        prior = [float(sum((x / a.sigma**a.power) ** 2 for a, x in zip(own, q, strict=True))) for q in points]
        for out, cost in zip((far, near), misfits(context, values, beside, (AFAR, 1.0)), strict=True):
            out[mine] = points[int(np.argmin(cost + prior))]
    return [far] if np.array_equal(far, near) else [far, near]


def from_afar(context: Context, about: Curvature, residuals: Array) -> Linear:
    """About the stated settings, with noise `AFAR` times larger; the first of residuals (n, m), and all as effects."""
    scaled = np.array([n.scaled for n in context.problem.nuisances], bool)
    white, nuisance = context.whiten(residuals) / AFAR, context.whiten(about.first) / AFAR
    return Linear(white[:, 0], nuisance, scaled, white, (), context.problem.block, 0.0)


def misfits(
    context: Context, values: Sequence[Mapping[str, float]], beside: Sequence[Array], noises: Sequence[float]
) -> list[Array]:
    """χ² of exact predictions about the stated settings, whose errors are integrated to first order.

    Parameters
    ----------
    context : Context
    values : sequence of m mappings
    beside : sequence of m (n, p) arrays
        The settings' columns there, per prior sigma.
    noises : sequence of float
        By how much noise is enlarged.

    Returns
    -------
    list of (m,) arrays
        For each of ``noises``.
    """
    problem = context.problem
    blocks = range(len(problem.names))
    found = linear.predictions(problem, [v for v in values for _ in blocks], [b for _ in values for b in blocks])
    scaled = np.array([n.scaled for n in problem.nuisances], bool)
    middle = float(context.scales[len(context.scales) // 2])
    out = np.zeros((len(noises), len(values)))
    for i, columns in enumerate(beside):
        predicted = np.concatenate(found[i * len(blocks) : (i + 1) * len(blocks)])
        white = np.nan_to_num(context.whiten(np.column_stack([problem.data - predicted, columns])), nan=1e6)
        for j, s in enumerate(noises):
            residual = white[:, :1] / s
            lin = Linear(residual[:, 0], white[:, 1:] / s, scaled, residual, (), problem.block, 0.0)
            out[j, i] = linear.marginal(lin, residual, middle).gram[0, 0]
    return list(out)


def together(context: Context) -> Effects:
    """Of the effects that are present as a whole or not at all, the set that comes nearest to the data; may be empty.

    One may show only in the presence of another (a beam has to have a width before its diffraction changes it), so
    that none of them is found alone.
    """
    whole = [e for e in context.problem.catalogue if e.whole]
    sets = [chosen for n in range(len(whole) + 1) for chosen in combinations(whole, n)]
    values = [{a.name: 1.0 for e in chosen for a in evidence.amplitudes(e)} for chosen in sets]
    if not whole or context.curvature is None:
        return ()
    (cost,) = misfits(context, values, [context.curvature.first] * len(sets), [AFAR])
    return tuple(e.name for e in sets[int(np.argmin(cost))])


def placed(
    context: Context, effect: Effect, node: Mapping[str, float], about: Ground
) -> tuple[list[float], dict[str, float]]:
    """Amplitudes and shapes near a node that explain the residual best, to first order.

    A fit descends from there into the nearest peak, and a grid is too coarse to say which is the highest; without an
    amplitude shapes would have no direction to go.
    """
    own, shapes = evidence.amplitudes(effect), evidence.shapes(effect)
    at = {**about.values, **evidence.fixed(effect)}
    prior = np.diag([a.sigma ** (-2.0 * a.power) for a in own])
    # A fixed seed: the same data give the same diagnosis.
    rng = np.random.default_rng(0)
    best, gain = {p.name: node[p.name] for p in shapes}, -np.inf
    size: Array = np.zeros(len(own))
    reach = {p.name: (max(p.grid) - min(p.grid)) / max(len(p.grid) - 1, 1) for p in shapes}
    for shrink in (1.0, 0.4):
        tried = [best]
        for _ in range(PLACES):
            moved = {p.name: best[p.name] + shrink * reach[p.name] * rng.uniform(-1, 1) for p in shapes}
            tried.append({p.name: float(np.clip(moved[p.name], min(p.grid), max(p.grid))) for p in shapes})
        found = linear.columns_at(context.problem, [({**at, **t}, own) for t in tried])
        white = about.white(context, np.column_stack(found))
        m = linear.marginal(about.linear, white, about.scale)
        for i, t in enumerate(tried):
            mine = slice(i * len(own), (i + 1) * len(own))
            inner, u = m.gram[mine, mine] + prior, m.projection[mine]
            mean: Array = np.asarray(np.linalg.solve(inner, u), float)
            now = 0.5 * float(u @ mean) - 0.5 * float(np.linalg.slogdet(inner)[1])
            if now > gain:
                best, size, gain = t, mean, now
    bounded = [max(q, 0.0) if evidence.kind(a) else q for q, a in zip(size.tolist(), own, strict=True)]
    return bounded, best


def best_nodes(
    context: Context, catalogue: Catalogue, h: Hypothesis, about: Ground, there: Effects = ()
) -> list[tuple[int, ...]]:
    """Grid nodes to start from: the most probable, then the next best that differs (or the same).

    Effects that are ``there`` already have their shapes.
    """
    if not h.shapes:
        only = tuple(0 for _ in h.effects)
        return [only, only]
    new = [e for e in h.effects if e.name not in there]
    terms = screen.hypothesis_terms(catalogue, tuple(e.name for e in new), {})
    many = settings.marginals(about.linear, about.white(context, catalogue.columns), context.scales)
    gram, projection = np.stack([m.gram for m in many]), np.stack([m.projection for m in many])
    log_z = evidence.log_factors(gram, projection, terms) + np.array([t.log_weight for t in terms])
    log_z = logsumexp(log_z + settings.log_null(many, context.weights)[:, None], axis=0)
    ranked: list[tuple[int, ...]] = []
    for i in np.argsort(-log_z):
        if terms[i].node not in ranked:
            ranked.append(terms[i].node)
        if len(ranked) == 2:
            break
    ranked = [*ranked, ranked[0]][:2]
    place = {e.name: j for j, e in enumerate(new)}
    return [tuple(node[place[e.name]] if e.name in place else 0 for e in h.effects) for node in ranked]
