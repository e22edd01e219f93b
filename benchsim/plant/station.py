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
    low, high : float
        Where it begins and ends: to the left, or up [mm].
    pitch : float
        Between detectors [mm].
    """

    name: str
    upright: bool
    offset: float
    low: float
    high: float
    pitch: float

    @property
    def count(self) -> int:
        """Of its detectors."""
        return int((self.high - self.low) / self.pitch + 1e-9) + 1


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
