"""Pointing runs of telescopes: the raw log of the MMT, and TPOINT's four columns.

The log holds blocks of lines ``KEY: values``; of each star ``RAA`` (altitude and azimuth of the encoders) and ``TAA``
(true ones, both in degrees, azimuth from north through east) are used, ``LST`` with ``ARD`` (right ascension in hours,
declination in degrees) to find the latitude. The four columns are azimuth and altitude of the star, then azimuth and
altitude as read, in degrees; anything before the first line of four numbers is a header.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.records import Array, Mount, Records, Session, toward

_KEYED = re.compile(r"^\s*(RAA|TAA|LST|ARD|CAT)\s*:\s*(.*)$")
_HEAD = 65536

SCATTER = 0.02
"""Largest rms by which altitudes of the log may miss those of one latitude [rad]; more, and none is believed."""

LOWEST_DEG = -1.0
"""True altitude below which no star is seen."""

FEWEST_FOR_HOURS = 8
"""Stars that lie within 24 deg of azimuth only where these are hours, or by a rare choice that is worth a remark."""


def recognises(path: Path) -> bool:
    """Whether a file looks like a pointing run."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return False
    if b"\0" in head:
        return False
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    keyed = {m.group(1) for line in lines if (m := _KEYED.match(line))}
    return bool({"RAA", "TAA"} & keyed) or any(_numerical(_bare(line)) > 2 for line in lines)


def read(path: Path) -> Session:
    """Read a pointing run.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Session

    Raises
    ------
    BenchsimError
        If a line cannot be understood; the message names file and line.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise BenchsimError(f"{path}: cannot be read ({error.strerror}); name a pointing file") from None
    keyed = {m.group(1) for line in lines if (m := _KEYED.match(line))}
    if {"RAA", "TAA"} & keyed:
        rows, latitude, remarks = _log(path, lines)
    else:
        rows, latitude, remarks = _columns(path, lines)
    table = np.array([r[1] for r in rows], float).reshape(-1, 4)
    numbers = [r[0] for r in rows]
    _plausible(path, numbers, table)
    if len(table) >= FEWEST_FOR_HOURS and np.abs(table[:, [0, 2]]).max() <= 24.0:
        remarks.append("No azimuth exceeds 24: if they are hours, write degrees; the names below are wrong then.")
    true, raw = np.radians(table[:, :2]), np.radians(table[:, 2:])
    names = tuple(f"star {k + 1} (line {line})" for k, line in enumerate(numbers))
    records = Records(names, raw, toward(true[:, 0], true[:, 1]), np.full((len(names), 3), np.nan), ("",) * len(names))
    mount = Mount("az-el", "sky", latitude=latitude)
    return Session(path.stem, path, (path,), mount, records, tuple(remarks))


def _log(path: Path, lines: Sequence[str]) -> tuple[list[tuple[int, list[float]]], float | None, list[str]]:
    """(line, [azimuth, altitude true; azimuth, altitude raw]) of every star, the latitude, remarks."""
    rows: list[tuple[int, list[float]]] = []
    sky: list[tuple[float, float, float]] = []
    pending: dict[str, list[float]] = {}
    where = 0
    remarks: list[str] = []

    def close() -> None:
        if "RAA" in pending or "TAA" in pending:
            missing = next((k for k in ("RAA", "TAA") if k not in pending), None)
            if missing:
                remarks.append(f"{path.name}, line {where}: this star has no {missing}, and was left out.")
                return
            raw, true = pending["RAA"], pending["TAA"]
            rows.append((where, [true[1], true[0], raw[1], raw[0]]))
            if "LST" in pending and "ARD" in pending:
                hours, (ascension, declination) = pending["LST"][0], pending["ARD"]
                sky.append((true[0], declination, 15 * (hours - ascension)))

    for number, line in enumerate(lines, 1):
        match = _KEYED.match(line)
        if not match:
            continue
        key, text = match.groups()
        if key == "CAT" or (key in ("RAA", "TAA") and key in pending):
            close()
            pending = {}
        if key == "CAT":
            continue
        if key == "RAA" or not pending:
            where = number
        pending[key] = [_sexagesimal(path, number, text)] if key == "LST" else _numbers(path, number, key, text)
    close()
    if not rows:
        raise BenchsimError(f"{path}: no star has both RAA and TAA; name a complete log")
    latitude, remark = _latitude(sky)
    return rows, latitude, [*remarks, *remark]


def _latitude(sky: Sequence[tuple[float, float, float]]) -> tuple[float | None, list[str]]:
    """Latitude [rad] from altitude, declination and hour angle [deg]: sin h = sin φ sin δ + cos φ cos δ cos H."""
    if len(sky) < 3:
        return None, ["The log holds no sidereal times, so that a wrong clock is not among the candidates."]
    altitude, declination, hour = np.radians(np.array(sky)).T
    a = np.column_stack([np.sin(declination), np.cos(declination) * np.cos(hour)])
    (sine, cosine), *_ = np.linalg.lstsq(a, np.sin(altitude), rcond=None)
    misfit = np.sin(altitude) - a @ [sine, cosine]
    if np.sqrt(np.mean(misfit**2)) > SCATTER or abs(np.hypot(sine, cosine) - 1) > SCATTER:
        return None, ["Altitudes, declinations and sidereal times of the log agree with no latitude; clocks are out."]
    return float(np.arctan2(sine, cosine)), []


def _columns(path: Path, lines: Sequence[str]) -> tuple[list[tuple[int, list[float]]], float | None, list[str]]:
    rows: list[tuple[int, list[float]]] = []
    remarks = ["The file states no latitude, so that a wrong clock is not among the candidates."]
    for number, line in enumerate(lines, 1):
        text = _bare(line)
        if not text:
            continue
        if rows and text.upper() == "END":
            break
        values = _four(text)
        if values is not None:
            rows.append((number, values))
        elif not rows and _numerical(text) == 3 and len(_parts(text)) == 4:
            remarks.append(f"Line {number}, {text[:40]!r}, is taken for a header, since it is not four numbers.")
        elif rows:
            raise BenchsimError(
                f"{path}, line {number}: {text[:40]!r} is not four numbers (azimuth and altitude of the star, azimuth "
                "and altitude as read, deg); mend or remove the line"
            )
    if not rows:
        first = next((n for n, text in enumerate(lines, 1) if _numerical(_bare(text)) > 2), None)
        raise BenchsimError(
            f"{path}{'' if first is None else f', line {first}'}: holds neither RAA and TAA lines nor four columns of "
            "numbers (azimuth and altitude of the star, azimuth and altitude as read, deg); name a pointing file"
        )
    return rows, None, remarks


def _bare(line: str) -> str:
    """A line of columns without its comment."""
    return line.split("#", 1)[0].split("!", 1)[0].strip()


def _parts(text: str) -> list[float | None]:
    """The fields of a line, those that are no numbers as None."""

    def one(part: str) -> float | None:
        try:
            return float(part)
        except ValueError:
            return None

    return [one(part) for part in re.split(r"[\s,;]+", text.strip(" \t,;"))]


def _numerical(text: str) -> int:
    """How many fields are numbers."""
    return sum(part is not None for part in _parts(text))


def _four(line: str) -> list[float] | None:
    found = [part for part in _parts(line) if part is not None]
    return found if len(found) == 4 == len(_parts(line)) else None


def _numbers(path: Path, number: int, key: str, text: str) -> list[float]:
    try:
        values = [float(p) for p in text.split()[:2]]
    except ValueError:
        values = []
    if len(values) != 2 or not np.isfinite(values).all():
        raise BenchsimError(
            f"{path}, line {number}: {key}: {text.strip()!r} is not two numbers; mend or remove the star"
        )
    return values


def _sexagesimal(path: Path, number: int, text: str) -> float:
    try:
        hours, minutes, seconds = (float(p) for p in text.strip().split(":"))
        if not np.isfinite(hours + minutes + seconds):
            raise ValueError
    except ValueError:
        raise BenchsimError(
            f"{path}, line {number}: LST: {text.strip()!r} is not hours:minutes:seconds; mend or remove the line"
        ) from None
    return hours + minutes / 60 + seconds / 3600


def _plausible(path: Path, numbers: Sequence[int], table: Array) -> None:
    """Degrees, and the right columns."""
    for line, row in zip(numbers, table, strict=True):
        if not np.isfinite(row).all():
            raise BenchsimError(f"{path}, line {line}: a number is not finite; mend or remove the line")
        if max(abs(row[1]), abs(row[3])) > 90.0 + 1.0 or max(abs(row[0]), abs(row[2])) > 720.0:
            raise BenchsimError(
                f"{path}, line {line}: altitude {row[1]:g} and {row[3]:g} deg, azimuth {row[0]:g} and {row[2]:g} deg "
                "are no directions; the columns are azimuth and altitude true, azimuth and altitude as read, in deg "
                "(before a line of a header write !)"
            )
        if row[1] < LOWEST_DEG:
            raise BenchsimError(f"{path}, line {line}: altitude {row[1]:g} deg is below the horizon; remove the line")
    if len(table) >= 3 and np.abs(table).max() <= 2 * np.pi:
        raise BenchsimError(
            f"{path}, line {numbers[0]}: no angle exceeds {np.abs(table).max():.3g}: these look like radians; "
            "write degrees"
        )
    rise = np.abs(table[:, 1] - table[:, 3])
    if len(table) >= 3 and np.median(rise) > 5.0:
        raise BenchsimError(
            f"{path}, line {numbers[0]}: true and read altitudes differ by {np.median(rise):.3g} deg in the median; "
            "the columns are azimuth and altitude true, azimuth and altitude as read, in deg, of one star each"
        )
