"""Times at which a plant is looked at, and where the sun stands: a moment, a day, or four days for a year."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import solar, stamps
from benchsim.instruments.mount.records import toward
from benchsim.plant.model import Site

Array = NDArray[np.float64]

QUARTERS = ("03-21", "06-21", "09-22", "12-21")
"""Days that stand for a year: the sun's longitude is a quarter of its circle apart."""


def at(text: str | None, site: Site, option: str = "--at") -> datetime:
    """A time of ISO 8601; without a zone in the site's."""
    time = stamps.parsed(text)
    # A date alone is midnight to ISO 8601, which nobody means of a sun.
    if time is None or ":" not in str(text):
        raise BenchsimError(
            f"{option}: {str(text)[:40]!r} is no time from 1950 to 2100; write it like 2026-06-21T12:00"
        )
    return time.astimezone(site.zone) if time.tzinfo else time.replace(tzinfo=site.zone)


def of_day(text: str, step: float, site: Site) -> list[datetime]:
    """Middles of a day's equal steps [h]."""
    try:
        first = date.fromisoformat(text)
    except ValueError:
        first = None
    if first is None or not 1950 <= first.year <= 2100:
        raise BenchsimError(f"--day, --year: {text[:40]!r} is no date from 1950 to 2100; write it like 2026-06-21")
    if not 1 / 60 <= step <= 6:
        raise BenchsimError(f"--step: {step:g} h is out of range; it must be from a minute, 0.0167, to 6 h")
    start = datetime(first.year, first.month, first.day, tzinfo=site.zone).astimezone(UTC)
    count = round(24 / step)
    return [(start + timedelta(hours=24 * (k + 0.5) / count)).astimezone(site.zone) for k in range(count)]


def without(asked: Sequence[datetime], left: Sequence[datetime]) -> tuple[str, ...]:
    """Days of which no time is left, as 2026-12-21."""
    days = {f"{t:%Y-%m-%d}" for t in left}
    return tuple(dict.fromkeys(d for t in asked if (d := f"{t:%Y-%m-%d}") not in days))


def highest(suns: Array) -> str:
    """How high the sun stands at most."""
    high = float(np.degrees(np.arcsin(suns[:, 2].max())))
    side = "above" if high > 0 else "below"
    return f"{abs(high):.1f} deg {side} the horizon{' at its highest' if len(suns) > 1 else ''}"


def suns(times: Sequence[datetime], site: Site) -> Array:
    """Unit vectors toward the apparent sun, (T, 3)."""
    azimuth, elevation = np.radians(solar.almanac(np.array([t.timestamp() for t in times]), site.place)).T
    return toward(azimuth, elevation)
