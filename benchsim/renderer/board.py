"""The board's reflectance: white, with black AprilTags, averaged exactly over the texels of a grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field, evaluate
from benchsim.bench.model import Screen

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]
Print = Callable[[Array, Array], tuple[Array, Array]]

EFFECTS: Mapping[str, tuple[str, ...]] = {"grid-scale": ("gs",), "grid-aspect": ("ga",), "grid-shear": ("gsh",)}

FIELDS = ("shift",)

INK = 0.04
"""Reflectance of printed black: laser prints have an optical density of 1.2 to 1.6, that is 2.5 to 6 %."""

CELLS = 8
"""Cells along the black square of an AprilTag 36h11: 6 of data and a black border of one."""


@dataclass(frozen=True)
class BoardTexture:
    """Reflectance on a grid of square texels.

    Attributes
    ----------
    values : (nz, ny) ndarray
        Mean reflectance over texel (i, j), which is centred at (y0 + j pitch, z0 + i pitch).
    y0, z0, pitch : mm
    """

    values: Array
    y0: float
    z0: float
    pitch: float


def tag_cells(tag: int) -> NDArray[np.bool_]:
    """Black cells (8, 8) of an AprilTag 36h11: row 0 at the bottom, column 0 at the left of the upright mark."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    upright = cv2.aruco.generateImageMarker(dictionary, tag, CELLS, borderBits=1)
    return upright[::-1] == 0


def _overlap(start: float, n: int, pitch: float, edges: Array) -> tuple[int, Array]:
    """First texel touched and the fraction (texels, len(edges) − 1) of each texel that each interval covers."""
    first = max(0, int(np.floor((edges[0] - start) / pitch)))
    last = min(n, int(np.ceil((edges[-1] - start) / pitch)))
    if last <= first:
        return 0, np.zeros((0, len(edges) - 1))
    borders = start + pitch * np.arange(first, last + 1)
    low = np.maximum(borders[:-1, None], edges[None, :-1])
    high = np.minimum(borders[1:, None], edges[None, 1:])
    return first, np.maximum(high - low, 0.0) / pitch


def printed(effects: Effects, fields: Mapping[str, Field]) -> Print | None:
    """Where the printer laid what it meant for (y, z): grid errors and the shift field; None where it did so truly.

    Design 2.3: nominal (y, z) lies at ((1 + gs + ga) y + gsh z, (1 + gs − ga) z + gsh y), then the field is added.
    """
    gs, ga, gsh = (
        1e-3 * effects.get(f"grid-{n}", {}).get(k, 0.0)
        for n, k in (("scale", "gs"), ("aspect", "ga"), ("shear", "gsh"))
    )
    field = fields.get("shift")
    if not (gs or ga or gsh) and field is None:
        return None

    def lay(y: Array, z: Array) -> tuple[Array, Array]:
        dy, dz = (0.0, 0.0) if field is None else evaluate(field, y, z)
        return (1 + gs + ga) * y + gsh * z + dy, (1 + gs - ga) * z + gsh * y + dz

    return lay


def _meant(lay: Print, y: Array, z: Array) -> tuple[Array, Array]:
    """Nominal place of the print that lies at (y, z): fixed point, each step shrinks the miss by the grid's error."""
    a, b = y, z
    for _ in range(40):
        at_y, at_z = lay(a, b)
        a, b = a - (at_y - y), b - (at_z - z)
        if max(np.abs(at_y - y).max(initial=0), np.abs(at_z - z).max(initial=0)) < 1e-7:
            return a, b
    raise BenchsimError("fields.shift: folds the print over; give values that change by less than 1 mm per mm")


def _displaced_mark(
    lay: Print, tag: int, centre: tuple[float, float], side: float, grid: tuple[list[float], list[int], float]
) -> tuple[int, int, Array]:
    """First row, first column and black share of the texels of a mark that is printed out of place.

    Each texel is taken back to where it was meant; there the cover of a texel's square by black cells is exact. That
    the square is turned and stretched by the grid's error changes the smoothing of edges, not where they lie.
    """
    start, n, pitch = grid
    around = np.linspace(-0.5, 0.5, 9) * side
    oy, oz = np.meshgrid(centre[0] + around, centre[1] + around)
    corners = lay(oy, oz)
    first = [max(0, int(np.floor((c.min() - s) / pitch)) - 2) for c, s in zip(corners, start, strict=True)]
    last = [min(k, int(np.ceil((c.max() - s) / pitch)) + 2) for c, s, k in zip(corners, start, n, strict=True)]
    if last[0] <= first[0] or last[1] <= first[1]:
        return 0, 0, np.zeros((0, 0))
    y, z = np.meshgrid(*(s + pitch * (np.arange(a, b) + 0.5) for s, a, b in zip(start, first, last, strict=True)))
    edges = side * (np.arange(CELLS + 1) / CELLS - 0.5)
    cover = []
    for at, c in zip(_meant(lay, y, z), centre, strict=True):
        low = (at - c - pitch / 2)[..., None]
        inside = np.minimum(low + pitch, edges[1:]) - np.maximum(low, edges[:-1])
        cover.append(np.maximum(inside, 0.0) / pitch)
    return (
        first[1],
        first[0],
        np.einsum("ija,ab,ijb->ij", cover[1], tag_cells(tag).astype(float), cover[0], optimize=True),
    )


def reflectance(
    screen: Screen,
    pitch: float = 0.25,
    *,
    outside: float = 0.0,
    border: int = 2,
    lay: Print | None = None,
    within: tuple[Array, Array] | None = None,
) -> BoardTexture:
    """Reflectance of the board and of what is seen beside it.

    Every texel holds the exact mean over its area, so that the edges of board and marks lie where the file says
    and not at the nearest texel.

    Parameters
    ----------
    screen : Screen
    pitch : float
        Size of a texel [mm].
    outside : float
        Reflectance beside the board.
    border : int
        Texels beside the board on every side.
    lay : callable, optional
        From `printed`: where the marks were printed in truth. The board's outline stays.
    within : (y, z), optional
        Growing places [mm]; only the texels from each's first to its last are made.

    Returns
    -------
    BoardTexture
        The whole is symmetric about the board's centre.

    Notes
    -----
    Marks are upright and not mirrored as seen from the mirror's side, with +y to the right and z up; ``sides`` is
    the black square without its white margin. Marks that overlap count once.
    """
    n = [int(np.ceil(size / pitch - 1e-9)) + 2 * border for size in screen.size]
    start = [-k * pitch / 2 for k in n]
    if within is not None:
        first = [int((at[0] - s) // pitch) for at, s in zip(within, start, strict=True)]
        n = [int((at[-1] - s) // pitch) + 1 - f for at, s, f in zip(within, start, first, strict=True)]
        start = [s + pitch * f for s, f in zip(start, first, strict=True)]
    white = [_overlap(start[a], n[a], pitch, np.array([-screen.size[a] / 2, screen.size[a] / 2])) for a in (0, 1)]
    board = np.zeros((n[1], n[0]))
    (j, across), (i, up) = white
    board[i : i + len(up), j : j + len(across)] = up @ across.T
    black = np.zeros_like(board)
    marks = screen.marks
    if marks is not None:
        for tag, (y, z), side in zip(marks.ids, marks.centres, marks.sides, strict=True):
            if lay is not None:
                i, j, cover = _displaced_mark(lay, tag, (y, z), side, (start, n, pitch))
                black[i : i + cover.shape[0], j : j + cover.shape[1]] += cover
                continue
            edges = side * (np.arange(CELLS + 1) / CELLS - 0.5)
            j, across = _overlap(start[0], n[0], pitch, y + edges)
            i, up = _overlap(start[1], n[1], pitch, z + edges)
            black[i : i + len(up), j : j + len(across)] += up @ tag_cells(tag) @ across.T
    np.minimum(black, board, out=black)
    # In place: a board at a quarter of a millimetre has 8 million texels.
    board *= screen.reflectance - outside
    black *= min(INK, screen.reflectance) - screen.reflectance
    board += black
    board += outside
    return BoardTexture(board, start[0] + pitch / 2, start[1] + pitch / 2, pitch)
