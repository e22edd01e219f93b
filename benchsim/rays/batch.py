"""Several benches as one, whose numbers are arrays: what the elements work out for one they work out for all at once.

A number becomes (bench, 1, 1, 1), to broadcast against (bench, profile, t, h), and a vector (bench, 1, 1, 1, 3); what
all benches share stays as it is. Benches can be stacked where they differ in numbers alone; one in which an effect is 0
may stand beside one in which it is not.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, cast

import numpy as np

from benchsim.rays.bench import Bench, nodes_needed
from benchsim.rays.interpolated_trace import rules
from benchsim.rays.laser import some

FEWEST = 8
"""Benches of the same effects that make a stack of their own; fewer share one whose formulas cover all of theirs."""


def alike(bench: Bench) -> Hashable | None:
    """Benches of equal answers can be stacked; None: this one cannot, with any.

    Left out are free fields and single rays: they are rare. What amplitudes mix is no one bench (`prediction`).
    """
    parts, has = bench.parts, bench.physics
    polygon, source = parts.polygon, parts.source
    plain = parts.air.kick is None and parts.board.height is None and source.angle is None and not polygon.uneven
    if not plain or not has.beam:
        return None
    return (
        bench.mirror,
        has,
        bench.screen,
        bench.facet,
        bench.laser.wavelength,
        _leans_differ(bench),
        bool(polygon.glass),
        rules(bench),
        nodes_needed(bench),
    )


def _leans_differ(bench: Bench) -> bool:
    leans = bench.parts.polygon.leans
    return bench.facet is None and leans is not None and bool(np.ptp(leans, axis=0).max() > 1e-15)


def active(bench: Bench) -> Hashable:
    """Which formulas a bench needs beyond the plain ones."""
    parts = bench.parts
    return (
        parts.source.homocentric,
        some(*parts.source.shape),
        some(parts.polygon.curvature),
        parts.air.still,
        parts.board.flat,
    )


def groups(benches: Sequence[Bench], most: int) -> list[list[int]]:
    """Numbers of benches that are worked out together, at most ``most`` in a group; alone what cannot be stacked."""
    out: list[list[int]] = []
    like: dict[Hashable, dict[Hashable, list[int]]] = {}
    # Most benches of a list have the same parts and are asked about once.
    known: dict[Hashable, tuple[Hashable | None, Hashable]] = {}
    for i, bench in enumerate(benches):
        same = (
            *(id(part) for part in (bench.laser, bench.mirror, bench.physics, bench.screen, bench.parts)),
            bench.facet,
        )
        if same not in known:
            known[same] = alike(bench), active(bench)
        key, effects = known[same]
        if key is None:
            out.append([i])
        else:
            like.setdefault(key, {}).setdefault(effects, []).append(i)
    for by_effects in like.values():
        rest: list[int] = []
        for members in by_effects.values():
            if len(members) < FEWEST:
                rest += members
                continue
            out += _split(members, most)
        if rest:
            out += _split(rest, most)
    return out


def _split(members: list[int], most: int) -> list[list[int]]:
    """Pieces of nearly equal length."""
    count = -(-len(members) // most)
    return [[int(i) for i in part] for part in np.array_split(members, count)]


def stacked(benches: Sequence[Bench]) -> Bench:
    """One bench of several that are `alike`."""
    leans = [b.parts.polygon.leans for b in benches]
    given = next((x for x in leans if x is not None), None)
    if given is not None:
        none = np.zeros_like(given)
        benches = [
            b
            if b.parts.polygon.leans is not None
            else replace(b, parts=replace(b.parts, polygon=replace(b.parts.polygon, leans=none)))
            for b in benches
        ]
    return cast(Bench, _stacked(benches))


def _stacked(values: Sequence[Any]) -> Any:
    first = values[0]
    if all(v is first for v in values):
        return first
    if isinstance(first, (float, int, np.number, np.ndarray)):
        array = np.array(values)
        return first if (array == array[0]).all() else array.reshape(len(values), 1, 1, 1, *array.shape[1:])
    if isinstance(first, tuple):
        return tuple(_stacked(column) for column in zip(*values, strict=True))
    if is_dataclass(first) and not isinstance(first, type):
        made: Any = type(first)
        return made(**{f.name: _stacked([getattr(v, f.name) for v in values]) for f in fields(first)})
    return first
