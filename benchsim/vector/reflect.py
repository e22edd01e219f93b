"""Reflection and projection: Carretero 2019, Eqs (11) and (12), and the deviation curves built from them.

I is the direction in which light *travels*, −S with S the unit vector toward the source of Eq. (1). The paper prints
I = S below Eq. (10); with that the "ideal normal" of Eq. (16) is perpendicular to the right one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.vector.cylinder import Cylinder, positions

Array = NDArray[np.float64]


def reflect(travel: ArrayLike, normals: ArrayLike) -> Array:
    """R = I − 2 (I·n) n (Carretero 2019, Eq. (11)) for unit normals.

    Parameters
    ----------
    travel : (3,) array
        I, unit direction of travel.
    normals : (..., 3) array
        n, unit; either sign gives the same R.

    Returns
    -------
    (..., 3) ndarray
    """
    i, n = np.asarray(travel, float), np.asarray(normals, float)
    return i - 2 * (n @ i)[..., None] * n


def project(
    points: ArrayLike, directions: ArrayLike, rotation: ArrayLike | None = None, origin: ArrayLike | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Where rays, or their backward extensions, meet the target plane (Carretero 2019, Eq. (12)).

    Parameters
    ----------
    points : (..., 3) array
        P [mm].
    directions : (..., 3) array
        R.
    rotation : (3, 3) array, optional
        Of the plane: X = origin + rotation @ (0, y, z). Default: the plane x = 0 of the world.
    origin : (3,) array, optional
        [mm]

    Returns
    -------
    plane_points : (..., 2) ndarray
        Y, Z in the plane [mm]; nan or inf where the ray runs parallel to it.
    real : (...) ndarray of bool
        True where the reflected ray itself reaches the plane: the sign of x_P is opposite to that of R_x. False for
        virtual rays, whose line meets the plane behind the mirror.
    """
    p, r = np.asarray(points, float), np.asarray(directions, float)
    if origin is not None:
        p = p - np.asarray(origin, float)
    if rotation is not None:
        p, r = p @ np.asarray(rotation, float), r @ np.asarray(rotation, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        plane_points = p[..., 1:] - r[..., 1:] * (p[..., :1] / r[..., :1])
    return plane_points, p[..., 0] * r[..., 0] < 0


def deviation(cylinder: Cylinder, source: ArrayLike, phases: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Deviation of the beam's centre on the tower for misalignments ε (Carretero 2019, Eqs (9)–(12)).

    Parameters
    ----------
    cylinder : Cylinder
    source : (3,) array
        S, unit, toward the source.
    phases : (...) array
        ε [rad].

    Returns
    -------
    plane_points : (..., 2) ndarray
        Y, Z on the plane x = 0, in the cylinder's unit of length.
    real : (...) ndarray of bool
        True where light meets the mirror's front and its reflection reaches the plane.
    """
    travel = -np.asarray(source, float)
    points, normals = positions(cylinder, phases)
    plane_points, reaches = project(points, reflect(travel, normals))
    return plane_points, reaches & (normals @ travel < 0)
