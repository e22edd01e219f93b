"""Where marks and check rules lie on a board, and where they lie in truth once the print was measured."""

from __future__ import annotations

from dataclasses import dataclass

from benchsim.bench.errors import BenchsimError
from benchsim.bench.marks import TAGS_36H11
from benchsim.bench.model import Marks

QUIET = 0.625
"""Half of a mark's place, white margin of one cell included, in units of its side."""

EDGE = 12.0
"""From the board's edge to the border marks' black [mm]: the scale with its numbers, and the marks' white margin."""

GAP = 12.0
"""Least room between the places of neighbouring marks [mm]: for a seam between two sheets."""

PITCH = 80.0 / 36.0
"""Distance of border marks in units of their side that is aimed at."""

RULE = 100.0
"""Length of the two check rules [mm]."""

RULE_BEGINS = 20.0
"""The rules reach this far beyond where they cross [mm]."""

LARGEST = 5000.0
"""Longest edge of a board [mm]: the PDF format ends at 5080."""


@dataclass(frozen=True)
class Layout:
    """A board as it is meant to be printed.

    Attributes
    ----------
    size : (2,) mm
        Along y and z.
    marks : Marks
        Border clockwise from the top left, then the inner ones in rows from the top.
    columns, rows : tuple of float, mm
        y and z of the marks' centres, ascending.
    rules_cross : (y, z) mm
        The check rules run along y and z through this point, from `RULE_BEGINS` before it on.
    """

    size: tuple[float, float]
    marks: Marks
    columns: tuple[float, ...]
    rows: tuple[float, ...]
    rules_cross: tuple[float, float]

    @property
    def rules(self) -> tuple[tuple[float, float, float, float], tuple[float, float, float, float]]:
        """(y, z) to (y, z) of the rule along y, and of that along z [mm]."""
        y, z = self.rules_cross
        start, end = -RULE_BEGINS, RULE - RULE_BEGINS
        return (y + start, z, y + end, z), (y, z + start, y, z + end)


def lay_out(size: tuple[float, float] = (700.0, 700.0), side: float = 36.0) -> Layout:
    """Marks all round the border, and inside at every second of their columns and rows, the centre left free.

    Parameters
    ----------
    size : (2,) mm
        Of the board along y and z.
    side : float
        Of a mark's black square [mm].

    Raises
    ------
    BenchsimError
        If the board has no room for the marks or the check rules, or too much.
    """
    if not (side >= 8 and all(side < s <= LARGEST for s in size)):
        raise BenchsimError(
            f"board: marks of {side:g} mm on {size[0]:g} × {size[1]:g} mm cannot be drawn; give --side-mm of 8 or more "
            f"and a --size-mm between it and {LARGEST:g}"
        )
    columns, rows = (_nodes(s - 2 * EDGE - side, side) for s in size)
    left, bottom = columns[0], rows[0]
    centres = [(y, rows[-1]) for y in columns]
    centres += [(columns[-1], z) for z in rows[-2::-1]]
    centres += [(y, bottom) for y in columns[-2::-1]]
    centres += [(left, z) for z in rows[1:-1]]
    middle = (len(columns) // 2, len(rows) // 2)
    centres += [
        (columns[i], rows[j])
        for j in range(len(rows) - 3, 1, -2)
        for i in range(2, len(columns) - 2, 2)
        if (i, j) != middle
    ]
    if len(centres) > TAGS_36H11:
        raise BenchsimError(
            f"board: {len(centres)} marks, but the family 36h11 has {TAGS_36H11}; give a larger --side-mm"
        )
    marks = Marks(tuple(range(len(centres))), tuple(centres), (side,) * len(centres))
    cross = ((columns[0] + columns[1]) / 2, (rows[0] + rows[1]) / 2)
    if any(c + RULE - RULE_BEGINS > s / 2 - EDGE for c, s in zip(cross, size, strict=True)):
        raise BenchsimError(
            f"board: {size[0]:g} × {size[1]:g} mm has no room for the check rule of {RULE:g} mm; give a larger "
            "--size-mm or a smaller --side-mm"
        )
    return Layout(size, marks, columns, rows, cross)


def _nodes(length: float, side: float) -> tuple[float, ...]:
    """Centres along one axis: an even number of intervals near `PITCH`, with room between the marks."""
    least = 2 * QUIET * side + GAP
    count = 2 * max(1, round(length / (2 * PITCH * side)))
    while count > 2 and length / count < least:
        count -= 2
    if length / count < least:
        raise BenchsimError(
            f"board: marks of {side:g} mm need {2 * least + side + 2 * EDGE:.0f} mm along each edge; give a larger "
            "--size-mm or a smaller --side-mm"
        )
    # From the middle outward: symmetric to the last bit.
    return tuple(length / count * (i - count // 2) for i in range(count + 1))


def corrected(marks: Marks, measured: tuple[float, float], over: float = RULE) -> Marks:
    """Marks where the printer put them, by what a ruler says of it.

    Parameters
    ----------
    marks : Marks
        As they were meant.
    measured : (2,) mm
        What the ruler reads along y and along z.
    over : float
        What was measured, as it was meant [mm]: 100 for the check rules, more for a part of the scales.

    Raises
    ------
    BenchsimError
        If a reading is more than a tenth off: then it is another length that was measured.

    Notes
    -----
    A mark's side is one number in ``marks.csv``: it gets the mean of both factors. Where they differ by 0.5 % the
    corners of a mark of 36 mm are 0.05 mm off, in opposite directions, which poses do not notice.
    """
    factors = tuple(m / over for m in measured)
    if not all(0.9 < f < 1.1 for f in factors):
        raise BenchsimError(
            f"board: --measured-mm {measured[0]:g} {measured[1]:g} is more than a tenth off {over:g} mm; measure the "
            "check rules, or say with --over-mm what else was measured; a print 'fitted to the page' is no use"
        )
    fy, fz = factors
    return Marks(
        marks.ids, tuple((y * fy, z * fz) for y, z in marks.centres), tuple(s * (fy + fz) / 2 for s in marks.sides)
    )
