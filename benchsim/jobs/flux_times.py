"""Times of ``benchsim flux``: one, the steps of a day, or four days that stand for a year; and their suns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.fluxes.day import clear_sky
from benchsim.instruments.mount import solar, stamps
from benchsim.instruments.mount.records import toward
from benchsim.plant.model import Plant

Array = NDArray[np.float64]

QUARTERS = ("03-21", "06-21", "09-22", "12-21")
"""Days that stand for a year: the sun's longitude is a quarter of its circle apart."""


@dataclass(frozen=True)
class Times:
    """When a plant is computed: only while the sun is up.

    Attributes
    ----------
    times : tuple of datetime
        In the site's zone.
    suns : (T, 3)
        Unit vectors toward the apparent sun.
    sky : (T,)
        Irradiance on a plane that faces it [W/m²].
    stands : float
        For which each stands in sums [h]; of a single time 1.
    """

    times: tuple[datetime, ...]
    suns: Array
    sky: Array
    stands: float


def chosen(
    plant: Plant, at: str | None, day: str | None, year: int | None, step: float, irradiance: float | None
) -> Times:
    """Times of which the sun is above the horizon.

    Parameters
    ----------
    plant : Plant
    at, day, year
        One of them, as `benchsim.jobs.plant_flux.flux` takes them.
    step : float
        Between the times of a day [h].
    irradiance : float or None
        On a plane that faces the sun [W/m²]; None: a clear sky's.
    """
    if [at, day, year].count(None) != 2:
        raise BenchsimError("--at, --day, --year: give one of them, a time, a date or a year")
    days = [day] if day is not None else [f"{year:04d}-{d}" for d in QUARTERS] if year is not None else []
    times = [moment(at, plant, "--at")] if at is not None else [t for d in days for t in steps(d, step, plant)]
    # A day has a whole number of steps.
    stands = 1.0 if at is not None else 24 / round(24 / step) * (1 if day is not None else 365.25 / len(days))
    suns = apparent(times, plant)
    up = [k for k in range(len(times)) if suns[k, 2] > 0]
    if not up:
        low = float(np.degrees(np.arcsin(suns[:, 2].max())))
        raise BenchsimError(
            f"--{'at' if at else 'day' if day else 'year'}: the sun is {-low:.1f} deg below the horizon; name another"
        )
    sky = np.full(len(times), irradiance) if irradiance is not None else clear_sky(suns, plant.site.elevation)
    return Times(tuple(times[k] for k in up), suns[up], np.asarray(sky)[up], stands)


def moment(text: str | None, plant: Plant, option: str) -> datetime:
    """A time that an option says, in the site's zone unless it names one."""
    time = stamps.parsed(text)
    if time is None:
        raise BenchsimError(
            f"{option}: {str(text)[:40]!r} is no time from 1950 to 2100; write it like 2026-06-21T12:00"
        )
    return time.astimezone(plant.site.zone) if time.tzinfo else time.replace(tzinfo=plant.site.zone)


def steps(text: str, step: float, plant: Plant) -> list[datetime]:
    """Middles of a day's equal steps [h]."""
    try:
        first = date.fromisoformat(text)
    except ValueError:
        first = None
    if first is None or not 1950 <= first.year <= 2100:
        raise BenchsimError(f"--day, --year: {text[:40]!r} is no date from 1950 to 2100; write it like 2026-06-21")
    if not 1 / 60 <= step <= 6:
        raise BenchsimError(f"--step: {step:g} h is out of range; it must be from a minute, 0.0167, to 6 h")
    start = datetime(first.year, first.month, first.day, tzinfo=plant.site.zone).astimezone(UTC)
    count = round(24 / step)
    return [(start + timedelta(hours=24 * (k + 0.5) / count)).astimezone(plant.site.zone) for k in range(count)]


def apparent(times: Sequence[datetime], plant: Plant) -> Array:
    """Apparent suns, (T, 3)."""
    azimuth, elevation = np.radians(solar.almanac(np.array([t.timestamp() for t in times]), plant.site.place)).T
    return toward(azimuth, elevation)
