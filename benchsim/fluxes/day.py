"""Heliostats that drift through a day: where their images go, and the flux that they make together.

The deviated normal is that of the azimuth–elevation mount with its errors (`benchsim.instruments.mount`); each image is
Collado's flux about the place to which that normal sends the central ray (Lara-Cerecedo 2016, section 2.3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.fluxes.collado import flux
from benchsim.fluxes.heliostat import Heliostat, Target, ideal_normal, landing
from benchsim.instruments.mount.axes import pointing, reflected
from benchsim.instruments.mount.records import Mount, angles

Array = NDArray[np.float64]

ALTITUDE = 200.0
"""Of Hermosillo, for the clear sky [m]."""


@dataclass(frozen=True)
class Errors:
    """The paper's primary errors [rad].

    Attributes
    ----------
    azimuth, elevation : float
        Reference offsets: Δγ, and −Δβ (β is a zenith angle).
    canting : float
        ξ.
    tilt, toward : float
        ε, and κ: the azimuth axis' top leans toward azimuth κ, counted from *south*, west positive, as the paper does.
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    canting: float = 0.0
    tilt: float = 0.0
    toward: float = 0.0

    def inside(self) -> dict[str, Array]:
        """As the mount's parameters."""
        return {
            "IA": np.array([self.azimuth]),
            "IE": np.array([self.elevation]),
            "CA": np.array([self.canting]),
            "AN": np.array([self.tilt * math.cos(self.toward)]),
            "AW": np.array([self.tilt * math.sin(self.toward)]),
        }


@dataclass(frozen=True)
class Compensation:
    """A constant by which the control answers drift.

    Attributes
    ----------
    aim : (2,) mm
        Added to the aim point, along the target's width and up: the image's path is shifted on the target.
    offset : (2,) rad
        Added to azimuth and elevation: reference offsets go altogether.
    """

    aim: tuple[float, float] = (0.0, 0.0)
    offset: tuple[float, float] = (0.0, 0.0)


NOTHING = Compensation()


def deviated_normals(
    position: ArrayLike, target: Target, suns: ArrayLike, errors: Errors, compensation: Compensation = NOTHING
) -> Array:
    """Normals through a day of a mount with errors that is driven to the ideal ones, (T, 3) (Eqs (1), (5)-(7)).

    Parameters
    ----------
    position : (3,) mm
    target : Target
    suns : (T, 3) array
    errors : Errors
    compensation : Compensation
    """
    aim = np.array(target.centre) + np.array(compensation.aim) @ target.axes
    azimuth, elevation = angles(ideal_normal(position, aim, np.atleast_2d(np.asarray(suns, float))))
    reading = np.stack([azimuth, elevation], axis=-1) + np.array(compensation.offset)
    return pointing(Mount("az-el", "spot"), reading, errors.inside())[0]


def image_centres(
    position: ArrayLike, target: Target, suns: ArrayLike, errors: Errors, compensation: Compensation = NOTHING
) -> Array:
    """Where the central ray meets the target's plane through a day, (T, 2) mm from its centre."""
    normals = deviated_normals(position, target, suns, errors, compensation)
    return landing(position, reflected(normals, np.atleast_2d(np.asarray(suns, float))), target)


def aligned(position: ArrayLike, target: Target, sun: ArrayLike, errors: Errors, by: str = "aim") -> Compensation:
    """The constant that puts the image on the target's centre at one sun; what is aligned then drifts all the same.

    Parameters
    ----------
    sun : (3,) array
    by : {"aim", "offset"}
        Which of `Compensation`'s constants. The paper's is not described; it is said to centre the trajectories.
    """
    step = {"aim": 1.0, "offset": 1e-5}[by]
    constant = np.zeros(2)

    def of(c: Array) -> Compensation:
        pair = (float(c[0]), float(c[1]))
        return Compensation(aim=pair) if by == "aim" else Compensation(offset=pair)

    def miss(c: Array) -> Array:
        return image_centres(position, target, sun, errors, of(c))[0]

    for _ in range(6):
        here = miss(constant)
        slope = [(miss(constant + d) - here) / step for d in step * np.eye(2)]
        constant = constant - np.linalg.solve(np.transpose(slope), here)
    return of(constant)


@dataclass(frozen=True)
class Moment:
    """A flux map and what it comes to.

    Attributes
    ----------
    values : (cells, cells)
        [along the width, up], in the unit of the irradiance.
    target : Target
    """

    values: Array
    target: Target

    @property
    def peak(self) -> float:
        """The brightest cell's."""
        return float(self.values.max())

    @property
    def average(self) -> float:
        return float(self.values.mean())

    @property
    def unevenness(self) -> float:
        """Standard deviation over the target, as a fraction of the average: 0 is uniform."""
        return float(self.values.std() / self.values.mean())

    @property
    def centroid(self) -> Array:
        """Of the light on the target, (2,) mm."""
        x, z = self.target.grid(len(self.values))
        return np.array([self.values.sum(axis=1) @ x, self.values.sum(axis=0) @ z]) / self.values.sum()

    @property
    def brightest(self) -> Array:
        """Place of the peak, (2,) mm: of the paraboloid through the brightest cell and its eight neighbours."""
        n = len(self.values)
        i, j = (int(np.clip(k, 1, n - 2)) for k in np.unravel_index(int(np.argmax(self.values)), self.values.shape))
        u, v = (g.ravel() for g in np.meshgrid([-1.0, 0, 1], [-1.0, 0, 1], indexing="ij"))
        terms = np.stack([np.ones(9), u, v, u * u, u * v, v * v], axis=1)
        _, a, b, aa, ab, bb = np.linalg.lstsq(terms, self.values[i - 1 : i + 2, j - 1 : j + 2].ravel(), rcond=None)[0]
        bend = np.array([[2 * aa, ab], [ab, 2 * bb]])
        step = np.zeros(2)
        if np.linalg.eigvalsh(bend)[1] < 0:  # a top, not a slope at the edge
            step = np.clip(-np.linalg.solve(bend, [a, b]), -1, 1)
        x, z = self.target.grid(n)
        return np.array([x[i], z[j]]) + step * [x[1] - x[0], z[1] - z[0]]


def flux_at(
    heliostats: list[Heliostat],
    target: Target,
    sun: ArrayLike,
    normals: ArrayLike,
    irradiance: float = 1.0,
    cells: int = 81,
) -> Moment:
    """The sum of the heliostats' fluxes at one moment.

    Parameters
    ----------
    heliostats : list of Heliostat
    target : Target
    sun : (3,) array
    normals : (heliostats, 3) array
        Deviated or ideal.
    irradiance : float
        On a plane that faces the sun.
    cells : int
        Of the map, along width and height.
    """
    x, z = target.grid(cells)
    values = np.zeros((cells, cells))
    for h, n in zip(heliostats, np.asarray(normals, float), strict=True):
        values += flux(h, target, sun, n, x[:, None], z[None, :])
    return Moment(irradiance * values, target)


def clear_sky(sun: ArrayLike, altitude: float = ALTITUDE) -> Array:
    """Direct normal irradiance of a clear sky [W/m²], of suns (T, 3) at an altitude [m].

    Ineichen's simplified Solis model of pvlib with its own aerosol and water; the paper does not say which it uses.
    """
    from pvlib import atmosphere, clearsky

    elevation = np.degrees(np.arcsin(np.atleast_2d(np.asarray(sun, float))[:, 2]))
    sky = clearsky.simplified_solis(elevation, pressure=float(atmosphere.alt2pres(altitude)))
    return np.asarray(sky["dni"], float)
