"""The catalogue of the bench: every effect that the simulation may lack, as data.

An effect is added here, in one module of `rays` and in one of `renderer`, and nowhere else. Names, units and signs are
those of the recording's ``[effects]``; amplitudes are added to what the file states.

Some mechanisms move the light in the same way and carry one name, under which each of them counts as found: see
`Entry.synonyms`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Recording
from benchsim.diagnosis import settings

ELEMENTS = ("source", "mirror", "air", "screen", "camera", "time", "settings")
"""In the order of the light; time is what changes on the way through a recording, settings what hands do."""


@dataclass(frozen=True)
class Term:
    """A number of an effect.

    Attributes
    ----------
    name, unit : str
        As in the recording's ``[effects]``; the unit as `bench.units` spells it.
    cap : float
        Largest plausible magnitude; an amplitude's prior is N(0, (cap/2)²), half of it where ``one_sided``.
    one_sided : bool
        Physical only where ≥ 0.
    power : int
        The light responds to value**power.
    grid : tuple of float
        Not empty for a shape (a place, a width, a period): the values at which the effect is screened; `candidates`
        replaces them by those that suit the recording.
    observable : bool
        False: accepted in files, but nothing that is measured depends on it, so that it is never fitted.
    """

    name: str
    unit: str
    cap: float
    one_sided: bool = False
    power: int = 1
    grid: tuple[float, ...] = ()
    observable: bool = True


@dataclass(frozen=True)
class Entry:
    """An effect of the catalogue; see `CATALOGUE`.

    Attributes
    ----------
    name, element : str
    terms : tuple of Term
        Amplitudes, then shapes.
    says : str
        One sentence of physics.
    remedy : str
        One sentence of what to do about it on the bench.
    source : str
        Where the form comes from.
    synonyms : tuple of str
        Other mechanisms that no recording of this bench tells from it.
    drawn : str
        How `renderer` draws it, one sentence, where no optics library draws it honestly and a closed form stands in;
        empty where light is traced through what it physically is.
    needs : tuple of str
        What a recording must have, or a diagnosis does not judge it there: keys of `candidates.NEEDS`.
    """

    name: str
    element: str
    terms: tuple[Term, ...]
    says: str
    remedy: str
    source: str
    synonyms: tuple[str, ...] = ()
    drawn: str = ""
    needs: tuple[str, ...] = ()


_GEOMETRY = "plane geometry of the bench"
_MIXED = "Drawn as what it is; a share between 0 and 1 as that mixture of the light without it and with it."
_DIRECTIONS = "Drawn as rays whose directions over the beam's section follow this form itself; no lens is traced."
_BROWN = "Drawn by Brown's polynomial itself; no lens is traced."

CATALOGUE: tuple[Entry, ...] = (
    Entry(
        "facets",
        "mirror",
        (Term("facets", "1", 1.0, one_sided=True),),
        "The mirror is a polygon of flat facets, not a cylinder of the same radius.",
        "Set physics.facets = true.",
        "Carretero 2019, the rotating polygonal mirror; its Eqs (9)-(12) take a cylinder",
        drawn=_MIXED,
        needs=("polygon",),
    ),
    Entry(
        "pivot-offset",
        "mirror",
        (Term("dr", "mm", 17.5),),
        "The reflecting surface lies further from the axis of rotation than stated.",
        "Measure the mirror's circumscribed diameter, or the coating's distance from the shaft.",
        "Carretero 2019, r of Eqs (9)-(12)",
    ),
    Entry(
        "canting",
        "mirror",
        (Term("pyr", "mrad", 10.0),),
        "Every facet's normal leans toward the axis of rotation by the same angle.",
        "Measure the pyramidal angle with an autocollimator, or reverse the mirror on its shaft and take the mean.",
        "Stone et al. 1999, alignment of rotating polygons; the same as a heliostat's canting",
        ("mean pyramidal error of the polygon",),
    ),
    Entry(
        "facet-tilts",
        "mirror",
        (Term("tilt_rms", "mrad", 3.0, one_sided=True, power=2),),
        "The facets' normals lean toward the axis by different angles, so that each draws a trace of its own.",
        "Gate the exposures to single facets and correct each, or replace the polygon.",
        "facet-to-facet pyramidal error of polygons (Marshall & Stutz, Handbook of Optical and Laser Scanning)",
        needs=("polygon", "facets", "gate or gamma"),
    ),
    Entry(
        "axis-wobble",
        "mirror",
        (Term("wob_c", "mrad", 2.0), Term("wob_s", "mrad", 2.0)),
        "The mirror sits askew on its shaft: the facets' lean goes through one period in a revolution.",
        "Remount the mirror square to the shaft, or replace the bearing.",
        "first harmonic of the facets' tilts (Marshall & Stutz)",
        needs=("polygon", "facets", "gate or gamma"),
    ),
    Entry(
        "axis-tilt",
        "mirror",
        (Term("ped_x", "mrad", 10.0), Term("ped_y", "mrad", 10.0)),
        "The mirror's pedestal leans: axis and body are turned about the world's x and y in every setting.",
        "Level the pedestal with a spirit level along x and y.",
        "pedestal tilt of two-axis mounts (AN, AW of TPOINT)",
    ),
    Entry(
        "azimuth-offset",
        "mirror",
        (Term("az_enc", "mrad", 10.0),),
        "The mirror's azimuth is off by a constant angle about the vertical in every setting.",
        "Find the zero of the azimuth encoder against a surveyed direction.",
        "encoder offset of two-axis mounts (IA of TPOINT)",
    ),
    Entry(
        "second-surface",
        "mirror",
        (Term("glass", "mm", 2.0, one_sided=True),),
        "The coating lies behind glass, which displaces the light and sends a ghost from its front face.",
        "Use a first-surface mirror, or state the glass.",
        "refraction at a plane plate, n = 1.515 (BK7 at 633 nm)",
    ),
    Entry(
        "facet-curvature",
        "mirror",
        (Term("fcurv", "1/m", 0.2),),
        "The facets are curved (convex where positive) instead of flat.",
        "Test a facet's flatness with an interferometer, or replace the polygon.",
        "reflection at a sphere, paraxial",
    ),
    Entry(
        "beam-direction",
        "source",
        (Term("saz", "mrad", 10.0), Term("sel", "mrad", 10.0)),
        "The laser's azimuth and elevation dials are off by a constant in every setting.",
        "Find the zeros of the laser's dials against a surveyed target.",
        _GEOMETRY,
        ("coma that is constant over the beam",),
    ),
    Entry(
        "beam-offset",
        "source",
        (Term("bu", "mm", 3.0), Term("bv", "mm", 3.0)),
        "The beam passes beside the point of the mirror that it is aimed at, parallel to itself.",
        "Centre the beam on the mirror: equal power lost on either edge.",
        _GEOMETRY,
    ),
    Entry(
        "wavefront-curvature",
        "source",
        (Term("curv", "1/m", 0.4),),
        "The beam converges or diverges more than its stated divergence allows.",
        "Adjust the expander's focus with a shear plate, or measure the beam's width at two distances.",
        "homocentric beam; exceeds the prior of the divergence",
        ("divergence beyond its prior",),
    ),
    Entry(
        "astigmatism",
        "source",
        (Term("astig0", "1/m", 0.4), Term("astig45", "1/m", 0.4)),
        "The beam's curvature differs between two sections, as behind a tilted lens.",
        "Square the expander's lenses to the beam.",
        "curvature matrix of the wavefront (Siegman 1986, ch. 15)",
        drawn=_DIRECTIONS,
    ),
    Entry(
        "coma",
        "source",
        (Term("coma_u", "mrad/mm2", 0.1), Term("coma_v", "mrad/mm2", 0.1)),
        "The expander is decentred: directions over the beam follow the gradient of Zernike's coma.",
        "Centre the expander's lenses on each other.",
        "gradient of r³ cos φ (Born & Wolf, ch. 9)",
        drawn=_DIRECTIONS,
    ),
    Entry(
        "finite-beam",
        "source",
        (Term("beam", "1", 1.0, one_sided=True),),
        "The light is a beam of finite diameter, not a single ray.",
        "Set physics.beam = true.",
        "Gaussian beam",
        drawn=_MIXED,
    ),
    Entry(
        "diffraction",
        "source",
        (Term("fresnel", "1", 1.0, one_sided=True),),
        "The mirror's height diffracts the light, whose Fresnel number is near one.",
        "Set physics.diffraction = true.",
        "Fresnel diffraction at a slit (Born & Wolf, ch. 8)",
        drawn="Drawn as rays whose places follow the Fresnel integral's intensity, since a tracer of rays knows no "
        "waves; a share between 0 and 1 as that mixture of the light without it and with it.",
    ),
    Entry(
        "window",
        "air",
        (Term("win", "mm", 10.0, one_sided=True),),
        "A plane-parallel plate stands before the screen and displaces light that falls at an angle.",
        "Remove the plate, or state its thickness.",
        "refraction at a plane plate, n = 1.515 (BK7 at 633 nm)",
    ),
    Entry(
        "window-tilt",
        "air",
        (Term("wty", "deg", 20.0), Term("wtz", "deg", 20.0)),
        "A plate of 4 mm before the screen is turned about y and z and displaces all light sideways.",
        "Set the plate parallel to the screen, or remove it.",
        "refraction at a plane plate, n = 1.515 (BK7 at 633 nm)",
    ),
    Entry(
        "air-gradient",
        "air",
        (Term("air", "K/m", 200.0), Term("airh", "K/m", 200.0)),
        "The air's temperature rises along z or y and bends the rays toward the cold side.",
        "Shield the path from heaters and sun, and stir the air.",
        "ray equation with dn/dT = −0.95e-6 /K (Ciddor 1996)",
    ),
    Entry(
        "plume",
        "air",
        (
            Term("plume", "mrad", 2.0),
            Term("plume_y", "mm", 400.0, grid=(-150.0, 0.0, 150.0)),
            Term("plume_z", "mm", 800.0, grid=(-600.0, -300.0, 0.0)),
            Term("plume_width", "mm", 150.0, one_sided=True, grid=(30.0, 60.0, 120.0)),
        ),
        "Warm air rises through the path at one place and turns the light that crosses it.",
        "Look for a source of heat below the path, and remove it.",
        "thin Gaussian deflector half way",
        drawn="Drawn as the thin deflector itself, which turns rays at one plane; no volume of warm air is traced.",
    ),
    Entry(
        "screen-distance",
        "screen",
        (Term("sx", "mm", 20.0),),
        "The screen stands nearer to the mirror than stated.",
        "Measure the distance of screen and mirror again.",
        _GEOMETRY,
        ("mirror and laser moved together along x",),
    ),
    Entry(
        "screen-tilt",
        "screen",
        (Term("st_y", "mrad", 20.0), Term("st_z", "mrad", 20.0)),
        "The screen is turned about its centre out of the plane square to x.",
        "Square the screen with a mirror on it that sends light from the rotation's centre back.",
        _GEOMETRY,
    ),
    Entry(
        "screen-rotation",
        "screen",
        (Term("srot", "mrad", 20.0),),
        "The screen is rolled about its normal.",
        "Level the screen's lower edge.",
        _GEOMETRY,
    ),
    Entry(
        "screen-bow",
        "screen",
        (Term("bow_y", "1/m", 0.2), Term("bow_z", "1/m", 0.2)),
        "The board is bent: its surface rises from its plane with the square of y or z.",
        "Put a straightedge across the board, and brace it.",
        "second-order surface",
    ),
    Entry(
        "grid-scale",
        "screen",
        (Term("gs", "1e-3", 10.0),),
        "The marks are printed too far apart by a factor.",
        "Measure the print with a steel rule and correct marks.csv.",
        "linear map of the print",
    ),
    Entry(
        "grid-aspect",
        "screen",
        (Term("ga", "1e-3", 10.0),),
        "The marks are printed too far apart along y and too near along z.",
        "Measure the print along y and z, and correct marks.csv.",
        "linear map of the print",
    ),
    Entry(
        "grid-shear",
        "screen",
        (Term("gsh", "1e-3", 10.0),),
        "The print's y and z are not perpendicular.",
        "Measure the print's diagonals and correct marks.csv.",
        "linear map of the print",
    ),
    Entry(
        "radial-distortion",
        "camera",
        (Term("k1", "1", 0.1), Term("k2", "1", 0.1)),
        "The lens' radial distortion differs from the stated one.",
        "Calibrate the camera again (`benchsim calibrate`).",
        "Brown 1971, Photogrammetric Engineering 37, 855, in OpenCV's form",
        drawn=_BROWN,
    ),
    Entry(
        "tangential-distortion",
        "camera",
        (Term("p1", "1", 0.02), Term("p2", "1", 0.02)),
        "The lens is decentred beyond what is stated.",
        "Calibrate the camera again (`benchsim calibrate`).",
        "Brown 1966, Photogrammetric Engineering 32, 444, in OpenCV's form",
        drawn=_BROWN,
    ),
    Entry(
        "rolling-shutter",
        "camera",
        (
            Term("rs_s", "px", 5.0),
            Term("rs_c", "px", 5.0),
            Term("rs_period", "rows", 3000.0, one_sided=True, grid=(700.0, 1000.0, 1400.0, 2000.0)),
        ),
        "The camera shakes while its rows are read out one after the other.",
        "Fix the camera, or use a global shutter.",
        "rows read out in order, harmonic motion",
        drawn="Drawn as rows of the picture that are each displaced by this harmonic itself; the camera is not moved.",
    ),
    Entry(
        "saturation",
        "camera",
        (Term("sat", "px", 3.0, one_sided=True),),
        "Charge spills along the columns where the trace is bright.",
        "Expose shorter.",
        "blooming, to second order in the brightness (Janesick 2001, Scientific CCDs)",
        drawn="Drawn as a line that is moved along the columns as a whole, by the square of its crest's brightness; no "
        "sensor is simulated.",
        needs=("gamma",),
    ),
    Entry(
        "drift",
        "time",
        (Term("dry", "mm/h", 1.0), Term("drz", "mm/h", 1.0)),
        "The light on the screen wanders in proportion to the time since the first exposure.",
        "Let laser and bench warm up, and repeat one setting at the end.",
        "linear in time",
        drawn="Drawn as a shift of the light on the screen itself; nothing on the bench is moved.",
        needs=("times",),
    ),
    Entry(
        "vibration",
        "time",
        (
            Term("amp", "mm", 1.0, one_sided=True, power=2),
            Term("freq", "Hz", 1e4, one_sided=True, grid=(50.0,), observable=False),
        ),
        "Something shakes during the exposure and widens the trace: laser, axis, mirror or screen.",
        "Decouple the bench from the motor and the floor.",
        "isotropic random displacement, averaged over the exposure",
        ("vibration of the laser", "of the axis", "of the mirror", "of the screen"),
        "Drawn as rays that each land displaced by a random draw of a round Gaussian; nothing on the bench is shaken.",
        needs=("gamma",),
    ),
    Entry(
        settings.NAME,
        settings.EFFECT.element,
        (Term(settings.SCALE, "1", settings.LARGEST, one_sided=True, observable=False),),
        settings.EFFECT.says,
        settings.EFFECT.remedy,
        "log-normal prior, sigma 0.3 about 1",
    ),
)
"""Every effect, in the order of the documentation."""

BY_NAME = {entry.name: entry for entry in CATALOGUE}

PHYSICS_OF = {"facets": "facets", "finite-beam": "beam", "diffraction": "diffraction"}
"""Effects that are switches of ``[physics]``: candidates only where it has them false."""

SIZE = Term("size_mm", "mm", 10.0, one_sided=True, observable=False)
"""Beside the share of a switch: the rms by which it moves the trace, as a diagnosis says it; see `displacement`."""

_TILT = re.compile(r"tilt_(\d+)$")


def terms(name: str, facets: int) -> tuple[Term, ...]:
    """All numbers that ``[effects.NAME]`` may hold on a mirror of so many facets."""
    entry = BY_NAME[name]
    if name == "facet-tilts":
        return (*entry.terms, *(Term(f"tilt_{k}", "mrad", 3.0) for k in range(facets)))
    if name == "window-tilt":
        return (*entry.terms, Term("win", "mm", 10.0, one_sided=True))
    if name in PHYSICS_OF:
        return (*entry.terms, SIZE)
    return entry.terms


def check(recording: Recording) -> None:
    """See that a recording's ``[effects]`` are the catalogue's.

    Parameters
    ----------
    recording : Recording

    Raises
    ------
    BenchsimError
        Unknown effect or parameter, or a value that is not physical: names file, key, the nearest name and the mend.
    """
    file = recording.path.name
    for name, values in recording.effects.items():
        if name not in BY_NAME:
            raise BenchsimError(
                f"{file}: effects.{name}: no such effect{_nearest(name, tuple(BY_NAME))}; "
                "`benchsim effects` lists them all"
            )
        known = {t.name: t for t in terms(name, recording.mirror.facets)}
        for key, value in values.items():
            if key not in known:
                tilt = _TILT.match(key)
                if name == "facet-tilts" and tilt:
                    raise BenchsimError(
                        f"{file}: effects.{name}.{key}: the mirror has {recording.mirror.facets} facets; "
                        f"count them from 0 to {recording.mirror.facets - 1}"
                    )
                raise BenchsimError(
                    f"{file}: effects.{name}.{key}: no such parameter{_nearest(key, tuple(known))}; "
                    f"{name} takes {', '.join(t.name for t in BY_NAME[name].terms)}"
                )
            if known[key].one_sided and value < 0:
                raise BenchsimError(f"{file}: effects.{name}.{key}: {value:g} is below 0; give 0 or more")
            if name in PHYSICS_OF and key != SIZE.name and value > 1:
                raise BenchsimError(f"{file}: effects.{name}.{key}: {value:g} is above 1; give a share from 0 to 1")
            if known[key].grid and known[key].one_sided and value == 0:
                raise BenchsimError(f"{file}: effects.{name}.{key}: 0 is no width or period; give more than 0")


def _nearest(name: str, of: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, of, n=1, cutoff=0.5)
    return f" (the nearest name is {close[0]})" if close else ""
