"""Which way azimuths run: what the header of a file states, and what the sky says where it is silent.

TPOINT's formulas count azimuth from south through east, most telescopes and everything here from north through east.
Read the wrong way about, an azimuth A is 180° − A, a mirrored sky that fits as well: IA, CA, NPAE and AN come out with
the other sign (their terms are odd under the mirror), AW, IE, TF and TX as they are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.records import Array, toward
from benchsim.vector.sun import horizontal


@dataclass(frozen=True)
class Convention:
    """Where azimuth is 0, and through which side it grows to 90 deg."""

    zero: str
    through: str

    def __str__(self) -> str:
        return f"from {self.zero} through {self.through}"

    def turned(self, azimuth: Array) -> Array:
        """Azimuths [deg] of this convention, from north through east."""
        sense = 1.0 if (self.zero == "north") == (self.through == "east") else -1.0
        return (180.0 if self.zero == "south" else 0.0) + sense * azimuth


NORTH_EAST = Convention("north", "east")
SOUTH_EAST = Convention("south", "east")
CONVENTIONS = (NORTH_EAST, SOUTH_EAST, Convention("north", "west"), Convention("south", "west"))

FITS_DEG = 2.0
"""Median miss of the sky below which a convention fits: clocks, catalogue places and refraction are off by less."""

FEWEST = 3
"""Stars from which the sky can speak."""

STATE = "write ': AZIMUTH NORTH EAST' or ': AZIMUTH SOUTH EAST' above the records"

_OTHER = re.compile(
    r"\b(?:unlike|not|instead of|rather than|converted from|transformed from)\b.*?(?=\bbut\b|\binto\b|\bto\b|[);]|$)"
)
_AZ = r"\b(?:alt)?az(?:imuths?|alt|el)?\b"
_SIDES = {"n": "north", "s": "south", "e": "east", "w": "west"}
_OPPOSITE = {"east": "west", "west": "east"}
_POLE, _SIDE = r"\b(north|south|n|s)\b", r"\b(?P<side>east|west|e|w)\b"
_EQUALS, _DEG = r"\s*(?:=|:|is|at|in)\s*(?:the\s+)?", r"(?:\.0*)?(?:\s*(?:deg\w*|°))?(?![\d.])"
_ENDS = r"(?=\s*(?:$|[,.;:()=]|through|via|over|to|and|eastw|westw|increas|positive))"
_THROUGH = re.compile(_POLE + r"\s*(?:,?\s*(?:through|thru|via|over|towards?|to)\s+(?:the\s+)?|->|→)\s*" + _SIDE)
_ZERO = (
    re.compile(_POLE + _EQUALS + r"\+?0" + _DEG),
    re.compile(r"(?<![\d.])0" + _DEG + _EQUALS + _POLE),
    re.compile(r"\b(?:from|zero|origin)\b\s*(?:=|:|is|at|in)?\s*(?:the\s+|due\s+)?\b(north|south)\b" + _ENDS),
    re.compile(r"\b(north|south)\b[\s-]*(?:zero|based|origin)\b"),
    re.compile(r"^\W*" + _AZ + r"\s*[:=]?\s*\b(north|south)\b"),
)
_OPTION = re.compile(r"\s*:\s*(north|south)\b[\s,]*(?:east|west)?\s*$")
_QUARTER = (
    re.compile(_SIDE + _EQUALS + r"(?P<sign>[+-]?)(?P<angle>90|270)" + _DEG),
    re.compile(r"(?<![\d.])(?P<sign>[+-]?)(?P<angle>90|270)" + _DEG + _EQUALS + _SIDE),
)


def stated_in(text: str) -> set[Convention]:
    """The conventions that a line of a header states; what it says of other files ("unlike …") does not count."""
    line = _OTHER.sub(" ", text.lower())
    found = {Convention(_SIDES[m.group(1)[0]], _SIDES[m.group("side")[0]]) for m in _THROUGH.finditer(line)}
    if found:
        return found
    alone = _OPTION.match(line)
    poles = {alone[1]} if alone else {_SIDES[m.group(1)[0]] for pattern in _ZERO for m in pattern.finditer(line)}
    quarter = next((m for pattern in _QUARTER if (m := pattern.search(line))), None)
    if not (alone or quarter or re.search(_AZ, line)):
        return set()
    return {Convention(pole, _growing(line, pole, quarter)) for pole in poles}


def _growing(line: str, pole: str, quarter: re.Match[str] | None) -> str:
    """The side through which azimuth grows by a line that states its zero; east where it does not say."""
    if quarter:
        side = _SIDES[quarter["side"][0]]
        return _OPPOSITE[side] if (quarter["sign"] == "-") != (quarter["angle"] == "270") else side
    if "clockwise" in line:
        clockwise = "east" if pole == "north" else "west"
        return _OPPOSITE[clockwise] if re.search(r"(?:counter|anti)[\s-]*clockwise", line) else clockwise
    return "west" if re.search(r"\bwest", line) else "east"


def stated(path: Path, header: Sequence[tuple[int, str]]) -> tuple[Convention, int] | None:
    """The convention that a header states, and in which line; None where it is silent.

    Raises
    ------
    BenchsimError
        If it states two.
    """
    found = {c: number for number, text in reversed(header) for c in stated_in(text)}
    if len(found) > 1:
        said = " and ".join(f"{c} (line {n})" for c, n in sorted(found.items(), key=lambda item: item[1]))
        raise BenchsimError(f"{path}: the header states azimuths {said}; keep the one that holds")
    return next(iter(found.items()), None)


def misses(stars: Array, sky: Array, latitude: float) -> dict[Convention, float]:
    """By convention, the median angle [deg] between stars as written and as the sky has them.

    Parameters
    ----------
    stars : (n, 2) array
        Azimuth and altitude [deg].
    sky : (n, 2) array
        Hour angle, which grows westward, and declination [deg].
    latitude : float
        [rad]
    """
    hour, declination = np.radians(sky).T
    there = toward(*horizontal(latitude, declination, hour))
    out = {}
    for convention in CONVENTIONS:
        written = toward(np.radians(convention.turned(stars[:, 0])), np.radians(stars[:, 1]))
        chord = np.linalg.norm(written - there, axis=1)
        out[convention] = float(np.degrees(np.median(2 * np.arcsin(np.clip(chord / 2, 0, 1)))))
    return out


def chosen(
    path: Path, said: tuple[Convention, int] | None, missed: Mapping[Convention, float]
) -> tuple[Convention, str]:
    """The convention in force and a sentence that says why.

    Parameters
    ----------
    path : Path
    said : (Convention, int) or None
        What the header states, and in which line.
    missed : mapping
        As `misses` gives it; empty where the file holds nothing to compare with.

    Raises
    ------
    BenchsimError
        If the header is silent and no convention fits the sky, or if the sky contradicts it.
    """
    sky = "sidereal times, right ascensions and declinations"
    fit = [c for c in CONVENTIONS if missed.get(c, np.inf) < FITS_DEG]
    if said is not None:
        convention, line = said
        if fit and convention not in fit:
            raise BenchsimError(
                f"{path}, line {line}: azimuths {convention} are stated, but {sky} put the stars "
                f"{missed[convention]:.3g} deg off then, and {missed[fit[0]]:.3g} deg {fit[0]}; mend the header "
                "or the columns"
            )
        beside = f"; {sky} fit no convention, and were not used" if missed and not fit else ""
        return convention, f"Azimuths are {convention}, as the header states (line {line}){beside}."
    if len(fit) == 1:
        other = SOUTH_EAST if fit[0] == NORTH_EAST else NORTH_EAST
        return fit[0], (
            f"Azimuths are {fit[0]}, as {sky} show: stars stand {missed[fit[0]]:.2g} deg from where these put them, "
            f"and {missed[other]:.3g} deg were azimuths {other}."
        )
    if missed and not fit:
        each = " nor ".join(f"{c} (median miss {missed[c]:.3g} deg)" for c in CONVENTIONS)
        raise BenchsimError(f"{path}: azimuths fit {sky} neither {each}; mend the columns or the times, or {STATE}")
    return NORTH_EAST, (
        "Azimuths are taken from north through east, since the file does not say and nothing in it tells; were they "
        f"from south through east, AN, NPAE, CA and IA would have the other sign: {STATE}."
    )
