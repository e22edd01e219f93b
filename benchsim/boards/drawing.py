"""What is printed on a board: filled shapes, lines and words in its own millimetres, whatever file they end in."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.boards.layout import EDGE, QUIET, RULE, Layout

CELLS = 8
"""Cells along the black square of an AprilTag 36h11: 6 of data and a black border of one."""

HAIR, THIN, LINE = 0.1, 0.15, 0.2
"""Widths of lines [mm]."""

Point = tuple[float, float]


@dataclass(frozen=True)
class Shape:
    """A black area: closed rings of (y, z) mm, outer ones anticlockwise and holes clockwise."""

    rings: tuple[tuple[Point, ...], ...]


@dataclass(frozen=True)
class Line:
    """A straight line of a width [mm]."""

    start: Point
    end: Point
    width: float = THIN


@dataclass(frozen=True)
class Words:
    """One line of words: ``anchor`` "left", "middle" or "right" of the base line's ``place``; turned about it [deg]."""

    place: Point
    words: str
    height: float = 2.2
    anchor: str = "middle"
    turn: float = 0.0


@dataclass(frozen=True)
class Drawing:
    """Everything on the board; ``size`` (y, z) mm, origin at its centre, y to the right and z up."""

    size: tuple[float, float]
    shapes: tuple[Shape, ...]
    lines: tuple[Line, ...]
    words: tuple[Words, ...]


def draw(layout: Layout) -> Drawing:
    """The board: marks, its outline to cut along, millimetre scales along the lower and left edges, check rules."""
    shapes = tuple(
        mark(tag, centre, side)
        for tag, centre, side in zip(layout.marks.ids, layout.marks.centres, layout.marks.sides, strict=True)
    )
    w, h = layout.size
    outline = [(-w / 2, -h / 2), (w / 2, -h / 2), (w / 2, h / 2), (-w / 2, h / 2)]
    lines = [Line(a, b, HAIR) for a, b in zip(outline, outline[1:] + outline[:1], strict=True)]
    words = [
        Words(
            (0.0, h / 2 - 5.0),
            f"benchsim board {w:g} × {h:g} mm, marks of {layout.marks.sides[0]:g} mm.  This edge up (z), this side to "
            "the mirror.  Print at 100 %; measure both check rules.",
            height=min(2.2, 2.2 * (w - 2 * EDGE) / 178),
        )
    ]
    for ticks, numbers in (_scale(w, h, upright=False), _scale(h, w, upright=True)):
        lines += ticks
        words += numbers
    for start, end in ((rule[:2], rule[2:]) for rule in layout.rules):
        along = np.subtract(end, start) / RULE
        across = np.array([along[1], -along[0]]) * 2.5
        lines.append(Line(start, end, LINE))
        lines += [Line(_at(p, -across), _at(p, across), LINE) for p in (start, end)]
        place = _at(start, 0.62 * RULE * along + 0.4 * np.abs(across) * [-1, 1])
        words.append(Words(place, f"{RULE:g} mm between the end marks", turn=90.0 if along[1] else 0.0))
    return Drawing(layout.size, shapes, tuple(lines), tuple(words))


def _at(point: Point, offset: NDArray) -> Point:
    return (float(point[0] + offset[0]), float(point[1] + offset[1]))


def _scale(length: float, other: float, upright: bool) -> tuple[list[Line], list[Words]]:
    """Ticks at every millimetre along the lower (or left) edge, inward from it, and numbers at every 50."""
    edge = -other / 2

    def place(along: float, inward: float) -> Point:
        return (edge + inward, along) if upright else (along, edge + inward)

    ticks, numbers = [], []
    for n in range(int(np.ceil(-length / 2)), int(length / 2) + 1):
        long = 3.4 if n % 10 == 0 else 2.4 if n % 5 == 0 else 1.5
        ticks.append(Line(place(n, 0.0), place(n, long), HAIR))
        if n % 50 == 0 and abs(n) < length / 2 - 10:
            axis = ("z" if upright else "y") + " = " if n == 0 else ""
            unit = " mm" if n == 0 else ""
            base = 5.9 if upright else 3.9
            numbers.append(Words(place(n, base), f"{axis}{n}{unit}".replace("-", "−"), turn=90.0 if upright else 0.0))
    return ticks, numbers


def mark(tag: int, centre: Point, side: float) -> Shape:
    """The black of an AprilTag 36h11, upright: outlines of its cells joined, so that no seam shows between them."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    black = cv2.aruco.generateImageMarker(dictionary, tag, CELLS, borderBits=1)[::-1] == 0
    pitch = side / CELLS
    return Shape(
        tuple(
            tuple((centre[0] + (i - CELLS / 2) * pitch, centre[1] + (j - CELLS / 2) * pitch) for i, j in ring)
            for ring in outlines(black)
        )
    )


def outlines(black: NDArray[np.bool_]) -> list[list[tuple[int, int]]]:
    """Rings around the black cells [row, column] of a grid, in (column, row) corners, black to the left of the way.

    Cells that touch at a corner only stay apart.
    """
    padded = np.pad(black, 1)
    ways: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for j, i in np.argwhere(black).tolist():
        corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        beside = [padded[j, i + 1], padded[j + 1, i + 2], padded[j + 2, i + 1], padded[j + 1, i]]
        for k in range(4):
            if not beside[k]:
                ways.setdefault(corners[k], []).append(corners[(k + 1) % 4])
    rings = []
    while ways:
        start = next(iter(ways))
        ring, at, came = [start], start, (0, 0)
        while True:
            ends = ways[at]
            # Where two cells touch at a corner, the way turns left and stays with its own cell.
            turn = [came[0] * (e[1] - at[1]) - came[1] * (e[0] - at[0]) for e in ends]
            end = ends.pop(int(np.argmax(turn)))
            if not ends:
                del ways[at]
            came, at = (end[0] - at[0], end[1] - at[1]), end
            if at == start:
                break
            ring.append(at)
        rings.append(_straightened(ring))
    return rings


def _straightened(ring: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Without the corners that lie on a straight way."""
    out = []
    for k, (i, j) in enumerate(ring):
        (a, b), (c, d) = ring[k - 1], ring[(k + 1) % len(ring)]
        if (i - a) * (d - j) != (j - b) * (c - i):
            out.append((i, j))
    return out


def occupied(layout: Layout) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Intervals of y, and of z, in which no seam may run: places of marks, and the check rules [mm]."""
    half = QUIET * layout.marks.sides[0]
    along_y, along_z = layout.rules
    y, z = layout.rules_cross
    return (
        [(c - half, c + half) for c in layout.columns] + [(along_y[0], along_y[2]), (y - 3, y + 3)],
        [(c - half, c + half) for c in layout.rows] + [(along_z[1], along_z[3]), (z - 3, z + 3)],
    )
