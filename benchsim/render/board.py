"""The board's reflectance: white, with black AprilTags, averaged exactly over the texels of a grid."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Screen

Array = NDArray[np.float64]

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


def reflectance(screen: Screen, pitch: float = 0.25, *, outside: float = 0.0, border: int = 2) -> BoardTexture:
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

    Returns
    -------
    BoardTexture
        Symmetric about the board's centre.

    Notes
    -----
    Marks are upright and not mirrored as seen from the mirror's side, with +y to the right and z up; ``sides`` is
    the black square without its white margin. Marks that overlap count once.
    """
    n = [int(np.ceil(size / pitch - 1e-9)) + 2 * border for size in screen.size]
    start = [-k * pitch / 2 for k in n]
    white = [_overlap(start[a], n[a], pitch, np.array([-screen.size[a] / 2, screen.size[a] / 2])) for a in (0, 1)]
    board = np.zeros((n[1], n[0]))
    (j, across), (i, up) = white
    board[i : i + len(up), j : j + len(across)] = up @ across.T
    black = np.zeros_like(board)
    marks = screen.marks
    if marks is not None:
        for tag, (y, z), side in zip(marks.ids, marks.centres, marks.sides, strict=True):
            edges = side * (np.arange(CELLS + 1) / CELLS - 0.5)
            j, across = _overlap(start[0], n[0], pitch, y + edges)
            i, up = _overlap(start[1], n[1], pitch, z + edges)
            black[i : i + len(up), j : j + len(across)] += up @ tag_cells(tag) @ across.T
    black = np.minimum(black, board)
    values = outside * (1 - board) + screen.reflectance * (board - black) + min(INK, screen.reflectance) * black
    return BoardTexture(values, start[0] + pitch / 2, start[1] + pitch / 2, pitch)
