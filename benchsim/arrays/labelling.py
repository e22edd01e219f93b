"""Labels planned for a field: rates that neither beat nor share a harmonic within a record, and how long it has to be.

Within one octave no overtone falls on a label. Labels that stand `APART` line widths 1/T from one another do not beat
within the record, and each is found nearly as if it stood alone. Multiples of the mains are left out. Where so many
labels would need a longer record than is wanted, the field is measured in rounds: the prisms of the others rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from benchsim.arrays.plant import Assumptions
from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]

APART = 7.0
"""Line widths between labels: least squares then loses below 1 % of a lone line's precision."""

GUARD = 1.0
"""Kept from multiples of the mains on either side [Hz]: at the fourth the grid's 0.2 Hz are 0.8."""


@dataclass(frozen=True, eq=False)
class Labels:
    """Labels of n heliostats.

    Attributes
    ----------
    rates : (n, 2)
        Of the elevation and the azimuth prism [Hz].
    round : (n,) of int
        In which each heliostat is measured, from 0.
    duration : float
        Of a record [s].
    apart : float
        Least distance of two labels of one round [1/T].
    """

    rates: Array
    round: NDArray[np.int_]
    duration: float
    apart: float

    @property
    def rounds(self) -> int:
        """How many there are."""
        return int(self.round.max()) + 1


def plan(count: int, assumptions: Assumptions, mains: float | None, longest: float) -> Labels:
    """Labels of ``count`` heliostats.

    Parameters
    ----------
    count : int
    assumptions : Assumptions
        The band, and the shortest record.
    mains : float or None
        Whose multiples are left out [Hz].
    longest : float
        Record [s].

    Raises
    ------
    BenchsimError
        If the mains leave no band.
    """
    pieces = free(assumptions.rate_low, assumptions.rate_high, mains)
    if not pieces:
        raise BenchsimError(
            f"prisms.mains_hz: of {assumptions.rate_low:g} to {assumptions.rate_high:g} Hz nothing is left beside "
            f"multiples of {mains:g} Hz; give the labels a wider band"
        )
    width = sum(high - low for low, high in pieces)
    at_once = max(1, int((width * longest / APART + 1) // 2))
    rounds = math.ceil(count / at_once)
    each = math.ceil(count / rounds)
    # Neighbours in the table take turns, so that every round sees the whole field.
    number = np.arange(count) % rounds
    values = spaced(pieces, 2 * each)
    step = next(k for k in range(max(1, round(0.382 * 2 * each)), 4 * each) if math.gcd(k, 2 * each) == 1)
    dealt = values[(step * np.arange(2 * each)) % (2 * each)].reshape(each, 2)
    rates = dealt[np.arange(count) // rounds]
    nearest = float(np.diff(values).min()) if len(values) > 1 else width
    duration = min(max(assumptions.duration, APART / nearest), longest)
    # Whole samples.
    duration = math.ceil(duration * assumptions.sample_rate - 1e-6) / assumptions.sample_rate
    return Labels(rates, number, duration, nearest * duration)


def free(low: float, high: float, mains: float | None) -> list[tuple[float, float]]:
    """The band without what lies within `GUARD` of multiples of the mains [Hz]."""
    pieces: list[tuple[float, float]] = []
    start = low
    for hum in () if mains is None else mains * np.arange(1, int((high + GUARD) / mains) + 1):
        if hum - GUARD > start:
            pieces.append((start, min(float(hum) - GUARD, high)))
        start = max(start, float(hum) + GUARD)
    if start < high:
        pieces.append((start, high))
    return pieces


def spaced(pieces: list[tuple[float, float]], count: int) -> Array:
    """(count,) rates, evenly spaced over the pieces laid end to end."""
    ends = np.concatenate([[0.0], np.cumsum([high - low for low, high in pieces])])
    at = np.linspace(0.0, ends[-1], count)
    which = np.clip(np.searchsorted(ends, at, side="right") - 1, 0, len(pieces) - 1)
    return np.array([pieces[k][0] for k in which]) + at - ends[which]


def clashes(rates: Array, duration: float, sample_rate: float, mains: float | None = None) -> list[tuple[float, float]]:
    """Labels that another label, an overtone that the converter passes, or the mains come nearer to than 1/T.

    Parameters
    ----------
    rates : (n, 2)
        Of one round [Hz].
    duration : float
        [s]
    sample_rate : float
        Its half is where the converter stops [Hz].
    mains : float, optional
        [Hz]

    Returns
    -------
    list of (label, what it clashes with) [Hz]
    """
    f = np.sort(rates.ravel())
    most = sample_rate / 2
    other: list[Array] = [k * f for k in range(2, int(most / f[0]) + 1)]
    if mains:
        other.append(np.asarray(mains * np.arange(1, int(most / mains) + 1), float))
    out = [(float(a), float(b)) for a, b in pairwise(f) if (b - a) * duration < 1 - 1e-9]
    for values in other:
        for v in values[values < most]:
            out += [(float(x), float(v)) for x in f[np.abs(f - v) * duration < 1 - 1e-9]]
    return out
