"""Residual and derivatives about a point to second order: what `descent` follows between predictions.

Second derivatives are those that `curvature` measured once; residual and first derivatives are the point's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from benchsim.diagnosis import curvature, evidence
from benchsim.diagnosis.hypothesis import Change, Context, Hypothesis, Known

Array = NDArray[np.float64]
Live = Sequence[tuple[slice, NDArray[np.intp]]]

STRETCH = 100
"""Least rows whose part of the normal equations is worked out alone."""


@dataclass(frozen=True)
class Bend:
    """Second derivatives of one block, whitened; only those by nuisances that act nonlinearly there are not 0.

    ``second`` are those by pairs of nuisances, ``changes`` the amplitudes' M and bend (None: not needed).
    """

    rows: slice
    curved: NDArray[np.intp]
    second: Array
    changes: Sequence[Change]


@dataclass(frozen=True)
class Model:
    """Residual and derivatives to second order about a point, whitened; ``plain`` are the amplitudes' M and bend before
    whitening, of all nuisances. Of the columns the first ``p`` are the nuisances'; ``live`` are stretches of rows and
    the columns that may differ from 0 there, since an exposure's settings do nothing in all others."""

    residual: Array
    columns: Array
    p: int
    bends: Sequence[Bend]
    plain: Sequence[Change]
    live: Live

    def at(self, step: Array) -> tuple[Array, Array]:
        """Whitened residual and columns a step away."""
        p, dq = self.p, step[self.p :]
        columns, residual = self.columns.copy(), self.residual - self.columns @ step
        for b in self.bends:
            dx = step[b.curved]
            more = b.second @ dx
            bent = 0.5 * more @ dx
            for i, change in enumerate(b.changes):
                if change is not None:
                    moved = change[0] @ dx
                    more += dq[i] * change[0]
                    columns[b.rows, p + i] += moved + dq[i] * change[1]
                    bent += dq[i] * (moved + 0.5 * dq[i] * change[1])
            columns[b.rows, b.curved] += more
            residual[b.rows] -= bent
        return residual, columns

    def normal(self, residual: Array, columns: Array) -> tuple[Array, Array]:
        """Columnsᵀ columns and columnsᵀ residual, of what `at` gives: several times faster without what is 0."""
        second = np.zeros((columns.shape[1],) * 2)
        for rows, live in self.live:
            part = columns[rows, live]
            second[np.ix_(live, live)] += part.T @ part
        return second, columns.T @ residual


def model_about(context: Context, h: Hypothesis, theta: Array, white: Array, known: Known, own: Array) -> Model:
    """About a point whose residual is whitened already."""
    p = len(context.problem.nuisances)
    columns = context.whiten(np.column_stack([carried(context, h, known, theta).columns, own]))
    plain: list[Change] = [*changes_of(context, h, theta), *[None] * len(h.shapes)]
    bends = _bends(context, plain)
    some = columns != 0.0
    some[:, p:] = True
    for b in bends:
        some[b.rows, b.curved] = True
    live = [(rows, np.flatnonzero(some[rows].any(axis=0))) for rows in _stretches(context)]
    return Model(white, columns, p, bends, plain, live)


def _stretches(context: Context) -> list[slice]:
    """Rows of blocks, small ones taken together: a product of two rows costs hundreds of times its arithmetic."""
    ends, first, out = np.cumsum([len(low) for low in context.whiten.lower]).tolist(), 0, []
    for end in ends:
        if end - first >= STRETCH or end == ends[-1]:
            out.append(slice(first, end))
            first = end
    return out


def _bends(context: Context, plain: Sequence[Change]) -> list[Bend]:
    """Of every block; none where nothing was measured of how they bend."""
    about = context.curvature
    if about is None:
        return []
    out = []
    for b, (low, curved, second) in enumerate(zip(context.whiten.lower, about.curved, context.second(), strict=True)):
        rows, changes = context.problem.rows(b), list[Change]()
        for change in plain:
            if change is None:
                changes.append(None)
                continue
            own = np.column_stack([change[0][rows, curved], change[1][rows]])
            white = solve_triangular(low, own, lower=True, check_finite=False)
            changes.append((white[:, :-1], white[:, -1]))
        out.append(Bend(rows, curved, second, changes))
    return out


def changes_of(context: Context, h: Hypothesis, theta: Array) -> list[Change]:
    """M of every own amplitude, as it is at this point."""
    p, k = len(context.problem.nuisances), len(h.amplitudes)
    if context.curvature is None:
        return [None] * k
    shapes = {s.name: float(x) for s, x in zip(h.shapes, theta[p + k :], strict=True)}
    out: list[Change] = []
    first = p
    for e in h.effects:
        others = {s.name: round(shapes[s.name], 2) for s in evidence.shapes(e)} | dict(evidence.fixed(e))
        for a in evidence.amplitudes(e):
            # What is there as a whole changes what the others do: measured alone, its M would be another's.
            out.append(None if e.whole else context.change(a, float(theta[first]), others))
            first += 1
    return out


def sizes_of(context: Context, h: Hypothesis, theta: Array) -> dict[str, float]:
    """Amplitudes by name, in fit space."""
    p = len(context.problem.nuisances)
    return {a.name: float(q) for a, q in zip(h.amplitudes, theta[p:], strict=False)}


def carried(context: Context, h: Hypothesis, known: Known, theta: Array) -> Known:
    """The nuisances' columns carried from where they are known to this point by second derivatives."""
    about, p = context.curvature, len(context.problem.nuisances)
    if about is None:
        return known
    now = sizes_of(context, h, theta)
    columns = known.columns + curvature.nuisance_columns(context.problem, about, theta[:p] - known.nuisance)
    columns -= about.first
    for name, change in zip(now, changes_of(context, h, theta), strict=True):
        if change is not None:
            columns += (now[name] - known.amplitude.get(name, 0.0)) * change[0]
    return Known(columns, theta[:p].copy(), now)
