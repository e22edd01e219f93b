"""What a mount is and what was recorded with it: frozen data, east-north-up, millimetres and radians.

Two mounts. ``az-el``: a vertical first axis (azimuth, north through east) carries a horizontal one (elevation).
``east-west``: a horizontal first axis along east carries a second one perpendicular to it, both driven by linear
actuators (heliostats of the Jülich solar tower). Two ways of observing. ``spot``: a heliostat's focal spot on a target;
what is compared is the direction of the reflected beam. ``sky``: a telescope's pointing at a star.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNITS = {"rad": 1.0, "mrad": 1e-3, "arcsec": np.pi / 648000, "mm": 1.0, "s": 1.0, "1": 1.0, "record": 1.0}
"""Parameter unit → the unit used inside."""


@dataclass(frozen=True)
class Actuator:
    """A linear actuator that turns an axis.

    Attributes
    ----------
    stroke : float
        Length at step 0 [mm].
    offset, radius : float
        Sides of the triangle that the actuator closes: joint to axis, and lever [mm].
    increment : float
        Steps per mm.
    initial_angle : float
        Of the axis at step 0 [rad].
    clockwise : bool
        Whether growing length turns the axis the negative way.
    reach : (float, float)
        Least and most steps.
    """

    stroke: float
    offset: float
    radius: float
    increment: float
    initial_angle: float
    clockwise: bool
    reach: tuple[float, float] = (-np.inf, np.inf)


@dataclass(frozen=True)
class Mount:
    """The mount as its owner states it.

    Attributes
    ----------
    axes : {"az-el", "east-west"}
    observes : {"spot", "sky"}
    position : (3,) array
        Where the axes meet, in the frame of the spots [mm]; unused for the sky.
    joints : (3, 3) array
        First joint, second joint and mirror centre, each from the one before, as (east, north, up) where all angles
        are 0 [mm]. The mirror's normal points to −north there in an ``east-west`` mount and to north in an ``az-el``.
    actuators : tuple of Actuator
        Two, or none where angles are read directly.
    latitude : float or None
        [rad]; None: unknown, and clock errors are no candidates.
    zero : (2,) array
        Added to the readings: what the encoders are known to be off by, [rad].
    tilts : (4,) array
        Of an ``east-west`` mount [rad]: the first axis' frame is turned by R_north(tilts[0]) R_up(tilts[1]), the second
        one's, in the first one's, by R_east(tilts[2]) R_north(tilts[3]); right-handed.
    normal : (3,) array
        Of the mirror of an ``east-west`` mount where all angles are 0, unit vector.
    targets : tuple of str
        Names of all the targets of the plant: their order numbers ``target_e_1`` and its like, whichever of them some
        records are of. Empty: those of the records, in the order of the alphabet.
    """

    axes: str
    observes: str
    position: Array = field(default_factory=lambda: np.zeros(3))
    joints: Array = field(default_factory=lambda: np.zeros((3, 3)))
    actuators: tuple[Actuator, ...] = ()
    latitude: float | None = None
    zero: Array = field(default_factory=lambda: np.zeros(2))
    tilts: Array = field(default_factory=lambda: np.zeros(4))
    normal: Array = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))
    targets: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """Of angles in results: arcsec for a telescope, mrad for a heliostat."""
        return "arcsec" if self.observes == "sky" else "mrad"

    @property
    def of_normal(self) -> float:
        """Mrad of the normal, or of the tube, in one of `unit`: a beam turns by twice what its mirror does."""
        return UNITS["arcsec"] / UNITS["mrad"] if self.observes == "sky" else 0.5


@dataclass(frozen=True)
class Records:
    """What was recorded, in the order of time.

    Attributes
    ----------
    names : (n,) tuple of str
    reading : (n, 2) array
        Of the two axes: azimuth and elevation [rad], or steps of the actuators.
    source : (n, 3) array
        Unit vectors toward the sun, or toward the star that was pointed at.
    spot : (n, 3) array
        Focal spots [mm]; nan for the sky.
    target : (n,) tuple of str
        Names of the targets; empty for the sky.
    when : (n,) array, optional
        Seconds since 1970-01-01 UTC; nan where nobody states it.
    spot_sigma : float
        Error of a spot per component, as two ways of finding it differ [mm]; 0 where there is but one.
    centre : (n, 3) array, optional
        Of every record's target, as the plant states it [mm]; None where nobody does.
    travel : (n, 2) array, optional
        Sign of each axis' way to this record (`history.travel`); None where records have no order.
    warmth : (n,) array, optional
        How warm it was, by season or temperature (`history`); None where nobody states it.
    prompt : bool
        Whether most have stamps in UTC that agree with the recorded sun: the clock's zone is right.
    """

    names: tuple[str, ...]
    reading: Array
    source: Array
    spot: Array
    target: tuple[str, ...]
    when: Array | None = None
    spot_sigma: float = 0.0
    centre: Array | None = None
    travel: Array | None = None
    warmth: Array | None = None
    prompt: bool = False

    def date(self, k: int) -> str:
        """Day of a record in UTC, as 2022-06-12; empty where nobody states it."""
        if self.when is None or not np.isfinite(self.when[k]):
            return ""
        return datetime.fromtimestamp(float(self.when[k]), UTC).date().isoformat()

    def chosen(self, index: NDArray[np.intp] | list[int]) -> Records:
        """Some of the records."""
        i = np.asarray(index, np.intp)
        arrays = ("reading", "source", "spot", "when", "centre", "travel", "warmth")
        some = {name: held[i] for name in arrays if (held := getattr(self, name)) is not None}
        return replace(self, names=tuple(self.names[k] for k in i), target=tuple(self.target[k] for k in i), **some)


@dataclass(frozen=True)
class Function:
    """A law without a name (`functions`): knots (K, d), and by input, as a file names it, a value for each."""

    knots: Array
    values: Mapping[str, Array]


@dataclass(frozen=True)
class Learnt:
    """What a diagnosis learnt beside the effects, which predictions rest on.

    Attributes
    ----------
    sigma : (2,) array
        Errors of a record on a day that was not learnt, across and up [mrad of the normal]: its own, and its day's.
    parameters : tuple of str
        What was fitted: parameters of effects, and what may differ without being an effect.
    covariance : (k, k) array
        Of these, in the units of the catalogue.
    zeros : (2,) array or None
        A telescope's encoder zeros (IA, IE) [rad]; None for a heliostat.
    change : float
        By which the mount changes until a later record, rms in each component [mrad of the normal].
    """

    sigma: Array
    parameters: tuple[str, ...]
    covariance: Array
    zeros: Array | None = None
    change: float = 0.0


@dataclass(frozen=True)
class Session:
    """A mount with its records, as a reader gives them.

    Attributes
    ----------
    title : str
    path : Path
        What was named.
    files : tuple of Path
        All that was read.
    mount : Mount
    records : Records
    remarks : tuple of str
        What the files leave open, one sentence each.
    effects : mapping of str to mapping
        Stated errors by effect and parameter, in the units of the catalogue; they are part of the simulation.
    fields : mapping of str to Function
        Stated functions without a name, by their attachment's.
    learnt : Learnt or None
        None where the file says nothing of it.
    """

    title: str
    path: Path
    files: tuple[Path, ...]
    mount: Mount
    records: Records
    remarks: tuple[str, ...] = ()
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    fields: Mapping[str, Function] = field(default_factory=dict)
    learnt: Learnt | None = None


def added(
    stated: Mapping[str, Mapping[str, float]], more: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """Stated errors, by effect and parameter, with others added."""
    out = {name: dict(terms) for name, terms in stated.items()}
    for name, terms in more.items():
        own = out.setdefault(name, {})
        for term, value in terms.items():
            own[term] = own.get(term, 0.0) + value
    return out


def numbers(records: Records) -> Array | None:
    """The records' numbers, the first in each name ("star 7 (line 9)": 7), if all have one and they grow."""
    found = [re.search(r"\d+", n) for n in records.names]
    if not all(found):
        return None
    counted = np.array([float(m[0]) for m in found if m])
    return counted if (np.diff(counted) > 0).all() else None


def toward(azimuth: Array, elevation: Array) -> Array:
    """Unit vectors (..., 3) east-north-up of azimuths from north through east and elevations [rad]."""
    c = np.cos(elevation)
    return np.stack([np.sin(azimuth) * c, np.cos(azimuth) * c, np.sin(elevation) + 0 * azimuth], axis=-1)


def angles(direction: Array) -> tuple[Array, Array]:
    """Azimuth from north through east in [0, 2π) and elevation [rad] of vectors (..., 3)."""
    e, n, u = np.moveaxis(direction, -1, 0)
    return np.arctan2(e, n) % (2 * np.pi), np.arctan2(u, np.hypot(e, n))
