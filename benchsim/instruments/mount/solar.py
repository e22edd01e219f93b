"""The sun of a heliostat's recordings: which way its azimuth runs, whether its elevation is apparent, what stamps say.

PAINT counts azimuth from south through east. Without stamps the sun's declination tells north from south: it is at most
23.44 deg. With stamps in UTC the sun is where the algorithm of Reda & Andreas 2004 (NREL/TP-560-34302, by pvlib) puts
it, within 0.001 deg: along its daily course it tells time, across it refraction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pvlib import atmosphere, spa

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import sky
from benchsim.instruments.mount.conventions import CONVENTIONS, FITS_DEG, SOUTH_EAST, Convention
from benchsim.instruments.mount.records import Array, toward

READINGS = (SOUTH_EAST, *(c for c in CONVENTIONS if c != SOUTH_EAST))
"""PAINT's convention before the others."""

DECLINATION_DEG = 32.0
"""The sun's is at most 23.44 deg; the rest leaves to the diagnosis what is a little wrong, and refuses other units."""

SHARP_DEG = 0.05
"""Median miss of the stamped sun up to which another convention than PAINT's is believed, and dates are: 12 s, 3 h."""

REFRACTION_DEG = 0.005
"""Median miss across the sun's course up to which elevations are told to be apparent, or true: refraction moves the sun
across by more, and by three times what is left."""

PROMPT_S, SINGLE_S = 2.0, 60.0
"""Median error of the stamps that is not worth a remark, and error of a single one that is."""

ZONES = {
    7200: "CEST taken for UTC",
    3600: "CET taken for UTC",
    -3600: "UTC taken for CET",
    -7200: "UTC taken for CEST",
}
"""Stamp less true time [s] → what went wrong."""

NEAR_S = 600.0
"""Difference from such an error up to which a clock that the spots show to be wrong is taken for it."""


@dataclass(frozen=True)
class Check:
    """Stamped suns against the almanac.

    Attributes
    ----------
    late : (n,) array
        Stamp less the time at which the sun stands at the recorded hour angle [s].
    across : (n,) array
        Recorded declination less that of the sun at that time [deg].
    """

    late: Array
    across: Array

    @property
    def zone(self) -> Array:
        """The error of `ZONES`, or none, that the lateness is nearest to [s]."""
        known = np.array([0, *ZONES])
        return np.asarray(known[np.argmin(np.abs(self.late[:, None] - known), axis=1)])

    @property
    def rest(self) -> Array:
        """What is left of the lateness beside a zone [s]."""
        return self.late - self.zone

    @property
    def prompt(self) -> bool:
        """Whether stamps and sun agree, without a whole hour between them."""
        return bool(np.abs(self.late).max() <= SINGLE_S and np.median(np.abs(self.late)) <= PROMPT_S)

    @property
    def miss(self) -> float:
        """Median angle between sun and almanac beside a zone [deg]."""
        return float(np.median(np.hypot(self.across, self.rest / 240)))


def directions(paths: Sequence[Path], seen: Array, times: Array, place: Array) -> tuple[Array, tuple[str, ...], bool]:
    """Unit vectors toward the sun as it is seen, and what is to be said of them.

    Parameters
    ----------
    paths : sequence of Path
        Files of the recordings, for messages.
    seen : (n, 2) array
        Azimuth and elevation as recorded [deg].
    times : (n,) array
        Stamps, seconds since 1970-01-01 UTC; nan where there is none.
    place : (3,) array
        Latitude, longitude [deg], height [m].

    Returns
    -------
    source : (n, 3) array
        East, north, up; refraction included.
    remarks : tuple of str
    prompt : bool
        Whether most records have stamps, and these agree with where the sun was recorded.

    Raises
    ------
    BenchsimError
        If the sun can stand there in no convention.
    """
    azimuth, elevation = seen.T
    suns = {c: toward(np.radians(c.turned(azimuth)), np.radians(elevation)) for c in READINGS}
    declinations = {c: _turns(s, place[0])[1] for c, s in suns.items()}
    possible = [c for c in READINGS if np.abs(declinations[c]).max() <= DECLINATION_DEG]
    if not possible:
        k = int(np.argmax(np.abs(declinations[SOUTH_EAST])))
        each = " and ".join(f"{d[k]:.0f} deg with azimuth {c}" for c, d in declinations.items() if c.through == "east")
        raise BenchsimError(
            f"{paths[k]}: sun_elevation, sun_azimuth: the sun never stands at {elevation[k]:g} and {azimuth[k]:g} deg "
            f"at latitude {place[0]:.4g} deg (its declination would be {each}); write degrees, azimuth from south with "
            "west negative"
        )
    stamped = np.flatnonzero(np.isfinite(times))
    if not len(stamped):
        return suns[possible[0]], (_said(possible[0], "only so can the sun stand there"),), False
    # All at once: the almanac takes hardly longer for hundreds of moments than for one.
    pairs = [(c, a) for c in possible for a in (True, False)]
    many, lifted = np.concatenate([suns[c][stamped] for c, _ in pairs]), np.repeat([a for _, a in pairs], len(stamped))
    every = _checked(many, np.tile(times[stamped], len(pairs)), place, lifted)
    parts = (np.split(x, len(pairs)) for x in (every.late, every.across))
    checks = {pair: Check(*part) for pair, *part in zip(pairs, *parts, strict=True)}
    least = {c: min(checks[c, a].miss for a in (True, False)) for c in possible}
    fit = [c for c in possible if least[c] < (FITS_DEG if c == possible[0] else SHARP_DEG)]
    convention = fit[0] if fit else possible[0]
    source = suns[convention]
    remarks = [_said(convention, "the stamps show it" if fit else "only so can the sun stand there")]
    apparent, true = (float(np.median(np.abs(checks[convention, a].across))) for a in (True, False))
    clear = min(apparent, true) < min(REFRACTION_DEG, max(apparent, true) / 3)
    if clear and apparent < true:
        remarks.append(
            f"Elevations of the sun are apparent, refraction included: by the stamps they miss {apparent:.1g} deg so, "
            f"{true:.1g} deg were they true."
        )
    elif clear:
        lifted = np.radians(elevation) + sky.refraction(source)
        source = toward(np.radians(convention.turned(azimuth)), lifted)
        remarks.append(
            f"Elevations of the sun are true, without refraction (by the stamps they miss {true:.1g} deg so, "
            f"{apparent:.1g} deg were they apparent): standard refraction was added."
        )
    elif min(apparent, true) > SHARP_DEG:
        remarks.append(
            f"The stamps are of other days: the sun stood {min(apparent, true):.2g} deg across its course from where "
            "it is recorded (median)."
        )
    names = [paths[int(k)].name for k in stamped]
    check = checks[convention, not clear or apparent < true]
    return source, (*remarks, *_clock(names, check)), 2 * len(stamped) > len(times) and check.prompt


def almanac(times: Array, place: Array, *, apparent: bool | NDArray[np.bool_] = True) -> Array:
    """Azimuth from north through east and elevation of the sun [deg], (n, 2).

    Reda & Andreas 2004, https://doi.org/10.1016/j.solener.2003.12.003; refraction (pressure by height)
    lifts the apparent sun.

    Parameters
    ----------
    times : (n,) array
        Seconds since 1970-01-01 UTC.
    place : (3,) array
        Latitude, longitude [deg], height [m].
    """
    dates = [datetime.fromtimestamp(t, UTC) for t in times]
    ahead = spa.calculate_deltat(np.array([d.year for d in dates]), np.array([d.month for d in dates]))
    pressure = atmosphere.alt2pres(place[2]) / 100
    _, _, lifted, plain, azimuth, _ = spa.solar_position(
        times, *place, pressure, sky.TEMPERATURE_C, ahead, sky.HORIZON_DEG, numthreads=1
    )
    return np.column_stack([azimuth, np.where(apparent, lifted, plain)])


def zone(late: float) -> str | None:
    """What went wrong with a clock that is late by some seconds, if its error is about a whole hour or two."""
    shift = min(ZONES, key=lambda z: abs(z - late))
    return f"clock: {shift:+d} s: {ZONES[shift]}" if abs(shift - late) < NEAR_S else None


def _said(convention: Convention, why: str) -> str:
    if convention == SOUTH_EAST:
        return f"Azimuths of the sun are {convention}, as PAINT has them."
    return f"Azimuths of the sun are {convention}, not {SOUTH_EAST} as PAINT has them: {why}."


def _clock(names: Sequence[str], check: Check) -> list[str]:
    """What the stamps' clock did."""
    single = np.abs(check.rest) > SINGLE_S
    if single.mean() > 0.5:
        low, middle, high = np.quantile(check.late, [0, 0.5, 1])
        return [
            f"clock: the stamps are {middle:+.0f} s off the recorded sun (median; {low:+.0f} to {high:+.0f} s), by no "
            "whole hours: they are not of these recordings, or not UTC."
        ]
    out = []
    for shift, what in ZONES.items():
        those = [n for n, z, s in zip(names, check.zone, single, strict=True) if z == shift and not s]
        if those:
            whose = "all stamps" if len(those) == len(names) else f"the stamps of {_listed(those)}"
            out.append(f"clock: {shift:+d} s: {what} in {whose}; the sun is taken as it is recorded.")
    usual = float(np.median(check.rest[~single]))
    if abs(usual) > PROMPT_S:
        out.append(f"clock: the stamps are {usual:+.1f} s off the recorded sun (median, beside whole hours).")
    if single.any():
        each = _listed([f"{n} ({late:+.0f} s)" for n, late, s in zip(names, check.late, single, strict=True) if s])
        out.append(f"Stamp and recorded sun are more than {SINGLE_S:.0f} s apart in {each}.")
    return out


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _checked(suns: Array, times: Array, place: Array, apparent: NDArray[np.bool_]) -> Check:
    hour, declination = _turns(suns, place[0])

    def known(late: Array) -> tuple[Array, Array]:
        return _turns(toward(*np.radians(almanac(times - late, place, apparent=apparent)).T), place[0])

    late = np.zeros(len(times))
    for _ in range(2):  # the second for the equation of time, which moves by a second in an hour
        late += 240 * ((known(late)[0] - hour + 180) % 360 - 180)
    return Check(late, declination - known(late)[1])


def _turns(direction: Array, latitude: float) -> tuple[Array, Array]:
    """`sky.hour_declination` in degrees."""
    hour, declination = sky.hour_declination(direction, np.radians(latitude))
    return np.degrees(hour), np.degrees(declination)
