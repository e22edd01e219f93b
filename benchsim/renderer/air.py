"""What stands between mirror and board: warm air that bends rays, and a window.

Each element takes a ray that leaves the mirror and hands over the straight ray that meets the board in its place: its
point less P (ξ) and its direction less the chief ray's R (q), both in the rotor's frame.

The gradient: n(r) = n₀ + ∇n·r with ∇n = dn/dT ∇T; the ray equation d/ds(n dr/ds) = ∇n is integrated step by step along
the whole way from the mirror to the board. The kick turns the unit vector of the direction by (0, k_y, k_z) of the
world where the ray crosses the plane half way between mirror and board, parallel to the world's y and z. The window: a
slab refracts at either face by Snell's law; its faces are coated against reflection and take no light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Recording
from benchsim.bench.place import Placement
from benchsim.renderer.effects import MRAD, PER_M, value
from benchsim.renderer.facet import GLASS
from benchsim.renderer.laser import Vec, dot
from benchsim.renderer.tables import Table, table

Array = NDArray[np.float64]

EFFECTS = {
    "window": ("win",),
    "window-tilt": ("wty", "wtz", "win"),
    "air-gradient": ("air", "airh"),
    "plume": ("plume", "plume_y", "plume_z", "plume_width"),
}
FIELDS = ("kick",)

DN_DT = -0.95e-6
"""Change of the air's refractive index with temperature [1/K] at 633 nm, 15-25 °C and 1013 hPa (Ciddor 1996)."""

N_AIR = 1.00027
"""Refractive index of air there (Ciddor 1996); what it is exactly moves nothing by more than a nanometre."""

TILTED_WINDOW = 4.0
"""Thickness of a turned window [mm] where none is given."""

PLUME_WIDTH = 60.0
"""rms radius of a plume [mm] where none is given."""

STEPS = 8
"""Of the integration along the way; the gradient being constant, the steps' error is far below a nanometre."""


@dataclass(frozen=True)
class Gradient:
    """``gradient`` ∇n [1/mm], ``chief`` R, as triples; ``n`` at P."""

    gradient: Vec
    chief: Vec
    front: Vec
    height: Any
    slope: Any

    def bend(self, xi: Vec, q: Vec, m: Any) -> tuple[Vec, Vec, Any]:
        """See the module's head."""
        g = tuple(self.chief[i] + q[i] for i in range(3))
        length = dot(g, g) ** 0.5
        way = -(self.height + dot(xi, self.front)) / (self.slope + dot(q, self.front)) * length
        ray = tuple(g[i] / length for i in range(3))
        # With dσ = ds/n the ray is a fall: r'' = n ∇n, r' = n × direction (Sharma 1982, Appl. Opt. 21, 984). What is
        # carried is its difference from the straight way, by the leapfrog scheme.
        step = way / (N_AIR * STEPS)
        place = tuple(0.0 * way for _ in range(3))
        speed = tuple(0.0 * way for _ in range(3))
        for k in range(STEPS):
            middle = tuple(
                xi[i] + (k + 0.5) * step * N_AIR * ray[i] + place[i] + 0.5 * step * speed[i] for i in range(3)
            )
            n = N_AIR + dot(self.gradient, middle)
            pull = tuple(n * self.gradient[i] for i in range(3))
            place = tuple(place[i] + step * (speed[i] + 0.5 * step * pull[i]) for i in range(3))
            speed = tuple(speed[i] + step * pull[i] for i in range(3))
        # The tangent at the end, prolonged backward to the mirror.
        turn = tuple(speed[i] / N_AIR for i in range(3))
        start = tuple(xi[i] + place[i] - way * turn[i] for i in range(3))
        return start, tuple(q[i] + length * turn[i] for i in range(3)), None


@dataclass(frozen=True)
class Kick:
    """``origin`` P and the axes x, y, z of the world as triples of the rotor's frame; ``half`` [mm] the plane's x.

    ``plume`` (k_y [rad], y, z, width [mm]) or None; ``field`` the free field's table.
    """

    origin: Vec
    axes: tuple[Vec, Vec, Vec]
    chief: Vec
    half: Any
    plume: tuple[Any, Any, Any, Any] | None
    field: Table | None

    def bend(self, xi: Vec, q: Vec, m: Any) -> tuple[Vec, Vec, Any]:
        """See the module's head."""
        x, y, z = self.axes
        g = tuple(self.chief[i] + q[i] for i in range(3))
        length = dot(g, g) ** 0.5
        way = (self.half - self.origin[0] - dot(xi, x)) / dot(g, x)
        at_y = self.origin[1] + dot(xi, y) + way * dot(g, y)
        at_z = self.origin[2] + dot(xi, z) + way * dot(g, z)
        ky: Any = 0.0 * way
        kz: Any = 0.0 * way
        if self.plume is not None:
            amount, py, pz, width = self.plume
            dy, dz = (at_y - py) / width, (at_z - pz) / width
            ky = ky + amount * m.exp(-0.5 * (dy * dy + dz * dz))
        if self.field is not None:
            fy, fz = self.field(at_y, at_z)
            ky, kz = ky + fy, kz + fz
        turn = tuple(length * (ky * y[i] + kz * z[i]) for i in range(3))
        return tuple(xi[i] - way * turn[i] for i in range(3)), tuple(q[i] + turn[i] for i in range(3)), None


@dataclass(frozen=True)
class Window:
    """``normal`` of the slab as a triple, ``thickness`` [mm]."""

    normal: Vec
    thickness: Any
    chief: Vec

    def bend(self, xi: Vec, q: Vec, m: Any) -> tuple[Vec, Vec, Any]:
        """Refracted in and out: the same direction, beside its place; where the slab stands does not matter."""
        g = tuple(self.chief[i] + q[i] for i in range(3))
        length = dot(g, g) ** 0.5
        cosine = abs(dot(g, self.normal)) / length
        inner = (1.0 - (1.0 - cosine * cosine) / (GLASS * GLASS)) ** 0.5
        # Through the slab light moves sideways by T tan within, not by T tan outside; "sideways" is along the slab.
        inward = dot(g, self.normal) / length
        side = tuple(g[i] / length - inward * self.normal[i] for i in range(3))
        shift = self.thickness * (1.0 / (GLASS * inner) - 1.0 / cosine)
        return tuple(xi[i] + shift * side[i] for i in range(3)), q, None


def air(recording: Recording, placement: Placement, rotor: Array, point: Array, chief: Array) -> tuple[Any, ...]:
    """The elements on the way from the mirror to the board, in the order of the light.

    Parameters
    ----------
    recording : Recording
    placement : Placement
    rotor : (3, 3) array
        Rows are the rotor's unit vectors in the world.
    point, chief : (3,) arrays
        P in the world [mm]; R in the rotor's frame.
    """
    effects = recording.effects

    def triple(v: Any) -> Vec:
        return tuple(float(x) for x in v)

    elements: list[Any] = []
    plume = None
    if value(effects, "plume", "plume"):
        width = float(effects["plume"].get("plume_width", PLUME_WIDTH))
        if not width > 0:
            raise BenchsimError(f"{recording.path}: [effects.plume] plume_width = {width}: give a width above 0 mm")
        y, z = (value(effects, "plume", k) for k in ("plume_y", "plume_z"))
        plume = (value(effects, "plume", "plume", MRAD), y, z, width)
    field = table(recording.fields, "kick")
    if plume is not None or field is not None:
        world = (triple(rotor[:, 0]), triple(rotor[:, 1]), triple(rotor[:, 2]))
        half = (placement.centre[0] + placement.screen_origin[0]) / 2
        elements.append(Kick(triple(point), world, triple(chief), float(half), plume, field))
    gradient = np.array([0.0, *(DN_DT * value(effects, "air-gradient", k, PER_M) for k in ("airh", "air"))])
    if gradient.any():
        front = rotor @ placement.screen_rotation[:, 0]
        height, slope = (rotor @ (point - placement.screen_origin)) @ front, chief @ front
        elements.append(Gradient(triple(rotor @ gradient), triple(chief), triple(front), float(height), float(slope)))
    turn = [value(effects, "window-tilt", k, np.pi / 180) for k in ("wty", "wtz")]
    thickness = value(effects, "window", "win") or value(effects, "window-tilt", "win")
    if thickness < 0:
        raise BenchsimError(f"{recording.path}: [effects.window] win = {thickness}: give a thickness of 0 or more")
    if any(turn) and thickness == 0:
        thickness = TILTED_WINDOW
    if thickness:
        normal = Rotation.from_rotvec([0.0, *turn]).as_matrix()[:, 0]
        elements.append(Window(triple(rotor @ normal), thickness, triple(chief)))
    return tuple(elements)
