"""Light from a flat facet straight to a flat board, in closed form: most benches, at a third of the general cost.

Of a homocentric beam and a mirror without glass or curvature, before still air and a plane board, everything is a sum
of a few products. In the frame that turns with the facet (n, axis × n, axis) a point (t, h) of it stands at
(ρ, t, η) = (r − h sin λ, t, h cos λ) from C, λ the lean; with L counted from C and u = d − κ L, the beam's ray there
runs along

    g = (κ ρ + u_n, κ t + u_t, κ η + u_a)   and leaves along   (−g_n cos 2λ − g_a sin 2λ, g_t, g_a cos 2λ − g_n sin 2λ).

A vector that stands still has v_n = v₀ cos ε + v_b sin ε and v_t = dv_n/dε in that frame, so the components of point
and ray along any direction of the board and their derivatives by the phase follow: what `sweep` finds for every element
by differences of rays is exact here. The two agree to some 1e-8 mm, where Newton's method by differences ends.

Everything may have a leading axis of benches, as in `batch`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.place import Placement
from benchsim.rays.laser import Beam, cos_sin, cross, dot, some
from benchsim.rays.profile import Profiles
from benchsim.rays.screen import columns

Array = NDArray[np.float64]
Components = tuple[Any, Any, Any]

SQUARE = 1e-12
"""Largest cosine between axis and normal: the frame is one only where they are perpendicular."""

CLOSE = 10.0
"""Newton's method, with exact slopes here, may end after a step this much larger than with slopes by differences."""


class Frame(NamedTuple):
    """Vectors by their components along normal, axis × normal and axis at phase 0.

    ``front``, ``edges``: the board's axes x; y and z. ``far``: C there, with what shifts the light.
    ``section``: the beam's u and v, where it has them.
    """

    radius: Any
    beam: Beam
    reference: Components
    travel: Components
    fan: Components
    front: Components
    edges: tuple[Components, Components]
    far: Components
    section: tuple[Components, Components] | None


def frame(placement: Placement, beam: Beam, radius: Array | float, shift: Array | None) -> Frame | None:
    """What is the same at all phases; None where axis and normal are not perpendicular."""
    normal, axis = placement.normal, placement.axis
    if np.max(np.abs(dot(normal, axis))) > SQUARE:
        return None
    across = cross(axis, normal)

    def seen(v: Array) -> Components:
        return dot(v, normal), dot(v, across), dot(v, axis)

    reference, travel = seen(beam.point - placement.centre), seen(beam.axis)
    fan = tuple(d - beam.curvature * at for d, at in zip(travel, reference, strict=True))
    front, y, z = columns(placement.screen_rotation)
    away = placement.centre - placement.screen_origin
    x0, y0, z0 = dot(away, front), dot(away, y), dot(away, z)
    if shift is not None:
        y0, z0 = y0 + shift[..., 0], z0 + shift[..., 1]
    section = None if beam.section is None else (seen(beam.section[0]), seen(beam.section[1]))
    fans = fan[0], fan[1], fan[2]
    return Frame(radius, beam, reference, travel, fans, seen(front), (seen(y), seen(z)), (x0, y0, z0), section)


def _turning(vector: Components, c: Array, s: Array) -> tuple[Array, Array]:
    """v_n, and v_t, its derivative by the phase."""
    return c * vector[0] + s * vector[1], c * vector[1] - s * vector[0]


class _Rays:
    """Points of the facet at phases, and the rays that leave them."""

    def __init__(self, f: Frame, phase: Array, t: Array, h: Array, lean: Any) -> None:
        self.turn = cos_sin(phase)
        self.t = t
        kappa = f.beam.curvature
        u_n, u_t = _turning(f.fan, *self.turn)
        self.leans = some(lean)
        (c1, s1), (c2, s2) = ((np.cos(k * lean), np.sin(k * lean)) for k in (1, 2))
        self.rho: Any = f.radius - h * s1 if self.leans else f.radius
        self.eta: Array = h * c1 if self.leans else h
        self.g_n, self.g_t = kappa * self.rho + u_n, kappa * t + u_t
        self.g_a = kappa * self.eta + f.fan[2]
        self.falling = c1 * self.g_n + s1 * self.g_a if self.leans else self.g_n
        # The ray, and what its derivative's components are along a direction's.
        if self.leans:
            self.out_n, self.out_a = -(c2 * self.g_n + s2 * self.g_a), c2 * self.g_a - s2 * self.g_n
            self.by_n, self.by_a = -(c2 * u_t + self.g_t), -s2 * u_t
        else:
            self.out_n, self.out_a = -self.g_n, self.g_a
            self.by_n, self.by_a = -(u_t + self.g_t), 0.0
        self.by_t = self.out_n - u_n

    def along(self, row: Components, far: Any) -> tuple[Array, Array, Array, Array]:
        """Along a direction: place of the point, component of the ray, and their derivatives by the phase."""
        n, t = _turning(row, *self.turn)
        at = self.rho * n + self.t * t + (self.eta * row[2] + far)
        ray = self.out_n * n + self.g_t * t + self.out_a * row[2]
        ray_turns = self.by_n * n + self.by_t * t
        if self.leans:
            ray_turns = ray_turns + self.by_a * row[2]
        return at, ray, self.rho * t - self.t * n, ray_turns

    def power(self, f: Frame) -> Array:
        """Power per dt dh, of the beam's light on the facet."""
        beam = f.beam
        (l_n, l_t), (d_n, d_t) = _turning(f.reference, *self.turn), _turning(f.travel, *self.turn)
        here = self.rho - l_n, self.t - l_t, self.eta - f.reference[2]
        along = here[0] * d_n + here[1] * d_t + here[2] * f.travel[2]
        inverse = 1.0 / (1.0 + beam.curvature * along)
        rho2 = here[0] * here[0] + here[1] * here[1] + here[2] * here[2] - along * along
        light = beam.gaussian(rho2 * (inverse * inverse))
        if some(*beam.more.shape):
            assert f.section is not None
            u, v = (
                here[0] * n + here[1] * t + here[2] * part[2]
                for part in f.section
                for n, t in (_turning(part, *self.turn),)
            )
            light = light * beam.reshaped(u * inverse, v * inverse)
        return np.asarray(light * np.maximum(-self.falling, 0.0) * (inverse * inverse * inverse))


def cuts(
    f: Frame,
    origin: Array,
    tangent: Array,
    phase: Array,
    nodes: tuple[Array, Array, Array],
    lean: Any,
    *,
    share: float,
    kicks: bool,
    last_step: float,
) -> Profiles:
    """`sweep.cuts` in closed form.

    Parameters
    ----------
    f : Frame
    origin, tangent, phase, kicks, last_step
        As there.
    nodes : (t, h, area)
        `bench.facet_nodes`.
    lean : float or (bench, 1, 1, 1) array
        All of it [rad].
    share : float
        `Bench.exposure_per_phase`.
    """
    t, h, area = nodes
    ty, tz, oy, oz = (v[..., k, None, None] for v in (tangent, origin) for k in (0, 1))
    (y, z), (x0, y0, z0) = f.edges, f.far
    y0, z0 = y0 - oy, z0 - oz
    track: Components = tuple(ty * a + tz * b for a, b in zip(y, z, strict=True))
    beside: Components = tuple(ty * b - tz * a for a, b in zip(y, z, strict=True))
    far_on, far_aside = ty * y0 + tz * z0, ty * z0 - tz * y0
    e = np.array(np.broadcast_to(phase, (*phase.shape[:-2], t.shape[0], h.shape[1])))

    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(20):
            rays = _Rays(f, e, t, h, lean)
            path, path_turns, falling = _paths(rays, f, x0)
            ahead, speed, _ = _hits(rays, track, far_on, path, path_turns)
            step = -ahead / speed
            last = float(np.fmax.reduce(np.abs(step).ravel(), initial=0.0))
            if last > 0.05:
                step = np.clip(step, -0.05, 0.05)
            e += step
            # The last bit is corrected to first order below.
            if not last > CLOSE * last_step:
                break
        rays = _Rays(f, e, t, h, lean)
        path, path_turns, falling = _paths(rays, f, x0)
        ahead, speed, ray_on = _hits(rays, track, far_on, path, path_turns)
        aside, slant, ray_aside = _hits(rays, beside, far_aside, path, path_turns)
        late = ahead / speed
        q = aside - slant * late
        reaches = (rays.falling < 0) & (falling < 0) & (path > 0) & np.isfinite(aside)
        weight = (share * area) * rays.power(f) / np.abs(speed)
        weight = np.where(np.abs(late) < 1e-4, np.where(reaches, weight, 0.0), np.nan)
        if not kicks:
            nothing = np.broadcast_to(0.0, q.shape)
            return Profiles(q, weight, e - late, nothing, nothing)
        # A turn of the ray moves its cut through the line as in `sweep`: here every component is at hand.
        slope = slant / speed
        scale = (ray_aside - slope * ray_on) / falling
        length2 = rays.g_n * rays.g_n + rays.g_t * rays.g_t + rays.g_a * rays.g_a
        way = path * np.sqrt(length2)
        lateral = way * np.sqrt(1.0 + slope * slope + scale * scale)
        chirp = (beside[2] - ray_aside * rays.out_a / length2) / way
    return Profiles(q, weight, e - late, lateral, chirp)


def _paths(rays: _Rays, f: Frame, far: Any) -> tuple[Array, Array, Array]:
    """Paths to the board in units of the ray's length, their derivatives, and the rays' components along its normal."""
    height, falling, climbs, bends = rays.along(f.front, far)
    path = -height / falling
    return path, -(climbs + path * bends) / falling, falling


def _hits(rays: _Rays, row: Components, far: Any, path: Array, path_turns: Array) -> tuple[Array, Array, Array]:
    """Where rays hit, along a direction of the board, the derivative by the phase, and the rays' component along it."""
    at, ray, at_turns, ray_turns = rays.along(row, far)
    return at + path * ray, at_turns + path_turns * ray + path * ray_turns, ray


def axis_hits(f: Frame, phase: Array, lean: Any) -> tuple[Array, NDArray[np.bool_]]:
    """Where the laser's axis ray meets the board, (..., 2) [mm], and whether it falls on both fronts.

    ``phase`` and ``lean`` as of `sweep.axis_ray`.
    """
    c, s = cos_sin(phase)
    c1, s1 = (np.cos(lean), np.sin(lean)) if some(lean) else (1.0, 0.0)

    def lean_toward(v: Components) -> Array:
        return np.asarray((c1 * v[0]) * c + (c1 * v[1]) * s + s1 * v[2])

    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        falls = lean_toward(f.travel)
        way = (f.radius * c1 - lean_toward(f.reference)) / falls
        twice = 2.0 * falls

        def along(row: Components, far: Any) -> tuple[Array, Array]:
            on = row[0] * f.travel[0] + row[1] * f.travel[1] + row[2] * f.travel[2]
            start = far + row[0] * f.reference[0] + row[1] * f.reference[1] + row[2] * f.reference[2]
            return start + on * way, on - twice * lean_toward(row)

        height, falling = along(f.front, f.far[0])
        path = -height / falling
        # Benches that differ only in what shifts the light share all paths to the board.
        hits = (at + path * ray for at, ray in map(along, f.edges, f.far[1:]))
        board = np.stack(np.broadcast_arrays(*hits), axis=-1)
        lit = (falls < 0) & (falling < 0) & (path > 0) & np.isfinite(board[..., 0])
    return board, lit
