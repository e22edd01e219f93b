"""Flux of one heliostat on a plane target by `benchsim.fluxes.product`, where the formula and its limits are stated."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.fluxes import product
from benchsim.fluxes.heliostat import Heliostat, Target
from benchsim.instruments.mount.axes import reflected

Array = NDArray[np.float64]


def flux(heliostat: Heliostat, target: Target, sun: ArrayLike, normal: ArrayLike, x: ArrayLike, z: ArrayLike) -> Array:
    """Flux on points of the target.

    Parameters
    ----------
    heliostat : Heliostat
    target : Target
    sun : (3,) array
        Unit vector toward the sun.
    normal : (3,) array
        Of the mirror's centre, deviated or ideal.
    x, z : arrays that broadcast
        Along the target's width and up, from its centre [mm].

    Returns
    -------
    array
        As a multiple of the irradiance on a plane that faces the sun. 0 where the target or the mirror is seen from
        behind.
    """
    s, n = np.asarray(sun, float), np.asarray(normal, float)
    x, z = np.broadcast_arrays(np.asarray(x, float), np.asarray(z, float))
    if n @ s <= 0 or reflected(n, s) @ np.array(target.normal) >= 0:
        return np.zeros(x.shape)
    across, up = target.axes
    points = np.array(target.centre) + x[..., None] * across + z[..., None] * up
    place = np.array([heliostat.position])
    beams = product.Beams(
        place, n[None], np.array([heliostat.width]), np.array([heliostat.height]), np.array([heliostat.total]),
        (np.array([target.centre]) - place) @ reflected(n, s), s,
    )  # fmt: skip
    found = product.flux(beams, points.reshape(-1, 3), np.array([target.normal]))
    return np.asarray(heliostat.reflectance * found.reshape(x.shape))
