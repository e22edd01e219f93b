"""What to record next with a mount: other places of the sun, or more stars where they tell most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from benchsim.diagnosis import linear
from benchsim.diagnosis.evidence import amplitudes
from benchsim.diagnosis.problem import Effect, NextRecording, Problem
from benchsim.instruments.mount import axes
from benchsim.instruments.mount.posing import problem_of
from benchsim.instruments.mount.prediction import Predict
from benchsim.instruments.mount.records import Array, Mount, Records, angles, toward
from benchsim.vector.sun import horizontal

OBLIQUITY = np.radians(23.44)

SEASONS = (("midsummer", OBLIQUITY), ("equinox", 0.0), ("midwinter", -OBLIQUITY))
"""Declinations of the sun by the northern name of the season."""

HOURS = (-4.0, -2.0, 0.0, 2.0, 4.0)
"""From noon, [h] of solar time."""

LOWEST = np.radians(12.0)
"""Elevation below which nothing is recorded."""

STARS = 8
"""In a ring of one elevation."""


@dataclass(frozen=True)
class Next:
    """The recordings that could be taken next, computed when they are asked for."""

    problem: Problem
    predict: Predict
    sigma: float

    def __call__(self) -> tuple[NextRecording, ...]:
        """Every candidate, linearised at the stated mount."""
        return tuple(
            _further(self.problem, self.predict, self.sigma, what, records)
            for what, records in _candidates(self.predict)
        )


def _candidates(predict: Predict) -> Iterator[tuple[str, Records]]:
    mount, records = predict.mount, predict.records
    if mount.observes == "sky":
        for height in (20, 40, 60, 75):
            azimuth = 2 * np.pi * np.arange(STARS) / STARS
            reading = np.column_stack([azimuth, np.full(STARS, np.radians(height))])
            where = toward(reading[:, 0], reading[:, 1])
            yield f"Point at {STARS} stars all around at an elevation of {height} deg.", _sky(mount, reading, where)
        return
    latitude = mount.latitude if mount.latitude is not None else np.radians(45.0)
    targets = {
        t: records.spot[[k for k, o in enumerate(records.target) if o == t]].mean(axis=0) for t in records.target
    }
    for season, declination in SEASONS:
        for hour in HOURS:
            sun = sun_at(latitude, declination, hour)
            azimuth, elevation = angles(sun)
            if elevation < LOWEST:
                continue
            for target, spot in targets.items():
                at = aimed(mount, sun, spot, records.reading)
                if at is None:
                    continue
                when = "at noon" if hour == 0 else f"{abs(hour):g} h {'before' if hour < 0 else 'after'} noon"
                what = (
                    f"Record a spot on {target} at {season} {when} (sun at azimuth {np.degrees(azimuth):.0f} deg from "
                    f"north through east, elevation {np.degrees(elevation):.0f} deg)."
                )
                yield what, Records(("next",), at[None], sun[None], spot[None], (target,))


def _sky(mount: Mount, reading: Array, where: Array) -> Records:
    n = len(reading)
    reading = reading - mount.zero
    return Records(tuple(f"next {k + 1}" for k in range(n)), reading, where, np.full((n, 3), np.nan), ("",) * n)


def sun_at(latitude: float, declination: float, hour: float) -> Array:
    """Unit vector toward the sun at an hour angle of ``hour`` hours, (3,)."""
    return toward(*horizontal(latitude, declination, hour * np.pi / 12))


def aimed(mount: Mount, sun: Array, spot: Array, known: Array) -> Array | None:
    """Readings (2,) at which the stated mount sends the sun's light to a spot; None where it cannot be reached.

    Found by least squares from each of the known readings' middle and extremes, actuators within their travel.
    """

    def miss(reading: Array) -> Array:
        normal, centre = axes.pointing(mount, reading[None] * unit, {})
        beam = axes.reflected(normal[0], sun)
        toward_spot = spot - centre[0]
        out = np.asarray(1e3 * (beam - toward_spot / np.linalg.norm(toward_spot)))
        return np.where(np.isfinite(out), out, 1e3)

    unit = np.maximum(np.ptp(known, axis=0), 1e-3 * np.maximum(np.abs(known).max(axis=0), 1.0))
    for start in (np.median(known, axis=0), *known[:: max(1, len(known) // 4)]):
        found = least_squares(miss, start / unit, x_scale=0.1)
        if np.abs(found.fun).max() < 1e-4 and (not mount.actuators or (found.x >= 0).all()):
            return np.asarray(found.x * unit)
    return None


def _further(problem: Problem, predict: Predict, sigma: float, what: str, records: Records) -> NextRecording:
    n = len(records.names)
    order = {t: k for t, k in zip(predict.records.target, predict.target_number, strict=True)}
    number = np.array([order.get(t, 0) for t in records.target], np.intp)
    own = replace(predict, records=records, target_number=number, drift=np.zeros((n, 0)))
    stub = problem_of(own, problem.catalogue, sigma)
    many = [p for e in _steady(problem.catalogue) for p in amplitudes(e)]
    slopes = linear.columns(stub, {}, (*stub.nuisances, *many))
    return NextRecording(
        kind="recording",
        what=what,
        covariance=np.eye(2 * n) * sigma**2,
        nuisance={p.name: slopes[:, k] for k, p in enumerate(stub.nuisances)},
        priors={},
        effect={p.name: slopes[:, len(stub.nuisances) + k] for k, p in enumerate(many)},
    )


def _steady(catalogue: Sequence[Effect]) -> list[Effect]:
    """Effects that a single later record shows: a change in time is none."""
    return [e for e in catalogue if e.name != "change-point"]
