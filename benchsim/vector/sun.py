"""The solar vector and the turn from north to the tower's frame: Carretero 2019, Eqs (1)-(6).

The paper calls the two angles of Eq. (1) declination δ and hour angle ω, but describes, and needs, the sun's elevation
and its azimuth from north toward east: with declination and hour angle the same formula gives a vector in the
equatorial frame. Here declination and hour angle become elevation and azimuth first (:func:`sun_angles`).

Vectors are world frame: x north (or, after Eq. (6), along the target's normal), y west, z up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]


def turn_y(angle: float) -> Array:
    """T_y, right-handed turn about y by ``angle`` [rad], (3, 3) (Carretero 2019, Eq. (4))."""
    return Rotation.from_euler("y", angle).as_matrix()


def turn_z(angle: float) -> Array:
    """T_z, right-handed turn about z by ``angle`` [rad], (3, 3) (Carretero 2019, Eq. (5))."""
    return Rotation.from_euler("z", angle).as_matrix()


def solar_vector(azimuth: ArrayLike, elevation: ArrayLike) -> Array:
    """S, unit vectors toward the sun (Carretero 2019, Eq. (1)); light travels along −S.

    :func:`benchsim.bench.place.toward_source` for arrays of angles.

    Parameters
    ----------
    azimuth, elevation : (...) array
        From north (+x) toward east (−y), and above the horizon [rad].

    Returns
    -------
    (..., 3) ndarray
    """
    a, e = np.broadcast_arrays(np.asarray(azimuth, float), np.asarray(elevation, float))
    return np.stack([np.cos(e) * np.cos(a), -np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def to_tower(source: ArrayLike, facing: float) -> Array:
    """S_local = T_z(φ) S, the solar vector in the tower's frame (Carretero 2019, Eq. (6)).

    Parameters
    ----------
    source : (..., 3) array
        In the frame north, west, up.
    facing : float
        φ, the direction that the target's normal looks to, from north toward east [rad]. With this sense the
        components of a fixed vector turn by +φ about z, as Eq. (6) has it.

    Returns
    -------
    (..., 3) ndarray
        In the frame target's normal, horizontal along the target, up.
    """
    return np.asarray(source, float) @ turn_z(facing).T


def sun_angles(latitude: float, day_of_year: int, solar_hour: ArrayLike) -> tuple[Array, Array]:
    """Azimuth and elevation of the sun's centre at true solar time.

    The declination is Spencer's series for the day (``pvlib.solarposition.declination_spencer71``, 0.0006 rad), the
    hour angle 15° per hour from the sun's own noon: no longitude, equation of time or refraction enters.
    The vector (cos δ cos ω, cos δ sin ω, sin δ) toward meridian, west and pole is turned by the colatitude about west.

    Parameters
    ----------
    latitude : float
        North positive [rad].
    day_of_year : int
        1 to 366; June 21 is 172 in a common year.
    solar_hour : (...) array
        True solar time, noon is 12 [h].

    Returns
    -------
    azimuth : (...) ndarray
        From north toward east, 0 to 2π [rad].
    elevation : (...) ndarray
        Geometric, negative below the horizon [rad].

    Raises
    ------
    BenchsimError
        If the latitude lies beyond a pole or the day outside 1 to 366.
    """
    # pvlib brings pandas, a second of import that only the sun needs
    from pvlib import solarposition

    if not abs(latitude) <= np.pi / 2:
        raise BenchsimError(f"latitude: {np.degrees(latitude):g}° lies beyond a pole; give it in rad, within ±π/2")
    if not 1 <= day_of_year <= 366:
        raise BenchsimError(f"day of year: {day_of_year} is no day; give 1 to 366")
    hour_angle = np.radians(15.0 * (np.asarray(solar_hour, float) - 12.0))
    return horizontal(latitude, solarposition.declination_spencer71(day_of_year), hour_angle)


def horizontal(latitude: float, declination: ArrayLike, hour_angle: ArrayLike) -> tuple[Array, Array]:
    """Azimuth and elevation of a direction given by declination and hour angle.

    Parameters
    ----------
    latitude : float
        North positive [rad].
    declination : float or (...) array
        North positive [rad].
    hour_angle : (...) array
        From the meridian, west positive [rad].

    Returns
    -------
    azimuth : (...) ndarray
        From north toward east, 0 to 2π [rad].
    elevation : (...) ndarray
        Negative below the horizon [rad].
    """
    hour_angle = np.asarray(hour_angle, float)
    # not pvlib's analytical azimuth: at noon it says south where the sun stands north, and its arccos keeps 1e-8 rad
    equatorial = np.stack(
        [
            np.cos(declination) * np.cos(hour_angle),
            np.cos(declination) * np.sin(hour_angle),
            np.full_like(hour_angle, np.sin(declination)),
        ],
        axis=-1,
    )
    south, west, up = np.moveaxis(equatorial @ turn_y(latitude - np.pi / 2).T, -1, 0)
    return np.mod(np.arctan2(-west, -south), 2 * np.pi), np.arctan2(up, np.hypot(south, west))
