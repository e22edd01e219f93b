"""Calibration recordings of heliostats as the PAINT data base keeps them: JSON files in a folder.

``NUMBER-calibration-properties.json`` (one per recording: motor positions in steps, the sun's azimuth from south, west
negative, and elevation [deg], focal spots [latitude, longitude, height m]), ``heliostat-properties.json`` (position and
kinematics; its name may begin with the heliostat's), and the tower file with the targets, looked for in the folder and
then above it. The older spelling is read, too: ``NUMBER_calibration_properties.json`` and ``ID_properties.json``.
Recordings may lie in the folder or in its ``Calibration``; the heliostat's file in the folder, in ``Properties`` beside
or inside it, or, for a folder of recordings, above it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.instruments.mount import history, paint_heliostat, solar, stamps
from benchsim.instruments.mount.geodesy import enu
from benchsim.instruments.mount.json_values import load, number, triple, value
from benchsim.instruments.mount.records import Array, Mount, Records, Session

CALIBRATION = ("*-calibration-properties.json", "*_calibration_properties.json")
HELIOSTAT = ("*heliostat-properties.json", "*_properties.json")
"""Names of the files in today's and in the older spelling."""

RECORDINGS, PROPERTIES = ("Calibration", "calibration"), ("Properties", "properties")
"""Folders in which they may lie."""

TOWER = ("tower-measurements.json", "*tower*.json")

METHODS = ("UTIS", "HeliOS")
"""Of finding the focal spot, the preferred one first."""

OFF_TARGET_M = 15.0
"""A spot further from its target's centre than this cannot have been seen on it."""


def recognises(path: Path) -> bool:
    """Whether a path is of this data base: a folder of recordings or above one, or a file of such a folder."""
    if path.is_dir():
        return holds_recordings(path) or bool(_heliostats(path))
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
    recorded(folder)
    tower = tower if tower is not None else find_tower(folder)
    heliostat = heliostat_of(folder)
    mount, absent = paint_heliostat.read(heliostat, tower)
    records, files, remarks = records_of(folder, tower, mount)
    return Session(
        printable(folder.resolve().name), folder, (*files, heliostat, tower), mount, records, (*remarks, *absent)
    )


def bare(path: Path, tower: Path | None = None) -> Session:
    """A heliostat without recordings: the file of its properties, or a folder that holds it; arguments as `read`."""
    heliostat = heliostat_of(path) if path.is_dir() else path
    tower = tower if tower is not None else find_tower(heliostat.parent)
    mount, remarks = paint_heliostat.read(heliostat, tower)
    none = Records((), np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3)), ())
    return Session(printable(path.resolve().stem), path, (heliostat, tower), mount, none, remarks)


def holds_recordings(folder: Path) -> bool:
    """Whether a folder, or one within it, holds recordings."""
    return bool(_calibrations(folder) or _inner(folder))


def recorded(folder: Path) -> list[Path]:
    """The recordings of a folder, in the order in which they were taken.

    Raises
    ------
    BenchsimError
        If there is none.
    """
    paths, inner = _calibrations(folder), _inner(folder)
    if not paths and len(inner) == 1 and inner[0].name in RECORDINGS:
        paths = _calibrations(inner[0])
    if not paths:
        mend = f"name one of its folders ({', '.join(p.name for p in inner[:5])})" if inner else "add the recordings"
        raise BenchsimError(f"{folder}: holds no {CALIBRATION[0]} itself; {mend}")
    return paths


def records_of(folder: Path, tower: Path, mount: Mount) -> tuple[Records, tuple[Path, ...], tuple[str, ...]]:
    """The records of a folder, of a mount that is known, the files that hold them, and what these leave open; errors
    as `read`."""
    plant = load(tower)
    origin = triple(tower, plant, paint_heliostat.ORIGIN)
    remarks: list[str] = []
    paths = recorded(folder)
    held = [(p, load(p)) for p in paths]
    found = [(one, row) for one in held if (row := _recording(*one, plant, tower, origin, remarks)) is not None]
    if not found:
        raise BenchsimError(f"{folder}: no recording has a focal spot; add measured ones")
    used = [p for (p, _), _ in found]
    reading, seen, spot, centre, target, methods, others = zip(*(row for _, row in found), strict=True)
    names = tuple(printable(p.name[: -len(CALIBRATION[0]) + 1]) for p in used)
    spots = np.array(spot)
    said, spot_sigma = _methods(names, methods, spots, np.array(others))
    times, stamped = stamps.read([one for one, _ in found], _name(used[0].parent))
    source, of_the_sun, prompt = solar.directions(used, np.array(seen), times, origin)
    read_out, latitude = np.array(reading), float(np.radians(origin[0]))
    records = Records(
        names, read_out, source, spots, target, times, spot_sigma, np.array(centre),
        travel=history.travel(mount, read_out, source, times),
        warmth=history.season(times, latitude),
        prompt=prompt,
    )  # fmt: skip
    _plausible(used, records, mount)
    return records, (*paths, *stamped), (*remarks, *said, *of_the_sun)


def _name(recordings: Path) -> str:
    """The heliostat's, as its folder has it."""
    folder = recordings.resolve()
    return folder.parent.name if folder.name in RECORDINGS else folder.name


def _methods(names: Sequence[str], methods: Sequence[str], spots: Array, others: Array) -> tuple[list[str], float]:
    """What the methods of finding the focal spot leave open, and the error of either per component [mm].

    Spots (n, 3) of the one in use and of the other [mm]. Were both methods alike and independent, their distance in the
    target's plane would have a median of √(4 ln 2) of that error.
    """
    out, error = [], 0.0
    second = [n for n, m in zip(names, methods, strict=True) if m != METHODS[0]]
    if second:
        which = f"any of the {len(names)} recordings" if len(second) == len(names) else ", ".join(second)
        out.append(f"There is no spot of {METHODS[0]} in {which}; that of {METHODS[1]} is used.")
    apart = np.linalg.norm(spots - others, axis=1)
    both = apart[np.isfinite(apart)]
    if len(both):
        error = float(np.median(both) / np.sqrt(4 * np.log(2)))
        out.append(
            f"{METHODS[0]} and {METHODS[1]} find spots {np.sqrt(np.mean(both**2)):.3g} mm apart (rms of {len(both)} "
            f"recordings; median {np.median(both):.3g} mm); that of {METHODS[0]} is used, and errors are taken to be "
            f"{error:.3g} mm in each component at least."
        )
    return out, error


def heliostat_of(folder: Path) -> Path:
    """The heliostat's one file: in the folder, in `PROPERTIES` in or beside it, or above its folder of recordings.

    Where there is none, the file that should be in the folder.
    """
    here = folder.resolve()
    places = [here, *(p / n for p in (here, here.parent) for n in PROPERTIES)]
    if here.name in RECORDINGS and _calibrations(here):
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


def _order(path: Path) -> tuple[int, str]:
    """Recordings are numbered as they were taken."""
    head = re.split("[-_]", path.name, maxsplit=1)[0]
    return (int(head) if head.isdigit() else 1 << 60, path.name)


def _recording(
    path: Path, data: Mapping[str, Any], plant: Mapping[str, Any], tower: Path, origin: Array, remarks: list[str]
) -> tuple[Array, Array, Array, Array, str, str, Array] | None:
    """Steps, azimuth and elevation of the sun [deg], spot and target's centre [mm], target, method, other spot."""
    steps = np.array([number(path, data, f"motor_position.axis_{k}_motor_position") for k in (1, 2)])
    azimuth, elevation = number(path, data, "sun_azimuth"), number(path, data, "sun_elevation")
    if not -2.0 <= elevation <= 90.0 or abs(azimuth) > 360.0:
        raise BenchsimError(
            f"{path}: sun_elevation, sun_azimuth: {elevation:g} and {azimuth:g} deg are no place of the sun; write "
            "degrees, azimuth from south with west negative"
        )
    target = value(path, data, "target_name")
    targets = [k for k in plant if k != "power_plant_properties"]
    if target not in targets or printable(target) != target:
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
    return steps, np.array([azimuth, elevation]), spot, centre, target, method, other


def _plausible(paths: Sequence[Path], records: Records, mount: Mount) -> None:
    limits = [(0.0, 4.0 * a.increment * (a.offset + a.radius)) for a in mount.actuators]
    for path, steps in zip(paths, records.reading, strict=True):
        for k, (low, high) in enumerate(limits):
            if not low - 1 <= steps[k] <= high:
                raise BenchsimError(
                    f"{path}: motor_position.axis_{k + 1}_motor_position: {steps[k]:g} steps is beyond the actuator; "
                    "mend the recording, or the actuator's increment"
                )
