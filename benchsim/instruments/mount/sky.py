"""Where the light comes from: errors of the clock and of refraction move the sun and the stars."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pvlib import spa

from benchsim.instruments.mount.axes import Inside, turned
from benchsim.instruments.mount.records import Array, Mount

DAY = {"spot": 86400.0, "sky": 86164.0905}
"""Seconds in which the sun, and a star, goes round."""

DECLINES, ALIKE = np.radians(0.4) / 24, np.radians(0.01)
"""Fastest change of the sun's declination [rad/h], and what rounding and refraction may add."""

PRESSURE_HPA, TEMPERATURE_C = 1010.0, 10.0
"""Of the standard refraction; an error of it is stated as a part of it, or as arcsec · cot E."""

HORIZON_DEG = 0.5667
"""Standard refraction on the horizon: lower, the sun is not lifted."""

_ZERO = np.zeros(1)


def seen(mount: Mount, source: Array, x: Inside) -> Array:
    """Unit vectors toward the light as it really comes, (T, 3).

    Parameters
    ----------
    mount : Mount
    source : (T, 3) array
        As recorded.
    x : mapping
        ``dt`` [s]: the true time is later by that much. ``refr``: the light comes from higher by that part of standard
        refraction (sun), or by refr · cot E [rad] (stars). ``sun_across``, ``sun_up`` [rad]: moved along its azimuth
        and its elevation.
    """
    out = source
    dt = x.get("dt", _ZERO)
    if dt.any():
        assert mount.latitude is not None, "a clock is a candidate only where the latitude is known"
        turn = -2 * np.pi / DAY[mount.observes] * dt
        out = turned(out, (_ZERO, turn * np.cos(mount.latitude), turn * np.sin(mount.latitude)))
    refr, across, up = (x.get(n, _ZERO) for n in ("refr", "sun_across", "sun_up"))
    if refr.any() or up.any():
        lift = up + refr * (_cotangent(out) if mount.observes == "sky" else refraction(out))
        level = np.stack([out[:, 1], -out[:, 0], 0 * out[:, 0]], axis=-1)
        level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-12)
        out = turned(out, tuple(lift * k for k in level.T))  # type: ignore[arg-type]
    if across.any():
        flat = np.maximum(np.hypot(out[:, 0], out[:, 1]), 1e-6)
        out = turned(out, (_ZERO, _ZERO, -across / flat))
    return out


def days(mount: Mount, source: Array, when: Array | None = None) -> NDArray[np.intp]:
    """Number of the day of records of the sun in the order of time, (n,), from where it stood (n, 3).

    A day goes on while the hour angle grows and the declination moves no further than the sun's in that time, and
    stamps [s], where there are, by no more than half a day. Without them two days may pass for one at the solstices;
    where the latitude is not known every record has its own.
    """
    if mount.latitude is None:
        return np.arange(len(source))
    hour, declination = hour_declination(source, mount.latitude)
    later = 12 / np.pi * np.diff(hour)
    goes_on = (later > 0) & (np.abs(np.diff(declination)) <= DECLINES * later + ALIKE)
    if when is not None:
        goes_on &= ~(np.abs(np.diff(when)) > DAY["spot"] / 2)
    return np.concatenate([[0], np.cumsum(~goes_on)]).astype(np.intp)


def hour_declination(direction: Array, latitude: float) -> tuple[Array, Array]:
    """Hour angle, growing westward, and declination [rad] of unit vectors (n, 3), seen from a latitude [rad]."""
    east, north, up = direction.T
    sine, cosine = np.sin(latitude), np.cos(latitude)
    return np.arctan2(-east, up * cosine - north * sine), np.arcsin(np.clip(north * cosine + up * sine, -1, 1))


def refraction(direction: Array) -> Array:
    """Standard refraction [rad] of unit vectors (T, 3), by Reda & Andreas 2004, NREL/TP-560-34302."""
    elevation = np.degrees(np.arcsin(np.clip(direction[:, 2], -1, 1)))
    return np.radians(spa.atmospheric_refraction_correction(PRESSURE_HPA, TEMPERATURE_C, elevation, HORIZON_DEG))


def _cotangent(direction: Array) -> Array:
    return np.hypot(direction[:, 0], direction[:, 1]) / np.maximum(direction[:, 2], 0.02)
