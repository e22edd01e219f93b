"""Pointing runs of telescopes: the raw log of the MMT (`mmt_log`), or four columns (`tpoint`).

`README.md` beside this file lists the formats, their conventions and their sources.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.bench.reading import TABLE_BYTES, read_file
from benchsim.instruments.mount import conventions, history, mmt_log, tpoint
from benchsim.instruments.mount.header import Run
from benchsim.instruments.mount.records import Array, Mount, Records, Session, toward

_HEAD = 65536

SCATTER = 0.02
"""Largest rms by which altitudes may miss those of one latitude [rad]; more, and none is believed."""

LOWEST_DEG = -1.0
"""True altitude below which no star is seen."""

FEWEST_FOR_HOURS = 8
"""Stars that lie within 24 deg of azimuth only where these are hours, or by a rare choice that is worth a remark."""

APART_DEG = 1.0
"""Difference of the stated latitude from that of the stars that is worth a remark."""


def recognises(path: Path) -> bool:
    """Whether a file looks like a pointing run."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return False
    if b"\0" in head:
        return False
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    return mmt_log.recognises(lines) or any(tpoint.numbers(line) > 2 for line in lines)


def read(path: Path) -> Session:
    """Read a pointing run.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Session
        Azimuths from north through east, whichever way the file counts them; a remark says which.

    Raises
    ------
    BenchsimError
        If a line cannot be understood, the mount is not altazimuth, or azimuths fit the sky in no convention; the
        message names file and line.
    """
    lines = _lines(path)
    run = (mmt_log if mmt_log.recognises(lines) else tpoint).read(path, lines)
    _plausible(path, run)
    latitude, said = _latitude(run)
    seen = np.isfinite(run.sky).all(axis=1)
    missed = {}
    if latitude is not None and seen.sum() >= conventions.FEWEST:
        missed = conventions.misses(run.angles[seen, :2], run.sky[seen], latitude)
    convention, how = conventions.chosen(path, conventions.stated(path, run.header), missed)
    remarks = [*run.remarks, *said, how]
    if len(run.lines) >= FEWEST_FOR_HOURS and np.abs(run.angles[:, [0, 2]]).max() <= 24.0:
        remarks.append("No azimuth exceeds 24: if they are hours, write degrees; the names below are wrong then.")
    true, raw = (
        np.radians(np.column_stack([convention.turned(azimuth), altitude]))
        for azimuth, altitude in (run.angles[:, :2].T, run.angles[:, 2:].T)
    )
    names = tuple(f"star {k + 1} (line {line})" for k, line in enumerate(run.lines))
    warmth = None if run.celsius is None else history.warmth(run.celsius)
    if run.celsius is not None and not (np.abs(run.celsius) <= history.HOTTEST_C).all():
        how = "the column is not used" if warmth is None else "these are taken at the median"
        remarks.append(f"Some temperatures are no number, or beyond {history.HOTTEST_C:g} °C: {how}.")
    mount, n, stars = Mount("az-el", "sky", latitude=latitude), len(names), toward(true[:, 0], true[:, 1])
    records = Records(
        names, raw, stars, np.full((n, 3), np.nan), ("",) * n,
        travel=history.travel(mount, raw, stars),
        warmth=warmth,
    )  # fmt: skip
    return Session(printable(path.stem), path, (path,), mount, records, tuple(remarks))


def _lines(path: Path) -> list[str]:
    data = read_file(path, TABLE_BYTES)
    if b"\0" in data:
        line = data[: data.index(b"\0")].count(b"\n") + 1
        raise BenchsimError(f"{path}, line {line}: holds a NUL byte, so it is no text in UTF-8; save the file as such")
    return data.decode("utf-8-sig", errors="replace").splitlines()


def _latitude(run: Run) -> tuple[float | None, list[str]]:
    """Latitude [rad] as stated, or else from the stars; and what is to be said of it."""
    sky = np.column_stack([run.angles[:, 1], run.sky])
    sky = sky[np.isfinite(sky).all(axis=1)]
    if len(sky) < conventions.FEWEST:
        found = None
        missing = (
            "The file states no latitude, nor sidereal times with right ascensions and declinations, so that a wrong "
            "clock is not among the candidates."
        )
    else:
        found = _fitted(sky)
        missing = "Altitudes, declinations and sidereal times agree with no latitude; clocks are out."
    if run.latitude is None:
        if found is None:
            return None, [missing]
        return found, [f"Latitude {np.degrees(found):.4f} deg, from altitudes, declinations and sidereal times."]
    stated, line = run.latitude
    remark = f"Latitude {stated:.4f} deg, as the header states (line {line})."
    if found is not None and abs(np.degrees(found) - stated) > APART_DEG:
        remark = f"{remark[:-1]}, though the stars' altitudes are of latitude {np.degrees(found):.3g} deg."
    return float(np.radians(stated)), [remark]


def _fitted(sky: Array) -> float | None:
    """Latitude [rad] from altitude, hour angle and declination [deg]: sin h = sin φ sin δ + cos φ cos δ cos H."""
    altitude, hour, declination = np.radians(sky).T
    a = np.column_stack([np.sin(declination), np.cos(declination) * np.cos(hour)])
    (sine, cosine), *_ = np.linalg.lstsq(a, np.sin(altitude), rcond=None)
    misfit = np.sin(altitude) - a @ [sine, cosine]
    if np.sqrt(np.mean(misfit**2)) > SCATTER or abs(np.hypot(sine, cosine) - 1) > SCATTER:
        return None
    return float(np.arctan2(sine, cosine))


def _plausible(path: Path, run: Run) -> None:
    """Degrees, and the right columns."""
    lines, table = run.lines, run.angles
    for line, row in zip(lines, table, strict=True):
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
            f"{path}, line {lines[0]}: no angle exceeds {np.abs(table).max():.3g}: these look like radians; "
            "write degrees"
        )
    rise = np.abs(table[:, 1] - table[:, 3])
    if len(table) >= 3 and np.median(rise) > 5.0:
        raise BenchsimError(
            f"{path}, line {lines[0]}: true and read altitudes differ by {np.median(rise):.3g} deg in the median; "
            "the columns are azimuth and altitude true, azimuth and altitude as read, in deg, of one star each"
        )
