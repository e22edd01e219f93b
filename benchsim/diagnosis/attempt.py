"""One refit of a hypothesis, begun where the fit that it was weighed about, foresight and the stated settings say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from benchsim.diagnosis import evidence, linear, refit, screen, starts
from benchsim.diagnosis.fits import Effects
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, Solved, values
from benchsim.diagnosis.screen import Catalogue
from benchsim.diagnosis.weighing import hypothesis_of, log_z_about

BORNE_OUT = 1.0
"""Difference in ln Z up to which a linearisation about a good fit and the refit it foretold check each other."""

SEEN = 6.0
"""Sigma from 0, at its place, from which on Laplace's method holds for an effect with a place. Of the best of many
places chance makes four."""


def attempt(
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
    h = hypothesis_of(catalogue, effects)
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
    known, own, p, hold = nearest(effects, done), None, lin.nuisance.shape[1], 0
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
        # Where it looks better from afar than from 0 there is another valley: the deeper of the two is the fit.
        points += foreseen
    if not hold and any(evidence.shapes(e) and e.name not in own_effects for e in h.effects):
        # Shapes are placed with the settings integrated; where the source has them, they speak against the place.
        hold = 1
    prior = screen.log_prior(effects, list(catalogue.effects))
    sure = bool(own_effects) and source.fit.converged and not refit.misses(context, source)
    solved = refit.fit(context, h, points[:1] if sure else points, known, own, prior, hold=hold)
    if sure and not (solved.fit.converged and abs(solved.fit.log_evidence - expected) < BORNE_OUT):
        # Checked from where it ended, not begun again.
        solved = refit.fit(context, h, [solved.point, *points[1:]], solved.known, solved.own, prior)
    faint = unseen(h, solved)
    if faint:
        # Laplace fails where an amplitude is too small to say where: the sum over the grid stands, about the best fit
        # of the rest. It asks for no convergence in a shape that has many peaks, only for that fit's.
        rest = max((s for e, s in done.items() if set(e) <= set(effects) - faint), key=lambda s: s.fit.log_evidence)
        if not refit.bent(rest):
            summed = log_z_about(context, catalogue, context.whiten(catalogue.columns), rest, [effects])[effects]
            solved = replace(solved, fit=replace(solved.fit, log_evidence=summed, converged=rest.fit.converged))
    return solved


def nearest(effects: Effects, done: Mapping[Effects, Solved]) -> Known:
    """Nuisances' columns about the fit that shares most effects."""
    return done[max(done, key=lambda e: (len(set(e) & set(effects)), -len(set(e) - set(effects))))].known


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
