"""What the order of records and their time tell of a mount: which way its axes came, and how warm it was."""

from __future__ import annotations

import numpy as np

from benchsim.instruments.mount import sky
from benchsim.instruments.mount.records import Array, Mount

WARMEST_DAY = 200.0
"""Days after New Year on which the air is warmest north of the equator, a month after the sun is highest."""

YEAR = 365.2425

FLANKS = 0.75
"""Part of a year below which records lie on one flank of the season, where it goes as age does."""

HOTTEST_C = 60.0
"""No air is so far from 0 °C: kelvin, and what stands for an unknown temperature."""

KELVIN = 10.0
"""Change of the temperature that one unit of warmth is, from `sky.TEMPERATURE_C` on: every night has the same zero."""


def travel(mount: Mount, reading: Array, source: Array, when: Array | None = None) -> Array:
    """Sign of each axis' way to a record from the one before, (n, 2); 0 where the order does not show it.

    It shows it within a heliostat's day (`sky.days`), since overnight the mirror is stowed, and through all a
    telescope's night, but for an azimuth that differs by more than half a turn: nobody knows which way round it went.

    Parameters
    ----------
    mount : Mount
    reading, source : (n, 2) and (n, 3) array
        All records, in the order of time.
    when : (n,) array, optional
        Their stamps [s]; may be nan.
    """
    way = np.diff(reading, axis=0, prepend=reading[:1])
    if mount.observes == "spot":
        day = sky.days(mount, source, when)
        way[np.diff(day, prepend=-1) != 0] = 0.0
    if not mount.actuators:
        way[np.abs(way) > np.pi] = 0.0
    return np.asarray(np.sign(way))


def season(when: Array, latitude: float) -> Array | None:
    """−1 on the coldest to 1 on the warmest day of the year, (n,); None where less than half state their time.

    The others are taken at the median. Within `FLANKS` of a year it is not told from age (`spans_flanks`).

    Parameters
    ----------
    when : (n,) array
        Seconds since 1970-01-01 UTC; may be nan.
    latitude : float
        [rad]
    """
    turn = 2 * np.pi * (when / 86400.0 - WARMEST_DAY) / YEAR
    return _filled(np.cos(turn) * (1.0 if latitude >= 0 else -1.0))


def spans_flanks(when: Array | None) -> bool:
    """Whether records reach so far in time that what goes with the season is told from what goes with age."""
    known = np.zeros(0) if when is None else when[np.isfinite(when)]
    return len(known) > 0 and bool(np.ptp(known) >= FLANKS * YEAR * 86400.0)


def warmth(celsius: Array) -> Array | None:
    """Temperature in units of `KELVIN`, (n,); None where less than half are temperatures of the air.

    The others are taken at the median.
    """
    return _filled(np.where(np.abs(celsius) <= HOTTEST_C, (celsius - sky.TEMPERATURE_C) / KELVIN, np.nan))


def _filled(values: Array) -> Array | None:
    known = np.isfinite(values)
    return np.where(known, values, np.median(values[known])) if 2 * known.sum() > len(values) else None
