"""``benchsim detectors``: which heliostats of a plant two arrays see, when, how well; labels, places, a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchsim.arrays import placing
from benchsim.arrays.sensitivity import sensitivity
from benchsim.bench.errors import BenchsimError
from benchsim.fluxes.day import clear_sky
from benchsim.jobs.detector_simulated import simulate
from benchsim.jobs.detector_station import Watch, watch
from benchsim.jobs.detectors_result import LIMIT, DetectorsResult, write
from benchsim.jobs.output import wanted_folder
from benchsim.jobs.progress import Progress, silent
from benchsim.plant import days, files
from benchsim.plant.model import Plant
from benchsim.plant.sensors import CLEAR
from benchsim.plant.station import Station

LOWEST = np.radians(10.0)
"""Height of the sun below which no plant runs."""

BATCH = 500
"""Heliostats whose light is computed at once: 300 MB."""

YEAR = 2026
"""Whose four days are taken unless a time is said; the sun's course differs by 0.1° from year to year."""

SEARCHED = 60
"""Heliostats by which places are compared, evenly through the table: the share is then known to some percent."""

SEARCH_STEP = 3.0
"""Hours between the times by which places are compared."""


@threadpool_limits.wrap(limits=1)
def detectors(
    plant: Plant | Path | str,
    output: Path | str | None = None,
    *,
    at: str | None = None,
    day: str | None = None,
    year: int | None = None,
    step: float = 1.0,
    place: bool = False,
    record: str | None = None,
    errors: str = "drawn",
    seed: int = 0,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> DetectorsResult:
    """Say which heliostats of a plant its arrays of detectors see, when, and how well.

    Parameters
    ----------
    plant : path
        ``plant.toml``, or the folder that holds it.
    output : path, optional
        Folder for ``detectors.json``, ``heliostats.csv``, ``times.csv``, ``detectors.csv``, pictures,
        ``report.html`` and ``summary.txt``; default: nothing is written.
    at, day, year : optional
        A time of ISO 8601, a date, or a year, of which equinoxes and solstices are taken; default the year 2026.
    step : float
        Between the times of a day [h].
    place : bool
        Look for places of two arrays at which they see the most.
    record : str, optional
        A time at which a record is simulated, measured, and the heliostats corrected.
    errors : {"stated", "none", "drawn", "diagnosed"}
        Of the mounts, in the record.
    seed : int
        Of drawn errors, and of the record's noise.
    allow_outside : bool
        Whether the plant's tables may lie outside of its folder.
    progress : callable

    Returns
    -------
    DetectorsResult

    Raises
    ------
    BenchsimError
        If the plant, a time or an option cannot be used.
    """
    p = plant if isinstance(plant, Plant) else files.read(plant, allow_outside=allow_outside)
    if [at, day, year].count(None) < 2:
        raise BenchsimError("--at, --day, --year: give one of them, or none for a year")
    when = days.at(record, p.site, "--record") if record is not None else None
    dates = [day] if day is not None else [f"{year or YEAR:04d}-{d}" for d in days.QUARTERS]
    times = [days.at(at, p.site)] if at is not None else [t for d in dates for t in days.of_day(d, step, p.site)]
    asked, times = times, _lit(times, p, LOWEST if at is None else 0.0)
    w = watch(p)
    options = {"at": at, "day": day, "year": year, "step": step, "place": place, "record": record}
    options |= {"errors": errors, "seed": seed}
    with wanted_folder(output, "detectors", p.files, options) as staging:
        weight = (2 if place else 0) + 1 + (3 if when is not None else 0)

        def through(what: str, first: float) -> Any:
            return lambda done: progress(what, 0.98 * (first + done) / weight)

        result = _looked(p, w, times, through("light on the arrays", 0.0))
        if place:
            moved = _placed(p, w, times, through("places", 1.0))
            again = _looked(p, watch(p, moved), times, through("light on the arrays", 2.0))
            if again.share > result.share:
                result = replace(again, before=result.share)
            else:
                result = replace(result, before=result.share)
        if when is not None:
            done = simulate(result.watch, when, errors, seed, through("record", weight - 3.0))
            result = replace(result, record=done)
        result = replace(result, dark=days.without(asked, times), folder=None if output is None else Path(output))
        if staging is not None:
            write(result, staging)
    progress("done", 1.0)
    return result


def _lit(times: Sequence[datetime], plant: Plant, lowest: float) -> list[datetime]:
    """Times at which the sun stands high enough."""
    suns = days.suns(times, plant.site)
    high = np.arcsin(suns[:, 2])
    if not (high > lowest).any():
        wanted = f", a day's arrays need {np.degrees(lowest):.0f} deg" if lowest > 0 else ""
        raise BenchsimError(f"--at, --day: the sun is {days.highest(suns)}{wanted}; name another time")
    return [t for t, h in zip(times, high, strict=True) if h > lowest]


def _looked(plant: Plant, w: Watch, times: Sequence[datetime], told: Any) -> DetectorsResult:
    suns = days.suns(times, plant.site)
    sky = clear_sky(suns, plant.site.elevation)
    shape = (len(times), len(w.who))
    sigma, crossed, hidden = np.full((*shape, 2), np.inf), np.zeros(shape, bool), np.zeros(shape, bool)
    for t, sun in enumerate(suns):
        told(t / len(suns))
        light, hidden[t] = w.arriving(sun)
        a = replace(w.assumptions, direct_irradiance=float(sky[t]), duration=w.labels.duration)
        for start in range(0, len(w.who), BATCH):
            some = slice(start, start + BATCH)
            s = sensitivity(w.scene(sun, some=some), a, light[some])
            sigma[t, some], crossed[t, some] = s.sigma, s.seen
    return DetectorsResult(plant, w, tuple(times), sigma, crossed, hidden)


def _placed(plant: Plant, w: Watch, times: Sequence[datetime], told: Any) -> Station:
    """The plant's two arrays where they see the most of some heliostats at some of the times."""
    s, receiver = w.station, plant.receivers[w.station.receiver]
    if len(s.arrays) != 2:
        raise BenchsimError(f"{plant.path.name}: detector: two arrays are placed, not {len(s.arrays)}; state two")
    halves = [(receiver.height if not a.upright else receiver.width) / 2 for a in s.arrays]
    found = [placing.places(line, half + CLEAR, -w.origin[2]) for line, half in zip(w.lines, halves, strict=True)]
    if not all(len(p.lines) for p, _ in found):
        raise BenchsimError(f"{plant.path.name}: detector: an array reaches into the ground; make it shorter")
    some = np.unique(np.linspace(0, len(w.who) - 1, SEARCHED).round().astype(int))
    hours = [times[0]]
    for t in times[1:]:
        if abs((t - hours[-1]).total_seconds()) >= 3600 * SEARCH_STEP:
            hours.append(t)
    suns = days.suns(hours, plant.site)
    sky = clear_sky(suns, plant.site.elevation)
    moments = []
    for sun, dni in zip(suns, sky, strict=True):
        # The light is compared at one irradiance: what a sky lets pass goes with what is hidden.
        light = w.arriving(sun)[0][some] * float(dni) / w.assumptions.direct_irradiance
        moments.append((lambda lines, sun=sun: w.scene(sun, lines, some), light))
    best = placing.search(moments, w.assumptions, found, LIMIT, told)
    arrays = []
    for old, line in zip(s.arrays, best.lines, strict=True):
        along = line.along if line.upright else -line.along
        offset = -line.offset if line.upright else line.offset
        arrays.append(replace(old, offset=offset, low=float(along.min()), count=len(along)))
    return Station(s.receiver, s.azimuth, tuple(arrays), ())
