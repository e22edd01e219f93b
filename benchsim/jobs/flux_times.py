"""Times of ``benchsim flux``: one, the steps of a day, or four days that stand for a year; and their suns."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.fluxes.day import clear_sky
from benchsim.plant import days
from benchsim.plant.model import Plant

Array = NDArray[np.float64]


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
    dark : tuple of str
        Days on which the sun is up at none of the times.
    """

    times: tuple[datetime, ...]
    suns: Array
    sky: Array
    stands: float
    dark: tuple[str, ...] = ()


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
    site = plant.site
    dates = [day] if day is not None else [f"{year:04d}-{d}" for d in days.QUARTERS] if year is not None else []
    times = [days.at(at, site)] if at is not None else [t for d in dates for t in days.of_day(d, step, site)]
    # A day has a whole number of steps.
    stands = 1.0 if at is not None else 24 / round(24 / step) * (1 if day is not None else 365.25 / len(dates))
    suns = days.suns(times, site)
    up = [k for k in range(len(times)) if suns[k, 2] > 0]
    if not up:
        option = "at" if at else "day" if day else "year"
        raise BenchsimError(f"--{option}: the sun is {days.highest(suns)}; name another")
    sky = np.full(len(times), irradiance) if irradiance is not None else clear_sky(suns, site.elevation)
    lit = tuple(times[k] for k in up)
    return Times(lit, suns[up], np.asarray(sky)[up], stands, days.without(times, lit))
