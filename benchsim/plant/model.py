"""What a plant is: frozen data, east-north-up about its own origin, millimetres and radians.

A field is a struct of arrays, one entry for each heliostat, so that ten thousand are worked on at once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.bench.names import printable
from benchsim.fluxes.heliostat import Target, landing, unit
from benchsim.instruments.mount.records import toward
from benchsim.plant.station import DroneFlight, Prisms, Station
from benchsim.plant.sunshape import SunShape

Array = NDArray[np.float64]

ERRORS = {
    "az-el": ("IA", "IE", "CA", "AN", "AW", "NPAE", "TF"),
    "east-west": ("IA", "IE", "CA", "NPAE", "tilt_n", "tilt_u", "TF"),
}
"""Errors of a mount by its axes, as `benchsim.instruments.mount` names them [rad]."""

OUTLINE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of a mirror in multiples of width and height."""


@dataclass(frozen=True)
class Site:
    """Where a plant stands.

    Attributes
    ----------
    latitude, longitude : float
        [rad], north and east positive.
    elevation : float
        Above the sea [m].
    zone : ZoneInfo
        Of times that are stated without one, and of days.
    attenuation : {"clear", "none"}
        Of the air between mirror and receiver.
    """

    latitude: float
    longitude: float
    elevation: float
    zone: ZoneInfo
    attenuation: str = "clear"

    @property
    def place(self) -> Array:
        """(3,): latitude, longitude [deg], elevation [m], as `solar.almanac` takes it."""
        return np.array([math.degrees(self.latitude), math.degrees(self.longitude), self.elevation])


@dataclass(frozen=True)
class Mesh:
    """Points of a receiver at which flux is computed.

    Attributes
    ----------
    points, normals : (M, 3)
        [mm]; normals of length 1 on the lit side, (1, 3) where all are the same.
    weights : (M,)
        By which values are multiplied to sum to their integral [mm²].
    u, v : arrays
        Along the receiver and up, of the grid whose product the points are [mm].
    """

    points: Array
    normals: Array
    weights: Array
    u: Array
    v: Array

    @property
    def shape(self) -> tuple[int, int]:
        """(along, up)"""
        return len(self.u), len(self.v)


@dataclass(frozen=True)
class Receiver:
    """A receiver.

    Attributes
    ----------
    name : str
    kind : {"plane", "aperture", "cylinder"}
        An aperture is the plane opening of a cavity: what passes it counts as caught.
    centre : (3,) mm
    width, height : float
        Of a cylinder the width is its diameter [mm].
    azimuth, elevation : float
        Of the normal of a plane, from north through east and above the horizon [rad].
    peak_limit : float or None
        Above which flux should not be anywhere on it [W/m²].
    """

    name: str
    kind: str
    centre: tuple[float, float, float]
    width: float
    height: float
    azimuth: float = 0.0
    elevation: float = 0.0
    peak_limit: float | None = None

    @property
    def radius(self) -> float:
        """Of a cylinder [mm]."""
        return self.width / 2

    @property
    def target(self) -> Target:
        """The plane; of a cylinder none."""
        e, n, u = toward(np.array(self.azimuth), np.array(self.elevation))
        return Target(self.centre, self.width, self.height, (float(e), float(n), float(u)))

    @property
    def extent(self) -> tuple[float, float]:
        """Along, all around for a cylinder, and up [mm]."""
        return (math.pi * self.width if self.kind == "cylinder" else self.width), self.height

    def mesh(self, cell: float, fewest: int = 60, most: int = 300) -> Mesh:
        """Centres of equal cells, as near to ``cell`` [mm] as the bounds of their number along each side allow.

        The rule of integration is the midpoint's with its first edge correction: 13/12, 7/8 and 25/24 of a cell from
        each edge, of fourth order; around a cylinder all cells weigh the same, as a function of an angle has no edge.
        """
        wide, high = (int(np.clip(math.ceil(x / cell), fewest, most)) for x in self.extent)
        u, v = (((np.arange(k) + 0.5) / k - 0.5) * x for k, x in zip((wide, high), self.extent, strict=True))
        centre, round_it = np.array(self.centre), self.kind == "cylinder"
        if round_it:
            out = toward(u / self.radius, 0 * u)
            points = centre + self.radius * out[:, None] + v[None, :, None] * np.array([0.0, 0.0, 1.0])
            normals = np.repeat(out, high, axis=0)
        else:
            across, up = self.target.axes
            points = centre + u[:, None, None] * across + v[None, :, None] * up
            normals = np.array([self.target.normal])
        steps = [x / k for k, x in zip((wide, high), self.extent, strict=True)]
        along = np.ones(wide) if round_it else _rule(wide)
        return Mesh(points.reshape(-1, 3), normals, np.outer(along * steps[0], _rule(high) * steps[1]).ravel(), u, v)

    def aim(self, places: ArrayLike) -> Array:
        """Where heliostats at (n, 3) aim unless they say it: the centre, of a cylinder its surface before it."""
        p = np.asarray(places, float)
        centre = np.broadcast_to(np.array(self.centre), p.shape)
        if self.kind != "cylinder":
            return np.array(centre)
        return np.asarray(centre + self.radius * unit((p - centre) * [1.0, 1.0, 0.0]))

    def shifted(self, places: Array, shift: Array) -> Array:
        """Points (n, 3) moved along its surface by (n, 2) along and up [mm]."""
        if self.kind != "cylinder":
            return np.asarray(places + shift @ self.target.axes)
        (e, n, u), turn = (places - np.array(self.centre)).T, shift[:, 0] / self.radius
        east, north = e * np.cos(turn) + n * np.sin(turn), n * np.cos(turn) - e * np.sin(turn)
        return np.asarray(np.array(self.centre) + np.stack([east, north, u + shift[:, 1]], axis=1))

    def landing(self, places: ArrayLike, directions: ArrayLike) -> Array:
        """Where rays meet the plane, or the cylinder however high: along and up from the centre [mm], (n, 2)."""
        q, r = np.asarray(places, float) - np.array(self.centre), np.asarray(directions, float)
        if self.kind != "cylinder":
            return landing(q, r, Target((0.0, 0.0, 0.0), 1.0, 1.0, self.target.normal))
        a, b = (r[:, :2] ** 2).sum(axis=1), (q[:, :2] * r[:, :2]).sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            way = (-b - np.sqrt(b**2 - a * ((q[:, :2] ** 2).sum(axis=1) - self.radius**2))) / a
        at = q + np.where(way > 0, way, np.nan)[:, None] * r
        return np.stack([self.radius * np.arctan2(at[:, 0], at[:, 1]), at[:, 2]], axis=1)

    def faces(self, places: Array) -> Array:
        """How squarely it faces heliostats at (n, 3): the cosine to its normal, of a cylinder to the nearest one."""
        way = unit(places - np.array(self.centre))
        if self.kind == "cylinder":
            return np.asarray(np.hypot(way[:, 0], way[:, 1]))
        return np.asarray(way @ np.array(self.target.normal))


def _rule(cells: int) -> Array:
    out = np.ones(cells)
    for k, w in enumerate((13 / 12, 7 / 8, 25 / 24)):
        out[k] = out[-1 - k] = w
    return out


@dataclass(frozen=True)
class Optics:
    """Errors of the mirrors' optics.

    Attributes
    ----------
    slope : float
        Standard deviation of the surface's normal in one direction [rad].
    specularity : float
        Standard deviation of the reflected ray in one direction [rad].
    reflectance : float
        Of the clean mirror.
    soiling : float
        Part of it that dirt takes.
    """

    slope: float
    specularity: float = 0.0
    reflectance: float = 1.0
    soiling: float = 0.0


@dataclass(frozen=True)
class Field:
    """The heliostats, n of them.

    Attributes
    ----------
    ids : (n,) tuple of str
    position : (n, 3)
        Of the mirrors' centres [mm].
    width, height : (n,)
        Horizontal and upward edge [mm].
    facets : (n, 2) of int
        Across and up.
    focal, canting : (n,)
        Focal length of the facets, and distance at which their images are laid over one another [mm]; nan: the
        distance to the aim point.
    receiver : (n,) of int
        Index of the receiver that is aimed at.
    aim : (n, 3)
        [mm]
    kinematics : {"az-el", "east-west"}
    errors, sigmas : mapping of str to (n,)
        Errors of the mounts, and their 1 sigma, by the names of `ERRORS` [rad]; what is left out is 0.
    """

    ids: tuple[str, ...]
    position: Array
    width: Array
    height: Array
    facets: NDArray[np.int64]
    focal: Array
    canting: Array
    receiver: NDArray[np.int64]
    aim: Array
    kinematics: str = "az-el"
    errors: Mapping[str, Array] = field(default_factory=dict)
    sigmas: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def area(self) -> Array:
        """(n,) mm²"""
        return self.width * self.height

    @property
    def distance(self) -> Array:
        """From mirror to aim point, (n,) mm."""
        return np.asarray(np.linalg.norm(self.aim - self.position, axis=1))


@dataclass(frozen=True)
class Plant:
    """A plant as its file states it.

    Attributes
    ----------
    title : str
    path : Path
    files : tuple of Path
        All that was read.
    site : Site
    receivers : tuple of Receiver
    field : Field
    sun : SunShape
    optics : Optics
    diagnosed : tuple of mappings or None
        Errors and sigmas as `Field` has them, of a diagnosis; None where the file names none.
    remarks : tuple of str
        What the files leave open, one sentence each.
    station : Station or None
        Arrays of detectors.
    prisms : Prisms
        That they see.
    drone : DroneFlight
    """

    title: str
    path: Path
    files: tuple[Path, ...]
    site: Site
    receivers: tuple[Receiver, ...]
    field: Field
    sun: SunShape
    optics: Optics
    diagnosed: tuple[Mapping[str, Array], Mapping[str, Array]] | None = None
    remarks: tuple[str, ...] = ()
    station: Station | None = None
    prisms: Prisms = dataclasses.field(default_factory=Prisms)
    drone: DroneFlight = dataclasses.field(default_factory=DroneFlight)

    @property
    def name(self) -> str:
        """What a person calls it: its title, or its folder."""
        return self.title or printable(self.path.resolve().parent.name)

    @property
    def spread(self) -> Array:
        """Standard deviation in one direction of the light that a heliostat reflects, (n,) rad: sun and `blur`."""
        return np.hypot(self.sun.sigma, self.blur)

    @property
    def blur(self) -> Array:
        """The same of what is not the sun's, (n,) rad.

        A circular Gaussian by its variance: of twice the slopes, of the specularity, and of facets that are not
        focused, or not canted, at the distance to their aim point d: a facet's image is |1 − d/f| of the facet, the
        facets' images lie |1 − d/c| of the facets' centres apart; a strip of length l has l²/12, and both directions
        are averaged.
        """
        f, o = self.field, self.optics
        d = f.distance
        variance = np.full(len(f), (2 * o.slope) ** 2 + o.specularity**2)
        for edge, count in ((f.width, f.facets[:, 0]), (f.height, f.facets[:, 1])):
            facet, frame = (
                np.where(np.isnan(x), 0.0, 1 - d / np.where(np.isnan(x), 1.0, x)) for x in (f.focal, f.canting)
            )
            strip = (edge / d) ** 2 / 12
            variance += strip * (facet**2 / count**2 + frame**2 * (1 - 1 / count**2)) / 2
        return np.asarray(np.sqrt(variance))
