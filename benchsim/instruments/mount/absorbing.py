"""What was found, put into the constants of an ``east-west`` mount, so far as a heliostat's file can hold it.

Exact, not to first order: the tilt of the first axis by a rotation vector is parted into turns about north, up and
east, the last of which is an offset of the first angle. What no constant of the mount can do is told.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchsim.instruments.mount.axes import actuator_angle
from benchsim.instruments.mount.problem import fitted, predicted
from benchsim.instruments.mount.records import Actuator, Array, Mount, Session

ELSEWHERE = {
    "tube-flexure": "the mirror's frame sags with its elevation, which rigid kinematics have no number for",
    "refraction": "the sun's elevation is at fault; correct what gives the sun's place",
    "clock": "the time of the records is at fault; set the clock",
    "target-position": "targets hang elsewhere; correct the tower's file",
    "backlash": "rigid kinematics have no number for play; drive each axis to its place from one side",
    "thermal-growth": "rigid kinematics know no season; correct the lengths by it (20 July +1, January -1)",
    "spot-scale": "the scale of the camera that measures spots is at fault; calibrate it",
}
"""Effects that are none of the mount's constants, and what is to be done."""


def absorbed(session: Session) -> tuple[Mount, tuple[str, ...]]:
    """The mount whose constants hold what the session states.

    Parameters
    ----------
    session : Session
        Of an ``east-west`` mount.

    Returns
    -------
    mount : Mount
        After its change, where there was one.
    left : tuple of str
        What its constants cannot hold, one sentence each.
    """
    stated = predicted(replace(session, fields={}), ()).stated

    def of(name: str) -> float:
        return stated.get(name, 0.0)

    mount = session.mount
    offsets = np.array([of("IE"), of("IA")]) + mount.zero
    actuators = [_with(a, k, of, offsets[k - 1]) for k, a in enumerate(mount.actuators, 1)]
    # R_north R_up R_east: the file holds the first two, the first angle takes the third.
    tilt = Rotation.from_rotvec([0.0, of("tilt_n"), of("tilt_u")]) * _turn("yz", mount.tilts[:2])
    north, up, east = tilt.as_euler("YZX")
    actuators[0] = replace(actuators[0], initial_angle=actuators[0].initial_angle + east)
    normal = _turn("x", -of("CA")).apply(mount.normal)
    joints = mount.joints.copy()
    joints[0] = _turn("x", east).apply(joints[0])
    # The mirror's arm along north is counted against its normal, which points south.
    joints[2] += of("dn") * normal * [1.0, -1.0, 1.0]
    out = replace(
        mount,
        position=mount.position + [of(f"mirror_{k}") for k in "enu"],
        actuators=tuple(actuators),
        joints=joints,
        tilts=np.array([north, up, mount.tilts[2], mount.tilts[3] + of("NPAE")]),
        normal=normal,
        zero=np.zeros(2),
    )
    return out, tuple(_left(session))


def _turn(axes: str, angles: float | Array) -> Rotation:
    """R_x R_y … of right-handed turns about east (x), north (y) and up (z)."""
    return Rotation.from_euler(axes.upper(), angles)


def _with(actuator: Actuator, k: int, of: Callable[[str], float], offset: float) -> Actuator:
    """An actuator with its own errors in it, and with an offset of its axis' angle."""
    same = replace(
        actuator,
        stroke=actuator.stroke + of(f"length_{k}"),
        offset=actuator.offset + of(f"offset_{k}"),
        radius=actuator.radius + of(f"radius_{k}"),
        increment=actuator.increment * (1 + of(f"increment_{k}")),
    )
    # Of what it is longer by since a change, its angle at step 0 knows nothing.
    grown = of(f"step_{k}")
    start = actuator_angle(same, np.array([grown * same.increment]), np.zeros(1), np.zeros(1), np.zeros(1))
    return replace(same, stroke=same.stroke + grown, initial_angle=float(start[0]) + offset)


def _left(session: Session) -> Iterator[str]:
    units = {p.name: p.unit for p in fitted(session)}
    for name, terms in session.effects.items():
        sizes = ", ".join(f"{k} = {v:.4g} {units[k]}" for k, v in terms.items() if k in units)
        if name in ELSEWHERE and any(terms.values()):
            yield f"{name} ({sizes}) is not in the file: {ELSEWHERE[name]}."
        if name == "change-point":
            place = f"{terms['change']:g}" if "change" in terms else "an unknown record"
            yield f"The mount is written as it is after its change at record {place}; before it {sizes} were not there."
    for name in session.fields:
        yield f"The function {name} is not in the file: what has no name has no key there."
