"""The air between mirror and screen: a glass slab, a gradient of temperature, and kicks at the plane half way.

Light is carried as the straight line on which it arrives at the board: a kick turns it about the point where it crosses
the plane half way, a constant gradient bends it into a parabola, whose tangent at the board's plane is the line, and a
slab displaces it. The slab's faces are taken as coated against reflection: it takes no light, so that what it does
grows from nothing with its thickness.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field, prepared
from benchsim.bench.place import Placement
from benchsim.rays.laser import dot, outer, over, some
from benchsim.rays.mirror import refracted

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "window": ("win",),
    "window-tilt": ("wty", "wtz", "win"),
    "air-gradient": ("air", "airh"),
    "plume": ("plume", "plume_y", "plume_z", "plume_width"),
}
"""Effects of the air, with their parameters."""

WINDOW = 4.0
"""Thickness [mm] of a tilted window whose thickness is not given."""

PLUME_WIDTH = 60.0
"""rms radius [mm] of a plume whose width is not given."""

DN_DT = -0.95e-6
"""dn/dT of air at room temperature [1/K] (Ciddor 1996, Appl. Opt. 35, 1566; at 633 nm and 101 kPa, 15 to 20 °C)."""


@dataclass(frozen=True, eq=False)
class AirEffects:
    """What stands between mirror and screen; nothing by default. See `effects` for the signs.

    Attributes
    ----------
    window : float
        Thickness of the slab [mm].
    turn : (about y, about z) rad
        Of the slab, from parallel to the nominal screen.
    gradient : (y, z) 1/mm
        Of the refractive index.
    plume : (kick [rad], y, z, rms radius [mm])
    kick : function of (y, z) [mm] that gives two angles [rad], or None
    """

    window: float = 0.0
    turn: tuple[float, float] = (0.0, 0.0)
    gradient: tuple[float, float] = (0.0, 0.0)
    plume: tuple[float, float, float, float] = (0.0, 0.0, 0.0, PLUME_WIDTH)
    kick: Callable[..., Array] | None = None

    @property
    def still(self) -> bool:
        """Whether light runs straight."""
        return not some(self.window, *self.gradient, self.plume[0]) and self.kick is None


def effects(tables: Effects, fields: Mapping[str, Field]) -> AirEffects:
    """The air's share of a recording's effects (file units: mm, deg, K/m, mrad) and fields.

    Raises
    ------
    BenchsimError
        A plume without width, or a window of negative thickness.
    """

    def of(name: str, key: str, default: float = 0.0) -> float:
        return tables.get(name, {}).get(key, default)

    turn = (np.radians(of("window-tilt", "wty")), np.radians(of("window-tilt", "wtz")))
    window = of("window", "win") or of("window-tilt", "win") or (WINDOW if any(turn) else 0.0)
    if window < 0:
        raise BenchsimError(f"effects.window.win: {window:g} mm is no thickness; give one of 0 or more")
    per_mm = DN_DT * 1e-3
    width = of("plume", "plume_width", PLUME_WIDTH)
    if width <= 0:
        raise BenchsimError(f"effects.plume.plume_width: {width:g} mm is no width; give one above 0")
    return AirEffects(
        window,
        turn,
        (per_mm * of("air-gradient", "airh"), per_mm * of("air-gradient", "air")),
        (1e-3 * of("plume", "plume"), of("plume", "plume_y"), of("plume", "plume_z"), width),
        prepared(fields["kick"]) if "kick" in fields else None,
    )


def half_way(placement: Placement) -> Array:
    """World x [mm] of the plane half way between the mirror's centre of rotation and the screen's centre."""
    return np.asarray(0.5 * (placement.centre[..., 0] + placement.screen_origin[..., 0]))


def carry(air: AirEffects, placement: Placement, x: Array, direction: Array) -> tuple[Array, Array]:
    """The straight line on which light from the mirror arrives at the board.

    Parameters
    ----------
    air : AirEffects
    placement : Placement
    x, direction : (..., 3) array
        Points where the light leaves the mirror [mm] and its directions, of any length.

    Returns
    -------
    x, direction : (..., 3) ndarray
        A point of the line as far from the board as the mirror is, and the direction, of the same length.
    """
    if air.still:
        return x, direction
    if some(air.plume[0]) or air.kick is not None:
        s = (half_way(placement) - x[..., 0]) / direction[..., 0]
        crossing = x + s[..., None] * direction
        length = np.sqrt(dot(direction, direction))
        direction = direction + length[..., None] * _kick(air, crossing)
        x = crossing - s[..., None] * direction
    if some(*air.gradient):
        front = placement.screen_rotation[..., 0]
        length2 = dot(direction, direction)
        pull = np.stack(np.broadcast_arrays(0.0, *air.gradient), axis=-1)
        # d²X/ds² for s in units of the direction's length: the gradient less its part along the ray.
        bend = outer(length2, pull) - dot(direction, pull)[..., None] * direction
        s = (dot(placement.screen_origin - x, front) / dot(direction, front))[..., None]
        direction = direction + s * bend
        x = x - 0.5 * s * s * bend
    if not some(air.window):
        return x, direction
    turn = np.stack(np.broadcast_arrays(0.0, *air.turn), axis=-1)
    slab = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix()[..., 0].reshape(turn.shape)
    inside, cosine, _ = refracted(direction, slab)
    straight = direction / -dot(direction, slab)[..., None]
    x = x + over(air.window) * (inside / cosine[..., None] - straight)
    return x, direction


def _kick(air: AirEffects, crossing: Array) -> Array:
    y, z = crossing[..., 1], crossing[..., 2]
    out = np.zeros_like(crossing)
    strength, y0, z0, width = air.plume
    if some(strength):
        out[..., 1] = strength * np.exp(-0.5 * ((y - y0) ** 2 + (z - z0) ** 2) / width**2)
    if air.kick is not None:
        free = air.kick(y, z)
        out[..., 1] += free[0]
        out[..., 2] += free[1]
    return out
