"""Calibration recordings of heliostats as the PAINT data base keeps them: JSON files in a folder.

``NUMBER-calibration-properties.json`` (one per recording: motor positions in steps, the sun's azimuth from south, west
negative, and elevation [deg], focal spots [latitude, longitude, height m]), ``heliostat-properties.json`` (position and
kinematics; its name may begin with the heliostat's), and the tower file with the targets, looked for in the folder and
then above it. The older spelling is read, too: ``NUMBER_calibration_properties.json`` and ``ID_properties.json``.
Recordings may lie in the folder or in its ``Calibration``; the heliostat's file in the folder, in ``Properties`` beside
or inside it, or, for a folder of recordings, above it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import solar, stamps
from benchsim.instruments.mount.json_values import load, number, number_in, short, triple, value
from benchsim.instruments.mount.records import Actuator, Array, Mount, Records, Session

CALIBRATION = ("*-calibration-properties.json", "*_calibration_properties.json")
HELIOSTAT = ("*heliostat-properties.json", "*_properties.json")
"""Names of the files in today's and in the older spelling."""

RECORDINGS, PROPERTIES = ("Calibration", "calibration"), ("Properties", "properties")
"""Folders in which they may lie."""

TOWER = ("tower-measurements.json", "*tower*.json")

METHODS = ("UTIS", "HeliOS")
"""Of finding the focal spot, the preferred one first."""

_A, _F = 6378137.0, 1 / 298.257223563
"""WGS 84: semi-major axis [m] and flattening."""

FAR_M = 2000.0
"""Heliostat or spot further from the tower than this is a mistake of units or of place."""

OFF_TARGET_M = 15.0
"""A spot further from its target's centre than this cannot have been seen on it."""

CLOCKWISE = "clockwise_axis_movement"
JOINTS = ("joint_translation_{}_1", "joint_translation_{}_2", "concentrator_translation_{}")

LARGEST_M = 5.0
"""No length of a heliostat's kinematics is larger."""


def recognises(path: Path) -> bool:
    """Whether a path is of this data base: a folder of recordings or above one, or a file of such a folder."""
    if path.is_dir():
        return bool(_calibrations(path) or _inner(path) or _heliostats(path))
    return any(path.match(p) for p in (*CALIBRATION, *HELIOSTAT))


def _matching(folder: Path, patterns: Iterable[str]) -> list[Path]:
    return [p for pattern in patterns for p in folder.glob(pattern)]


def _calibrations(folder: Path) -> list[Path]:
    """Recordings in a folder, in the order in which they were taken."""
    return sorted(_matching(folder, CALIBRATION), key=_order)


def _inner(folder: Path) -> list[Path]:
    """Folders within a folder that hold recordings."""
    return sorted({p.parent for p in _matching(folder, [f"*/{c}" for c in CALIBRATION])})


def _heliostats(folder: Path) -> list[Path]:
    """Files of a heliostat's properties."""
    found = set(_matching(folder, HELIOSTAT)) - set(_matching(folder, CALIBRATION))
    return sorted(found)


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
    if not folder.is_dir():
        raise BenchsimError(f"{folder}: is one file of a heliostat's recordings; name the folder that holds them")
    paths = _calibrations(folder)
    inner = _inner(folder)
    if not paths and len(inner) == 1 and inner[0].name in RECORDINGS:
        paths = _calibrations(inner[0])
    if not paths:
        mend = f"name one of its folders ({', '.join(p.name for p in inner[:5])})" if inner else "add the recordings"
        raise BenchsimError(f"{folder}: holds no {CALIBRATION[0]} itself; {mend}")
    tower = tower if tower is not None else find_tower(folder)
    plant = load(tower)
    origin = triple(tower, plant, "power_plant_properties.coordinates")
    heliostat = _heliostat(folder, paths[0].parent)
    properties = load(heliostat)
    position = enu(triple(heliostat, properties, "heliostat_position"), origin)
    if np.linalg.norm(position) > 1e3 * FAR_M:
        raise BenchsimError(
            f"{heliostat}: heliostat_position: {np.linalg.norm(position) / 1e6:.3g} km from the tower; write latitude "
            "and longitude in deg and the height in m, and name the right tower with --tower"
        )
    remarks: list[str] = []
    found = [(p, _recording(p, plant, tower, origin, remarks)) for p in paths]
    used = [p for p, row in found if row is not None]
    rows = [row for _, row in found if row is not None]
    mount = Mount(
        axes="east-west",
        observes="spot",
        position=position,
        actuators=_actuators(heliostat, properties),
        joints=_joints(heliostat, properties, remarks),
        latitude=math.radians(origin[0]),
        targets=tuple(sorted(k for k in plant if k != "power_plant_properties")),
    )
    if not rows:
        raise BenchsimError(f"{folder}: no recording has a focal spot; add measured ones")
    reading, seen, spot, target, methods, others = zip(*rows, strict=True)
    names = tuple(p.name[: -len(CALIBRATION[0]) + 1] for p in used)
    remarks += _methods(names, methods, np.array(spot), np.array(others))
    times, stamped = stamps.read([(p, load(p)) for p in used], _name(paths[0].parent))
    source, said = solar.directions(used, np.array(seen), times, origin)
    records = Records(names, np.array(reading), source, np.array(spot), target)
    _plausible(used, records, mount)
    files = (*paths, heliostat, *stamped, tower)
    return Session(folder.resolve().name, folder, files, mount, records, (*remarks, *said))


def _name(recordings: Path) -> str:
    """The heliostat's, as its folder has it."""
    folder = recordings.resolve()
    return folder.parent.name if folder.name in RECORDINGS else folder.name


def _methods(names: Sequence[str], methods: Sequence[str], spots: Array, others: Array) -> list[str]:
    """What the methods of finding the focal spot leave open; spots (n, 3) of the one in use and of the other [mm]."""
    out = []
    second = [n for n, m in zip(names, methods, strict=True) if m != METHODS[0]]
    if second:
        which = f"any of the {len(names)} recordings" if len(second) == len(names) else ", ".join(second)
        out.append(f"There is no spot of {METHODS[0]} in {which}; that of {METHODS[1]} is used.")
    apart = np.linalg.norm(spots - others, axis=1)
    both = np.isfinite(apart)
    if both.any():
        out.append(
            f"{METHODS[0]} and {METHODS[1]} find spots {np.sqrt(np.mean(apart[both] ** 2)):.3g} mm apart (rms of "
            f"{both.sum()} recordings; median {np.median(apart[both]):.3g} mm); that of {METHODS[0]} is used."
        )
    return out


def _heliostat(folder: Path, recordings: Path) -> Path:
    """The heliostat's one file: in the folder, in `PROPERTIES` in or beside it, or above its folder of recordings."""
    here = folder.resolve()
    places = [here, *(p / n for p in (here, here.parent) for n in PROPERTIES)]
    if recordings.resolve() == here and here.name in RECORDINGS:
        places.append(here.parent)
    for place in places:
        found = _heliostats(place)
        if len(found) > 1:
            raise BenchsimError(
                f"{folder}: {' and '.join(p.name for p in found[:3])} may each be the heliostat's; keep the right one"
            )
        if found:
            return found[0]
    return folder / HELIOSTAT[0].lstrip("*")


def find_tower(folder: Path) -> Path:
    """The tower file in a folder or the nearest of its parents."""
    start = folder.resolve()
    for place in (start, *start.parents[:4]):
        for pattern in TOWER:
            found = sorted(p for p in place.glob(pattern) if not any(p.match(c) for c in CALIBRATION))
            if len(found) > 1:
                raise BenchsimError(
                    f"{place}: {' and '.join(p.name for p in found[:3])} may each be the tower's; name the right one "
                    "with --tower FILE"
                )
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


def _order(path: Path) -> tuple[int, str]:
    """Recordings are numbered as they were taken."""
    head = re.split("[-_]", path.name, maxsplit=1)[0]
    return (int(head) if head.isdigit() else 1 << 60, path.name)


def _recording(
    path: Path, plant: Mapping[str, Any], tower: Path, origin: Array, remarks: list[str]
) -> tuple[Array, Array, Array, str, str, Array] | None:
    """Steps, azimuth and elevation of the sun as recorded [deg], focal spot [mm], target, method, the other's spot."""
    data = load(path)
    steps = np.array([number(path, data, f"motor_position.axis_{k}_motor_position") for k in (1, 2)])
    azimuth, elevation = number(path, data, "sun_azimuth"), number(path, data, "sun_elevation")
    if not -2.0 <= elevation <= 90.0 or abs(azimuth) > 360.0:
        raise BenchsimError(
            f"{path}: sun_elevation, sun_azimuth: {elevation:g} and {azimuth:g} deg are no place of the sun; write "
            "degrees, azimuth from south with west negative"
        )
    target = value(path, data, "target_name")
    targets = [k for k in plant if k != "power_plant_properties"]
    if target not in targets:
        known = ", ".join(targets)
        raise BenchsimError(f"{path}: target_name: {target!r} is not in {tower} ({known}); name the right tower file")
    spots = value(path, data, "focal_spot")
    if not isinstance(spots, Mapping):
        raise BenchsimError(f"{path}: focal_spot: {spots!r} holds no methods; write {METHODS[0]} = [lat, lon, height]")
    found = {m: enu(triple(path, data, f"focal_spot.{m}"), origin) for m in METHODS if spots.get(m) is not None}
    if not found:
        remarks.append(f"{path.name}: neither {' nor '.join(METHODS)} found a focal spot; left out.")
        return None
    method, spot = next(iter(found.items()))
    centre = enu(triple(tower, plant, f"{target}.coordinates.center"), origin)
    off = float(np.linalg.norm(spot - centre)) / 1e3
    if off > OFF_TARGET_M:
        raise BenchsimError(
            f"{path}: focal_spot.{method}: {off:.3g} m from the centre of {target}, which is off the target; mend the "
            "spot, the target's name, or the tower file"
        )
    other = found[METHODS[1]] if len(found) == len(METHODS) else np.full(3, np.nan)
    return steps, np.array([azimuth, elevation]), spot, target, method, other


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
        first = -math.pi / 2 if k == 0 else 0.0
        out.append(Actuator(1e3 * stroke, 1e3 * offset, 1e3 * radius, increment / 1e3, angle + first, bool(clockwise)))
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


def _plausible(paths: Sequence[Path], records: Records, mount: Mount) -> None:
    limits = [(0.0, 4.0 * a.increment * (a.offset + a.radius)) for a in mount.actuators]
    for path, steps in zip(paths, records.reading, strict=True):
        for k, (low, high) in enumerate(limits):
            if not low - 1 <= steps[k] <= high:
                raise BenchsimError(
                    f"{path}: motor_position.axis_{k + 1}_motor_position: {steps[k]:g} steps is beyond the actuator; "
                    "mend the recording, or the actuator's increment"
                )
