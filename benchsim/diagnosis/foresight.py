"""What a hypothesis would reach, foretold from the stated settings without a fit.

A null whose settings were bent to imitate an effect is no place to judge effects from: no linearisation about it shows
what it hides. About the stated settings the second-order model (`curvature`) holds over some prior sigma of them, and a
descent on it costs no prediction. What it ends at ranks hypotheses, and is where their fits begin. Not an evidence to
claim anything by: the model's own errors, of third order, are in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import descent, evidence, refit
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, values

Array = NDArray[np.float64]

SIDES = 2
"""Most amplitudes of an effect that are begun with either sign: a descent from 0 may end in the wrong valley."""

VALLEYS = 2
"""Most points that a fit begins at, the signs of their amplitudes different."""


@dataclass(frozen=True)
class Foretold:
    """ln Z without the prior of presence about the best of ``points``, which differ in their amplitudes' signs."""

    log_evidence: float
    points: tuple[Point, ...]


def foretell(context: Context, h: Hypothesis) -> Foretold | None:
    """Descend on the second-order model from the stated settings, amplitudes at one prior sigma of either sign.

    Parameters
    ----------
    context : Context
    h : Hypothesis

    Returns
    -------
    Foretold or None
        None where it cannot say: without a curvature, for shapes, which have many valleys, and for effects that are
        there as a whole or not at all.
    """
    about = context.curvature
    if about is None or h.shapes or any(e.whole for e in h.effects):
        return None
    p, k, terms = len(context.problem.nuisances), len(h.amplitudes), h.terms()
    middle = len(context.scales) // 2
    prior = descent.prior_of(context, h, context.scales[middle], terms[len(terms) // 2].field_sigma)
    ends: list[tuple[float, Array, Array]] = []
    for begun in _begun(h):
        theta = np.concatenate([np.zeros(p), begun])
        state = descent.begin(context, h, prior, descent.point_of(theta, p, k))
        if not np.isfinite(state.cost):
            continue
        own = context.columns(values(context.problem, h, descent.point_of(theta, p, k)), h.amplitudes)
        step, cost, residual, columns = descent.followed(context, h, prior, state, Known(about.first, theta[:p]), own)
        theta = theta + step
        ends.append((cost, theta, np.column_stack([residual + columns @ theta, columns])))
    if not ends:
        return None
    ends.sort(key=lambda end: end[0])
    valleys: list[Array] = []
    for _, theta, _ in ends:
        if len(valleys) < VALLEYS and not any(np.array_equal(np.sign(theta[p:]), np.sign(v[p:])) for v in valleys):
            valleys.append(theta)
    lin = refit.linear_about(context, h, ends[0][2])
    log_z = refit.log_evidence(context, lin, lin.effect, terms)
    return Foretold(log_z, tuple(descent.point_of(v, p, k) for v in valleys))


def _begun(h: Hypothesis) -> list[Array]:
    axes: list[tuple[float, ...]] = []
    for e in h.effects:
        own = evidence.amplitudes(e)
        for a in own:
            q = a.sigma**a.power
            axes.append((0.0,) if len(own) > SIDES else (q,) if evidence.kind(a) else (-q, q))
    return [np.array(q) for q in product(*axes)]
