"""The catalogue of two-axis mounts in both tongues: the heliostat's names and TPOINT's codes.

Amplitudes of a telescope are in arcsec, of a heliostat in mrad; lengths in mm. Signs: `axes`, `sky`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchsim.diagnosis.problem import Effect, Parameter
from benchsim.instruments.mount import history
from benchsim.instruments.mount.records import Mount, Records

ANGLE = "angle"
"""Stands for the mount's own unit."""


@dataclass(frozen=True)
class Term:
    """A number of an effect: its unit, and its largest plausible magnitude for a telescope and for a heliostat."""

    name: str
    unit: str
    sky: float
    spot: float


@dataclass(frozen=True)
class Entry:
    """An effect; ``axes`` and ``observes`` say which mounts it is a candidate for, empty: all."""

    name: str
    element: str
    terms: tuple[Term, ...]
    says: str
    remedy: str
    source: str
    axes: str = ""
    observes: str = ""


_LARA = "Lara-Cerecedo et al. 2016, https://doi.org/10.1155/2016/3158091"
_TPOINT = "Wallace, TPOINT telescope pointing analysis"
_PLAY = "play between motor and axis: the reading is the motor's"
_GROWTH = "thermal expansion: 0.12 mm of a metre of steel for 10 K"
_JUELICH = "kinematics of the Jülich heliostats as the PAINT data base states them"


def _actuator(name: str, cap: float, says: str, remedy: str) -> Entry:
    kind = name.partition("-")[2]
    terms = tuple(Term(f"{kind}_{k}", "mm", cap, cap) for k in (1, 2))
    return Entry(name, "mount", terms, says, remedy, _JUELICH, "east-west", "spot")


CATALOGUE: tuple[Entry, ...] = (
    Entry(
        "encoder-offset",
        "mount",
        (Term("IA", ANGLE, 3600.0, 50.0), Term("IE", ANGLE, 3600.0, 50.0)),
        "The zero points of the two axes are off by constant angles (IA, IE).",
        "Set the reference switches, or put IA and IE into the controller.",
        f"{_LARA}, angular reference offset; {_TPOINT}, IA and IE",
        observes="spot",
    ),
    Entry(
        "axis-tilt",
        "mount",
        (Term("AN", ANGLE, 600.0, 50.0), Term("AW", ANGLE, 600.0, 50.0)),
        "The azimuth axis is not vertical: its top leans toward south by AN and toward west by AW.",
        "Level the pedestal, or put AN and AW into the pointing model.",
        f"{_LARA}, Eq. (7); {_TPOINT}, AN and AW",
        axes="az-el",
    ),
    Entry(
        "axis-tilt",
        "mount",
        (Term("tilt_n", ANGLE, 600.0, 50.0), Term("tilt_u", ANGLE, 600.0, 50.0)),
        "The first axis does not lie horizontal along east: it is turned about north and about up.",
        "Survey and align the first axis, or put both angles into the controller.",
        _JUELICH,
        axes="east-west",
    ),
    Entry(
        "non-perpendicular-axes",
        "mount",
        (Term("NPAE", ANGLE, 600.0, 30.0),),
        "The two axes are not perpendicular to each other (NPAE).",
        "Shim the second axis' bearing, or put NPAE into the pointing model.",
        f"{_TPOINT}, NPAE",
    ),
    Entry(
        "canting",
        "mount",
        (Term("CA", ANGLE, 600.0, 30.0),),
        "Optical axis and second axis are not perpendicular: a canting or collimation error (CA).",
        "Cant the mirror on its frame, or collimate the telescope; or put CA into the pointing model.",
        f"{_LARA}, Eq. (6); {_TPOINT}, CA",
    ),
    Entry(
        "tube-flexure",
        "mount",
        (Term("TF", ANGLE, 600.0, 20.0), Term("TX", ANGLE, 600.0, 0.0)),
        "Gravity bends the tube, or the mirror's frame: it sinks by TF cos E and, for a telescope, TX cot E.",
        "Stiffen the structure, or put TF and TX into the pointing model.",
        f"{_TPOINT}, TF and TX",
    ),
    _actuator(
        "actuator-length", 30.0, "An actuator is longer at step 0 than stated.", "Measure the strokes at the switches."
    ),
    _actuator(
        "actuator-offset",
        20.0,
        "The joint of an actuator lies further from its axis than stated.",
        "Measure the distance from joint to axis.",
    ),
    _actuator(
        "actuator-radius", 20.0, "The lever of an actuator is longer than stated.", "Measure the lever of each axis."
    ),
    Entry(
        "encoder-increment",
        "mount",
        tuple(Term(f"increment_{k}", "1", 0.03, 0.03) for k in (1, 2)),
        "An actuator takes more steps for a millimetre than stated, by that part.",
        "Count the steps over a measured stroke.",
        _JUELICH,
        "east-west",
        "spot",
    ),
    Entry(
        "backlash",
        "mount",
        tuple(Term(f"backlash_{k}", ANGLE, 120.0, 10.0) for k in "AE"),
        "The axes have play: each stands behind its reading by half of it, in the way in which it came.",
        "Take up the play, or drive each axis to its place from one side.",
        _PLAY,
        axes="az-el",
    ),
    Entry(
        "backlash",
        "mount",
        tuple(Term(f"backlash_{k}", "mm", 5.0, 5.0) for k in (1, 2)),
        "The actuators have play: each is behind its steps by half of it, in the way in which it came.",
        "Take up the play, or drive each actuator to its place from one side.",
        _PLAY,
        axes="east-west",
    ),
    Entry(
        "thermal-growth",
        "mount",
        tuple(Term(f"thermal_{k}", ANGLE, 120.0, 10.0) for k in "AE"),
        "The axes turn as the structure grows with warmth: by that for 10 K, or from the year's mean to its warmest.",
        "Shield or model the structure; record again in another season.",
        _GROWTH,
        axes="az-el",
    ),
    Entry(
        "thermal-growth",
        "mount",
        tuple(Term(f"thermal_{k}", "mm", 3.0, 3.0) for k in (1, 2)),
        "The actuators, and what holds them, grow with warmth: by that from the year's mean to its warmest day.",
        "Put the expansion into the controller; record again in another season.",
        _GROWTH,
        axes="east-west",
    ),
    Entry(
        "pivot-offset",
        "mount",
        (Term("dn", "mm", 0.0, 300.0),),
        "The mirror lies further in front of its axes than stated.",
        "Measure the distance from the axes to the mirror's surface.",
        "plane geometry of a heliostat",
        observes="spot",
    ),
    Entry(
        "mirror-position",
        "mount",
        tuple(Term(f"mirror_{k}", "mm", 0.0, 3000.0) for k in "enu"),
        "The heliostat stands elsewhere than stated, by that much to the east, north and up.",
        "Survey the heliostat's position again.",
        "plane geometry of a heliostat",
        observes="spot",
    ),
    Entry(
        "target-position",
        "target",
        (Term("target_e", "mm", 0.0, 3000.0), Term("target_u", "mm", 0.0, 3000.0)),
        "The targets hang elsewhere than stated, each by that much to the east and up.",
        "Survey the targets' marks again.",
        "plane geometry of a heliostat",
        observes="spot",
    ),
    Entry(
        "spot-scale",
        "target",
        (Term("spot_scale", "1", 0.0, 0.1),),
        "The camera that measures spots has another scale: it shows them nearer to the target's centre, by that part.",
        "Calibrate the camera's scale by the target's corners.",
        "similarity of triangles in a camera",
        observes="spot",
    ),
    Entry(
        "refraction",
        "sky",
        (Term("refr", "1", 600.0, 2.0),),
        "The light comes from higher than stated by a part of the refraction of the air.",
        "Put pressure and temperature into the refraction model, and apply it once.",
        "Reda & Andreas 2004, NREL/TP-560-34302, for the sun; cot E for stars",
    ),
    Entry(
        "clock",
        "time",
        (Term("dt", "s", 20.0, 5400.0),),
        "The clock is wrong: the sun, or the stars, are where they are that much later.",
        "Set the clock, its time zone and daylight saving.",
        "the sky turns about the pole",
    ),
    Entry(
        "change-point",
        "time",
        (Term("dIA", ANGLE, 600.0, 50.0), Term("dIE", ANGLE, 600.0, 50.0)),
        "From one record on the mount's zero points are others: something slipped or was set anew.",
        "Ask the log what happened before that record; judge the records before and after it apart.",
        "a step in both encoder offsets",
        axes="az-el",
    ),
    Entry(
        "change-point",
        "time",
        (Term("step_1", "mm", 0.0, 30.0), Term("step_2", "mm", 0.0, 30.0)),
        "From one record on the actuators are longer than their steps say: one lost steps or was homed anew.",
        "Ask the log what happened before that record; judge the records before and after it apart.",
        "a step in the length of both actuators",
        axes="east-west",
    ),
)
"""Effects in the order of the light: mount, target, sky, time."""

MOST_PLACES = 160
"""Places at which a change is looked for: with one for every record the work would grow as their square. Among a
thousand records a change is found to three."""

STAMPED_S = 60.0
"""Prior sigma of a clock whose stamps agree with the sun that was recorded [s]: one computer wrote both, so that no
zone is wrong, and it may still run free."""

_HISTORY = ("backlash", "thermal-growth")

EACH_WAY = 3
"""Records that an axis came to from either side, below which its play is not told from its offset."""

WARMTH = 0.5
"""Range of the records' warmth (`history`) below which growth is not told from a length: 5 K, or a season."""

FEWEST_FOR_CHANGE = 8
"""Records without which no change can be told from chance."""


def candidates(mount: Mount, records: Records, *, every: bool = False) -> tuple[Effect, ...]:
    """What the simulation of this mount may lack; shapes with the values that suit the records.

    With ``every`` all that may be stated of the mount, though these records say nothing of it: what other records of
    the same mount showed.
    """
    count = len(records.names)
    seen = targets(mount, records) if every else records.target
    out = []
    for entry in CATALOGUE:
        if entry.axes not in ("", mount.axes) or entry.observes not in ("", mount.observes):
            continue
        if entry.name == "clock" and mount.latitude is None:
            continue
        # A camera is a plant's: a single heliostat, whose spots lie close together, says next to nothing of it.
        if entry.name == "spot-scale" and (records.centre is None or not every):
            continue
        if entry.name == "change-point" and count < FEWEST_FOR_CHANGE and not every:
            continue
        terms = [Parameter(t.name, unit(mount, t), _cap(mount, t) / 2) for t in entry.terms if _cap(mount, t) > 0]
        if entry.name == "clock" and records.prompt:
            terms = [replace(t, sigma=min(t.sigma, STAMPED_S)) for t in terms]
        if entry.name in _HISTORY and not every:
            terms = [t for t, k in zip(terms, (0, 1), strict=True) if _told(entry.name, records, k)]
            if not terms:
                continue
        if entry.name == "change-point":
            # Between two records each, with three or more on either side: fewer are outlying records.
            grid = changes(count)
            terms.append(Parameter("change", "record", float(count), grid=grid))
        if entry.name == "target-position":
            numbers = [k for k, name in enumerate(targets(mount, records)) if name in seen]
            terms = [replace(t, name=f"{t.name}_{k + 1}") for k in numbers for t in terms]
        # Several targets hang wrong by as much as they were surveyed badly, which nobody states.
        population = entry.name == "target-position" and len(set(records.target)) > 1
        out.append(Effect(entry.name, entry.element, tuple(terms), entry.says, entry.remedy, random_field=population))
    return tuple(out)


def _told(name: str, records: Records, axis: int) -> bool:
    """Whether the order or the time of these records shows anything of an axis' play or growth."""
    if name == "thermal-growth":
        aged = records.when is not None and not history.spans_flanks(records.when)
        return records.warmth is not None and float(np.ptp(records.warmth)) >= WARMTH and not aged
    return records.travel is not None and min((records.travel[:, axis] == way).sum() for way in (-1, 1)) >= EACH_WAY


def changes(count: int) -> tuple[float, ...]:
    """Places of a change among so many records: between two each, or `MOST_PLACES`; three or more on either side."""
    last = count - 4
    if last < 2:
        return ()
    return tuple(float(k) + 0.5 for k in np.unique(np.linspace(2, last, min(last - 1, MOST_PLACES)).round()))


def targets(mount: Mount, records: Records) -> tuple[str, ...]:
    """Names of the targets, in the order of the numbers of ``target_e_1`` and its like."""
    return mount.targets or tuple(sorted(set(records.target)))


def unit(mount: Mount, term: Term) -> str:
    """Of a term in this mount."""
    if term.name == "refr" and mount.observes == "sky":
        return "arcsec"
    return mount.unit if term.unit == ANGLE else term.unit


def _cap(mount: Mount, term: Term) -> float:
    return term.sky if mount.observes == "sky" else term.spot
