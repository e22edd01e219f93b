"""One ray by the turning mirror to the board, precise in float32.

Frame: the rotor's at a middle phase φc, with unit vectors n (normal of the reflecting facet at φc), b = a × n, a (axis
of rotation), and the point P = C + r n. The ray along the laser's axis that is reflected at P with the normal n has
the direction R and meets the board at H; both are computed in float64. Every other ray is traced as its difference
from that one. With δ the phase less φc, m = (cos δ − 1, sin δ, 0) the change of the normal, ξ the point less P, k the
direction less d:

    g' − R = q = k − 2 [(d·n) m + (d·m + k·(n + m)) (n + m)]
    t = −(P·N + ξ·N) / ((R + q)·N),   hit = H + v·G,   v = ξ + t q,   G = E − N (R·E)/(R·N)

with N the board's normal and E its two axes. No term is larger than the board, so a float32 hit is within 0.1 µm or so
of float64, where tracing in the world frame loses tens of µm.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from benchsim.bench.model import Laser, Mirror
from benchsim.bench.place import Placement
from benchsim.render.beam_table import BeamTable, axes
from benchsim.render.laser import Beam, Vec, dot, ray_through


@dataclass(frozen=True)
class Optics:
    """One exposure about one middle phase: every constant of a trace. Triples are in the rotor's frame.

    Attributes
    ----------
    beam : Beam
    radius, half_width, half_height : mm
    offset : triple, mm
        P less the laser's reference point.
    chief : triple
        R.
    front : triple
        N, the board's normal, toward the mirror.
    height : mm
        P·N, the distance of P from the board.
    slope : mm/mm
        R·N.
    across, up : triple
        G of the board's y and z.
    hit : (y, z), mm
        H.
    """

    beam: Beam
    radius: Any
    half_width: Any
    half_height: Any
    offset: Vec
    chief: Vec
    front: Vec
    height: Any
    slope: Any
    across: Vec
    up: Vec
    hit: tuple[Any, Any]

    def map(self, convert: Any) -> Optics:
        """The same with every number converted, for instance to opaque Dr.Jit variables."""

        def walk(x: Any) -> Any:
            if isinstance(x, tuple):
                return tuple(walk(e) for e in x)
            if isinstance(x, Beam):
                return replace(x, **{f.name: walk(getattr(x, f.name)) for f in fields(x)})
            return convert(x)

        return replace(self, **{f.name: walk(getattr(self, f.name)) for f in fields(self)})


def optics(laser: Laser, mirror: Mirror, placement: Placement, phase: float, table: BeamTable | None = None) -> Optics:
    """Constants of a trace about a phase [rad] of the reflecting facet's normal, from ``placement.normal``.

    ``table`` is what lenses add to the laser's ideal beam.
    """
    a = placement.axis / np.linalg.norm(placement.axis)
    n0 = placement.normal - (placement.normal @ a) * a
    n0 = n0 / np.linalg.norm(n0)
    n = np.cos(phase) * n0 + np.sin(phase) * np.cross(a, n0)
    rotor = np.stack([n, np.cross(a, n), a])
    d = rotor @ placement.laser_direction
    chief = d * np.array([-1.0, 1.0, 1.0])
    front, ey, ez = (rotor @ placement.screen_rotation).T
    point = placement.centre + mirror.radius * n
    from_board = rotor @ (point - placement.screen_origin)
    height, slope = from_board @ front, chief @ front
    t = -height / slope

    def triple(v: Any) -> Vec:
        return tuple(float(x) for x in v)

    lenses: tuple[Any, ...] = ()
    if table is not None:
        x, y = (triple(rotor @ v) for v in axes(placement.laser_direction))
        lenses = (x, y, 1 / (table.reach * laser.waist), table.slope_x, table.slope_y, table.log_ratio)
    return Optics(
        beam=Beam(triple(d), laser.curvature, laser.waist, lenses),
        radius=mirror.radius,
        half_width=mirror.facet_width / 2,
        half_height=mirror.height / 2,
        offset=triple(rotor @ (point - placement.laser_point)),
        chief=triple(chief),
        front=triple(front),
        height=float(height),
        slope=float(slope),
        across=triple(ey - front * (chief @ ey) / slope),
        up=triple(ez - front * (chief @ ez) / slope),
        hit=(float((from_board + t * chief) @ ey), float((from_board + t * chief) @ ez)),
    )


@dataclass(frozen=True)
class Hit:
    """Where a ray meets the board, and what it met before.

    ``y, z`` [mm] on the board; ``rho``, ``spread`` of the beam's ray (see `laser.ray_through`); ``falling`` n·g,
    negative on the mirror's outside; ``distance`` [mm] from the mirror to the board in units of |g| ≈ 1; ``approach``
    g'·N, negative on the board's front; ``lean`` a·g; ``t, h`` [mm] the point on the facet.
    """

    y: Any
    z: Any
    rho: Vec
    spread: Any
    falling: Any
    distance: Any
    approach: Any
    lean: Any
    t: Any
    h: Any

    @property
    def arrives(self) -> Any:
        """Whether the light meets the mirror's outside and then the board's front."""
        return (self.falling < 0.0) & (self.approach < 0.0) & (self.distance > 0.0)


def _turn(delta: Any, m: Any) -> tuple[Any, Any]:
    """cos δ − 1 without cancellation, and sin δ."""
    s, c = m.sin(delta * 0.5), m.cos(delta * 0.5)
    return -2.0 * s * s, 2.0 * s * c


def _onward(o: Optics, xi: Vec, kick: Vec, rho: Vec, spread: Any, c1: Any, s: Any, t: Any, h: Any) -> Hit:
    """Reflect the ray d + kick at P + ξ with the normal (1 + c1, s, 0) and meet the board."""
    d = o.beam.direction
    turn = d[0] * c1 + d[1] * s + kick[0] * (1.0 + c1) + kick[1] * s
    q = (
        kick[0] - 2.0 * (d[0] * c1 + turn * (1.0 + c1)),
        kick[1] - 2.0 * (d[0] * s + turn * s),
        kick[2],
    )
    approach = o.slope + dot(q, o.front)
    distance = -(o.height + dot(xi, o.front)) / approach
    v = tuple(xi[i] + distance * q[i] for i in range(3))
    return Hit(
        y=o.hit[0] + dot(v, o.across),
        z=o.hit[1] + dot(v, o.up),
        rho=rho,
        spread=spread,
        falling=d[0] + turn,
        distance=distance,
        approach=approach,
        lean=d[2] + kick[2],
        t=t,
        h=h,
    )


def from_facet(o: Optics, delta: Any, t: Any, h: Any, m: Any, jitter: Any = None) -> Hit:
    """The beam's ray that meets the point (t, h) of the facet.

    Parameters
    ----------
    o : Optics
    delta : array
        Phase less the middle phase [rad].
    t, h : array
        Position on the facet across the axis and along it, from its centre [mm]; for a cylinder t is 0.
    m : module
        numpy or drjit, whichever the arrays are of.
    jitter : optional
        See `laser.ray_through`.
    """
    c1, s = _turn(delta, m)
    xi = (o.radius * c1 - t * s, o.radius * s + t * (1.0 + c1), h)
    kick, rho, spread = ray_through(o.beam, tuple(o.offset[i] + xi[i] for i in range(3)), jitter)
    return _onward(o, xi, kick, rho, spread, c1, s, t, h)


def single_ray(o: Optics, delta: Any, m: Any, *, facets: bool) -> Hit:
    """The one ray of ``physics.beam = false``.

    With facets it is fixed along the laser's axis and meets the facet's plane at (t, h), which may lie beyond its
    edges; without, it is the ray of a parallel pencil that meets P(ε) = C + r n(ε) (Carretero 2019, Eqs (9)-(12)).
    """
    c1, s = _turn(delta, m)
    zero = delta * 0.0
    if facets:
        d, e = o.beam.direction, o.offset
        n = (1.0 + c1, s)
        along = (n[0] * e[0] + n[1] * e[1] - o.radius * c1) / (d[0] * n[0] + d[1] * n[1])
        # The facet's plane is n·ξ = r (1 − cos δ), and t = (axis × n)·(r n_c + ξ).
        xi = tuple(along * d[i] - e[i] for i in range(3))
        t = -s * (o.radius + xi[0]) + n[0] * xi[1]
    else:
        xi, t = (o.radius * c1, o.radius * s, zero), zero
    nothing = (zero, zero, zero)
    return _onward(o, xi, nothing, nothing, 1.0 + zero, c1, s, t, xi[2])
