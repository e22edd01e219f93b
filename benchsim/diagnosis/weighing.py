"""Hypotheses weighed about the fits that were made: by linear algebra, the prior of presence included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import evidence, refit, screen, starts
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.fits import LARGEST, Effects
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Point, Solved
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.screen import Catalogue

Array = NDArray[np.float64]


@dataclass
class Table:
    """ln Z of all hypotheses, about whose fit each was weighed, and where foresight would have its fit begin.

    ``begin`` is empty where foresight was asked and could not say.
    """

    log_z: dict[Effects, float]
    source: dict[Effects, Effects]
    begin: dict[Effects, tuple[Point, ...]] = field(default_factory=dict)


def hypothesis_of(catalogue: Catalogue, effects: Effects) -> Hypothesis:
    return Hypothesis(tuple(catalogue.effects[e] for e in effects))


def log_z_about(
    context: Context, catalogue: Catalogue, white: Array, solved: Solved, wanted: Sequence[Effects]
) -> dict[Effects, float]:
    """ln Z of hypotheses about a refitted point, prior of presence included; what both hold has its columns there."""
    h = hypothesis_of(catalogue, solved.fit.effects)
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


def weigh_again(
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
    for effects, z in log_z_about(context, catalogue, white, solved, wanted).items():
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
