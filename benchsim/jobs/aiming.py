"""``benchsim predict --aim``: motor positions at which a heliostat's beam hits, by the mount as amended."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import history, misses, solar, stamps
from benchsim.instruments.mount.geodesy import enu
from benchsim.instruments.mount.json_values import load, triple
from benchsim.instruments.mount.paint_heliostat import FAR_M, ORIGIN
from benchsim.instruments.mount.records import UNITS, Array, Records, Session, numbers, toward
from benchsim.jobs import amended_mounts
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown

HIT_RAD = 1e-9
"""Of the beam: motor positions that miss by more are not given."""

STARTS = 5
"""Recorded positions nearest to the aim from which a solution is looked for."""


@dataclass(frozen=True, repr=False)
class Aim(Shown):
    """Motor positions that hit.

    Attributes
    ----------
    heliostat, target : str
    place : (3,) array
        Aimed at: east, north, up about the plant's reference [mm].
    time : datetime
    sun : (float, float)
        Azimuth from north through east and apparent elevation [deg].
    motor : (2,) array
        [steps]
    sigma : (float, float) or None
        1 sigma of the spot across and up, as seen along the beam, from what was fitted [mm]; None where the file does
        not say.
    play : float
        By how much the spot lies to either side, by the way in which the axes come, where backlash is stated [mm].
    """

    heliostat: str
    target: str
    place: Array
    time: datetime
    sun: tuple[float, float]
    motor: Array
    sigma: tuple[float, float] | None
    play: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "target": self.target,
            "aim_m": [round(float(v) / 1e3, 6) for v in self.place],
            "time": self.time.isoformat(),
            "sun_azimuth_deg": self.sun[0],
            "sun_elevation_deg": self.sun[1],
            "motor_positions": [round(float(v), 2) for v in self.motor],
            "sigma_mm": None if self.sigma is None else list(self.sigma),
            "play_mm": self.play,
        }

    def text(self) -> str:
        """In sentences."""
        when = self.time.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        steps = f"{self.motor[0]:.2f} and {self.motor[1]:.2f} steps"
        lines = [
            f"{self.heliostat}: the beam hits {self.target} on {when} with motor positions {steps}",
            f"  sun at {self.sun[0]:.3f} deg azimuth from north, {self.sun[1]:.3f} deg high",
        ]
        if self.sigma is not None:
            across, up = self.sigma
            lines.append(f"  the spot's place is known to {across:.0f} mm across and {up:.0f} mm up (1 sigma)")
        if self.play:
            lines.append(
                f"  its play moves the spot by up to {self.play:.0f} mm to either side, by the way the axes come"
            )
        return "\n".join(lines)

    summary = text


def aim(
    amended: Path | str,
    target: str,
    time: str | None,
    *,
    tower: Path | str | None = None,
    progress: Progress = silent,
) -> Aim:
    """Motor positions at which an amended heliostat's beam hits.

    Parameters
    ----------
    amended : path
        As `amended_mounts.read` takes it.
    target : str
        Of the tower file, or ``EAST,NORTH,UP`` about the plant's reference [m].
    time : str
        ISO 8601 with a zone, ``2024-06-21T10:00:00Z``.
    tower : path, optional
    progress : callable

    Returns
    -------
    Aim

    Raises
    ------
    BenchsimError
        If the mount is no heliostat, target or time cannot be read, the sun is below the horizon, or the actuators do
        not reach.
    """
    return aim_at(amended_mounts.read(Path(amended), None if tower is None else Path(tower)), target, time)


def aim_at(session: Session, target: str, time: str | None) -> Aim:
    """`aim` of a session that was read."""
    if session.mount.observes == "sky":
        raise BenchsimError(f"{session.path}: is of a telescope; --aim is for a heliostat's beam, so leave it out")
    when = _parsed(time)
    file = session.files[-1]
    plant = load(file)
    origin = triple(file, plant, ORIGIN)
    place = _place(session, target, origin)
    azimuth, elevation = (float(v) for v in solar.almanac(np.array([when.timestamp()]), origin)[0])
    if elevation <= 0:
        raise BenchsimError(
            f"--time {time}: the sun is {-elevation:.1f} deg below the horizon of the plant in {file.name} then; name "
            "a time of its day"
        )
    source = toward(np.radians([azimuth]), np.radians([elevation]))
    counted = numbers(session.records)
    # The record after the last: as the mount is by now.
    name = f"{1 + (0 if counted is None else int(counted.max(initial=0)))}"
    known = target in session.mount.targets
    named = (target if known else session.mount.targets[0],)
    latitude = session.mount.latitude
    warmth = None if latitude is None else history.season(np.array([when.timestamp()]), latitude)
    one = replace(session, records=Records((name,), np.zeros((1, 2)), source, place[None], named, warmth=warmth))
    if not known:
        # A place is where it is, however a target hangs.
        one = replace(one, effects={k: v for k, v in one.effects.items() if k != "target-position"})
    motor = _solved(one, session)
    hit = _at(one, motor)
    sigma = None
    if session.learnt is not None:
        length = float(np.linalg.norm(misses.directions(hit)[1]))
        fitted = misses.covariances(hit, session.learnt, single=False)[0]
        across, up = np.sqrt(np.diag(fitted)) / session.mount.of_normal * UNITS["mrad"] * length
        sigma = (float(across), float(up))
    return Aim(session.title, target, place, when, (azimuth, elevation), motor, sigma, _play(hit))


def _play(hit: Session) -> float:
    """How far the spot moves at most where both axes come from a side, against where they are amid their play [mm]."""
    beam, seen = misses.directions(hit)
    moved = 0.0
    for way in np.eye(2):
        came = replace(hit, records=replace(hit.records, travel=way[None]))
        moved += float(np.linalg.norm(misses.directions(came)[0] - beam))
    return moved * float(np.linalg.norm(seen))


def _parsed(time: str | None) -> datetime:
    when = stamps.parsed(time)
    if when is None or when.tzinfo is None:
        raise BenchsimError(
            f"--time {time or ''}: is no time with a zone, 1950 to 2100; write it like 2024-06-21T10:00:00Z (UTC)"
        )
    return when


def _place(session: Session, target: str, origin: Array) -> Array:
    """Where a target's centre is [mm]."""
    file = session.files[-1]
    if target in session.mount.targets:
        return enu(triple(file, load(file), f"{target}.coordinates.center"), origin)
    try:
        place = np.array([float(p) for p in target.split(",")])
    except ValueError:
        place = np.zeros(0)
    if place.shape != (3,) or not np.isfinite(place).all():
        listed = ", ".join(session.mount.targets)
        raise BenchsimError(f"--aim {target}: is no target of {file} ({listed}) and no EAST,NORTH,UP in m; write one")
    if np.linalg.norm(place) > FAR_M:
        raise BenchsimError(f"--aim {target}: is {np.linalg.norm(place) / 1e3:.3g} km from the tower; write metres")
    return 1e3 * place


def _at(one: Session, motor: Array) -> Session:
    return replace(one, records=replace(one.records, reading=np.reshape(motor, (1, 2))))


def _solved(one: Session, session: Session) -> Array:
    """Steps at which the beam hits, (2,)."""

    def off(motor: Array) -> Array:
        beam, seen = misses.directions(_at(one, motor))
        # What of the beam is beside its aim, in two directions perpendicular to that; far off it grows on.
        way = seen[0] / np.linalg.norm(seen[0])
        right = np.cross(way, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rest = np.array([beam[0] @ right, beam[0] @ np.cross(right, way), 1 - beam[0] @ way])
        return np.where(np.isfinite(rest), rest, 2.0)

    low, high = np.array([a.reach for a in session.mount.actuators]).T
    bounded = np.isfinite(low) & np.isfinite(high)
    middle = np.full(2, 2e4)
    middle[bounded] = (low[bounded] + high[bounded]) / 2
    known = session.records.reading
    ranked = sorted((np.clip(r, low, high) for r in known), key=lambda r: float(np.linalg.norm(off(r))))
    for start in [*ranked[:STARTS], middle]:
        found = least_squares(off, start, x_scale=1e3, xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200).x
        if np.linalg.norm(off(found)) < HIT_RAD and (found >= low).all() and (found <= high).all():
            return np.asarray(found)
    reach = ", ".join(f"{a.reach[0]:g} to {a.reach[1]:g}" for a in session.mount.actuators)
    raise BenchsimError(
        f"{session.path}: with {reach} steps of its actuators the heliostat cannot send the sun there at that time; "
        "choose another target or time"
    )
