"""The beam at the mirror: directions of its rays and the power they carry.

Homocentric Gaussian beam: through the point (u, v) of the plane perpendicular to the axis at the reference point L runs
a ray along d + κ (u û + v v̂), with density 2/(π w²) exp(-2 (u² + v²)/w²). All rays pass through the virtual source
L − d/κ, so the ray through any point X runs along g = d + κ (X − L): no source point is needed, and κ → 0 (parallel)
and κ < 0 (converging) are no special cases.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Laser

Array = NDArray[np.float64]


def dot(a: Array, b: Array) -> Array:
    """Scalar product over the last axis."""
    return np.einsum("...i,...i->...", a, b)


def direction(curvature: float, point: Array, axis: Array, x: Array) -> Array:
    """Direction of travel of the beam's ray through x, not normalised: its component along the axis is 1 + κ ζ.

    Parameters
    ----------
    curvature : float
        κ of the wavefront at the reference plane [1/mm], > 0 diverging.
    point : (3,) array [mm]
        L, where the axis meets the reference plane.
    axis : (3,) array
        d, unit, of travel.
    x : (..., 3) array [mm]
        Points on this side of a converging beam's focus, where 1 + κ ζ > 0.

    Returns
    -------
    (..., 3) ndarray
    """
    return axis + curvature * (x - point)


def power_density(laser: Laser, point: Array, axis: Array, x: Array, normal: Array) -> Array:
    """Power per area that the beam lays on a surface, laser power 1.

    An element dA at x with unit normal n is cut by the rays of |n·g| / (g·d)³ dA of the reference plane, exactly.
    Not valid beyond the focus of a converging beam.

    Parameters
    ----------
    laser : Laser
    point, axis : (3,) array
        Reference point [mm] and unit direction of travel.
    x : (..., 3) array [mm]
    normal : (..., 3) array
        Unit normals of the surface; light that comes from behind counts as none.

    Returns
    -------
    (...) ndarray [1/mm²]
    """
    offset = x - point
    g = axis + laser.curvature * offset
    spread = dot(g, axis)
    along = dot(offset, axis)
    rho2 = (dot(offset, offset) - along**2) / spread**2
    w2 = laser.waist**2
    falling = np.maximum(-dot(g, normal), 0.0)
    return 2.0 / (np.pi * w2) * np.exp(-2.0 * rho2 / w2) * falling / spread**3


def blur_sigma(laser: Laser) -> float:
    """rms of the incoherent blur in one direction [rad]: a quarter of its full 1/e² angle."""
    return laser.incoherent_divergence / 4.0
