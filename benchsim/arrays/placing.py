"""Where two arrays see the most: a search over their places, each computed once.

The prisms' light falls on long rows at several distances on either side of the receiver, cut into parts; a place is a
row and a stretch of parts on it as long as the array. `sensitivity.Sums` of parts add, and so do those of two arrays,
so that all pairs of places are compared at the price of all places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.arrays.crossings import THRESHOLD
from benchsim.arrays.plant import Assumptions, Line, Plant
from benchsim.arrays.sensitivity import sums

Array = NDArray[np.float64]

OFFSETS = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2)
"""Distances that are tried, in parts of the least: a third more light at most is lost between two of them."""

PARTS = 4
"""Of an array: it is shifted by quarters of its length."""

SHIFTS = 2
"""Such quarters to either side of the middle."""

FINE = 1e-3
"""Worth of a tenfold smaller sigma against a share seen of 1: it decides between places that see as many."""


@dataclass(frozen=True, eq=False)
class Places:
    """Places of one array: the lines, and as columns of parts' indices the parts of each."""

    lines: tuple[Line, ...]
    parts: NDArray[np.int_]


def places(line: Line, least: float, lowest: float) -> tuple[Places, tuple[Line, ...]]:
    """Places to be tried of an array, and the parts that they are made of.

    Parameters
    ----------
    line : Line
        Stated: its pitch is kept; its length becomes that of `PARTS` equal parts of whole detectors, of which there are
        then up to two more or fewer.
    least : float
        Distance from the receiver's middle that it has to keep [mm].
    lowest : float
        z of the ground [mm].
    """
    count = len(line.along)
    each = max(2, round(count / PARTS))
    length = each * line.pitch
    rows = PARTS + 2 * SHIFTS
    start = -rows / 2 * length + line.pitch / 2
    parts, lines, stretches = [], [], []
    for side in (1, -1):
        for times in OFFSETS:
            offset = side * times * least
            for k in range(rows):
                low = start + k * length
                parts.append(Line(line.name, line.upright, offset, low, low + (each - 1) * line.pitch, line.pitch))
            base = len(parts) - rows
            for shift in range(2 * SHIFTS + 1):
                low = start + shift * length
                there = replace(line, offset=offset, low=low, high=low + (PARTS * each - 1) * line.pitch)
                if min(there.places(there.along)[:, 2]) > lowest:
                    lines.append(there)
                    stretches.append(base + shift + np.arange(PARTS))
    return Places(tuple(lines), np.array(stretches, int).reshape(-1, PARTS)), tuple(parts)


@dataclass(frozen=True, eq=False)
class Placed:
    """The best pair of places.

    Attributes
    ----------
    lines : tuple of Line
    share : float
        Of heliostats and moments of the search in which both angles are known to the limit.
    tried : int
        Pairs.
    """

    lines: tuple[Line, ...]
    share: float
    tried: int


def search(
    moments: Sequence[tuple[Callable[[Sequence[Line]], Plant], Array]],
    assumptions: Assumptions,
    found: Sequence[tuple[Places, tuple[Line, ...]]],
    limit: float,
    told: Callable[[float], None] = lambda done: None,
) -> Placed:
    """The pair of places that sees the most.

    Parameters
    ----------
    moments : sequence
        For each: the plant as a function of its arrays, and the part of each heliostat's light that arrives (n,).
    assumptions : Assumptions
    found : two results of `places`
    limit : float
        1 sigma of either angle [rad].
    told : callable
        Called with the part done.
    """
    parts = [line for _, some in found for line in some]
    # The last part of each row ends it.
    goes_on = np.array([k % (PARTS + 2 * SHIFTS) != PARTS + 2 * SHIFTS - 1 for k in range(len(parts))])
    first = len(found[0][1])
    picks = [found[0][0].parts, found[1][0].parts + first]
    share = np.zeros((len(picks[0]), len(picks[1])))
    fine = np.zeros_like(share)
    for done, (build, transmission) in enumerate(moments):
        plant = build(parts)
        s = sums(plant, assumptions, transmission, goes_on)
        one, other = (s.gathered(p) for p in picks)
        for i in range(len(share)):
            pairs = one.only(i).beside(other)
            variance, strength = (x.reshape(-1, 2, len(picks[1])) for x in pairs.values())
            variance, strength = variance / plant.duration, strength * plant.duration
            seen = pairs.crosses.reshape(variance.shape) & (strength > THRESHOLD) & (variance <= limit**2)
            known = seen.all(axis=1)
            share[i] += known.mean(axis=0)
            better = -0.5 * np.log10(np.clip(variance / limit**2, 1e-12, 1.0))
            fine[i] += np.where(known, better.mean(axis=1), 0.0).mean(axis=0)
        told((done + 1) / len(moments))
    share, fine = share / len(moments), fine / len(moments)
    i, j = divmod(int(np.argmax(share + FINE * fine)), share.shape[1])
    return Placed((found[0][0].lines[i], found[1][0].lines[j]), float(share[i, j]), share.size)
