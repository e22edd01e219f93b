"""The board: where rays meet its surface, in its own coordinates.

The surface stands x = sx + st_z y + st_y z + ½ (bow_y y² + bow_z z²) + field(y, z) over the board's plane, toward the
mirror; y, z and x are the board's own axes, which roll with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.fields import Field, prepared
from benchsim.bench.place import Placement
from benchsim.rays.laser import components_last, dot, some

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "screen-distance": ("sx",),
    "screen-tilt": ("st_y", "st_z"),
    "screen-bow": ("bow_y", "bow_z"),
    "screen-rotation": ("srot",),
}
"""Effects of the board on the light, with their parameters; the errors of its print are in `camera`."""


@dataclass(frozen=True, eq=False)
class BoardEffects:
    """How the board differs from the plane that the recording states; nothing by default.

    Attributes
    ----------
    distance : float [mm]
    slope : (along y, along z)
    bow : (along y, along z) [1/mm]
    height : function of (y, z) [mm] that gives a height [mm], or None
    turn : float
        About the board's own x, marks and all [rad].
    """

    distance: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)
    bow: tuple[float, float] = (0.0, 0.0)
    height: Callable[..., Array] | None = None
    turn: float = 0.0

    @property
    def flat(self) -> bool:
        """Whether the surface is the plane x = 0."""
        return not some(self.distance, *self.slope, *self.bow) and self.height is None

    def slopes(self, y: Array, z: Array) -> tuple[Array, Array]:
        """Slopes of the surface without its field, along y and z; plain numbers where it is not bent."""
        if not some(*self.bow):
            return np.asarray(self.slope[0]), np.asarray(self.slope[1])
        return self.slope[0] + self.bow[0] * y, self.slope[1] + self.bow[1] * z


def effects(tables: Effects, fields: Mapping[str, Field]) -> BoardEffects:
    """The board's share of a recording's effects (file units: mm, mrad, 1/m) and fields."""

    def of(name: str, key: str, unit: float = 1e-3) -> float:
        return unit * tables.get(name, {}).get(key, 0.0)

    return BoardEffects(
        of("screen-distance", "sx", 1.0),
        (of("screen-tilt", "st_z"), of("screen-tilt", "st_y")),
        (of("screen-bow", "bow_y"), of("screen-bow", "bow_z")),
        prepared(fields["height"]) if "height" in fields else None,
        of("screen-rotation", "srot"),
    )


def turned(placement: Placement, board: BoardEffects) -> Placement:
    """The placement with the board turned about its own x."""
    if not board.turn:
        return placement
    turn = Rotation.from_rotvec([board.turn, 0.0, 0.0]).as_matrix()
    return replace(placement, screen_rotation=placement.screen_rotation @ turn)


def meet(placement: Placement, x: Array, direction: Array, surface: BoardEffects | None = None) -> tuple[Array, Array]:
    """Where rays meet the board.

    Parameters
    ----------
    placement : Placement
    x : (..., 3) array [mm]
        Points on the rays, world frame.
    direction : (..., 3) array
        Directions of travel, of any length.
    surface : BoardEffects, optional
        Default the plane.

    Returns
    -------
    board : (..., 2) ndarray [mm]
        y, z on the board.
    s : (...) ndarray
        Path from x in units of |direction|. It is positive and ``facing(direction) < 0`` for light that
        reaches the front of the board; the caller checks.
    """
    front, along_y, along_z = columns(placement.screen_rotation)
    off = x - placement.screen_origin
    with np.errstate(divide="ignore", invalid="ignore"):
        height, falling = dot(off, front), dot(direction, front)
        y0, z0 = dot(off, along_y), dot(off, along_z)
        to_y, to_z = dot(direction, along_y), dot(direction, along_z)
        s = -height / falling
        if surface is not None and not surface.flat:
            s = _on_surface(surface, s, (height, y0, z0), (falling, to_y, to_z))
        board = np.empty((2, *s.shape))
        np.add(y0, s * to_y, out=board[0])
        np.add(z0, s * to_z, out=board[1])
    return components_last(board), s


def _on_surface(
    surface: BoardEffects, s: Array, start: tuple[Array, Array, Array], ray: tuple[Array, Array, Array]
) -> Array:
    """Newton's method on the surface; the field's slope is left out, so that it only shrinks the error each round."""
    for _ in range(30):
        y, z = start[1] + s * ray[1], start[2] + s * ray[2]
        slope_y, slope_z = surface.slopes(y, z)
        high = surface.distance + 0.5 * (y * (surface.slope[0] + slope_y) + z * (surface.slope[1] + slope_z))
        if surface.height is not None:
            high = high + surface.height(y, z)[0]
        step = (high - start[0] - s * ray[0]) / (ray[0] - slope_y * ray[1] - slope_z * ray[2])
        s = s + step
        if not np.fmax.reduce(np.abs(step * ray[0]).ravel(), initial=0.0) > 1e-8:
            break
    return s


def to_world(placement: Placement, board: Array) -> Array:
    """World points (..., 3) [mm] of board points (..., 2) [mm]."""
    return placement.screen_origin + np.asarray(board, float) @ placement.screen_rotation[:, 1:].T


def facing(placement: Placement, direction: Array) -> Array:
    """Component of directions along the board's front normal: negative for light that falls on the front."""
    return dot(direction, placement.screen_rotation[..., 0])


def columns(rotation: Array) -> Array:
    """Columns of a matrix, or of a stack of matrices (..., 3, 3): (3, ..., 3)."""
    return rotation.T if rotation.ndim == 2 else np.moveaxis(rotation, -1, 0)


def margin(size: tuple[float, float], board: Array) -> Array:
    """Signed distance in the maximum norm beyond the board's edge [mm]: ≤ 0 on the board."""
    return np.maximum(np.abs(board[..., 0]) - size[0] / 2, np.abs(board[..., 1]) - size[1] / 2)
