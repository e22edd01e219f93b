"""A pointing run as it is written, and what its header says of mount and latitude.

TPOINT's header: a caption, options (``: ALTAZ``), the run's parameters (latitude in degrees, minutes and seconds, then
perhaps date and weather). Comments begin with ``!`` or ``#`` and are read, too.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.records import Array

Lines = Sequence[tuple[int, str]]
"""Numbered lines, as they are written."""

ALTAZIMUTH = {"ALTAZ", "AZALT", "AZEL"}

OTHER_MOUNTS = {
    "EQUAT": "an equatorial mount",
    "HADEC": "an equatorial mount",
    "GIMBAL": "a gimbal whose axes point anywhere",
    "XY": "an X-Y mount",
    "ALTALT": "an alt-alt mount",
}
"""Option → the mount that it states."""

NO_ABERRATION = "NODA"
"""The stars' places are without diurnal aberration."""

HARMLESS = re.compile(r"ROT\w*|ALLSKY|NODA|AZ(?:IMUTHS?)?|FROM|NORTH|SOUTH|THROUGH|EAST|WEST")
"""Options that say nothing of the mount: rotator, sky plots, aberration, and azimuths, which `conventions` reads."""

_DATED = r"(?=\s*$|\s+(?:19|20)\d\d\b|\s+[^\d\s.+-])"
_PARAMETERS = re.compile(r"^\s*([+-]?)(\d{1,3})\s+(\d{1,2})\s+(\d{1,2}(?:\.\d*)?)" + _DATED)
_ALONE = re.compile(r"^\s*([+-]?)(\d{1,2}(?:\.\d*)?)\s*$")
_NAMED = re.compile(
    r"\blat(?:itude)?\b\.?(?:\s*\(?deg\w*\)?)?\s*(?:is|=|:)?\s*([+-]?)(\d{1,3}(?![\d.])|\d{1,3}\.\d*)"
    r"(?:(?:\s*(?:deg\w*|[d°:])\s*|\s+)(\d{1,2}(?:\.\d+)?)(?![\d.]))?"
    r"(?:(?:\s*(?:min\w*|['m:′])\s*|\s+)(\d{1,2}(?:\.\d+)?)(?![\d.]))?"
    r"(?:\s*(?:sec\w*|deg\w*|[\"″°]|(?-i:s)\b))?\s*((?-i:[NS])|north|south)?(?!\w)",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Run:
    """A pointing run as it is written.

    Attributes
    ----------
    lines : (n,) tuple of int
        Where the stars stand in the file.
    angles : (n, 4) array
        Azimuth and altitude of the star, azimuth and altitude as read [deg], azimuths as they are written.
    sky : (n, 2) array
        Hour angle and declination [deg]; nan where the file has none.
    header : sequence of (int, str)
        The lines above the stars.
    latitude : (float, int) or None
        What the header states [deg], and in which line.
    remarks : tuple of str
    celsius : (n,) array or None
        Temperature at every star.
    """

    lines: tuple[int, ...]
    angles: Array
    sky: Array
    header: Lines
    latitude: tuple[float, int] | None
    remarks: tuple[str, ...]
    celsius: Array | None = None


def comment_cut(text: str) -> str:
    """A line without its comment."""
    return text.split("#", 1)[0].split("!", 1)[0].strip()


def is_parameters(text: str) -> bool:
    """Whether a line is TPOINT's run parameters, and no star."""
    return bool(_PARAMETERS.match(comment_cut(text)))


def options(text: str) -> tuple[str, ...]:
    """The options that a line holds: behind a colon, or nothing but words of which one states the mount."""
    bare = comment_cut(text).upper()
    words = tuple(re.split(r"[\s,;:]+", bare.strip(" :,;")))
    if bare.startswith(":"):
        return words if words != ("",) else ()
    mounts = {*ALTAZIMUTH, "EQUAT"}
    return words if words[0] in mounts and all(w in mounts or HARMLESS.fullmatch(w) for w in words) else ()


def mount_remarks(path: Path, header: Lines) -> list[str]:
    """What the options leave open.

    Raises
    ------
    BenchsimError
        If they state a mount that is not altazimuth.
    """
    stated = {word: number for number, text in reversed(header) for word in options(text)}
    for word, number in stated.items():
        if word in OTHER_MOUNTS:
            raise BenchsimError(
                f"{path}, line {number}: option {word} states {OTHER_MOUNTS[word]}; only altazimuth mounts "
                "(: ALTAZ) are diagnosed"
            )
    if NO_ABERRATION in stated and not ALTAZIMUTH & set(stated):
        raise BenchsimError(
            f"{path}, line {stated[NO_ABERRATION]}: option {NO_ABERRATION} (places without diurnal aberration) stands "
            "without : ALTAZ, which makes it a run of an equatorial mount; only altazimuth mounts are diagnosed (write "
            ": ALTAZ if it is one)"
        )
    return [
        f"Option {word} (line {number}) is not known here, and was left aside."
        for word, number in stated.items()
        if word not in ALTAZIMUTH and not HARMLESS.fullmatch(word)
    ]


def latitude(path: Path, header: Lines) -> tuple[float, int] | None:
    """The latitude [deg] that a header states and in which line.

    Raises
    ------
    BenchsimError
        If it is none.
    """
    optional = False
    for number, text in header:
        optional |= bool(options(text))
        match = _PARAMETERS.match(comment_cut(text)) or _NAMED.search(text)
        if match is None and optional:
            match = _ALONE.match(comment_cut(text))
        if match is None:
            continue
        sign, degrees, minutes, seconds, side, *_ = (*match.groups(), None, None, None)
        if "." in degrees:
            minutes = seconds = None
        parts = [float(part or 0) for part in (degrees, minutes, seconds)]
        value = parts[0] + parts[1] / 60 + parts[2] / 3600
        if value > 90 or max(parts[1:]) >= 60:
            raise BenchsimError(
                f"{path}, line {number}: {match.group().strip()!r} is no latitude; write degrees, minutes and seconds"
            )
        south = sign == "-" or (side or "").upper().startswith("S")
        return -value if south else value, number
    return None
