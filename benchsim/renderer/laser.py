"""The beam at one point of the mirror: direction of its ray and the density of its power.

Homocentric Gaussian beam: through the point ρ of the plane perpendicular to the axis at the reference point L runs a
ray along d + κ ρ, with density 2/(π w²) exp(−2 ρ²/w²); all rays pass through the virtual source L − d/κ, and κ ≤ 0 is
no special case. Where lenses make the beam, a `BeamTable` adds their aberration to the direction and their shape to the
density.

Astigmatism, coma and the field of angle add to the direction over the section (`Bent`): the ray is then found by
iteration, and the density follows from how the congruence of rays spreads, det(1 + ζ ∂direction/∂ρ).

The functions take NumPy arrays (float64) or Dr.Jit arrays (float32) alike. Vectors are tuples of three components, and
whatever is small is kept apart from what is not: a direction is handed over as its difference from the axis d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.fields import evaluate
from benchsim.bench.model import Exposure, Laser, Recording
from benchsim.bench.place import Placement, toward_source
from benchsim.renderer.beam_table import onto_disc, polynomial
from benchsim.renderer.effects import MRAD, PER_M, value
from benchsim.renderer.tables import Table, table

EFFECTS = {
    "beam-direction": ("saz", "sel"),
    "beam-offset": ("bu", "bv"),
    "wavefront-curvature": ("curv",),
    "astigmatism": ("astig0", "astig45"),
    "coma": ("coma_u", "coma_v"),
}
FIELDS = ("angle", "stage")

Vec = tuple[Any, ...]


def dot(a: Vec, b: Vec) -> Any:
    """Scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def perpendicular(d: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """u, v that make a right-handed frame with the unit vector d."""
    u = np.cross(np.eye(3)[np.argmin(np.abs(d))], d)
    u = u / np.linalg.norm(u)
    return u, np.cross(d, u)


def section_frame(axis: NDArray[np.float64], d: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """u, v of the beam's section: v the mirror's axis less its part along d, u = v × d; unit vectors.

    ``axis`` along d leaves them undefined; then any pair serves, since no light meets the mirror.
    """
    v = axis - (axis @ d) * d
    length = np.linalg.norm(v)
    if length < 1e-9:
        return perpendicular(d)
    v = v / length
    return np.cross(v, d), v


def disturbed(recording: Recording, exposure: Exposure, placement: Placement) -> tuple[Laser, Placement]:
    """Laser and placement with what is rigid: wrong dials, a beam beside its axis, more or less divergence.

    The beam turns about the point that it is aimed at and is not aimed anew.
    """
    effects, laser = recording.effects, recording.laser
    toward = -placement.laser_direction
    saz, sel = value(effects, "beam-direction", "saz", MRAD), value(effects, "beam-direction", "sel", MRAD)
    if "stage" in recording.fields:
        found = evaluate(recording.fields["stage"], exposure.laser_azimuth, exposure.laser_elevation)
        saz, sel = saz + float(found[0]), sel + float(found[1])
    if saz or sel:
        azimuth, elevation = np.arctan2(-toward[1], toward[0]), np.arcsin(toward[2])
        placement = replace(placement, laser_direction=-toward_source(azimuth + saz, elevation + sel))
    bu, bv = value(effects, "beam-offset", "bu"), value(effects, "beam-offset", "bv")
    if bu or bv:
        u, v = section_frame(placement.axis, placement.laser_direction)
        placement = replace(placement, laser_point=placement.laser_point + bu * u + bv * v)
    curvature = value(effects, "wavefront-curvature", "curv", PER_M)
    if curvature:
        laser = replace(laser, divergence=laser.divergence + curvature * laser.beam_diameter)
    return laser, placement


@dataclass(frozen=True)
class Bent:
    """Directions over the beam's section beyond the homocentric ones.

    ``u, v`` as triples; ``astigmatism`` (a0, a45) [1/mm], ``coma`` (along u, along v) [rad/mm²], ``angle`` the free
    field.
    """

    u: Vec
    v: Vec
    astigmatism: tuple[Any, Any]
    coma: tuple[Any, Any]
    angle: Table | None = None

    def slopes(self, a: Any, b: Any) -> tuple[Any, Any]:
        """What is added to the direction of the ray at (a, b) [mm] of the section, along u and v [rad]."""
        (a0, a45), (cu, cv) = self.astigmatism, self.coma
        su = a0 * a + a45 * b + cu * (3.0 * a * a + b * b) + 2.0 * cv * a * b
        sv = a45 * a - a0 * b + 2.0 * cu * a * b + cv * (a * a + 3.0 * b * b)
        if self.angle is not None:
            fu, fv = self.angle(a, b)
            su, sv = su + fu, sv + fv
        return su, sv

    def gradient(self, a: Any, b: Any) -> tuple[Any, Any, Any, Any]:
        """∂su/∂a, ∂su/∂b, ∂sv/∂a, ∂sv/∂b [1/mm], by differences over 0.1 mm."""
        e = 0.05
        right, left = self.slopes(a + e, b), self.slopes(a - e, b)
        up, down = self.slopes(a, b + e), self.slopes(a, b - e)
        return tuple((p[i] - q[i]) / (2 * e) for i in (0, 1) for p, q in ((right, left), (up, down)))  # type: ignore[return-value]


def bent(
    recording: Recording, axis: NDArray[np.float64], d: NDArray[np.float64], frame: NDArray[np.float64]
) -> Bent | None:
    """What bends the beam in a recording, in the frame whose axes are the rows of ``frame``; None if nothing."""
    effects = recording.effects
    astigmatism = value(effects, "astigmatism", "astig0", PER_M), value(effects, "astigmatism", "astig45", PER_M)
    coma = value(effects, "coma", "coma_u", MRAD), value(effects, "coma", "coma_v", MRAD)
    angle = table(recording.fields, "angle")
    if not any(astigmatism) and not any(coma) and angle is None:
        return None
    u, v = section_frame(axis, d)
    return Bent(tuple((frame @ u).tolist()), tuple((frame @ v).tolist()), astigmatism, coma, angle)


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
    bent: Bent | None = None

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
    if beam.bent is not None:
        return _bent_ray(beam, beam.bent, zeta, spread, rho, blur)
    return tuple(k * rho[i] + blur[i] for i in range(3)), rho, spread


def _bent_ray(beam: Beam, bent: Bent, zeta: Any, spread: Any, start: Vec, blur: list[Any]) -> tuple[Vec, Vec, Any]:
    """The ray of a bent beam; ``start`` is ρ of the ray that is not bent."""
    k, rho = beam.curvature, start
    for _ in range(4):
        # Each step shrinks the error by ζ ∂slope/∂ρ, a few per cent at most.
        su, sv = bent.slopes(dot(rho, bent.u), dot(rho, bent.v))
        extra = tuple(bent.u[i] * su + bent.v[i] * sv for i in range(3))
        rho = tuple(start[i] - zeta / spread * extra[i] for i in range(3))
    uu, uv, vu, vv = bent.gradient(dot(rho, bent.u), dot(rho, bent.v))
    area = (1.0 + zeta * (k + uu)) * (1.0 + zeta * (k + vv)) - zeta * zeta * uv * vu
    return tuple(k * rho[i] + blur[i] + extra[i] for i in range(3)), rho, abs(area) ** 0.5


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
