"""What to record next with a mount: other places of the sun, or more stars where they tell most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchsim.diagnosis import linear
from benchsim.diagnosis.evidence import amplitudes
from benchsim.diagnosis.problem import Effect, NextRecording, Parameter, Problem
from benchsim.instruments.mount import axes
from benchsim.instruments.mount.posing import problem_of
from benchsim.instruments.mount.prediction import Predict
from benchsim.instruments.mount.records import Array, Mount, Records, angles, toward
from benchsim.vector.sun import horizontal

OBLIQUITY = np.radians(23.44)

SEASONS = (("midsummer", OBLIQUITY, 0.9), ("equinox", 0.0, 0.0), ("midwinter", -OBLIQUITY, -0.9))
"""Declination of the sun and warmth (`history.season`) by the northern name of the season; of the equinoxes one is
warmer than the year's mean, one colder."""

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
        known, (whats, records) = self.predict, _candidates(self.predict)
        if not whats:
            return ()
        order = {t: k for t, k in zip(known.records.target, known.target_number, strict=True)}
        number = np.array([order.get(t, 0) for t in records.target], np.intp)
        own = replace(known, records=records, target_number=number, drift=np.zeros((len(number), 0)))
        stub = problem_of(own, self.problem.catalogue, self.sigma)
        many = [p for e in _steady(self.problem.catalogue) for p in amplitudes(e)]
        slopes = linear.columns(stub, {}, (*stub.nuisances, *many))
        parts = slopes.reshape(len(whats), -1, slopes.shape[1])
        return tuple(_further(stub, many, self.sigma, what, part) for what, part in zip(whats, parts, strict=True))


def _further(stub: Problem, many: Sequence[Parameter], sigma: float, what: str, slopes: Array) -> NextRecording:
    return NextRecording(
        kind="recording",
        what=what,
        covariance=np.eye(len(slopes)) * sigma**2,
        nuisance={p.name: slopes[:, k] for k, p in enumerate(stub.nuisances)},
        priors={},
        effect={p.name: slopes[:, len(stub.nuisances) + k] for k, p in enumerate(many)},
    )


def _candidates(predict: Predict) -> tuple[list[str], Records]:
    """What could be recorded, and the records of it, as many of each."""
    mount, records = predict.mount, predict.records
    if mount.observes == "sky":
        heights = (20, 40, 60, 75)
        azimuth = np.tile(2 * np.pi * np.arange(STARS) / STARS, len(heights))
        reading = np.column_stack([azimuth, np.repeat(np.radians(heights), STARS)])
        names, spots = tuple(f"next {k + 1}" for k in range(len(reading))), np.full((len(reading), 3), np.nan)
        later = Records(names, reading - mount.zero, toward(*reading.T), spots, ("",) * len(reading))
        return [f"Point at {STARS} stars all around at an elevation of {h} deg." for h in heights], later
    latitude = mount.latitude if mount.latitude is not None else np.radians(45.0)
    targets = {
        t: records.spot[[k for k, o in enumerate(records.target) if o == t]].mean(axis=0) for t in records.target
    }
    asked = [
        (season, hour, target, sun, warm)
        for season, declination, warm in SEASONS
        for hour in HOURS
        if angles(sun := sun_at(latitude, declination, hour))[1] >= LOWEST
        for target in targets
    ]
    suns = np.array([sun for *_, sun, _ in asked]).reshape(-1, 3)
    spots = np.array([targets[target] for _, _, target, *_ in asked]).reshape(-1, 3)
    warmth = np.array([warm for *_, warm in asked]) * (1.0 if latitude >= 0 else -1.0)
    reading = aimed(mount, suns, spots, records.reading)
    good = np.flatnonzero(np.isfinite(reading).all(axis=1))
    whats = []
    for season, hour, target, sun, _ in (asked[i] for i in good):
        azimuth, elevation = angles(sun)
        when = "at noon" if hour == 0 else f"{abs(hour):g} h {'before' if hour < 0 else 'after'} noon"
        whats.append(
            f"Record a spot on {target} at {season} {when} (sun at azimuth {np.degrees(azimuth):.0f} deg from "
            f"north through east, elevation {np.degrees(elevation):.0f} deg)."
        )
    own = tuple(asked[i][2] for i in good)
    return whats, Records(("next",) * len(good), reading[good], suns[good], spots[good], own, warmth=warmth[good])


def sun_at(latitude: float, declination: float, hour: float) -> Array:
    """Unit vector toward the sun at an hour angle of ``hour`` hours, (3,)."""
    return toward(*horizontal(latitude, declination, hour * np.pi / 12))


def aimed(mount: Mount, suns: Array, spots: Array, known: Array) -> Array:
    """Readings (T, 2) at which the stated mount sends the light of suns (T, 3) to spots (T, 3).

    Found by damped Newton steps from the middle and the extremes of the known readings, of which the first that leads
    there counts, actuators within their travel; nan where a spot cannot be reached.
    """
    unit = np.maximum(np.ptp(known, axis=0), 1e-3 * np.maximum(np.abs(known).max(axis=0), 1.0))
    steps = SMALL * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    starts = np.array([np.median(known, axis=0), *known[:: max(1, len(known) // 4)]]) / unit
    sun, spot = (np.tile(v, (len(steps) * len(starts), 1)) for v in (suns, spots))

    def off(x: Array) -> Array:
        """1e3 times by how much the beam misses the spot at readings (T, 2), and beside them; (3, T, 3)."""
        normal, centre = axes.pointing(mount, (x + steps[:, None]).reshape(-1, 2) * unit, {})
        goal = spot - centre
        found = 1e3 * (axes.reflected(normal, sun) - goal / np.linalg.norm(goal, axis=1, keepdims=True))
        return np.where(np.isfinite(found), found, 1e3).reshape(len(steps), -1, 3)

    x = np.repeat(starts, len(suns), axis=0)
    for _ in range(STEPS):
        here, *beside = off(x)
        slope = np.stack([(there - here) / SMALL for there in beside], axis=-1)
        inner = np.einsum("tki,tkj->tij", slope, slope) + 1e-12 * np.eye(2)
        step = np.linalg.solve(inner, np.einsum("tki,tk->ti", slope, here)[..., None])[..., 0]
        x = x - np.clip(step, -LONGEST, LONGEST)
    good = np.abs(off(x)[0]).max(axis=1) < 1e-4
    if mount.actuators:
        good &= (x >= 0).all(axis=1)
    good, found = good.reshape(len(starts), -1), (x * unit).reshape(len(starts), -1, 2)
    return np.where(good.any(axis=0)[:, None], found[good.argmax(axis=0), np.arange(len(suns))], np.nan)


def _steady(catalogue: Sequence[Effect]) -> list[Effect]:
    """Effects that a single later record shows: a change in time is none."""
    return [e for e in catalogue if e.name != "change-point"]
