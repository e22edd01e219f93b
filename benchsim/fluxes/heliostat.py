"""Heliostat, target, and where light goes between them, for flux on a target.

Frame: x east, y north, z up [mm], origin at the tower's foot. The paper's target is vertical; any plane is allowed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Heliostat:
    """A rectangular heliostat whose facets are spheres, focused and canted at its own distance from the aim point.

    Attributes
    ----------
    position : (3,) mm
        Of the mirror's centre.
    width, height : float
        Horizontal and upward edge of the mirror [mm].
    sun : float
        Standard deviation of the sun's shape in one direction [rad].
    slope : float
        Standard deviation of the surface's normal in one direction [rad].
    reflectance : float
    facets : (int, int)
        Across and up; only the Monte Carlo tells them apart.
    """

    position: tuple[float, float, float]
    width: float
    height: float
    sun: float
    slope: float
    reflectance: float = 1.0
    facets: tuple[int, int] = (1, 1)

    def __post_init__(self) -> None:
        if not (self.width > 0 and self.height > 0):
            raise BenchsimError(f"heliostat: {self.width:g} × {self.height:g} mm is no mirror; give sizes above 0")
        if not (self.sun >= 0 and self.slope >= 0 and self.sun + self.slope > 0):
            raise BenchsimError("heliostat: sun and slope are standard deviations; give them in rad, one above 0")

    @property
    def total(self) -> float:
        """Of a reflected ray's direction, √(sun² + (2 slope)²) [rad]: Collado's circular effective sun."""
        return float(np.hypot(self.sun, 2 * self.slope))


@dataclass(frozen=True)
class Target:
    """A plane rectangle.

    Attributes
    ----------
    centre : (3,) mm
    width, height : float
        [mm]
    normal : (3,)
        Unit vector on the lit side; the height is along what is upward in the plane.
    """

    centre: tuple[float, float, float]
    width: float
    height: float
    normal: tuple[float, float, float] = (0.0, 1.0, 0.0)

    @property
    def axes(self) -> Array:
        """(2, 3): along the width, to the left of who looks at the target (east, if it faces north), and up."""
        n = np.array(self.normal, float)
        across = np.cross(n, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        return np.array([across, np.cross(across, n)])

    def grid(self, cells: int) -> tuple[Array, Array]:
        """Centres of ``cells`` × ``cells`` equal cells along width and height, from the centre [mm]."""
        steps = (np.arange(cells) + 0.5) / cells - 0.5
        return steps * self.width, steps * self.height


def unit(v: ArrayLike) -> Array:
    """(..., 3) to length 1."""
    v = np.asarray(v, float)
    with np.errstate(invalid="ignore"):
        return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def ideal_normal(position: ArrayLike, aim: ArrayLike, sun: ArrayLike) -> Array:
    """The bisector of the directions to sun and aim point (Lara-Cerecedo 2016, Eq. (1)), (..., 3)."""
    return unit(unit(np.asarray(aim, float) - np.asarray(position, float)) + np.asarray(sun, float))


def landing(position: ArrayLike, direction: ArrayLike, target: Target) -> Array:
    """Where a ray meets the target's plane, (along its width, up) from its centre [mm], (..., 2); nan: it does not."""
    p, r = np.asarray(position, float), np.asarray(direction, float)
    n, c = np.array(target.normal), np.array(target.centre)
    toward = r @ n
    way = np.where(toward < 0, (c - p) @ n / np.where(toward < 0, toward, 1.0), np.nan)
    return np.asarray((p + way[..., None] * r - c) @ target.axes.T)


def mirror_axes(normal: ArrayLike) -> Array:
    """(2, 3): horizontal and upward edge of a mirror on an azimuth–elevation mount."""
    n = np.asarray(normal, float)
    across = unit(np.cross([0.0, 0.0, 1.0], n))
    return np.array([across, np.cross(n, across)])
