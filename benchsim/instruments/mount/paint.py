"""Calibration recordings of heliostats as the PAINT data base keeps them: JSON files in a folder.

``*-calibration-properties.json`` (one per recording: motor positions in steps, the sun's azimuth from south, west
negative, and elevation [deg], focal spots [latitude, longitude, height m]), ``heliostat-properties.json`` (position and
kinematics), and the tower file with the targets, looked for in the folder and then above it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.records import Actuator, Array, Mount, Records, Session, toward

CALIBRATION = "*-calibration-properties.json"
HELIOSTAT = "heliostat-properties.json"
TOWER = ("tower-measurements.json", "*tower*.json")

METHODS = ("UTIS", "HeliOS")
"""Of finding the focal spot, the preferred one first."""

_A, _F = 6378137.0, 1 / 298.257223563
"""WGS 84: semi-major axis [m] and flattening."""

FAR_M = 2000.0
"""Heliostat or spot further from the tower than this is a mistake of units or of place."""

OFF_TARGET_M = 15.0
"""A spot further from its target's centre than this cannot have been seen on it."""


def recognises(path: Path) -> bool:
    """Whether a folder holds calibration recordings."""
    return path.is_dir() and any(path.glob(CALIBRATION))


def read(folder: Path, tower: Path | None = None) -> Session:
    """Read a folder of calibration recordings.

    Parameters
    ----------
    folder : Path
    tower : Path, optional
        The tower file; default it is looked for in the folder, then in its parents.

    Returns
    -------
    Session
        Positions in mm, east-north-up about the plant's reference.

    Raises
    ------
    BenchsimError
        If a file or a key is missing or has no plausible value; the message names file and key.
    """
    tower = tower if tower is not None else find_tower(folder)
    plant = load(tower)
    origin = triple(tower, plant, "power_plant_properties.coordinates")
    heliostat = folder / HELIOSTAT
    properties = load(heliostat)
    position = enu(triple(heliostat, properties, "heliostat_position"), origin)
    if np.hypot(*position[:2]) > 1e3 * FAR_M:
        raise BenchsimError(
            f"{heliostat}: heliostat_position: {np.hypot(*position[:2]) / 1e6:.3g} km from the tower; write latitude "
            "and longitude in deg and the height in m, and name the right tower with --tower"
        )
    paths = sorted(folder.glob(CALIBRATION), key=_order)
    remarks: list[str] = []
    rows = [_recording(p, plant, tower, origin, remarks) for p in paths]
    rows = [r for r in rows if r is not None]
    mount = Mount(
        axes="east-west",
        observes="spot",
        position=position,
        joints=_joints(heliostat, properties),
        actuators=_actuators(heliostat, properties),
        latitude=math.radians(origin[0]),
    )
    if not rows:
        raise BenchsimError(f"{folder}: no recording has a focal spot; add measured ones")
    reading, source, spot, target, names = zip(*rows, strict=True)
    records = Records(names, np.array(reading), np.array(source), np.array(spot), target)
    _plausible(paths, records, mount)
    unsure = [m for m in remarks]
    return Session(folder.resolve().name, folder, (*paths, heliostat, tower), mount, records, tuple(unsure))


def find_tower(folder: Path) -> Path:
    """The tower file in a folder or the nearest of its parents."""
    start = folder.resolve()
    for place in (start, *start.parents[:4]):
        for pattern in TOWER:
            found = sorted(p for p in place.glob(pattern) if not p.name.endswith("calibration-properties.json"))
            if found:
                return found[0]
    raise BenchsimError(
        f"{folder}: no tower-measurements.json there or above it; name the file of the tower with --tower FILE"
    )


def enu(place: Array, origin: Array) -> Array:
    """East, north, up [mm] of (latitude deg, longitude deg, height m) about an origin of the same form, on WGS 84."""
    latitude, longitude = np.radians(origin[:2])
    apart = _earth_centred(place) - _earth_centred(origin)
    sa, ca, so, co = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    axes = np.array([[-so, co, 0.0], [-sa * co, -sa * so, ca], [ca * co, ca * so, sa]])
    return np.asarray(1e3 * axes @ apart)


def _earth_centred(place: Array) -> Array:
    latitude, longitude = np.radians(place[:2])
    squared = _F * (2 - _F)
    across = _A / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    return np.array(
        [
            (across + place[2]) * np.cos(latitude) * np.cos(longitude),
            (across + place[2]) * np.cos(latitude) * np.sin(longitude),
            (across * (1 - squared) + place[2]) * np.sin(latitude),
        ]
    )


def load(path: Path) -> Mapping[str, Any]:
    """A JSON object."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BenchsimError(f"{path}: cannot be read ({error.strerror}); put the file there") from None
    except ValueError as error:
        raise BenchsimError(f"{path}: is no JSON ({error}); mend the file") from None
    if not isinstance(value, dict):
        raise BenchsimError(f"{path}: is no JSON object; mend the file")
    return value


def value(path: Path, data: Mapping[str, Any], key: str) -> Any:
    """What stands under a dotted key."""
    at: Any = data
    for part in key.split("."):
        if not isinstance(at, Mapping) or part not in at:
            raise BenchsimError(f"{path}: {key}: is missing; add it")
        at = at[part]
    return at


def number(path: Path, data: Mapping[str, Any], key: str) -> float:
    """A finite number under a dotted key."""
    found = value(path, data, key)
    if isinstance(found, bool) or not isinstance(found, int | float) or not math.isfinite(found):
        raise BenchsimError(f"{path}: {key}: {found!r} is no finite number; mend it")
    return float(found)


def triple(path: Path, data: Mapping[str, Any], key: str) -> Array:
    """Latitude and longitude [deg] and height [m] under a dotted key."""
    found = value(path, data, key)
    good = isinstance(found, list) and len(found) == 3
    if not good or not all(isinstance(v, int | float) and math.isfinite(v) for v in found):
        raise BenchsimError(f"{path}: {key}: {found!r} is not [latitude deg, longitude deg, height m]; mend it")
    out = np.array(found, float)
    if abs(out[0]) > 90 or abs(out[1]) > 360 or not -500 < out[2] < 9000:
        raise BenchsimError(f"{path}: {key}: {found!r} is not [latitude deg, longitude deg, height m]; mend it")
    return out


def _order(path: Path) -> tuple[int, str]:
    """Recordings are numbered as they were taken."""
    head = path.name.split("-", 1)[0]
    return (int(head) if head.isdigit() else 1 << 60, path.name)


def _recording(
    path: Path, plant: Mapping[str, Any], tower: Path, origin: Array, remarks: list[str]
) -> tuple[Array, Array, Array, str, str] | None:
    data = load(path)
    steps = np.array([number(path, data, f"motor_position.axis_{k}_motor_position") for k in (1, 2)])
    azimuth, elevation = number(path, data, "sun_azimuth"), number(path, data, "sun_elevation")
    if not -2.0 <= elevation <= 90.0 or abs(azimuth) > 360.0:
        raise BenchsimError(
            f"{path}: sun_elevation, sun_azimuth: {elevation:g} and {azimuth:g} deg are no place of the sun; write "
            "degrees, azimuth from south with west negative"
        )
    name = path.name.split("-", 1)[0]
    target = str(value(path, data, "target_name"))
    if target not in plant:
        known = ", ".join(k for k in plant if k != "power_plant_properties")
        raise BenchsimError(f"{path}: target_name: {target!r} is not in {tower} ({known}); name the right tower file")
    spots = value(path, data, "focal_spot")
    if not isinstance(spots, Mapping):
        raise BenchsimError(f"{path}: focal_spot: {spots!r} holds no methods; write {METHODS[0]} = [lat, lon, height]")
    method = next((m for m in METHODS if spots.get(m) is not None), None)
    if method is None:
        remarks.append(f"{path.name}: neither {' nor '.join(METHODS)} found a focal spot; left out.")
        return None
    if method != METHODS[0]:
        remarks.append(f"{path.name}: no spot of {METHODS[0]}; that of {method} is used.")
    spot = enu(triple(path, data, f"focal_spot.{method}"), origin)
    centre = enu(triple(tower, plant, f"{target}.coordinates.center"), origin)
    off = float(np.linalg.norm(spot - centre)) / 1e3
    if off > OFF_TARGET_M:
        raise BenchsimError(
            f"{path}: focal_spot.{method}: {off:.3g} m from the centre of {target}, which is off the target; mend the "
            "spot, the target's name, or the tower file"
        )
    sun = toward(np.array(np.pi - math.radians(azimuth)), np.array(math.radians(elevation)))
    return steps, sun, spot, target, name


def _actuators(path: Path, data: Mapping[str, Any]) -> tuple[Actuator, ...]:
    listed = value(path, data, "kinematics_properties.actuators")
    if not isinstance(listed, list) or len(listed) != 2:
        raise BenchsimError(f"{path}: kinematics_properties.actuators: two are needed, one per axis; mend the list")
    out = []
    for k, one in enumerate(listed):
        key = f"kinematics_properties.actuators.{k + 1}"
        inner = {"actuator": one}

        def get(name: str, inner: dict[str, Any] = inner, key: str = key) -> float:
            try:
                return number(path, inner, f"actuator.{name}")
            except BenchsimError as error:
                raise BenchsimError(str(error).replace("actuator.", f"{key}.", 1)) from None

        kind = str(one.get("type_axis", "linear"))
        if kind != "linear":
            raise BenchsimError(f"{path}: {key}.type_axis: {kind!r} is not linear; only linear actuators are known")
        offset, radius, increment = get("offset"), get("pivot_radius"), get("increment")
        if not (0 < offset < 5 and 0 < radius < 5 and increment > 0):
            raise BenchsimError(
                f"{path}: {key}: offset {offset:g}, pivot_radius {radius:g} m and increment {increment:g} steps per "
                "m are no actuator of a heliostat; write metres"
            )
        first = -math.pi / 2 if k == 0 else 0.0
        out.append(
            Actuator(
                1e3 * get("initial_stroke_length"),
                1e3 * (offset + float(one.get("offset_shift", 0.0))),
                1e3 * (radius + float(one.get("radius_shift", 0.0))),
                increment / 1e3,
                get("initial_angle") + first,
                bool(one.get("clockwise_axis_movement", 0)),
            )
        )
    return tuple(out)


def _joints(path: Path, data: Mapping[str, Any]) -> Array:
    inner = value(path, data, "kinematics_properties")
    names = ("joint_translation_{}_1", "joint_translation_{}_2", "concentrator_translation_{}")
    return 1e3 * np.array([[float(inner.get(n.format(k), 0.0)) for k in "enu"] for n in names])


def _plausible(paths: list[Path], records: Records, mount: Mount) -> None:
    limits = [(0.0, 4.0 * a.increment * (a.offset + a.radius)) for a in mount.actuators]
    for path, name, steps in zip(paths, records.names, records.reading, strict=False):
        for k, (low, high) in enumerate(limits):
            if not low - 1 <= steps[k] <= high:
                raise BenchsimError(
                    f"{path if path.name.startswith(name) else name}: motor_position.axis_{k + 1}_motor_position: "
                    f"{steps[k]:g} steps is beyond the actuator; mend the recording"
                )
