"""A virtual flight: where the drone is and says it is, a cluster of heliostats, and what is read of their glints.

Every error source of HelioPoint's Table 1 is a number in `Errors`; at zero it is off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.drones.glints import Glints, glints
from benchsim.drones.heliostat import (
    Design,
    Index,
    Mount,
    Surface,
    SurfaceMap,
    aimed,
    axes,
    distorted,
    mean_normal,
    measured_map,
    random_surface,
)

Array = NDArray[np.float64]

LAMP_OFFSET = (0.0, -120.0)
"""The lamp beside the camera, along the pattern's two axes [mm]."""

WANDER = 80.0
"""How far wind leaves the drone from where it was sent, 1 sigma along each axis [mm]; RTK says so."""

FALSE_GLINTS = 0.01
"""Chance per frame and heliostat that something else is taken for a glint."""


@dataclass(frozen=True)
class Errors:
    """1 sigma of every error source; what the paper prints stands beside it.

    Attributes
    ----------
    rtk_relative : float
        Camera position of each image, per component [mm]: 10, Appendix A.
    rtk_absolute : float
        Camera position of a whole flight, per component [mm]: none assumed in the budget, 10 in Appendix A.
    detection : float
        Place of a glint in the mirror as read, per component [mm]: not printed; 20 is one pixel at 150 m.
    position : float
        Heliostat, per component [mm]: 10.
    offset : float
        Concentrator against its axes, fixed in the concentrator, per component [mm]: 30 for "shifts due to errors in
        K_helio".
    tilt : float
        Of the pylon, about north and about west [rad]: not printed.
    slope, slope_scale : float
        Zero-mean slope errors per component [rad], and their length [mm]: 0.8 mrad with canting; no length printed.
    canting : float
        Slope of a whole facet, per component [rad]: see ``slope``.
    map_slope, map_scale : float
        Errors of the measured surface [rad] and their length [mm]: "< 0.1 mrad"; no length printed.
    tracking : float
        What is to be found: orientation against the plant's own tracking angles [rad].
    false_glints : float
        Chance per frame and heliostat.
    """

    rtk_relative: float = 10.0
    rtk_absolute: float = 0.0
    detection: float = 20.0
    position: float = 10.0
    offset: float = 30.0
    tilt: float = 2e-3
    slope: float = 0.7e-3
    slope_scale: float = 250.0
    canting: float = 0.4e-3
    map_slope: float = 0.1e-3
    map_scale: float = 100.0
    tracking: float = 2e-3
    false_glints: float = FALSE_GLINTS

    @classmethod
    def none(cls, **only: float) -> Errors:
        """All errors off but ``only``; the tracking error, which is no error of the method, stays."""
        off = {k: 0.0 for k in cls.__dataclass_fields__ if k not in ("slope_scale", "map_scale", "tracking")}
        return cls(**(off | only))


@dataclass(frozen=True)
class Flight:
    """One pattern over one cluster.

    Attributes
    ----------
    target : (3,) ndarray
        The camera point that all heliostats of the cluster are told to look at, middle of the pattern [mm].
    cameras, lamps : (frames, 3) ndarray
        Where they are [mm].
    said_cameras, said_lamps : (frames, 3) ndarray
        Where RTK says they are [mm].
    """

    target: Array
    cameras: Array
    lamps: Array
    said_cameras: Array
    said_lamps: Array


@dataclass(frozen=True)
class Sightings:
    """Glints of one heliostat as read from the images.

    Attributes
    ----------
    frame : (n,) ndarray of int
    points : (n, 2) ndarray
        In the concentrator's frame, as the mirror's corners in the image define it [mm].
    """

    frame: Index
    points: Array


@dataclass(frozen=True)
class Heliostat:
    """One heliostat of a cluster: what the estimator is told, and the truth.

    Attributes
    ----------
    said : Mount
        The plant's position, kinematics and tracking angles.
    mount : Mount
        The true ones.
    surface : Surface
        The true mirror.
    measured : SurfaceMap
        A deflectometer's map of it, with the map's own errors.
    axis : (3,) ndarray
        The true optical axis in the field frame: the mean of all normals of the entire mirror surface.
    """

    said: Mount
    mount: Mount
    surface: Surface
    measured: SurfaceMap
    axis: Array


def camera_point(distance: float, azimuth: float, elevation: float) -> Array:
    """(3,) point at ``distance`` [mm] from the field's origin, toward azimuth (north to east) and elevation [rad]."""
    out = [
        math.cos(elevation) * math.cos(azimuth),
        -math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    return distance * np.array(out)


def pattern(target: ArrayLike, half: tuple[float, float], pitch: float) -> tuple[Array, Array]:
    """A raster in the plane through ``target`` that faces the field frame's origin, flown to and fro.

    Parameters
    ----------
    target : (3,) array
        [mm]
    half : tuple
        Half extents, horizontal and upward along the plane [mm].
    pitch : float
        [mm]

    Returns
    -------
    points : (frames, 3) ndarray
    plane : (2, 3) ndarray
        Its unit axes: horizontal, to the right as seen from the heliostats' back; upward.
    """
    target = np.asarray(target, float)
    toward = target / np.linalg.norm(target)
    across = np.cross([0.0, 0.0, 1.0], toward)
    if np.linalg.norm(across) < 1e-3:
        raise BenchsimError("the camera point stands over the cluster, where the pattern has no horizontal: move it")
    across /= np.linalg.norm(across)
    plane = np.stack([across, np.cross(toward, across)])
    nx, ny = (2 * int(h // pitch) + 1 for h in half)
    x, y = (pitch * (np.arange(n) - (n - 1) / 2) for n in (nx, ny))
    rows = [np.column_stack([x[:: 1 if j % 2 == 0 else -1], np.full(nx, v)]) for j, v in enumerate(y)]
    return target + np.concatenate(rows) @ plane, plane


def fly(
    target: Array,
    route: tuple[Array, Array],
    errors: Errors,
    rng: np.random.Generator,
    lamp: Array | None = None,
) -> Flight:
    """The drone along its route (from `pattern`): wind moves it, RTK measures where to; the camera's errors are the
    lamp's, for both hang on one drone whose attitude is taken as known. ``lamp`` is (3,) from the camera to it in the
    field frame [mm], default `LAMP_OFFSET` along the pattern's axes.
    """
    points, plane = route
    cameras = points + WANDER * rng.standard_normal(points.shape)
    wrong = errors.rtk_absolute * rng.standard_normal(3) + errors.rtk_relative * rng.standard_normal(points.shape)
    beside = np.array(LAMP_OFFSET) @ plane if lamp is None else lamp
    return Flight(target, cameras, cameras + beside, cameras + wrong, cameras + beside + wrong)


def stand(
    places: ArrayLike, design: Design, target: Array, errors: Errors, rng: np.random.Generator
) -> list[Heliostat]:
    """Heliostats at ``places`` (n, 3) [mm], told to look at ``target``, with all their errors drawn."""
    out = []
    for place in np.asarray(places, float):
        said = aimed(design, place, target)
        turn = errors.tracking * rng.standard_normal(2)
        mount = Mount(
            said.position + errors.position * rng.standard_normal(3),
            said.azimuth + turn[0] / math.cos(said.elevation),
            said.elevation + turn[1],
            said.offset + errors.offset * rng.standard_normal(3),
            errors.tilt * rng.standard_normal(2),
        )
        surface = random_surface(design, errors.slope, errors.slope_scale, errors.canting, rng)
        exact = measured_map(surface)
        measured = distorted(exact, errors.map_slope, errors.map_scale, rng)
        out.append(Heliostat(said, mount, surface, measured, axes(mount)[0] @ mean_normal(exact)))
    return out


def seen(heliostat: Heliostat, flight: Flight) -> Glints:
    """The glints that there are."""
    return glints(heliostat.surface, heliostat.mount, flight.cameras, flight.lamps)


def read(true: Glints, frames: int, design: Design, errors: Errors, rng: np.random.Generator) -> Sightings:
    """The glints as image processing would read them: misplaced, and with false ones among them.

    In place of pictures; `benchsim.drones.finding` reads them from rendered ones.
    """
    points = true.points + errors.detection * rng.standard_normal(true.points.shape)
    false = np.flatnonzero(rng.random(frames) < errors.false_glints)
    low, _, high, _ = design.outline
    points = np.concatenate([points, rng.uniform(low, high, (len(false), 2))])
    frame = np.concatenate([true.frame, false])
    order = np.argsort(frame, kind="stable")
    return Sightings(frame[order], points[order])
