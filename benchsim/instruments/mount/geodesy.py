"""Places on the earth as a plant's own east, north and up, and back, on WGS 84."""

from __future__ import annotations

import numpy as np

from benchsim.instruments.mount.records import Array

_A, _F = 6378137.0, 1 / 298.257223563
"""WGS 84: semi-major axis [m] and flattening."""


def enu(place: Array, origin: Array) -> Array:
    """East, north, up [mm] of (latitude deg, longitude deg, height m) about an origin of the same form, on WGS 84."""
    latitude, longitude = np.radians(origin[:2])
    apart = _earth_centred(place) - _earth_centred(origin)
    sa, ca, so, co = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    axes = np.array([[-so, co, 0.0], [-sa * co, -sa * so, ca], [ca * co, ca * so, sa]])
    return np.asarray(1e3 * axes @ apart)


def geodetic(place: Array, about: Array) -> Array:
    """Latitude, longitude [deg], height [m] of (east, north, up) mm about an origin of that form: the inverse of
    `enu`, by Newton's method."""
    at = np.array(about, float)
    step = np.array([1e-5, 1e-5, 1.0])
    for _ in range(3):
        slope = [(enu(at + d, about) - enu(at - d, about)) / 2 for d in np.diag(step)]
        at = at + step * np.linalg.solve(np.transpose(slope), np.asarray(place) - enu(at, about))
    return at


def _earth_centred(place: Array) -> Array:
    latitude, longitude = np.radians(place[:2])
    squared = _F * (2 - _F)
    across = _A / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    return np.array(
        [
            (across + place[2]) * np.cos(latitude) * np.cos(longitude),
            (across + place[2]) * np.cos(latitude) * np.sin(longitude),
            (across * (1 - squared) + place[2]) * np.sin(latitude),
        ]
    )
