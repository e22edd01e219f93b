"""TPOINT's four columns: azimuth and altitude of the star, azimuth and altitude as read.

Degrees, or degrees, minutes and seconds (``119:42:00``, ``119d42m00s``, or each in a column of its own). Columns are
separated by blanks, semicolons or commas; a comma within every number is a decimal one. Further columns (rotator,
flags, names) are read over; if the line above the stars names as many columns as they have, and LST, RA and DEC among
them, these say which way azimuths run. A backslash at its end continues a line. The header ends with the first line of
four angles, the stars with the file or ``END``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import header
from benchsim.instruments.mount.header import Lines, Run, comment_cut
from benchsim.instruments.mount.records import Array

COLUMNS = "the columns are azimuth and altitude of the star, azimuth and altitude as read, in deg"

_SEXAGESIMAL = re.compile(
    r"([+-]?)(\d{1,3})[:dh°\ufffd](\d{1,2}(?:\.\d*)?)(?:[:m'′](\d{1,2}(?:\.\d*)?)?(?:s|\"|″|'')?)?", re.IGNORECASE
)
_WHOLE = re.compile(r"[+-]?\d+")
_DECIMAL = re.compile(r"[+-]?\d+(?:\.\d+)?")

Fields = Sequence[str]


def numbers(text: str) -> int:
    """How many fields of a line are numbers or angles."""
    return sum(_value(field) is not None for field in _fields(comment_cut(text), False))


def read(path: Path, lines: Sequence[str]) -> Run:
    """Read columns.

    Raises
    ------
    BenchsimError
        If a line cannot be understood, or there is none of four angles; the message names file, line and column.
    """
    joined = _joined(lines)
    comma = any(_has_decimal_commas(text) for _, text in joined)
    split = [(number, _fields(text, comma)) for number, text in joined]
    start = next((k for k, (n, f) in enumerate(split) if _is_star(f) and not header.is_parameters(lines[n - 1])), None)
    above = list(enumerate(lines[: split[start][0] - 1] if start is not None else lines, 1))
    remarks = header.mount_remarks(path, above)
    if start is None:
        first = next((n for n, text in enumerate(lines, 1) if numbers(text) > 2), None)
        raise BenchsimError(
            f"{path}{'' if first is None else f', line {first}'}: holds neither RAA and TAA lines nor four columns of "
            "numbers (azimuth and altitude of the star, azimuth and altitude as read, deg); name a pointing file"
        )
    for number, fields in split[:start]:
        if len(fields) == 4 and sum(_value(f) is not None for f in fields) == 3:
            text = " ".join(fields)[:40]
            remarks.append(f"Line {number}, {text!r}, is taken for a header, since it is not four numbers.")
    end = next((k for k, (_, f) in enumerate(split) if k > start and f[0].upper() == "END"), None)
    stars = split[start:end]
    angles = _angles(path, stars)
    sky, celsius = _sky(path, above, stars), _celsius(above, stars)
    return Run(tuple(n for n, _ in stars), angles, sky, above, header.latitude(path, above), tuple(remarks), celsius)


def _joined(lines: Sequence[str]) -> list[tuple[int, str]]:
    """Lines that hold something, without comments, continued ones joined."""
    out: list[tuple[int, str]] = []
    goes_on = False
    for number, line in enumerate(lines, 1):
        text = comment_cut(line)
        if goes_on:
            out[-1] = (out[-1][0], f"{out[-1][1]} {text.rstrip(chr(92))}")
        elif text:
            out.append((number, text.rstrip(chr(92))))
        goes_on = text.endswith(chr(92))
    return [(number, text) for number, text in out if text.strip(" \t,;")]


def _has_decimal_commas(text: str) -> bool:
    fields = _fields(text, True)[:4]
    within = any(re.search(r"\d,\d", field) for field in re.split(r"[\s;]+", text))
    return len(fields) == 4 and within and all(_DECIMAL.fullmatch(f) or _SEXAGESIMAL.fullmatch(f) for f in fields)


def _fields(text: str, comma: bool) -> Fields:
    """The fields of a line, commas as separators or within numbers."""
    if not comma:
        return re.split(r"[\s,;]+", text.strip(" \t,;"))
    return [field.strip(",").replace(",", ".", 1) for field in re.split(r"[\s;]+", text.strip(" \t;"))]


def _value(field: str) -> float | None:
    """A number or an angle, minutes and seconds not yet checked."""
    match = _SEXAGESIMAL.fullmatch(field)
    if match:
        return _sum(match[1] == "-", float(match[2]), float(match[3]), float(match[4] or 0))
    try:
        return float(field.removesuffix("°"))
    except ValueError:
        return None


def _sum(negative: bool, degrees: float, minutes: float, seconds: float) -> float:
    value = abs(degrees) + minutes / 60 + seconds / 3600
    return -value if negative else value


def _is_star(fields: Fields) -> bool:
    return len(fields) >= 4 and all(_value(f) is not None for f in fields[:4])


def _leading(fields: Fields) -> int:
    """How many fields from the first on are numbers."""
    return next((k for k, f in enumerate(fields) if _value(f) is None), len(fields))


def _angles(path: Path, stars: Sequence[tuple[int, Fields]]) -> Array:
    """The four angles of every star [deg], (n, 4)."""
    if _is_mean_place(stars[0][1]):
        raise BenchsimError(
            f"{path}, line {stars[0][0]}: holds right ascension and declination of a star (a mean place), as of an "
            f"equatorial mount; only azimuths and altitudes are read ({COLUMNS})"
        )
    wide = 3 if _in_parts(stars[0][1]) else 1
    usual = max(Counter(_leading(fields) for _, fields in stars).most_common(1)[0][0], 4 * wide)
    out = []
    for number, fields in stars:
        count = _leading(fields)
        if count < usual:
            broken = f"{fields[count]!r} is no number" if count < len(fields) else "is missing"
            raise BenchsimError(
                f"{path}, line {number}, column {count + 1}: {broken}, where other lines have {usual} numbers "
                f"({COLUMNS}); mend or remove the line"
            )
        if count > usual and _in_parts(fields) != (wide == 3):
            raise BenchsimError(
                f"{path}, line {number}, column 5: degrees, minutes and seconds, where the first star's line "
                "has degrees; write all lines in one way"
            )
        out.append([_angle(path, number, k * wide, fields[k * wide : (k + 1) * wide]) for k in range(4)])
    found = np.array(out)
    if wide == 3 and len(found) >= 8 and np.abs(found[:, [0, 2]]).max() <= 24.0:
        raise BenchsimError(
            f"{path}, line {stars[0][0]}: no first angle exceeds 24: these are right ascensions and declinations, as "
            "of an equatorial mount; only azimuths and altitudes are read"
        )
    return found


def _in_parts(fields: Fields) -> bool:
    """Whether degrees, minutes and seconds stand in columns of their own: then true and read altitudes agree better."""
    parts = fields[:12]
    if _leading(parts) < 12 or not all(_WHOLE.fullmatch(parts[k]) for k in (0, 1, 3, 4, 6, 7, 9, 10)):
        return False
    values = [_value(f) or 0.0 for f in parts]
    as_parts = abs(values[3] - values[9]) + abs(values[4] - values[10]) / 60
    return as_parts < abs(values[1] - values[3])


def _is_mean_place(fields: Fields) -> bool:
    """Whether a line begins with h m s, d m s, two proper motions and an equinox."""
    if _leading(fields) < 9 or not all(_WHOLE.fullmatch(fields[k]) for k in (0, 1, 3, 4)):
        return False
    return 1850 <= (_value(fields[8]) or 0.0) <= 2150


def _angle(path: Path, number: int, column: int, fields: Fields) -> float:
    """An angle [deg] of one field, or of three: degrees, minutes, seconds."""
    where = f"{path}, line {number}, column {column + 1}: {' '.join(fields)!r}"
    match = _SEXAGESIMAL.fullmatch(fields[0])
    parts = [fields[0].lstrip("+-"), *fields[1:]] if match is None else [match[2], match[3], match[4] or "0"]
    values = [_value(part) for part in parts]
    if not np.isfinite([np.nan if v is None else v for v in values]).all():
        raise BenchsimError(f"{where} is not finite; mend or remove the line")
    degrees, minutes, seconds = (*(float(v or 0) for v in values), 0.0, 0.0)[:3]
    if not (0 <= minutes < 60 and 0 <= seconds < 60):
        raise BenchsimError(f"{where}: minutes and seconds go from 0 to 60; mend or remove the line")
    return _sum(fields[0].startswith("-"), degrees, minutes, seconds)


def _sky(path: Path, above: Lines, stars: Sequence[tuple[int, Fields]]) -> Array:
    """Hour angle and declination [deg] of stars whose columns are named, (n, 2); nan where they are not.

    LST and RA are in hours, unless their names say ``deg``.
    """
    found = _named(above, stars, ["lst", "ra", "dec"])
    if found is None:
        return np.full((len(stars), 2), np.nan)
    at, names = found
    lst, ra, dec = np.array([[_angle(path, n, k, f[k : k + 1]) for k in at] for n, f in stars]).T
    in_hours = [1.0 if "deg" in name else 15.0 for name in names]
    return np.column_stack([in_hours[0] * lst - in_hours[1] * ra, dec])


def _celsius(above: Lines, stars: Sequence[tuple[int, Fields]]) -> Array | None:
    """Temperature at every star, nan where it is no number; None where no column is named so."""
    found = _named(above, stars, ["temp(?:erature)?(?:_?(?:deg)?_?c)?$"])
    if found is None:
        return None
    return np.array([np.nan if (value := _value(f[found[0][0]])) is None else value for _, f in stars])


def _named(
    above: Lines, stars: Sequence[tuple[int, Fields]], keys: Sequence[str]
) -> tuple[list[int], list[str]] | None:
    """Numbers and names of columns, if a line above the stars has a name for each of theirs."""
    for _, text in reversed(above):
        names = [n for n in re.split(r"[\s,;|]+", text.strip(" \t#!:,;|").lower()) if n]
        at = [next((k for k, n in enumerate(names) if re.match(rf"{key}(?![a-z])", n)), -1) for key in keys]
        if min(at) >= 0 and all(len(fields) == len(names) for _, fields in stars):
            return at, [names[k] for k in at]
    return None
