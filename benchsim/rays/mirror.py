"""The turning mirror: points and normals of a facet or of the cylinder, and reflection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.place import Placement
from benchsim.rays.laser import dot

Array = NDArray[np.float64]


def normal_at(placement: Placement, phase: Array) -> Array:
    """Outward normal of the reflecting facet, facet 0's at phase 0 turned about the axis.

    Parameters
    ----------
    placement : Placement
    phase : (...) array
        Right-handed turn of this facet's normal from ``placement.normal`` [rad]: the mirror's phase plus 2πk/facets.

    Returns
    -------
    (..., 3) ndarray
    """
    e = np.asarray(phase)[..., None]
    along = (placement.axis @ placement.normal) * placement.axis
    across = np.cross(placement.axis, placement.normal)
    return along + np.cos(e) * (placement.normal - along) + np.sin(e) * across


def facet_point(placement: Placement, radius: float, normal: Array, t: Array, h: Array) -> Array:
    """Point of a facet: C + r n + t (axis × n) + h axis.

    Parameters
    ----------
    placement : Placement
    radius : float
        r, the reflecting distance [mm].
    normal : (..., 3) array
    t, h : array, broadcast against ``normal[..., 0]``
        Position on the facet across the axis and along it, from its centre [mm].

    Returns
    -------
    (..., 3) ndarray [mm]
    """
    a = placement.axis
    t, h = np.asarray(t)[..., None], np.asarray(h)[..., None]
    return placement.centre + radius * normal + t * np.cross(a, normal) + h * a


def reflect(direction: Array, normal: Array) -> Array:
    """Mirror directions in planes of unit normal; lengths are kept."""
    return direction - 2.0 * dot(direction, normal)[..., None] * normal


def meet_facet_plane(placement: Placement, radius: float, normal: Array, point: Array, direction: Array) -> Array:
    """Where one ray meets the turning facet's plane n·(X − C) = r.

    Parameters
    ----------
    placement : Placement
    radius : float
        r [mm].
    normal : (..., 3) array
        The facet's normals.
    point, direction : (3,) array
        The ray.

    Returns
    -------
    (..., 3) ndarray [mm]
        Infinite or NaN where the ray runs along the plane.
    """
    s = (radius - dot(normal, point - placement.centre)) / dot(normal, direction)
    return point + s[..., None] * direction
