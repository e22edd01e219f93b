"""A board cut into sheets of paper: seams run between the marks, so that every mark is whole on one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from benchsim.bench.errors import BenchsimError
from benchsim.boards.drawing import HAIR, THIN, Line, Words, occupied
from benchsim.boards.layout import Layout

PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of papers, upright [mm]."""

MARGIN = 10.0
"""What printers leave white all round [mm]."""

OVERLAP = 10.0
"""Width of the strip that two neighbouring sheets both show [mm]."""

CROSS_EVERY = 60.0
"""Crosses along a seam are at most this far apart [mm]."""


@dataclass(frozen=True)
class Tile:
    """One page: the window of the board it shows and what is printed on it for the joining.

    Attributes
    ----------
    paper : (2,) mm
        Width and height of the page.
    low, high : (y, z) mm
        Corners of the window; ``low`` lies at (`MARGIN`, `MARGIN`) from the page's lower left.
    lines, words
        In the board's millimetres; the words, unlike the board's own, may lie in the page's margin.
    """

    paper: tuple[float, float]
    low: tuple[float, float]
    high: tuple[float, float]
    lines: tuple[Line, ...] = ()
    words: tuple[Words, ...] = ()


def whole(layout: Layout) -> Tile:
    """The board on one large sheet."""
    w, h = layout.size
    return Tile((w + 2 * MARGIN, h + 2 * MARGIN), (-w / 2, -h / 2), (w / 2, h / 2))


def tiles(layout: Layout, paper: str) -> list[Tile]:
    """The board on sheets of a paper, by rows from the top; upright or lengthwise, whatever needs fewer.

    Raises
    ------
    BenchsimError
        If the marks leave no place for a seam within a sheet.
    """
    upright = PAPERS[paper]
    options = [_tiles(layout, page) for page in (upright, upright[::-1])]
    possible = [option for option in options if option]
    if not possible:
        raise BenchsimError(
            f"board: marks of {layout.marks.sides[0]:g} mm do not fit on {paper} sheets with a seam between them; give "
            "a smaller --side-mm or --paper sheet"
        )
    return min(possible, key=len)


def _tiles(layout: Layout, page: tuple[float, float]) -> list[Tile]:
    used = occupied(layout)
    columns, rows = (_cuts(s, p - 2 * MARGIN, u) for s, p, u in zip(layout.size, page, used, strict=True))
    if columns is None or rows is None:
        return []
    windows_y, windows_z = _windows(columns), _windows(rows)
    out = []
    for j in range(len(windows_z) - 1, -1, -1):
        for i, (left, right) in enumerate(windows_y):
            bottom, top = windows_z[j]
            lines = _seams(columns[1:-1], (left, right), (bottom, top), upright=True)
            lines += _seams(rows[1:-1], (bottom, top), (left, right), upright=False)
            words = Words(
                (left, bottom - 3.5),
                f"row {len(windows_z) - j} of {len(windows_z)} from the top, column {i + 1} of {len(windows_y)} from "
                "the left. Cut along one sheet's dashed line and lay it on its neighbour's, cross on cross.",
                anchor="left",
                height=2.0,
            )
            out.append(Tile(page, (left, bottom), (right, top), tuple(lines), (words,)))
    return out


def _cuts(length: float, printable: float, used: Sequence[tuple[float, float]]) -> list[float] | None:
    """Edges and seams along one axis: every seam as far on as a sheet reaches and the marks allow."""
    cuts, half = [-length / 2], OVERLAP / 2
    while True:
        start = cuts[-1] - (half if len(cuts) > 1 else 0.0)
        if start + printable >= length / 2:
            return [*cuts, length / 2]
        cut = start + printable - half
        for low, high in sorted(used, reverse=True):
            if low - half < cut < high + half:
                cut = low - half
        if cut <= cuts[-1] + half:
            return None
        cuts.append(cut)


def _windows(cuts: Sequence[float]) -> list[tuple[float, float]]:
    half = OVERLAP / 2
    last = len(cuts) - 2
    return [(a - (half if i else 0.0), b + (half if i < last else 0.0)) for i, (a, b) in enumerate(pairwise(cuts))]


def _seams(
    cuts: Sequence[float], window: tuple[float, float], along: tuple[float, float], *, upright: bool
) -> list[Line]:
    """Dashed ends and crosses of the seams within a window; the crosses lie where both sheets show them."""
    lines = []

    def place(c: float, a: float) -> tuple[float, float]:
        return (c, a) if upright else (a, c)

    for c in (c for c in cuts if window[0] < c < window[1]):
        count = int((along[1] - along[0]) // 4)
        for k in range(count):
            a = along[0] + 4 * k
            lines.append(Line(place(c, a), place(c, a + 1.0), HAIR))
        first = int(along[0] // CROSS_EVERY) + 1
        for n in range(first, int(along[1] // CROSS_EVERY) + 1):
            a = n * CROSS_EVERY
            lines += [Line(place(c - 4, a), place(c + 4, a), THIN), Line(place(c, a - 4), place(c, a + 4), THIN)]
    return lines
