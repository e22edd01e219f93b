"""The board's marks: ``marks.csv``, one AprilTag 36h11 a row."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Marks
from benchsim.bench.reading import TABLE_BYTES, read_file

MARKS_HEADER = ["id", "y_mm", "z_mm", "side_mm"]
TAGS_36H11 = 587
"""Number of tags in the family 36h11; ids run from 0."""


def read_marks(path: Path) -> Marks:
    """Read ``marks.csv``: header ``id,y_mm,z_mm,side_mm``, one AprilTag 36h11 a row.

    Raises
    ------
    BenchsimError
        Naming file and line.
    """
    if not path.exists():
        raise BenchsimError(
            f"{path.name}: not there (looked in {path.parent}); add it ('benchsim board' makes one), "
            "or mend screen.marks"
        )
    try:
        text = read_file(path, TABLE_BYTES).decode("utf-8-sig")
        rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row]
    except (UnicodeDecodeError, csv.Error):
        raise BenchsimError(f"{path.name!r}: cannot be read as a CSV file; check its name and permissions") from None
    if not rows or [c.strip() for c in rows[0]] != MARKS_HEADER:
        raise BenchsimError(f"{path.name}: line 1 must read {','.join(MARKS_HEADER)}")
    ids, centres, sides = [], [], []
    for n, row in enumerate(rows[1:], 2):
        try:
            tag, y, z, side = int(row[0]), float(row[1]), float(row[2]), float(row[3])
            good = len(row) == 4 and all(abs(x) <= 1e6 for x in (y, z, side)) and side > 0 and 0 <= tag < TAGS_36H11
        except (ValueError, IndexError):
            good = False
        if not good:
            raise BenchsimError(
                f"{path.name}: line {n}: {','.join(row)[:60]!r} is not id (0 … {TAGS_36H11 - 1}), y, z, side > 0 in mm"
            )
        if tag in ids:
            raise BenchsimError(f"{path.name}: line {n}: id {tag} stands twice; each mark has its own id")
        ids.append(tag)
        centres.append((y, z))
        sides.append(side)
    if not ids:
        raise BenchsimError(f"{path.name}: no marks in it; list the board's AprilTags")
    return Marks(tuple(ids), tuple(centres), tuple(sides))
