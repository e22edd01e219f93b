"""The flat board: where rays meet it, in its own coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.place import Placement
from benchsim.rays.laser import dot

Array = NDArray[np.float64]


def meet(placement: Placement, x: Array, direction: Array) -> tuple[Array, Array]:
    """Where rays meet the board's plane.

    Parameters
    ----------
    placement : Placement
    x : (..., 3) array [mm]
        Points on the rays, world frame.
    direction : (..., 3) array
        Directions of travel, of any length.

    Returns
    -------
    board : (..., 2) ndarray [mm]
        y, z on the board.
    s : (...) ndarray
        Path from x in units of |direction|. It is positive and ``facing(direction) < 0`` for light that
        reaches the front of the board; the caller checks.
    """
    front = placement.screen_rotation[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = dot(placement.screen_origin - x, front) / dot(direction, front)
        hit = x + s[..., None] * direction
    return (hit - placement.screen_origin) @ placement.screen_rotation[:, 1:], s


def to_world(placement: Placement, board: Array) -> Array:
    """World points (..., 3) [mm] of board points (..., 2) [mm]."""
    return placement.screen_origin + np.asarray(board, float) @ placement.screen_rotation[:, 1:].T


def facing(placement: Placement, direction: Array) -> Array:
    """Component of directions along the board's front normal: negative for light that falls on the front."""
    return direction @ placement.screen_rotation[:, 0]


def margin(size: tuple[float, float], board: Array) -> Array:
    """Signed distance in the maximum norm beyond the board's edge [mm]: ≤ 0 on the board."""
    return np.maximum(np.abs(board[..., 0]) - size[0] / 2, np.abs(board[..., 1]) - size[1] / 2)
