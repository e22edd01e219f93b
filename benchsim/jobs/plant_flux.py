"""``benchsim flux``: the flux that a plant makes on its receivers, at a time, in a day or a year; who loses what."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchsim.bench.errors import BenchsimError
from benchsim.jobs import flux_cost, flux_files, flux_times
from benchsim.jobs.cluster import Scheduler
from benchsim.jobs.flux_choices import FluxEngine, MountErrors
from benchsim.jobs.flux_engines import Engine, Pool, moments, parted
from benchsim.jobs.flux_result import FluxResult
from benchsim.jobs.output import wanted_folder
from benchsim.jobs.progress import Progress, silent
from benchsim.plant import days, files
from benchsim.plant.model import Plant

Array = NDArray[np.float64]

KINDS = tuple(MountErrors)
"""Whose errors of the mounts are taken."""


@threadpool_limits.wrap(limits=1)
def flux(
    plant: Plant | Path | str,
    output: Path | str | None = None,
    *,
    at: str | None = None,
    day: str | None = None,
    year: int | None = None,
    step: float = 1.0,
    errors: str | None = None,
    seed: int = 0,
    aligned: str | None = None,
    irradiance: float | None = None,
    cells: int | None = None,
    levels: Sequence[float] = (),
    engine: str = "product",
    accuracy: float = 1.0,
    variant: str | None = None,
    rank: bool = False,
    scheduler: Scheduler | None = None,
    workers: int | None = None,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> FluxResult:
    """Compute the flux that a plant makes on its receivers, by the product of error functions or by rays.

    Parameters
    ----------
    plant : path
        ``plant.toml``, or the folder that holds it.
    output : path, optional
        Folder for ``flux.json``, ``heliostats.csv``, maps, pictures, ``report.html`` and ``summary.txt``;
        default: nothing is written.
    at : str, optional
        A time of ISO 8601; without a zone in the site's.
    day : str, optional
        A date instead, in the site's zone: sums through the day.
    year : int, optional
        A year instead: sums by four days, the equinoxes and solstices, each of which stands for a quarter of it.
    step : float
        For which each time of a day stands, which is its middle [h].
    errors : {"stated", "none", "drawn", "diagnosed"}, optional
        Of the mounts. Default: as diagnosed where the plant names a diagnosis, else as stated.
    seed : int
        Of drawn errors, which are as stated, and normal about that with their sigmas; and of rays.
    aligned : str, optional
        A time at which all images were put on their aims, by constant shifts of these; default: never.
    irradiance : float, optional
        On a plane that faces the sun [W/m²]; default a clear sky's.
    cells : int, optional
        Of a map along and up; default half as wide as the narrowest spot's sigma, 60 to 300.
    levels : sequence of float
        Of contours [kW/m²], or kWh/m² of a day; default parts of the peak.
    engine : {"product", "carlo", "both"}
        Product of error functions, Monte Carlo in Mitsuba, or both and where they part.
    accuracy : float
        Standard error of the Monte Carlo's power and brightest cell, of all times together [%].
    variant : str, optional
        Of Mitsuba.
    rank : bool
        With ``day`` or ``year``: what the errors cost each heliostat, by the product.
    scheduler : Scheduler, optional
        Of Dask; default processes of this machine.
    workers : int, optional
        Of this machine; default one per core if the work is long, 0: everything in this process.
    allow_outside : bool
        Whether the plant's tables may lie outside of its folder.
    progress : callable

    Returns
    -------
    FluxResult

    Raises
    ------
    BenchsimError
        If the plant, the time or an option cannot be used, or Mitsuba not be loaded.
    """
    p = plant if isinstance(plant, Plant) else files.read(plant, allow_outside=allow_outside)
    times = flux_times.chosen(p, at, day, year, step, irradiance)
    if rank and at is not None:
        raise BenchsimError("--rank: what errors cost is summed through a day; give --day or --year")
    kind = errors or ("diagnosed" if p.diagnosed else "stated")
    for option, value, known in (("errors", kind, KINDS), ("engine", engine, tuple(FluxEngine))):
        if value not in known:
            raise BenchsimError(f"--{option}: {value!r} is none of {', '.join(known)}")
    if irradiance is not None and not 1 <= irradiance <= 1400:
        raise BenchsimError(f"--irradiance: {irradiance:g} W/m² is out of range; it must be 1 to 1400")
    if any(not level > 0 for level in levels):
        raise BenchsimError(f"--level: {min(levels):g} is out of range; a contour's flux must be above 0")
    if not 0.1 <= accuracy <= 20:
        raise BenchsimError(f"--accuracy: {accuracy:g} % is out of range; it must be 0.1 to 20")
    stated, sigmas = mount_errors(p, kind, seed)
    if aligned is not None:
        sun = days.suns([days.at(aligned, p.site, "--aligned")], p.site)[0]
        if sun[2] <= 0:
            raise BenchsimError("--aligned: the sun is below the horizon then; name another time")
        p = flux_cost.aligned(p, sun, stated)
    options = {
        "at": at, "day": day, "year": year, "step": step, "errors": kind, "seed": seed, "aligned": aligned,
        "irradiance": irradiance, "cells": cells, "levels": [float(x) for x in levels], "engine": engine,
        "accuracy": accuracy, "variant": variant, "rank": rank,
    }  # fmt: skip
    product = Engine("product", cells)
    rays = Engine("carlo", cells, accuracy / 100 * math.sqrt(len(times.times)), seed, variant)
    with wanted_folder(output, "flux", p.files, options) as staging:
        # What errors cost is told by the product, whatever the engine of the maps.
        wanted = (engine != "carlo" or rank, engine != "product", rank)
        share = 0.95 / sum(wanted)

        def told(what: str, part: int) -> Callable[[float], None]:
            start = share * sum(wanted[:part])
            return lambda done: progress(what, start + share * done)

        def through(how: Engine, what: str, part: int) -> tuple:
            pool = Pool(scheduler, workers, own=how.name == "carlo")
            return moments(p, times.suns, times.sky, stated, how, pool, told(what, part))

        base = through(product, "flux", 0) if wanted[0] else ()
        traced = through(rays, "rays", 1) if wanted[1] else ()
        found = base if engine != "carlo" else ()
        cost = None
        if rank:
            cost = flux_cost.cost(
                p, times, stated, sigmas, base, cells, Pool(scheduler, workers), told("what errors cost", 2)
            )
        result = FluxResult(
            p, times.times, found or traced, None if at is not None else step, times.stands, kind, seed, tuple(levels),
            engine, traced if found else (), (), cost, None if output is None else Path(output), irradiance is None,
            times.dark,
        )  # fmt: skip
        if engine == "both":
            k = result.brightest
            why = parted(p, times.suns[k], float(times.sky[k]), stated, found[k], traced[k], rays)
            result = replace(result, partings=why)
        if staging is not None:
            flux_files.write(result, staging)
    progress("done", 1.0)
    return result


def mount_errors(plant: Plant, kind: str, seed: int) -> tuple[Mapping[str, Array], Mapping[str, Array]]:
    """Errors of the mounts and their sigmas [rad], (n,) by name: as stated, none, drawn, or as diagnosed."""
    f = plant.field
    if kind == "none":
        return {}, {}
    if kind == "diagnosed":
        if plant.diagnosed is None:
            raise BenchsimError(
                f"{plant.path.name}: heliostats.diagnosed: is missing, so nothing is as diagnosed; name a field.csv"
            )
        return plant.diagnosed
    if kind == "stated":
        return f.errors, f.sigmas
    rng = np.random.default_rng(seed)
    zero = np.zeros(len(f))
    return {
        n: f.errors.get(n, zero) + f.sigmas.get(n, zero) * rng.standard_normal(len(f))
        for n in dict.fromkeys((*f.errors, *f.sigmas))
    }, f.sigmas
