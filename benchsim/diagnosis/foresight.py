"""What a hypothesis would reach, foretold from the stated settings without a fit.

A null whose settings were bent to imitate an effect is no place to judge effects from: no linearisation about it shows
what it hides. About the stated settings the second-order model (`curvature`) holds over some prior sigma of them; it is
followed to its minimum, where the residual is asked again, and so on a few times. The settings' derivatives are never
made anew, so that this costs some tens of predictions of the data where a fit takes hundreds. What it ends at ranks
hypotheses, and is where their fits begin. Not an evidence to claim anything by: it need not have converged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import descent, evidence, refit
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Point, each, values
from benchsim.diagnosis.model import carried

Array = NDArray[np.float64]

SIDES = 2
"""Most amplitudes of an effect that are begun with either sign: a descent from 0 may end in the wrong valley."""

SIZES = (0.5, 1.0, 2.0)
"""Prior sigmas at which amplitudes are begun, all at the same: beside a strong effect even the right sign has valleys
in which another takes a part of it."""

FAINT = 0.01
"""Amplitude with a power, in units of sigma**power, at which it is begun besides."""

LOOKS = 8
"""Models that are followed after the first, each about the end of the last: settings some sigma off, and effects at a
prior sigma, are ten thousand sigma in the data, and their third order is hundreds."""

FEWER = 3
"""The same beside amplitudes that are there: those only rank what is fitted next."""

LOOSE = 1
"""Which of the grid's setting scales a descent has, the first but the stated one: beside the right effect settings are
off as stated. Looser ones wander to seven sigma, where the effect's size no longer matters."""

LEAST = 0.3
"""Gain [ln posterior] at which a model is followed no further."""

VALLEYS = 2
"""Most points that a fit begins at, the signs of their amplitudes different."""


@dataclass(frozen=True)
class Foretold:
    """ln Z without the prior of presence about the best of ``points``, which differ in their amplitudes' signs."""

    log_evidence: float
    points: tuple[Point, ...]


def foretell_all(
    context: Context, hypotheses: Sequence[Hypothesis], there: Mapping[str, float] | None = None
) -> list[Foretold | None]:
    """`foretell` of each, through `Problem.spread`; what is measured for them is kept in the context."""
    return each(context, partial(foretell, there=there), hypotheses)


def foretell(context: Context, h: Hypothesis, there: Mapping[str, float] | None = None) -> Foretold | None:
    """Descend from the stated settings, amplitudes at some sizes (`SIZES`) of either sign, or also faint (`FAINT`).

    Parameters
    ----------
    context : Context
    h : Hypothesis
    there : mapping, optional
        Amplitudes, in fit space, that begin where another fit has them; the others then begin at one size, and less far
        is looked.

    Returns
    -------
    Foretold or None
        None where it cannot say: without a curvature, for shapes, which have many valleys, and for effects that are
        there as a whole or not at all.
    """
    stated = context.stated()
    if stated is None or h.shapes or any(e.whole for e in h.effects):
        return None
    p, k, terms = len(context.problem.nuisances), len(h.amplitudes), h.terms()
    prior = descent.prior_of(context, h, context.scales[LOOSE], terms[len(terms) // 2].field_sigma)

    def columns_each(thetas: Sequence[Array]) -> list[Array]:
        return context.columns_each(
            [values(context.problem, h, descent.point_of(t, p, k)) for t in thetas], h.amplitudes
        )

    def followed(states: Sequence[descent.State], renewals: int) -> list[descent.State]:
        owns = columns_each([state.theta for state in states])
        ended = descent.follow(
            context, h, prior, states, stated, owns, lambda theta: columns_each([theta])[0],
            tempered=False, renewals=renewals, least=LEAST,
        )  # fmt: skip
        return [state for state, _, _ in ended]

    points = [descent.point_of(np.append(np.zeros(p), q), p, k) for q in _begun(h, there or {})]
    ends = followed([state for state in descent.begin(context, h, prior, points) if np.isfinite(state.cost)], 1)
    ends = _valleys(followed(_valleys(ends, p), FEWER if there else LOOKS), p)[:VALLEYS]
    if not ends:
        return None
    state, own = ends[0], columns_each([ends[0].theta])[0]
    point = descent.point_of(state.theta, p, k)
    known = carried(context, h, stated, state.theta)
    lin = refit.about(context, h, point, state.residual, known, own)
    # What is sought beside others is what lets settings be as stated.
    few = slice(LOOSE + 1) if there else slice(None)
    judged = replace(context, scales=context.scales[few], weights=context.weights[few])
    log_z = refit.log_evidence(judged, lin, lin.effect, terms)
    return Foretold(log_z, tuple(descent.point_of(end.theta, p, k) for end in ends))


def _valleys(ends: list[descent.State], p: int) -> list[descent.State]:
    """The lowest of every combination of the amplitudes' signs, the lowest of all first."""
    lowest: dict[bytes, descent.State] = {}
    for end in sorted(ends, key=lambda end: end.cost):
        lowest.setdefault(np.sign(end.theta[p:]).tobytes(), end)
    return list(lowest.values())


def _begun(h: Hypothesis, there: Mapping[str, float]) -> list[Array]:
    """Amplitudes to begin at, those that are ``there`` as they are."""
    axes: list[tuple[tuple[float, bool], ...]] = []
    for e in h.effects:
        own = evidence.amplitudes(e)
        for a in own:
            q = a.sigma**a.power
            if a.name in there:
                axes.append(((there[a.name], False),))
                continue
            # What has a power is seen at a tenth of a prior sigma, where widths bend otherwise than at a whole one.
            faint = (FAINT * q,) if a.power > 1 else ()
            mine = (0.0,) if len(own) > SIDES else (*faint, q) if evidence.kind(a) else (-q, q)
            axes.append(tuple((size, True) for size in mine))
    sizes = (1.0,) if there else SIZES
    return [np.array([x * (s if free else 1.0) for x, free in point]) for s in sizes for point in product(*axes)]
