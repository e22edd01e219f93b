"""The exact conic: the cone of reflected rays and its section with the board.

Derivation. Where the mirror turns about its own centre (r = 0) and n is perpendicular to the axis a, Eq. (11) gives
R·a = I·a for every ε: the rays leave P on a cone about a whose half-angle is that between the axis and the
incident ray. A point X lies on the double cone when ((X − P)·a)² = (I·a)² |X − P|², that is

    (X − P)ᵀ M (X − P) = 0,   M = a aᵀ − (I·a)² 1,

and X = o + y e_y + z e_z on the board turns this into A y² + B y z + C z² + D y + E z + F = 0. The nappe with
sign((X − P)·a) = sign(I·a) carries the real rays, P + t R with t > 0; the other one the virtual rays.

Limits. With r > 0 the trace departs from a conic, on the bench by 1e-7 mm; the cone of r = 0, aimed by
Eq. (17), stands up to 0.1 mm from it. A heliostat that leans sideways turns about a line that n is not perpendicular
to: no cone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.bench import conic
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Mirror
from benchsim.bench.place import Placement, place
from benchsim.vector.curve import on_board

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cone:
    """Cone of reflected rays.

    Attributes
    ----------
    apex : (3,) [mm]
    axis : (3,)
        Unit, the axis of rotation.
    cosine : float
        R·axis = I·axis, signed: negative when the real rays run against the axis.
    """

    apex: Array
    axis: Array
    cosine: float

    @property
    def half_angle(self) -> float:
        """Angle between the axis' line and the rays, 0 to π/2 [rad]; π/2 is a plane."""
        return float(np.arccos(min(1.0, abs(self.cosine))))


def cone(apex: ArrayLike, axis: ArrayLike, normal: ArrayLike, travel: ArrayLike) -> Cone:
    """Cone of the rays that a mirror turning about its own centre reflects.

    Parameters
    ----------
    apex : (3,) array
        P [mm].
    axis, normal : (3,) array
        a and n(0), unit.
    travel : (3,) array
        I, unit direction of travel.

    Raises
    ------
    BenchsimError
        If the normal is not perpendicular to the axis (within 1e-9): the rays then lie on no cone.
    """
    a, n = np.asarray(axis, float), np.asarray(normal, float)
    if abs(a @ n) > 1e-9:
        raise BenchsimError(
            "the mirror's normal is not perpendicular to the axis it turns about, so the rays lie on no cone; "
            "use the trace itself"
        )
    return Cone(np.asarray(apex, float), a, float(a @ np.asarray(travel, float)))


def bench_cone(placement: Placement) -> Cone:
    """Cone of the bench's mirror with r = 0: apex at the placement's C, normal and axis as placed."""
    return cone(placement.centre, placement.axis, placement.normal, placement.laser_direction)


def section(cone: Cone, rotation: ArrayLike | None = None, origin: ArrayLike | None = None) -> Array:
    """Coefficients (6,) of the cone's section with the plane X = origin + rotation @ (0, y, z).

    Normalised (:func:`benchsim.bench.conic.normalise`), for :func:`benchsim.bench.conic.geometry`. Default: x = 0.
    """
    rows = np.eye(3) if rotation is None else np.asarray(rotation, float)
    o = np.zeros(3) if origin is None else np.asarray(origin, float)
    h = np.stack([rows[:, 1], rows[:, 2], o - cone.apex], axis=-1)
    # hᵀ (aaᵀ − c²1) h, multiplied out: a cone that is nearly a plane keeps its digits.
    along = cone.axis @ h
    return conic.normalise(conic.from_matrix(np.outer(along, along) - cone.cosine**2 * h.T @ h))


@dataclass(frozen=True)
class TraceConic:
    """The exact conic of one exposure and how its real branch bends. Board coordinates, mm.

    Attributes
    ----------
    cone : Cone
    coefficients : (6,)
    geometry : ConicGeometry
    point : (2,)
        Of the real branch at ε = 0, near the board's centre.
    curvature_centre : (2,)
        Of the osculating circle at ``point``.
    focus : (2,)
        The one on the concave side of the real branch. The paper says of Fig. 7(a) "its focus at the left".
    focus_side : str
        "+y" or "-y": where ``curvature_centre`` (and the focus beyond it) lies from ``point``. Seen from the mirror's
        side +y is to the right, from behind the screen to the left.
    """

    cone: Cone
    coefficients: Array
    geometry: conic.ConicGeometry
    point: Array
    curvature_centre: Array
    focus: Array
    focus_side: str


def trace_conic(mirror: Mirror, exposure: Exposure, placement: Placement | None = None) -> TraceConic:
    """Exact conic of an exposure's trace with r = 0, on the board.

    Parameters
    ----------
    mirror, exposure
        The stated setting.
    placement : Placement, optional
        With setting errors, or aimed at another r; its C is the apex. Default: aimed by Eq. (17) with r = 0.

    Raises
    ------
    BenchsimError
        If the ray at ε = 0 does not reach the board.
    """
    where = place(mirror, exposure, radius=0.0) if placement is None else placement
    rays = bench_cone(where)
    coefficients = section(rays, where.screen_rotation, where.screen_origin)
    geometry = conic.geometry(coefficients)
    point, real = on_board(where, 0.0, 0.0)
    if not real:
        raise BenchsimError(
            f"{exposure.name}: the aimed ray does not reach the board; mend mirror_position_mm or the laser's angles"
        )
    gradient = conic.gradient(coefficients, point)
    centre = point - gradient / np.linalg.norm(gradient) / conic.curvature(coefficients, point)
    nearest = int(np.nanargmin(np.linalg.norm(geometry.foci - point, axis=-1)))
    return TraceConic(
        rays, coefficients, geometry, point, centre, geometry.foci[nearest], "+y" if centre[0] > point[0] else "-y"
    )
