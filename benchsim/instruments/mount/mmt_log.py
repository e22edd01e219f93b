"""The raw log of the MMT's pointing runs: blocks of lines ``KEY: values``.

Of each star ``RAA`` (altitude and azimuth of the encoders) and ``TAA`` (true ones, both in degrees) are used, and
``LST`` with ``ARD`` (right ascension in hours, declination in degrees) to find the latitude and which way azimuths run.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import header
from benchsim.instruments.mount.header import Run

_KEYED = re.compile(r"^\s*(RAA|TAA|LST|ARD|CAT)\s*:\s*(.*)$")


def recognises(lines: Sequence[str]) -> bool:
    """Whether a file holds such blocks."""
    return any(m.group(1) in ("RAA", "TAA") for line in lines if (m := _KEYED.match(line)))


def read(path: Path, lines: Sequence[str]) -> Run:
    """Read a log's lines.

    Raises
    ------
    BenchsimError
        If a line cannot be understood, or no star is whole; the message names file and line.
    """
    first = next(k for k, line in enumerate(lines) if _KEYED.match(line))
    above = list(enumerate(lines[:first], 1))
    remarks = header.mount_remarks(path, above)
    rows: list[tuple[int, list[float]]] = []
    sky: list[list[float]] = []
    pending: dict[str, list[float]] = {}
    where = 0

    def close() -> None:
        if "RAA" in pending or "TAA" in pending:
            missing = next((k for k in ("RAA", "TAA") if k not in pending), None)
            if missing:
                remarks.append(f"{path.name}, line {where}: this star has no {missing}, and was left out.")
                return
            raw, true = pending["RAA"], pending["TAA"]
            rows.append((where, [true[1], true[0], raw[1], raw[0]]))
            whole = "LST" in pending and "ARD" in pending
            sky.append([15 * (pending["LST"][0] - pending["ARD"][0]), pending["ARD"][1]] if whole else [np.nan] * 2)

    for number, line in enumerate(lines[first:], first + 1):
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
    return Run(
        tuple(n for n, _ in rows),
        np.array([r for _, r in rows]),
        np.array(sky),
        above,
        header.latitude(path, above),
        tuple(remarks),
    )


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
