"""The file of a heliostat's properties in the PAINT data base: its position and kinematics, read and written.

    heliostat_position                  latitude, longitude [deg], height [m] of where the axes meet
    initial_orientation                 the mirror's normal where all angles are 0, east-north-up
    kinematics_properties
        joint_translation_{e,n,u}_{1,2}, concentrator_translation_{e,n,u}       [m]
        first_joint_tilt_{n,u}, second_joint_tilt_{e,n}                         [rad]
        actuators                       of each: increment [steps per m], initial_stroke_length, offset, pivot_radius
                                        [m], initial_angle [rad], clockwise_axis_movement, min_increment, max_increment

The tilts are ARTIST's (artist-csp 2.0, ``artist.util.constants``), with its signs; the data base states none, and
ARTIST's own reader of these files takes them for 0. The first axis' angle is counted from the horizontal mirror.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.geodesy import enu, geodetic
from benchsim.instruments.mount.json_values import finite, load, number, number_in, short, triple, value
from benchsim.instruments.mount.records import Actuator, Array, Mount

CLOCKWISE = "clockwise_axis_movement"
JOINTS = ("joint_translation_{}_1", "joint_translation_{}_2", "concentrator_translation_{}")
ORIGIN = "power_plant_properties.coordinates"

TILTS = ("first_joint_tilt_n", "first_joint_tilt_u", "second_joint_tilt_e", "second_joint_tilt_n")

SIGNS = np.array([-1.0, 1.0, 1.0, -1.0])
"""Of the tilts: ARTIST's ``rotate_n`` turns east up, the other way round than a right-handed turn about north."""

FIRST_ANGLE = -math.pi / 2
"""The first axis' angle here where the file says 0."""

SLANTED_RAD = 0.5
"""No joint is tilted by more, nor does a mirror's normal at angles 0 lie further from south."""

LARGEST_M = 5.0
"""No length of a heliostat's kinematics is larger."""

FAR_M = 2000.0
"""Heliostat or spot further from the tower than this is a mistake of units or of place."""


def read(heliostat: Path, tower: Path) -> tuple[Mount, tuple[str, ...]]:
    """The mount that a heliostat's file states.

    Parameters
    ----------
    heliostat, tower : Path

    Returns
    -------
    Mount
        Positions in mm, east-north-up about the plant's reference.
    remarks : tuple of str
        What the file leaves open.

    Raises
    ------
    BenchsimError
        If a key is missing or has no plausible value; the message names file and key.
    """
    plant, properties = load(tower), load(heliostat)
    origin = triple(tower, plant, ORIGIN)
    position = enu(triple(heliostat, properties, "heliostat_position"), origin)
    if np.linalg.norm(position) > 1e3 * FAR_M:
        raise BenchsimError(
            f"{heliostat}: heliostat_position: {np.linalg.norm(position) / 1e6:.3g} km from the tower; write latitude "
            "and longitude in deg and the height in m, and name the right tower with --tower"
        )
    remarks: list[str] = []
    mount = Mount(
        axes="east-west",
        observes="spot",
        position=position,
        actuators=_actuators(heliostat, properties),
        joints=_joints(heliostat, properties, remarks),
        latitude=math.radians(origin[0]),
        tilts=_tilts(heliostat, properties),
        normal=_normal(heliostat, properties),
        targets=tuple(sorted(k for k in plant if k != ORIGIN.partition(".")[0])),
    )
    return mount, tuple(remarks)


def _actuators(path: Path, data: Mapping[str, Any]) -> tuple[Actuator, ...]:
    listed = value(path, data, "kinematics_properties.actuators")
    if not isinstance(listed, list) or len(listed) != 2:
        raise BenchsimError(f"{path}: kinematics_properties.actuators: two are needed, one per axis; mend the list")
    out = []
    for k, one in enumerate(listed):
        key = f"kinematics_properties.actuators.{k + 1}"
        if not isinstance(one, Mapping):
            raise BenchsimError(f"{path}: {key}: {short(one)} is no table of an actuator; mend the list")

        def get(name: str, default: float | None = None, one: Mapping[str, Any] = one, key: str = key) -> float:
            if default is not None and name not in one:
                return default
            return number_in(path, f"{key}.{name}", value(path, one, name))

        for name in ("increment", "offset", "pivot_radius", "initial_stroke_length", "initial_angle", CLOCKWISE):
            if name not in one:
                raise BenchsimError(f"{path}: {key}.{name}: is missing; add it")
        kind = str(one.get("type_axis", "linear"))
        if kind != "linear":
            raise BenchsimError(f"{path}: {key}.type_axis: {kind!r} is not linear; only linear actuators are known")
        offset = get("offset") + get("offset_shift", 0.0)
        radius = get("pivot_radius") + get("radius_shift", 0.0)
        increment, stroke, angle = get("increment"), get("initial_stroke_length"), get("initial_angle")
        lengths = 0 < offset < LARGEST_M and 0 < radius < LARGEST_M and 0 <= stroke < LARGEST_M
        if not lengths or increment <= 0:
            raise BenchsimError(
                f"{path}: {key}: offset {offset:g}, pivot_radius {radius:g}, initial_stroke_length {stroke:g} m and "
                f"increment {increment:g} steps per m are no actuator of a heliostat; write metres"
            )
        if abs(angle) > 2 * math.pi:
            raise BenchsimError(f"{path}: {key}.initial_angle: {angle:g} rad is more than a turn; write radians")
        clockwise = one[CLOCKWISE]
        if clockwise not in (0, 1):
            raise BenchsimError(f"{path}: {key}.{CLOCKWISE}: {short(clockwise)} is neither 0 nor 1; mend it")
        first = FIRST_ANGLE if k == 0 else 0.0
        turn, reach = bool(clockwise), (get("min_increment", -math.inf), get("max_increment", math.inf))
        out.append(Actuator(1e3 * stroke, 1e3 * offset, 1e3 * radius, increment / 1e3, angle + first, turn, reach))
    return tuple(out)


def _joints(path: Path, data: Mapping[str, Any], remarks: list[str]) -> Array:
    """The three translations [mm]; those that are absent are none, and said."""
    kinematics = value(path, data, "kinematics_properties")
    names = [n.format(k) for n in JOINTS for k in "enu"]
    absent = [n for n in names if n not in kinematics]
    if absent:
        remarks.append(f"{path.name} states no {', '.join(absent)}: taken as 0.")
    out = [0.0 if n in absent else number(path, data, f"kinematics_properties.{n}") for n in names]
    far = next((n for n, length in zip(names, out, strict=True) if abs(length) >= LARGEST_M), None)
    if far:
        raise BenchsimError(
            f"{path}: kinematics_properties.{far}: {out[names.index(far)]:g} m is no length of a heliostat; write "
            "metres"
        )
    return 1e3 * np.array(out).reshape(3, 3)


def _tilts(path: Path, data: Mapping[str, Any]) -> Array:
    """`Mount.tilts`; those that are absent are none."""
    found = value(path, data, "kinematics_properties")
    out = [number(path, data, f"kinematics_properties.{n}") if n in found else 0.0 for n in TILTS]
    large = next((n for n, tilt in zip(TILTS, out, strict=True) if abs(tilt) > SLANTED_RAD), None)
    if large:
        raise BenchsimError(
            f"{path}: kinematics_properties.{large}: {out[TILTS.index(large)]:g} rad is no tilt of a joint; "
            "write radians"
        )
    return SIGNS * out


def _normal(path: Path, data: Mapping[str, Any]) -> Array:
    """The mirror's normal where all angles are 0."""
    key, south = "initial_orientation", np.array([0.0, -1.0, 0.0])
    found = data.get(key, [0.0, -1.0, 0.0])
    if not isinstance(found, list) or len(found) != 3 or not all(finite(v) for v in found):
        raise BenchsimError(f"{path}: {key}: {short(found)} is not [east, north, up]; mend it")
    length = float(np.linalg.norm(found))
    if length == 0 or np.dot(found, south) < length * math.cos(SLANTED_RAD):
        raise BenchsimError(
            f"{path}: {key}: {short(found)}: the mirror's normal at angles 0 points south, near [0, -1, 0]; mend it"
        )
    return np.array(found, float) / length


def written(mount: Mount, origin: Array, properties: Mapping[str, Any]) -> dict[str, Any]:
    """A heliostat's properties with a mount's constants in them: `read` finds them again.

    Parameters
    ----------
    mount : Mount
    origin : (3,) array
        Of the plant: latitude, longitude [deg], height [m].
    properties : mapping
        All that is no constant of the mount is kept from there.
    """
    kinematics = dict(properties["kinematics_properties"])
    for row, name in zip(mount.joints / 1e3, JOINTS, strict=True):
        kinematics |= {name.format(k): float(v) for k, v in zip("enu", row, strict=True)}
    kinematics |= {n: float(v) for n, v in zip(TILTS, SIGNS * mount.tilts, strict=True)}
    kinematics["actuators"] = [
        {
            **one,
            "increment": 1e3 * a.increment,
            "initial_stroke_length": a.stroke / 1e3,
            "offset": a.offset / 1e3 - one.get("offset_shift", 0.0),
            "pivot_radius": a.radius / 1e3 - one.get("radius_shift", 0.0),
            "initial_angle": a.initial_angle - (FIRST_ANGLE if k == 0 else 0.0),
        }
        for k, (one, a) in enumerate(zip(kinematics["actuators"], mount.actuators, strict=True))
    ]
    return {
        **properties,
        "heliostat_position": [float(v) for v in geodetic(mount.position, origin)],
        "initial_orientation": [float(v) for v in mount.normal],
        "kinematics_properties": kinematics,
    }
