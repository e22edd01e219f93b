"""The heliostat under the drone: its drawings, its stance, and the shape of its mirror.

Frames, all right-handed, in mm. Field: x north, y west, z up. Concentrator: origin in the middle of the mirror, z its
optical axis by design, x horizontal and to the right as seen from the mirror's front, y upward along the mirror.
A mirror is a height field z(x, y) over the four facets' rectangles; a facet's canting is a slope of that field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]
Index = NDArray[np.intp]

WAVES = 32
"""Plane waves per facet in a random surface: their sum is close to Gaussian."""

MAP_PITCH = 25.0
"""Of a measured surface's cells [mm]."""


@dataclass(frozen=True)
class Design:
    """A heliostat as its drawings have it.

    Attributes
    ----------
    centres : (facets, 2) ndarray
        Facets' middles in the concentrator's frame [mm].
    size : tuple
        Of a facet along x and y [mm].
    radius : float
        Of the sphere that the facets are canted onto [mm]: twice the focal length.
    offset : (3,) ndarray
        From the crossing of the two axes to the concentrator's origin, in its own frame [mm].
    curvature : float
        Of a facet itself [1/mm]; 0: flat.
    """

    centres: Array
    size: tuple[float, float]
    radius: float
    offset: Array
    curvature: float = 0.0

    @property
    def cant(self) -> Array:
        """(facets, 2) slopes ∂z/∂x, ∂z/∂y of the canted facets."""
        return self.centres / self.radius

    @property
    def outline(self) -> Array:
        """(4, 2) corners of the whole mirror [mm]: lower left, lower right, upper right, upper left."""
        low = self.centres.min(axis=0) - np.array(self.size) / 2
        high = self.centres.max(axis=0) + np.array(self.size) / 2
        return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])


def four_facets(focal: float = 200e3) -> Design:
    """3.22 m × 2.56 m in four flat facets with 20 mm between them, the size of the heliostats in Jülich."""
    centres = np.array([(x, y) for y in (-645.0, 645.0) for x in (-810.0, 810.0)])
    return Design(centres, (1600.0, 1270.0), 2 * focal, np.array([0.0, 0.0, 200.0]))


@dataclass(frozen=True)
class Mount:
    """Where a heliostat stands and looks: azimuth-elevation, elevation axis horizontal but for the tilt.

    Attributes
    ----------
    position : (3,) ndarray
        Crossing of the two axes, field frame [mm].
    azimuth, elevation : float
        Tracking angles [rad]: from north toward east; above the horizon.
    offset : (3,) ndarray
        As in `Design` [mm].
    tilt : (2,) ndarray
        Small turns of the pylon about field x and y [rad].
    """

    position: Array
    azimuth: float
    elevation: float
    offset: Array
    tilt: Array


def axes(mount: Mount) -> tuple[Array, Array]:
    """Concentrator's axes as columns (3, 3), and its origin (3,) [mm], in the field frame."""
    ca, sa, ce, se = (f(a) for a in (mount.azimuth, mount.elevation) for f in (math.cos, math.sin))
    turned = np.array([[sa, -se * ca, ce * ca], [ca, se * sa, -ce * sa], [0.0, ce, se]])
    turned = Rotation.from_rotvec([*mount.tilt, 0.0]).as_matrix() @ turned
    return turned, mount.position + turned @ mount.offset


def aimed(design: Design, position: ArrayLike, target: ArrayLike) -> Mount:
    """The upright mount whose optical axis passes through ``target``; for a mirror whose offset lies along that axis.

    Raises
    ------
    BenchsimError
        If the axis is within 1° of the zenith, where azimuth is undefined.
    """
    position = np.asarray(position, float)
    x, y, z = np.asarray(target, float) - position
    elevation = math.atan2(z, math.hypot(x, y))
    if elevation > math.radians(89):
        raise BenchsimError(
            f"the heliostat at {position / 1e3} m looks to the zenith, where azimuth is undefined: "
            "move the camera point"
        )
    return Mount(position, math.atan2(-y, x), elevation, design.offset, np.zeros(2))


@dataclass(frozen=True)
class Surface:
    """A real mirror: facets' slopes, and a random wavy height field on each.

    Attributes
    ----------
    design : Design
    cant : (facets, 2) ndarray
        Slopes of the facets, canting errors included.
    wave : (facets, waves, 2) ndarray
        Wave vectors [rad/mm].
    phase : (facets, waves) ndarray
        [rad]
    amplitude : float
        Of every wave's height [mm].
    """

    design: Design
    cant: Array
    wave: Array
    phase: Array
    amplitude: float


def random_surface(design: Design, slope: float, scale: float, canting: float, rng: np.random.Generator) -> Surface:
    """A mirror with Gaussian slope errors of covariance height ∝ exp(−r²/2L²), and with canting errors.

    Parameters
    ----------
    design : Design
    slope, canting : float
        1 sigma of either component of the waves' slope, and of a facet's own [rad].
    scale : float
        L [mm].
    rng : Generator
    """
    facets = len(design.centres)
    wave = rng.normal(0, 1 / scale, (facets, WAVES, 2))
    phase = rng.uniform(0, 2 * math.pi, (facets, WAVES))
    cant = design.cant + canting * rng.standard_normal((facets, 2))
    return Surface(design, cant, wave, phase, slope * scale * math.sqrt(2 / WAVES))


def shape(surface: Surface, facet: Index, points: Array) -> tuple[Array, Array]:
    """Height [mm] and slopes of the mirror.

    Parameters
    ----------
    surface : Surface
    facet : (n,) array of int
    points : (n, 2) array
        x, y in the concentrator's frame [mm]; a facet's field goes on beyond its edges.

    Returns
    -------
    height : (n,) ndarray
    slopes : (n, 2) ndarray
    """
    own, k = points - surface.design.centres[facet], surface.wave[facet]
    angle = _angle(surface, facet, own)
    bent = surface.design.curvature
    height = (surface.cant[facet] * own).sum(axis=1) + surface.amplitude * np.cos(angle).sum(axis=1)
    height += 0.5 * bent * (own**2).sum(axis=1)
    slopes = surface.cant[facet] + bent * own - surface.amplitude * (np.sin(angle)[:, None] @ k)[:, 0]
    return height, slopes


def bend(surface: Surface, facet: Index, points: Array) -> Array:
    """(n, 2, 2) second derivatives of the height [1/mm]; arguments as for `shape`."""
    k = surface.wave[facet]
    angle = _angle(surface, facet, points - surface.design.centres[facet])
    waves = -surface.amplitude * np.swapaxes(np.cos(angle)[..., None] * k, 1, 2) @ k
    return np.asarray(waves + surface.design.curvature * np.eye(2))


def _angle(surface: Surface, facet: Index, own: Array) -> Array:
    return np.asarray((surface.wave[facet] @ own[..., None])[..., 0] + surface.phase[facet])


def normals(slopes: Array) -> Array:
    """(n, 3) unit normals of a height field of slopes (n, 2)."""
    up = np.concatenate([-slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)
    return up / np.linalg.norm(up, axis=-1, keepdims=True)


@dataclass(frozen=True)
class SurfaceMap:
    """The reference surface that the estimator is given: slopes on a grid over each facet.

    Attributes
    ----------
    design : Design
    slopes : (facets, rows, columns, 2) ndarray
        At the middles of equal cells that tile the facet; rows along y, columns along x.
    """

    design: Design
    slopes: Array


def cells(design: Design, pitch: float) -> Array:
    """(facets, rows, columns, 2) middles of equal cells of about ``pitch`` [mm] that tile every facet."""
    nx, ny = (max(1, round(s / pitch)) for s in design.size)
    x = ((np.arange(nx) + 0.5) / nx - 0.5) * design.size[0]
    y = ((np.arange(ny) + 0.5) / ny - 0.5) * design.size[1]
    return design.centres[:, None, None, :] + np.stack(np.meshgrid(x, y), axis=-1)


def design_map(design: Design) -> SurfaceMap:
    """The reference surface by design."""
    if not design.curvature:
        return SurfaceMap(design, design.cant[:, None, None, :])
    own = cells(design, MAP_PITCH) - design.centres[:, None, None, :]
    return SurfaceMap(design, design.cant[:, None, None, :] + design.curvature * own)


def measured_map(surface: Surface) -> SurfaceMap:
    """The surface as a deflectometer without error has it, in cells of `MAP_PITCH`; `distorted` adds errors."""
    points = cells(surface.design, MAP_PITCH)
    facet = np.repeat(np.arange(len(points)), points[0, ..., 0].size)
    slopes = shape(surface, facet, points.reshape(-1, 2))[1]
    return SurfaceMap(surface.design, slopes.reshape(points.shape))


def distorted(reference: SurfaceMap, slope: float, scale: float, rng: np.random.Generator) -> SurfaceMap:
    """A measured map with a deflectometer's own errors: wavy, 1 sigma ``slope`` per component [rad], ``scale`` [mm]."""
    design = reference.design
    errors = random_surface(replace(design, radius=math.inf, curvature=0.0), slope, scale, 0.0, rng)
    return SurfaceMap(design, reference.slopes + measured_map(errors).slopes)


def mapped_slopes(reference: SurfaceMap, points: Array) -> tuple[Index, Array]:
    """Facet (n,) nearest to each point, and the map's slopes (n, 2) there, between cells by cubic splines.

    A point off the mirror takes the nearest facet's edge: a reading error may put a glint there.
    """
    design, table = reference.design, reference.slopes
    away = np.abs(points[:, None] - design.centres) / np.array(design.size)
    facet = away.max(axis=-1).argmin(axis=1)
    rows, columns = table.shape[1:3]
    own = (points - design.centres[facet]) / np.array(design.size) + 0.5
    where = np.clip(own[:, ::-1] * [rows, columns] - 0.5, 0, [rows - 1, columns - 1])
    out = np.empty((len(points), 2))
    for f in range(len(design.centres)):
        chosen = facet == f
        for axis in range(2):
            out[chosen, axis] = map_coordinates(table[f, ..., axis], where[chosen].T, order=3, mode="nearest")
    return facet, out


def mean_normal(reference: SurfaceMap) -> Array:
    """(3,) the optical axis in the concentrator's frame: mean of all normals of the entire mirror surface."""
    mean = normals(reference.slopes).mean(axis=(0, 1, 2))
    return mean / np.linalg.norm(mean)
