"""A plant's heliostats as a drone looks at them: in clusters, each told to look at a point that the drone flies about.

Every cluster has a field frame of its own about its middle, x north, y west, z up, as `benchsim.drones` has it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.drones.estimate import sigma_sys
from benchsim.drones.flight import Errors, Flight, Heliostat, Sightings, camera_point, fly, pattern, read, seen, stand
from benchsim.drones.heliostat import Design, Mount, aimed, axes
from benchsim.instruments.mount.geodesy import enu, geodetic
from benchsim.plant.hiding import hidden
from benchsim.plant.model import Plant

Array = NDArray[np.float64]

ENU = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""From east, north, up to north, west, up; its transpose leads back."""

TRACKING = TILT = 2e-3
"""1 sigma by which heliostats may look beside, and by which pylons lean, where the plant states no errors of the mounts
[rad]."""

MARGIN = 4.0
"""Such sigmas by which the pattern is wider than a mirror."""

HESSIANS = np.array([[math.sqrt(2), 1.0, 0.0], [math.sqrt(2), -1.0, 0.0], [0.0, 0.0, 1.0]]) @ (
    np.random.default_rng(48).standard_normal((3, 2000))
)
"""Second derivatives xx, yy, xy of a Gaussian field whose slopes and length are 1, drawn: variances 3, 3 and 1, and
covariance 1 of xx and yy; the mean of a determinant is then known to 3 %."""

MOST_POINTS = 5000
"""Of a pattern."""


@dataclass(frozen=True, eq=False)
class Cluster:
    """Heliostats that are looked at together.

    Attributes
    ----------
    plant : Plant
    number : int
        From 1.
    who : (k,) ndarray of int
        Indices into the field.
    """

    plant: Plant
    number: int
    who: NDArray[np.int_]

    @cached_property
    def middle(self) -> Array:
        """(3,) east, north, up [mm]."""
        return np.asarray(self.plant.field.position[self.who].mean(axis=0))

    @cached_property
    def target(self) -> Array:
        """(3,) where all are told to look, in the cluster's frame [mm]."""
        d = self.plant.drone
        azimuth = math.atan2(self.middle[0], self.middle[1]) if d.azimuth is None else d.azimuth
        return camera_point(d.distance, azimuth, d.elevation)

    @cached_property
    def route(self) -> tuple[Array, Array]:
        """Points (frames, 3) in the cluster's frame [mm], and the pattern's axes (2, 3)."""
        f, d = self.plant.field, self.plant.drone
        beside = MARGIN * self.tracking * d.distance
        half = tuple(float(x[self.who].max()) / 2 + beside for x in (f.width, f.height))
        count = np.prod([2 * (h // d.pitch) + 1 for h in half])
        if count > MOST_POINTS:
            raise BenchsimError(
                f"{self.plant.path.name}: drone.pitch_m: {count:.0f} pictures of a cluster are more than "
                f"{MOST_POINTS}; make it larger"
            )
        return pattern(self.target, (half[0], half[1]), d.pitch)

    @property
    def tracking(self) -> float:
        """1 sigma by which they may look beside [rad]: rms of those stated of IA and IE, or `TRACKING` if none is."""
        return self._stated("IA", "IE", default=TRACKING)

    @property
    def tilt(self) -> float:
        """1 sigma of the pylons [rad]: the drone's, or rms of those stated of AN and AW, or `TILT` if none is."""
        own = self.plant.drone.tilt
        return self._stated("AN", "AW", default=TILT) if own is None else own

    def _stated(self, *names: str, default: float) -> float:
        s = self.plant.field.sigmas
        there = [s[k] for k in names if k in s]
        return float(np.sqrt(np.mean(np.square(there)))) if there else default

    @property
    def lamps(self) -> Array:
        """(3,) of the lamp from the camera [mm]: the pattern's horizontal axis runs to the camera's right."""
        return np.asarray(np.array(self.plant.drone.lamp) @ self.route[1])

    def place(self, k: int) -> Array:
        """(3,) of a heliostat's mirror in the cluster's frame [mm]."""
        return np.asarray(ENU @ (self.plant.field.position[k] - self.middle))

    def mount(self, k: int) -> Mount:
        """Of a heliostat, told to look at the target."""
        return aimed(self.design(k), self.place(k), self.target)

    def design(self, k: int) -> Design:
        """Of a heliostat as the plant has it."""
        f = self.plant.field
        columns, rows = (int(n) for n in f.facets[k])
        size = float(f.width[k]) / columns, float(f.height[k]) / rows
        x, y = ((np.arange(n) - (n - 1) / 2) * s for n, s in zip((columns, rows), size, strict=True))
        centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        far = float(f.distance[k])
        canting, focal = (far if np.isnan(v[k]) else float(v[k]) for v in (f.canting, f.focal))
        return Design(centres, size, 2 * canting, np.zeros(3), 1 / (2 * focal))

    def seen(self, k: int) -> NDArray[np.intp]:
        """Pictures in which a heliostat by design shows the lamp, in a facet of them."""
        design, (turned, origin) = self.design(k), axes(self.mount(k))
        q = (self.route[0] + self.lamps / 2 - origin) @ turned
        far = q[:, 2, None, None]
        # A point p of the mirror glints at q = p − D ∇z(p).
        middle = design.centres - far * design.cant
        half = np.abs(1 - far * design.curvature) * np.array(design.size) / 2
        return np.flatnonzero((np.abs(q[:, None, :2] - middle) <= half).all(axis=2).any(axis=1))

    def glints(self, k: int) -> float:
        """How many of a heliostat are expected: the mirror is mapped to the pattern with |det(1 − D Hessian)|.

        Its mean is over Hessians of slope errors (`Errors.slope_scale`), whose covariance is that of a Gaussian field.
        """
        design, (xx, yy, xy) = self.design(k), self._mapping(k)
        folds = float(np.mean(np.abs(xx * yy - xy * xy)))
        return float(len(design.centres) * np.prod(design.size) * folds / self.plant.drone.pitch**2)

    def _mapping(self, k: int) -> Array:
        """(3, draws): 1 − D Hessian of a heliostat, xx, yy and xy, with slope errors drawn."""
        away, o = self.distance(k), self.plant.optics
        flat = (1 - away * self.design(k).curvature) * np.array([[1.0], [1.0], [0.0]])
        return np.asarray(flat - away * o.slope / self.plant.drone.length * HESSIANS)

    def frames(self, k: int) -> float:
        """How many pictures are expected to show any: the mirror's image at the pattern, two sigma of slopes wider."""
        design, away, d = self.design(k), self.distance(k), self.plant.drone
        canted = np.ptp(design.centres, axis=0) * abs(1 - away / design.radius)
        image = canted + np.array(design.size) * abs(1 - away * design.curvature)
        return float(np.prod((image + 4 * away * self.slope(k)) / d.pitch))

    def slope(self, k: int) -> float:
        """1 sigma of a mirror's slope, facets' own included [rad]."""
        canting = self.plant.drone.canting if self.plant.field.facets[k].prod() > 1 else 0.0
        return math.hypot(self.plant.optics.slope, canting)

    def distance(self, k: int) -> float:
        """From a heliostat to the target [mm]."""
        return float(np.linalg.norm(self.target - self.place(k)))

    def sigma(self, k: int, measured: bool = False) -> tuple[float, float, float]:
        """σ_ad, σ_mean and σ_sys expected [rad]; glints of one picture count once, as they share what is wrong.

        With the surface by design, or ``measured``: slopes are then wrong by the map's errors, and by what a glint that
        is read beside its place is off on a wavy mirror, more often where that is steep.
        """
        d, away = self.plant.drone, self.distance(k)
        beside, slope = abs(1 / away - self.design(k).curvature), self.slope(k)
        if measured:
            xx, yy, xy = self._mapping(k)
            beside = math.sqrt(np.average(xx * xx + xy * xy, weights=np.abs(xx * yy - xy * xy))) / away
            slope = d.map_slope
        width = math.hypot(slope, d.detection * beside, d.relative / away)
        return (
            width,
            width / math.sqrt(max(min(self.glints(k), self.frames(k)), 1.0)),
            sigma_sys(away, (d.position, d.kinematics, d.absolute)),
        )

    def errors(self) -> Errors:
        """Of a virtual flight."""
        d = self.plant.drone
        return Errors(
            rtk_relative=d.relative, rtk_absolute=d.absolute, detection=d.detection, position=d.position,
            offset=d.kinematics, slope=self.plant.optics.slope, slope_scale=d.length, canting=d.canting,
            tracking=self.tracking, tilt=self.tilt, map_slope=d.map_slope, map_scale=d.map_length,
            false_glints=d.false_glints,
        )  # fmt: skip

    def fly(self, rng: np.random.Generator) -> Iterator[tuple[int, Flight, Heliostat, Sightings]]:
        """Fly it virtually: of each heliostat its index, the flight, the truth, and what is read of its glints."""
        errors = self.errors()
        flight = fly(self.target, self.route, errors, rng, self.lamps)
        for k in map(int, self.who):
            design = self.design(k)
            (h,) = stand([self.place(k)], design, self.target, errors, rng)
            yield k, flight, h, read(seen(h, flight), len(flight.cameras), design, errors, rng)

    def hidden(self) -> NDArray[np.bool_]:
        """Which of them stand behind another mirror, of the whole cluster, as the drone sees them."""
        f = self.plant.field
        places = np.array([self.place(k) for k in self.who])
        ways = self.target - places
        far = np.linalg.norm(ways, axis=1)
        return hidden(places, ways / far[:, None], f.width[self.who], f.height[self.who], ways, far)

    def geographic(self, points: Array) -> Array:
        """(n, 3) latitude, longitude [deg], height [m] of points in the cluster's frame, near the target."""
        origin = self.plant.site.place
        east = points @ ENU + self.middle
        about = geodetic(east.mean(axis=0), origin)
        step = np.array([1e-5, 1e-5, 1.0])
        slope = np.stack([(enu(about + d, origin) - enu(about - d, origin)) / 2 for d in np.diag(step)], axis=1)
        return np.asarray(about + step * np.linalg.solve(slope, (east - enu(about, origin)).T).T)

    def local(self, geographic: Array) -> Array:
        """(n, 3) in the cluster's frame [mm] of latitude, longitude [deg] and height [m]."""
        return np.array([ENU @ (enu(p, self.plant.site.place) - self.middle) for p in geographic])


def clusters(plant: Plant) -> list[Cluster]:
    """The field cut in halves, along its longer side, until no part has more heliostats than are looked at together."""
    done: list[NDArray[np.int_]] = []
    left = [np.arange(len(plant.field))]
    while left:
        who = left.pop()
        if len(who) <= plant.drone.at_once:
            done.append(who)
            continue
        at = plant.field.position[who, :2]
        order = who[np.argsort(at[:, int(np.argmax(np.ptp(at, axis=0)))], kind="stable")]
        half = len(order) // 2
        left += [order[half:], order[:half]]
    return [Cluster(plant, k, np.sort(who)) for k, who in enumerate(done, 1)]
