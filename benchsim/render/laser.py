"""The beam at one point of the mirror: direction of its ray and the density of its power.

Homocentric Gaussian beam: through the point ρ of the plane perpendicular to the axis at the reference point L runs a
ray along d + κ ρ, with density 2/(π w²) exp(−2 ρ²/w²); all rays pass through the virtual source L − d/κ, and κ ≤ 0 is
no special case. Where lenses make the beam, a `BeamTable` adds their aberration to the direction and their shape to the
density.

The functions take NumPy arrays (float64) or Dr.Jit arrays (float32) alike. Vectors are tuples of three components, and
whatever is small is kept apart from what is not: a direction is handed over as its difference from the axis d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Laser
from benchsim.render.beam_table import onto_disc, polynomial

Vec = tuple[Any, ...]


def dot(a: Vec, b: Vec) -> Any:
    """Scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def perpendicular(d: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """u, v that make a right-handed frame with the unit vector d."""
    u = np.cross(np.eye(3)[np.argmin(np.abs(d))], d)
    u = u / np.linalg.norm(u)
    return u, np.cross(d, u)


@dataclass(frozen=True)
class Beam:
    """The beam in the frame of whoever holds it: ``direction`` d (unit), ``curvature`` κ [1/mm], ``waist`` w [mm].

    ``lenses``: empty, or what a `BeamTable` says: its axes x and y as triples, 1/(reach · w) [1/mm], and the
    coefficients slope_x, slope_y, log_ratio.
    """

    direction: Vec
    curvature: Any
    waist: Any
    lenses: tuple[Any, ...] = ()

    def section(self, rho: Vec) -> tuple[Any, Any]:
        """Coordinates (a, b) of the lenses' polynomials."""
        x, y, scale = self.lenses[:3]
        return onto_disc(dot(rho, x) * scale, dot(rho, y) * scale)

    def aberration(self, rho: Vec) -> Vec:
        """What the lenses add to the direction of the ray through ``rho``."""
        a, b = self.section(rho)
        x, y = self.lenses[:2]
        sx, sy = (polynomial(c, a, b) for c in self.lenses[3:5])
        return tuple(x[i] * sx + y[i] * sy for i in range(3))


def ray_through(beam: Beam, offset: Vec, jitter: tuple[Vec, Vec, Any, Any] | None = None) -> tuple[Vec, Vec, Any]:
    """The ray that meets a point.

    Parameters
    ----------
    beam : Beam
    offset : triple of arrays [mm]
        The point less L; on this side of a converging beam's focus.
    jitter : (u, v, a, b), optional
        Incoherent blur: the ray is turned by angles a, b [rad] along the unit vectors u, v ⟂ d.

    Returns
    -------
    kick : triple of arrays
        g − d, where g is the ray's direction, of component 1 along d.
    rho : triple of arrays [mm]
        Where the ray crosses the reference plane.
    spread : array
        1 + κ ζ, the scale of the beam at the point relative to the reference plane.
    """
    d, k = beam.direction, beam.curvature
    zeta = dot(offset, d)
    spread = 1.0 + k * zeta
    blur: list[Any] = [0.0, 0.0, 0.0]
    if jitter is not None:
        u, v, a, b = jitter
        blur = [u[i] * a + v[i] * b for i in range(3)]
    rho = tuple((offset[i] - zeta * d[i] - zeta * blur[i]) / spread for i in range(3))
    if beam.lenses:
        # Taken at the ideal ray's rho: over the millimetres of zeta at a facet a second step would add 1e-8 rad.
        extra = beam.aberration(rho)
        blur = [blur[i] + extra[i] for i in range(3)]
        rho = tuple(rho[i] - zeta / spread * extra[i] for i in range(3))
    return tuple(k * rho[i] + blur[i] for i in range(3)), rho, spread


def density(beam: Beam, rho: Vec, spread: Any, exp: Any) -> Any:
    """Power per area of a plane perpendicular to the axis, where the ray from ``rho`` meets it; laser power 1 [1/mm²].

    On a surface of unit normal n multiply by |n·g| (g of component 1 along d), which is exact for a homocentric beam.
    ``exp`` is numpy's or Dr.Jit's.
    """
    w2 = beam.waist * beam.waist
    exponent = -2.0 * dot(rho, rho) / w2
    if beam.lenses:
        exponent = exponent + polynomial(beam.lenses[5], *beam.section(rho))
    return 2.0 / (math.pi * w2) * exp(exponent) / (spread * spread)


def blur_sigma(laser: Laser) -> float:
    """rms of the incoherent blur in one direction [rad]: a quarter of the full 1/e² angle."""
    return laser.incoherent_divergence / 4
