"""What watches a plant's heliostats while they run: arrays of detectors beside a receiver, and the prisms they see."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DetectorArray:
    """A straight row of detectors on the upright plane through a receiver's centre.

    Attributes
    ----------
    name : str
    upright : bool
    offset : float
        Of a horizontal row up, of an upright one to the left of who looks at the receiver, from its centre [mm].
    low : float
        Where its first detector stands: to the left, or up [mm].
    count : int
        Of its detectors.
    pitch : float
        Between them [mm].
    """

    name: str
    upright: bool
    offset: float
    low: float
    count: int
    pitch: float

    @property
    def along(self) -> Array:
        """(count,): where its detectors stand, to the left, or up [mm]."""
        return np.asarray(self.low + self.pitch * np.arange(self.count), float)


@dataclass(frozen=True)
class Station:
    """All arrays of a plant.

    Attributes
    ----------
    receiver : int
        Index of the receiver beside which they stand.
    azimuth : float
        Where they look, from north through east [rad].
    arrays : tuple of DetectorArray
    remarks : tuple of str
    """

    receiver: int
    azimuth: float
    arrays: tuple[DetectorArray, ...]
    remarks: tuple[str, ...] = ()

    @property
    def frame(self) -> Array:
        """(3, 3): as rows, in east, north, up, where they look, to the right of who looks at them, up."""
        s, c = math.sin(self.azimuth), math.cos(self.azimuth)
        return np.array([[s, c, 0.0], [-c, s, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Prisms:
    """Turning prisms of the heliostats, and the converter that records the detectors: mm, rad, Hz, s, W/m².

    Attributes
    ----------
    radius, height : float
    facets : int
    reflectance, slope : float
        Of a facet.
    background : float
        Steady light on a detector.
    spread : float
        Relative rms of the detectors' responsivities, as calibrated. Photodiodes side by side under one lamp reach 0.5
        %; what the model itself leaves out is below 0.1 % of a line.
    low, high : float
        Band of the labels.
    mains : float or None
        Multiples of it are left out.
    sample_rate, record, longest : float
        Shortest and longest record.
    """

    radius: float = 150.0
    height: float = 150.0
    facets: int = 36
    reflectance: float = 0.9
    slope: float = 0.25e-3
    background: float = 100.0
    spread: float = 0.005
    low: float = 127.0
    high: float = 197.0
    mains: float | None = 50.0
    sample_rate: int = 500
    record: float = 20.0
    longest: float = 60.0


@dataclass(frozen=True)
class DroneFlight:
    """A drone with camera and lamp, and how it is flown: mm, rad, s.

    Attributes
    ----------
    distance : float
        From the middle of heliostats that are looked at together to where they are told to look.
    azimuth : float or None
        Toward there, from north through east; None: away from the plant's origin, where no tower stands between.
    elevation : float
    pitch : float
        Of the pattern that is flown about that point.
    each : float
        From one picture to the next.
    at_once : int
        Heliostats, at most.
    lamp : (right, up)
        Beside the camera, as seen along its axis.
    relative, absolute, detection, position, kinematics : float
        1 sigma per component, as `benchsim.drones.flight.Errors` has them.
    canting : float
        1 sigma of a facet.
    length : float
        Of slope errors.
    tilt : float or None
        1 sigma of a pylon, about north and about west; None: as the mounts' AN and AW are stated.
    map_slope, map_length : float
        1 sigma of a deflectometer's map of the mirror, per component, and the length of its errors.
    false_glints : float
        Chance per picture and heliostat that something else is taken for a glint.
    """

    distance: float = 150e3
    azimuth: float | None = None
    elevation: float = math.radians(35.0)
    pitch: float = 350.0
    each: float = 2.0
    at_once: int = 12
    lamp: tuple[float, float] = (0.0, -120.0)
    relative: float = 10.0
    absolute: float = 0.0
    detection: float = 20.0
    position: float = 10.0
    kinematics: float = 30.0
    canting: float = 0.4e-3
    length: float = 250.0
    tilt: float | None = None
    map_slope: float = 0.1e-3
    map_length: float = 100.0
    false_glints: float = 0.01
