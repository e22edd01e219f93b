"""The cylinders of the vector model: how a misaligned mirror's centre and normal move, Carretero 2019, Eqs (7)-(10).

A geometric error ε turns the mirror about some line. Its centre P(ε) then runs along a circle and its plane
envelopes a cylinder about that line, so that the rays reflected at P(ε) with normal n(ε), over all ε, are those of a
cylindrical mirror. The paper's three sources differ in where the line lies:

==========================  =====================================  ==============================  =================
source                      the line passes through                its direction                   cylinder's radius
==========================  =====================================  ==============================  =================
encoder reference offset    C, the heliostat's centre of rotation  cylinder axis at C              r
mirror misalignment         P = C + r n, the mirror's own centre   cylinder axis at P              0
heliostat tilt              F, the pedestal's foot below C         horizontal: see below           r + h sin E
==========================  =====================================  ==============================  =================

The cylinder axis is z × n for "elevation" and n × (z × n) for "azimuth" (:func:`benchsim.bench.place.rotation_axis`).

*Heliostat tilt.* The paper names the source and no axis. A pedestal of height h that leans carries heliostat, axes and
mirror with it as one body, about its foot F = C − h z; it can lean about horizontal lines only, for a turn about the
vertical is an offset of the azimuth encoder. With E the elevation of n above the horizon:

- "elevation" is the lean in the vertical plane of n, about z × n, as the encoder's offset but about another point. n is
  not along P − F, so the radius of the envelope, r + h sin E, is not the distance of P from the line;
- "azimuth" is the lean sideways, about the horizontal part of n. To first order the normal turns as by an
  azimuth error −ε sin E about n × (z × n), for the rest, ε cos E about n itself, leaves n as it is: a mirror that looks
  at the horizon gets no such error. As n is not perpendicular to that line, the rays lie on no cone, the
  planes envelope a cone in place of a cylinder, and the trace is not a conic.

Lengths are in one unit throughout (mm in the bench). ε is right-handed about the axis as directed here: about
z × n, ε > 0 lowers n; about n × (z × n) it turns n from north toward west.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.place import Placement, rotation_axis

Array = NDArray[np.float64]

CYLINDERS = ("elevation", "azimuth")


@dataclass(frozen=True)
class Cylinder:
    """A mirror that turns about a line.

    Attributes
    ----------
    pivot : (3,) [mm]
        A point of the line.
    axis : (3,)
        The line's direction, unit.
    point : (3,) [mm]
        P(0), the mirror's centre where there is no error.
    normal : (3,)
        n(0), unit.
    """

    pivot: Array
    axis: Array
    point: Array
    normal: Array

    @property
    def radius(self) -> float:
        """Radius of the cylinder that the mirror's planes envelope, n · (P − pivot) [mm] (if n ⟂ axis)."""
        return float(self.normal @ (self.point - self.pivot))


def _turn(vectors: Array, axis: Array, phases: ArrayLike) -> Array:
    """Rodrigues: vectors (3,) turned by phases (...) about the unit axis, (..., 3)."""
    e = np.asarray(phases, float)[..., None]
    along = (axis @ vectors) * axis
    # cos ε − 1 as a half-angle sine: at ε = 0 and for small ε nothing is lost
    return vectors + np.sin(e) * np.cross(axis, vectors) - 2 * np.sin(e / 2) ** 2 * (vectors - along)


def positions(cylinder: Cylinder, phases: ArrayLike) -> tuple[Array, Array]:
    """P(ε) and n(ε) of a cylinder (Carretero 2019, Eqs (9), (10)).

    Parameters
    ----------
    cylinder : Cylinder
    phases : (...) array
        ε [rad].

    Returns
    -------
    points, normals : (..., 3) ndarray
    """
    points = cylinder.pivot + _turn(cylinder.point - cylinder.pivot, cylinder.axis, phases)
    return points, _turn(cylinder.normal, cylinder.axis, phases)


def encoder_offset(centre: ArrayLike, normal: ArrayLike, radius: float, stands_for: str) -> Cylinder:
    """Encoder reference offset: the mirror turns about C at the distance r (Carretero 2019, Fig. 1).

    Parameters
    ----------
    centre : (3,) array
        C [mm].
    normal : (3,) array
        n(0,0), unit.
    radius : float
        r [mm].
    stands_for : "elevation" or "azimuth"

    Raises
    ------
    BenchsimError
        If ``stands_for`` is neither, the radius is negative, or the normal is vertical.
    """
    c, n = np.asarray(centre, float), np.asarray(normal, float)
    _check(stands_for, radius, "r")
    return Cylinder(c, rotation_axis(n, stands_for), c + radius * n, n)


def mirror_misalignment(centre: ArrayLike, normal: ArrayLike, radius: float, stands_for: str) -> Cylinder:
    """Mirror misalignment: the mirror turns about its own centre P = C + r n, a cylinder of radius 0.

    Parameters and errors as of :func:`encoder_offset`. Its rays form an exact cone.
    """
    c, n = np.asarray(centre, float), np.asarray(normal, float)
    _check(stands_for, radius, "r")
    point = c + radius * n
    return Cylinder(point, rotation_axis(n, stands_for), point, n)


def heliostat_tilt(
    centre: ArrayLike, normal: ArrayLike, radius: float, stands_for: str, pedestal_height: float
) -> Cylinder:
    """Heliostat tilt: everything turns about a horizontal line through the pedestal's foot, C − h z.

    Parameters
    ----------
    centre, normal, radius
        As of :func:`encoder_offset`.
    stands_for : "elevation" or "azimuth"
        Lean in the vertical plane of n, about z × n, or sideways, about the horizontal part of n (the module's
        docstring says why).
    pedestal_height : float
        h, of C above the foot [mm].

    Raises
    ------
    BenchsimError
        As of :func:`encoder_offset`; also if the height is negative.
    """
    c, n = np.asarray(centre, float), np.asarray(normal, float)
    _check(stands_for, radius, "r")
    _check(stands_for, pedestal_height, "pedestal height")
    across = rotation_axis(n, "elevation")
    up = np.array([0.0, 0.0, 1.0])
    axis = across if stands_for == "elevation" else np.cross(across, up)
    return Cylinder(c - pedestal_height * up, axis, c + radius * n, n)


def bench_cylinder(placement: Placement, radius: float) -> Cylinder:
    """Cylinder of the bench's mirror as it is placed: about C at the distance r, axis and normal from the placement."""
    return Cylinder(placement.centre, placement.axis, placement.centre + radius * placement.normal, placement.normal)


def _check(stands_for: str, length: float, name: str) -> None:
    if stands_for not in CYLINDERS:
        raise BenchsimError(f"stands_for: {stands_for!r} is no cylinder of the model; use 'elevation' or 'azimuth'")
    if not (np.isfinite(length) and length >= 0):
        raise BenchsimError(f"{name}: {length!r} is no length; give a finite number that is not negative")
