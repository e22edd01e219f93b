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

With effects m is any change of the unit normal and ξ any point (`facet`), the air hands over another ξ and q (`air`),
and the plane's hit goes on to the board's surface (`board_intersection`). What a recording has not is not in its
kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement
from benchsim.renderer import facet as facet_shape
from benchsim.renderer import laser as source
from benchsim.renderer.air import air
from benchsim.renderer.beam_table import BeamTable, axes
from benchsim.renderer.board_intersection import Landing, landing
from benchsim.renderer.facet import Shape
from benchsim.renderer.laser import Beam, Vec, bent, dot, ray_through
from benchsim.renderer.motion import Motion, motion
from benchsim.renderer.surface import turned


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
    edges : (triple, triple)
        E, the board's y and z.
    shape, air, landing, motion
        What effects make of facet, air, board and light; None or empty without.
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
    edges: tuple[Vec, Vec]
    shape: Shape | None = None
    air: tuple[Any, ...] = ()
    landing: Landing | None = None
    motion: Motion | None = None

    @property
    def plain(self) -> bool:
        """Whether every ray is as the module's head has it: flat upright facets, still air, a plane board."""
        return self.shape is None and not self.air and self.landing is None and self.beam.bent is None

    def from_board(self, v: Vec) -> Vec:
        """A vector (x, y, z) of the board's frame as a triple of the rotor's."""
        return tuple(v[0] * self.front[i] + v[1] * self.edges[0][i] + v[2] * self.edges[1][i] for i in range(3))

    def map(self, convert: Any) -> Optics:
        """The same with every number converted, for instance to opaque Dr.Jit variables."""

        def walk(x: Any) -> Any:
            if isinstance(x, tuple):
                return tuple(walk(e) for e in x)
            if is_dataclass(x) and not isinstance(x, type):
                return replace(x, **{f.name: walk(getattr(x, f.name)) for f in fields(x)})
            return convert(x) if isinstance(x, float) else x

        return replace(self, **{f.name: walk(getattr(self, f.name)) for f in fields(self)})


@dataclass(frozen=True)
class Bench:
    """What one exposure's light meets: the recording with its true laser, r, and where everything stands."""

    recording: Recording
    exposure: Exposure
    placement: Placement
    radius: float
    lenses: BeamTable | None = None


def bench(recording: Recording, exposure: Exposure, placement: Placement, lenses: BeamTable | None = None) -> Bench:
    """The bench of one exposure, with every effect that is a matter of where things stand worked into the placement.

    ``lenses`` is what lenses add to the laser's ideal beam.
    """
    radius, placement = facet_shape.disturbed(recording, placement)
    laser, placement = source.disturbed(recording, exposure, placement)
    placement = turned(placement, recording.effects)
    return Bench(replace(recording, laser=laser), exposure, placement, radius, lenses)


def optics(bench: Bench, phase: float) -> Optics:
    """Constants of a trace about a phase [rad] of the reflecting facet's normal, from ``placement.normal``."""
    placement, laser, mirror, table = bench.placement, bench.recording.laser, bench.recording.mirror, bench.lenses
    a = placement.axis / np.linalg.norm(placement.axis)
    n0 = placement.normal - (placement.normal @ a) * a
    n0 = n0 / np.linalg.norm(n0)
    n = np.cos(phase) * n0 + np.sin(phase) * np.cross(a, n0)
    rotor = np.stack([n, np.cross(a, n), a])
    d = rotor @ placement.laser_direction
    chief = d * np.array([-1.0, 1.0, 1.0])
    front, ey, ez = (rotor @ placement.screen_rotation).T
    point = placement.centre + bench.radius * n
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
        beam=Beam(
            triple(d),
            laser.curvature,
            laser.waist,
            lenses,
            bent(bench.recording, placement.axis, placement.laser_direction, rotor),
        ),
        radius=bench.radius,
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
        edges=(triple(ey), triple(ez)),
        shape=facet_shape.shape(bench.recording, float(phase)),
        air=air(bench.recording, placement, rotor, point, chief),
        landing=landing(bench.recording, placement, rotor, chief),
        motion=motion(bench.recording, bench.exposure, placement),
    )


@dataclass(frozen=True)
class Hit:
    """Where a ray meets the board, and what it met before.

    ``y, z`` [mm] on the board; ``rho``, ``spread`` of the beam's ray (see `laser.ray_through`); ``falling`` n·g,
    negative on the mirror's outside; ``distance`` [mm] from the mirror to the board in units of |g| ≈ 1; ``approach``
    g'·N, negative on the board's front; ``lean`` a·g; ``t, h`` [mm] the point on the facet.

    With effects also ``x`` [mm], the board's height there, ``share``, the part of the light that glass lets through or
    None, ``out`` g' at the mirror, ``up``, the facet's own direction of h, ``sound``, whether the surface is met.
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
    x: Any = 0.0
    share: Any = None
    out: Vec = ()
    up: Vec = ()
    sound: Any = None

    @property
    def arrives(self) -> Any:
        """Whether the light meets the mirror's outside and then the board's front."""
        arrives = (self.falling < 0.0) & (self.approach < 0.0) & (self.distance > 0.0)
        return arrives if self.sound is None else arrives & self.sound


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


def _onward_bent(
    o: Optics, xi: Vec, kick: Vec, rho: Vec, spread: Any, change: Vec, up: Vec, t: Any, h: Any, ghost: Any, m: Any
) -> Hit:
    """The same with whatever effects there are; ``change`` is the unit normal less (1, 0, 0)."""
    d = o.beam.direction
    normal = (1.0 + change[0], change[1], change[2])
    turn = dot(d, change) + dot(kick, normal)
    q: Vec = tuple(kick[i] - 2.0 * (d[0] * change[i] + turn * normal[i]) for i in range(3))
    out = tuple(o.chief[i] + q[i] for i in range(3))
    share = None
    if o.shape is not None and o.shape.coated_behind:
        # The coating is parallel to the front face: the light leaves in the direction in which that would reflect it.
        aside, reflected = facet_shape.within(tuple(d[i] + kick[i] for i in range(3)), normal)
        share = facet_shape.share(reflected, ghost)
        xi = tuple(xi[i] + (1.0 - ghost) * 2.0 * o.shape.glass * aside[i] for i in range(3))
    for element in o.air:
        xi, q, part = element.bend(xi, q, m)
        if part is not None:
            share = part if share is None else share * part
    approach = o.slope + dot(q, o.front)
    distance = -(o.height + dot(xi, o.front)) / approach
    v = tuple(xi[i] + distance * q[i] for i in range(3))
    sound: Any = None
    x, y, z = 0.0 * approach, o.hit[0] + dot(v, o.across), o.hit[1] + dot(v, o.up)
    if o.landing is not None:
        x, y, z, sound = o.landing.land(y, z, q, approach)
        distance = distance + x / approach
    return Hit(y, z, rho, spread, d[0] + turn, distance, approach, d[2] + kick[2], t, h, x, share, out, up, sound)


def from_facet(
    o: Optics, delta: Any, t: Any, h: Any, m: Any, jitter: Any = None, facet: Any = 0.0, ghost: Any = 0.0
) -> Hit:
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
    facet, ghost : array
        Number of the facet; 1 for what a glass front face reflects, else 0. Looked at where they matter only.
    """
    c1, s = _turn(delta, m)
    if o.plain:
        xi: Vec = (o.radius * c1 - t * s, o.radius * s + t * (1.0 + c1), h)
        kick, rho, spread = ray_through(o.beam, tuple(o.offset[i] + xi[i] for i in range(3)), jitter)
        return _onward(o, xi, kick, rho, spread, c1, s, t, h)
    zero = 0.0 * (delta + t + h)
    if o.shape is None:
        on, change, up = (-t * s, t * (1.0 + c1), h + zero), (c1, s, 0.0), (0.0, 0.0, 1.0)
    else:
        on, change, up = facet_shape.lift(o.shape, c1, s, o.shape.leaning(delta, facet, m), t + zero, h + zero, m)
    xi = (o.radius * c1 + on[0], o.radius * s + on[1], on[2])
    kick, rho, spread = ray_through(o.beam, tuple(o.offset[i] + xi[i] for i in range(3)), jitter)
    return _onward_bent(o, xi, kick, rho, spread, change, up, t, h, ghost, m)


def single_ray(o: Optics, delta: Any, m: Any, *, facets: bool, facet: Any = 0.0, ghost: Any = 0.0) -> Hit:
    """The one ray of ``physics.beam = false``.

    With facets it is fixed along the laser's axis and meets the facet's plane at (t, h), which may lie beyond its
    edges; without, it is the ray of a parallel pencil that meets P(ε) = C + r n(ε) (Carretero 2019, Eqs (9)-(12)).
    """
    c1, s = _turn(delta, m)
    zero = delta * 0.0
    if not o.plain:
        return _bent_ray(o, c1, s, zero, delta, m, facets, facet, ghost)
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


def _bent_ray(o: Optics, c1: Any, s: Any, zero: Any, delta: Any, m: Any, facets: bool, facet: Any, ghost: Any) -> Hit:
    """The single ray with effects: the facet's surface is met by iteration, and the beam bends where its axis is."""
    nothing = (zero, zero, zero)
    kick: Vec = nothing
    if o.beam.bent is not None:
        bent = o.beam.bent
        su, sv = bent.slopes(zero, zero)
        kick = tuple(bent.u[i] * su + bent.v[i] * sv for i in range(3))
    g, e = tuple(o.beam.direction[i] + kick[i] for i in range(3)), o.offset
    shape = o.shape
    lean = zero if shape is None else shape.leaning(delta, facet, m)
    across = (-s, 1.0 + c1, zero)
    t, h = zero, zero
    xi: Vec = (o.radius * c1, o.radius * s, zero)
    flat = Shape(0.0, 0.0, (), None, 0.0, 0.0, False, 1) if shape is None else shape
    _, change, up = facet_shape.lift(flat, c1, s, lean, zero, zero, m)
    if facets:
        base, n = xi, (1.0 + change[0], change[1], change[2])
        for _ in range(3):
            sag = -0.5 * flat.curvature * (t * t + h * h)
            along = (dot(n, tuple(e[i] + base[i] for i in range(3))) + sag) / dot(n, g)
            xi = tuple(along * g[i] - e[i] for i in range(3))
            away = tuple(xi[i] - base[i] for i in range(3))
            t, h = dot(away, across), dot(away, up)
        _, change, up = facet_shape.lift(flat, c1, s, lean, t, h, m)
    return _onward_bent(o, xi, kick, nothing, 1.0 + zero, change, up, t, h, ghost, m)
