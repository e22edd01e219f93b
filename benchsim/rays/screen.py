"""The board: how it is turned, and where rays meet its surface, in its own coordinates.

The board is rigid. A tilt turns it with its marks about its centre, by the smallest turn that brings its plane to
x = sx + st_z y + st_y z; the recording's known roll takes that plane with it, and an unknown one turns the board within
it. On the board itself the surface stands ½ (bow_y y² + bow_z z²) + field(y, z) over its plane, along its normal at
coordinates y, z that are measured along it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

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
        Along the world's x.
    slope : (along y, along z)
        Of the plane to which the board is tilted.
    bow : (along y, along z) [1/mm]
    height : function of (y, z) [mm] that gives a height [mm], or None
    roll : float
        About the board's own normal, in the plane to which it is tilted [rad].
    """

    distance: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)
    bow: tuple[float, float] = (0.0, 0.0)
    height: Callable[..., Array] | None = None
    roll: float = 0.0

    @property
    def flat(self) -> bool:
        """Whether the surface is plane."""
        return not some(*self.bow) and self.height is None

    @cached_property
    def turn(self) -> Array:
        """Matrix (3, 3) of the board's turn, marks and all, in the frame in which it is seated; see `tilted`."""
        c, s = np.cos(self.roll), np.sin(self.roll)
        roll: Array = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        return tilted(*self.slope) @ roll

    def slopes(self, y: Array, z: Array) -> tuple[Array, Array]:
        """Slopes of the surface without its field, along y and z; plain numbers where it is not bent."""
        if not some(*self.bow):
            return np.zeros(()), np.zeros(())
        return self.bow[0] * y, self.bow[1] * z


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


def tilted(along_y: float, along_z: float) -> Array:
    """Matrix (3, 3) of the smallest turn that brings the plane x = 0 to x = along_y y + along_z z.

    The turn from x to the plane's normal n about x × n, by Rodrigues' formula; it has no part about x.
    """
    n = np.array([1.0, -along_y, -along_z])
    n /= np.sqrt(n @ n)
    out: Array = np.eye(3) - np.outer(n, n) / (1.0 + n[0])
    out[0], out[:, 0] = -n, n
    return out


def turned(placement: Placement, board: BoardEffects) -> Placement:
    """The placement with the board moved along x, and turned about its centre."""
    if not some(board.distance, board.roll, *board.slope):
        return placement
    return replace(
        placement,
        screen_rotation=placement.screen_rotation @ board.turn,
        screen_origin=placement.screen_origin + np.array([board.distance, 0.0, 0.0]),
    )


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
        high = 0.5 * (y * slope_y + z * slope_z)
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
