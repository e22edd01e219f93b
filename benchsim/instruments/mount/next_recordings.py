"""What to record next with a mount: other places of the sun, or more stars where they tell most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

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

STEPS, LONGEST, SMALL = 25, 0.3, 1e-5
"""Newton's steps to an aim, the longest of them and the one of its derivatives, in ranges of the known readings."""

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
    asked = [
        (season, hour, target, sun)
        for season, declination in SEASONS
        for hour in HOURS
        if angles(sun := sun_at(latitude, declination, hour))[1] >= LOWEST
        for target in targets
    ]
    suns = np.array([sun for *_, sun in asked]).reshape(-1, 3)
    spots = np.array([targets[target] for _, _, target, _ in asked]).reshape(-1, 3)
    for (season, hour, target, sun), at in zip(asked, aimed(mount, suns, spots, records.reading), strict=True):
        if not np.isfinite(at).all():
            continue
        azimuth, elevation = angles(sun)
        when = "at noon" if hour == 0 else f"{abs(hour):g} h {'before' if hour < 0 else 'after'} noon"
        what = (
            f"Record a spot on {target} at {season} {when} (sun at azimuth {np.degrees(azimuth):.0f} deg from "
            f"north through east, elevation {np.degrees(elevation):.0f} deg)."
        )
        yield what, Records(("next",), at[None], sun[None], targets[target][None], (target,))


def _sky(mount: Mount, reading: Array, where: Array) -> Records:
    n = len(reading)
    reading = reading - mount.zero
    return Records(tuple(f"next {k + 1}" for k in range(n)), reading, where, np.full((n, 3), np.nan), ("",) * n)


def sun_at(latitude: float, declination: float, hour: float) -> Array:
    """Unit vector toward the sun at an hour angle of ``hour`` hours, (3,)."""
    return toward(*horizontal(latitude, declination, hour * np.pi / 12))


def aimed(mount: Mount, suns: Array, spots: Array, known: Array) -> Array:
    """Readings (T, 2) at which the stated mount sends the light of suns (T, 3) to spots (T, 3).

    Found by damped Newton steps from the middle and the extremes of the known readings, actuators within their travel;
    nan where a spot cannot be reached.
    """
    unit = np.maximum(np.ptp(known, axis=0), 1e-3 * np.maximum(np.abs(known).max(axis=0), 1.0))
    out, steps = np.full((len(suns), 2), np.nan), SMALL * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    for start in (np.median(known, axis=0), *known[:: max(1, len(known) // 4)]):
        left = np.flatnonzero(np.isnan(out[:, 0]))
        if not len(left):
            break
        sun, spot = (np.tile(v[left], (len(steps), 1)) for v in (suns, spots))

        def off(x: Array, sun: Array = sun, spot: Array = spot) -> Array:
            """1e3 times by how much the beam misses the spot at readings (T, 2), and beside them; (3, T, 3)."""
            normal, centre = axes.pointing(mount, (x + steps[:, None]).reshape(-1, 2) * unit, {})
            goal = spot - centre
            found = 1e3 * (axes.reflected(normal, sun) - goal / np.linalg.norm(goal, axis=1, keepdims=True))
            return np.where(np.isfinite(found), found, 1e3).reshape(len(steps), -1, 3)

        x = np.tile(start / unit, (len(left), 1))
        for _ in range(STEPS):
            here, *beside = off(x)
            slope = np.stack([(there - here) / SMALL for there in beside], axis=-1)
            inner = np.einsum("tki,tkj->tij", slope, slope) + 1e-12 * np.eye(2)
            step = np.linalg.solve(inner, np.einsum("tki,tk->ti", slope, here)[..., None])[..., 0]
            x = x - np.clip(step, -LONGEST, LONGEST)
        good = np.abs(off(x)[0]).max(axis=1) < 1e-4
        if mount.actuators:
            good &= (x >= 0).all(axis=1)
        out[left[good]] = x[good] * unit
    return out


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
