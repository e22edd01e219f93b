"""Laser, mirror and screen joined: where light arrives at a phase, and the profiles of the time-averaged trace.

The mirror's phase ε is swept uniformly, so the exposure averages over ε. Light from the point (t, h) of a facet draws
a thin curve on the board; the profile of the trace along a straight line (X, m), perpendicular to the tangent τ, is the
sum over (t, h) of what arrives where that curve cuts the line:

    E(q) dq = N/(2π) Σ I |n·g|/(g·d)³ dt dh / |τ·∂hit/∂ε|        at τ·(hit(t, h, ε) − X) = 0,  q = m·(hit − X).

The phase is solved for each node of a Gauss–Legendre rule on the facet. There is no edge to clip but the facet's own,
so the moments are smooth in every parameter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.place import Placement
from benchsim.rays import air as medium
from benchsim.rays import laser as source
from benchsim.rays import mirror as optic
from benchsim.rays import plane
from benchsim.rays import screen as board_plane
from benchsim.rays.bench import Bench, facet_nodes
from benchsim.rays.laser import dot, over, some
from benchsim.rays.profile import Profiles

Array = NDArray[np.float64]

PHASE_STEP = 1e-5
"""Step of the central difference in phase (rad): truncation and rounding are both near 1e-10 of the derivative."""


LAST_STEP = 1e-6
"""Step of Newton's method [rad] after which the error left is some 1e-8 and neither flux nor centre feel it."""


class Light(NamedTuple):
    """Light at the mirror and on the board: point, unit normal, directions in and out (not normalised), hit, path.

    ``passed`` is the share of it that a mirror's glass lets through, None for all.
    """

    x: Array
    normal: Array
    incoming: Array
    outgoing: Array
    board: Array
    path: Array
    passed: Array | None = None

    def first(self) -> Light:
        """The first of a stack of phases."""
        passed = None if self.passed is None else self.passed[0]
        x, normal, incoming, outgoing, board, path = (a[0] for a in self[:6])
        return Light(x, normal, incoming, outgoing, board, path, passed)

    def reaches(self, placement: Placement) -> NDArray[np.bool_]:
        """Where light falls on the mirror's outside and then on the board's front."""
        return (
            (dot(self.incoming, self.normal) < 0)
            & (board_plane.facing(placement, self.outgoing) < 0)
            & (self.path > 0)
            & np.isfinite(self.board).all(axis=-1)
        )


def _onward(
    bench: Bench,
    x: Array,
    normal: Array,
    incoming: Array,
    leave: Array | None = None,
    passed: Array | None = None,
) -> Light:
    """Light from the mirror's points x, or from where it leaves the glass, on to the board."""
    p, parts = bench.placement, bench.parts
    outgoing = optic.reflect(incoming, normal)
    start, way = x if leave is None else leave, outgoing
    if not parts.air.still:
        start, way = medium.carry(parts.air, p, start, outgoing)
    board, path = board_plane.meet(p, start, way, parts.board)
    if bench.shift is not None:
        board = board + bench.shift
    return Light(x, normal, incoming, outgoing, board, path, passed)


def axis_ray(bench: Bench, phase: Array, lean: Array | float = 0.0, *, front: bool = False) -> Light:
    """The single ray of ``physics.beam = false``, at each phase.

    With facets it is fixed along the laser's axis and meets the facet's plane; the facet's edges are not applied here.
    Without, it is the ray of a parallel pencil that meets P(ε) = C + r n(ε) (Carretero 2019, Eqs (9)-(12)).

    Parameters
    ----------
    bench : Bench
    phase : (...) array
        Phase of the reflecting facet [rad].
    lean : float or (...) array
        Added to the mean facet's lean [rad].
    front : bool
        The ray that the front of the mirror's glass reflects.
    """
    p, polygon = bench.placement, bench.parts.polygon
    lean = lean + polygon.lean(bench.facet, phase)
    direction = bench.beam.centre
    zero = np.zeros(())
    x, normal, _ = optic.surface(p, bench.radius, 0.0, phase, lean, zero, zero)
    incoming = np.broadcast_to(direction, np.broadcast_shapes(direction.shape, normal.shape))
    if bench.facets:
        # On the facet's plane, then on its sag there: the ray is fixed and the facet turns.
        s = (dot(normal, x) - dot(normal, p.laser_point)) / dot(normal, direction)
        at = p.laser_point + source.outer(s, direction)
        if some(polygon.curvature):
            off = at - x
            normal = normal + over(polygon.curvature) * off
            normal = normal / np.sqrt(dot(normal, normal))[..., None]
            sag = 0.5 * polygon.curvature * dot(off, off)
            at = at - source.outer(sag / dot(normal, direction), direction)
        x = at
    if front:
        return _onward(bench, x, normal, incoming, passed=optic.refracted(incoming, normal)[2])
    if not some(polygon.glass):
        return _onward(bench, x, normal, incoming)
    return _onward(bench, x, normal, incoming, *optic.through_glass(polygon.glass, x, normal, incoming))


def _beam_light(
    bench: Bench,
    phase: Array,
    t: Array,
    h: Array,
    lean: Array | float = 0.0,
    *,
    front: bool = False,
    power: bool = False,
) -> tuple[Light, Array | float]:
    """The beam's ray that meets the point (t, h) of the facet at a phase; for a cylinder t is 0.

    ``lean`` is added to the mean facet's. Of glass (t, h) is the point of the front face at which the light enters.
    With ``power`` also the power per dt dh that the first of a stack of phases brings to the board.
    """
    p, polygon = bench.placement, bench.parts.polygon
    lean = lean + polygon.lean(bench.facet, phase)
    x, normal, area = optic.surface(p, bench.radius, polygon.curvature, phase, lean, t, h)
    incoming, density = bench.beam.light(x)
    leave, passed = None, None
    if front:
        passed = optic.refracted(incoming, normal)[2]
    elif some(polygon.glass):
        leave, passed = optic.through_glass(polygon.glass, x, normal, incoming)
    light = _onward(bench, x, normal, incoming, leave, passed)
    if not power:
        return light, 0.0
    falls = density(normal[0], 0)
    if area is not None:
        falls = falls * area[0]
    return light, falls


def cuts(
    bench: Bench,
    origin: Array,
    tangent: Array,
    phase: Array,
    across: int,
    along: int,
    *,
    lean: Array | float = 0.0,
    front: bool = False,
    kicks: bool = True,
    last_step: float = LAST_STEP,
) -> Profiles:
    """Profiles of the trace along straight lines on the board, of one lean of the facets.

    Parameters
    ----------
    bench : Bench
    origin, tangent : (..., m, 2) array
        Points [mm] near the trace, and unit tangents in the direction of growing phase; the line runs along the tangent
        turned by +90 degrees.
    phase : (..., m, 1 or across, 1 or along) array
        Phases at which light arrives near each origin [rad]; Newton's method starts there.
    across, along : int
        Number of nodes over the facet's width and height.
    lean : float
        Added to the mean facet's [rad].
    front : bool
        Light off the front of the mirror's glass.
    kicks : bool
        Whether `Profiles.lateral` and `Profiles.chirp` are wanted; 0 otherwise.
    last_step : float
        Newton's method ends after a step this small [rad].

    Returns
    -------
    Profiles
        ``weight`` is NaN where a node's light cannot be brought to the line at any phase.
    """
    p = bench.placement
    t, h, area = nodes = facet_nodes(bench, across, along)
    if bench.frame is not None and not front:
        leans = lean + bench.parts.polygon.lean(bench.facet, phase)
        share = bench.exposure_per_phase
        return plane.cuts(
            bench.frame, origin, tangent, phase, nodes, leans, share=share, kicks=kicks, last_step=last_step
        )
    (ty, tz), (oy, oz) = _components(tangent), _components(origin)
    e = np.array(np.broadcast_to(phase, (*phase.shape[:-2], t.shape[0], h.shape[1])))
    steps = PHASE_STEP * np.array([0.0, 1.0, -1.0]).reshape(3, *(1,) * e.ndim)

    def ahead(light: Light) -> Array:
        return (light.board[..., 0] - oy) * ty + (light.board[..., 1] - oz) * tz

    def ray(at: Array, power: bool) -> tuple[Light, Array | float]:
        if not bench.physics.beam:
            return axis_ray(bench, at, lean, front=front), 1.0
        return _beam_light(bench, at, t, h, lean, front=front, power=power)

    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        last, rise = np.inf, e
        for _ in range(20):
            # After a small step the slope serves once more: it is off by about twice the step.
            new = last > 1e-2
            f = ahead(ray(e + steps[: 2 if new else 1], False)[0])
            if new:
                rise = (f[1] - f[0]) / PHASE_STEP
            step = -f[0] / rise
            e += np.clip(step, -0.05, 0.05)
            last = float(np.fmax.reduce(np.abs(step).ravel(), initial=0.0))
            # The last bit is corrected to first order below.
            if not last > last_step:
                break
        light, power = ray(e + steps, True)
        f = ahead(light)
        speed = (f[1] - f[2]) / (2 * PHASE_STEP)
        beside = (light.board[..., 1] - oz) * ty - (light.board[..., 0] - oy) * tz
        slant = (beside[1] - beside[2]) / (2 * PHASE_STEP)
        late = f[0] / speed
        q = beside[0] - slant * late
        light = light.first()
        reaches = light.reaches(p)
        weight = bench.exposure_per_phase * area * power
        weight = weight / np.abs(speed)
        if light.passed is not None:
            weight = weight * light.passed
        missed = ~(np.abs(late) < 1e-4)
        weight = np.where(missed, np.nan, np.where(reaches, weight, 0.0))
        nothing = np.zeros(())
        lateral, chirp = _kick(bench, light, tangent, slant / speed) if kicks else (nothing, nothing)
    return Profiles(q, weight, e - late, np.broadcast_to(lateral, q.shape), np.broadcast_to(chirp, q.shape))


def mixed(
    bench: Bench,
    nodes: Profiles,
    origin: Array,
    tangent: Array,
    across: int,
    finer: Callable[[Profiles], Profiles] = lambda nodes: nodes,
) -> Profiles:
    """The profiles of the mean lean with the facets' shifts and shares, and the light of all in ``weight``.

    ``finer`` carries nodes to a rule that is fine enough for sums over them.
    """
    if bench.facet is not None:
        return finer(nodes)
    fine = finer(nodes)
    with np.errstate(invalid="ignore", divide="ignore"):
        here = fine.mean(fine.phase)
        off = bench.parts.polygon.spread(here)
    if off is None:
        return fine
    far = np.abs(off).max(axis=(-2, -1))[..., None, None]
    start = nodes.phase[..., nodes.phase.shape[-1] // 2, None]
    middle, more, less = (
        finer(cuts(bench, origin, tangent, start, across, 1, lean=lean, kicks=False))
        for lean in (0.0, far[..., None], -far[..., None])
    )
    three = [less, middle, more]
    hurried: Array | float = 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        if bench.parts.polygon.uneven:
            # A facet that leans more is met a little later, where its lean has changed again; and while it changes
            # the light passes the profile faster or slower.
            late = (more.mean(more.phase) - less.mean(less.phase)) / (2 * far[..., 0])
            hurried = 1.0 / (1.0 - bench.parts.polygon.steepness(here) * late[..., None])
        u: Array = off * hurried / far

        def at(values: list[Array]) -> Array:
            low, here, high = (v[..., None] for v in values)
            return here + 0.5 * u * (high - low) + 0.5 * u * u * (high + low - 2 * here)

        shift = at([s.mean(s.q) - middle.mean(middle.q) for s in three])
        light = np.maximum(at([s.flux / middle.flux for s in three]), 0.0) * hurried
    total = light.mean(axis=-1)
    return fine._replace(
        weight=fine.weight * total[..., None, None], shift=shift, share=light / light.sum(axis=-1, keepdims=True)
    )


def _components(vectors: Array) -> tuple[Array, Array]:
    """y and z of vectors (..., m, 2) of profiles, to broadcast against their nodes."""
    return vectors[..., 0, None, None], vectors[..., 1, None, None]


def _kick(bench: Bench, light: Light, tangent: Array, slant: Array) -> tuple[Array, Array]:
    """How a small turn of the reflected ray moves its cut through the profile's line; see `Profiles`.

    A turn δ ⟂ r̂ moves the hit by s (δ − r̂ (δ·b)/(r̂·b)), b the board's normal; what of it lies along the motion only
    changes the phase at which the line is cut. ``slant`` is the motion's part across the tangent over that along it.
    """
    p, board = bench.placement, bench.parts.board
    length = np.sqrt(dot(light.outgoing, light.outgoing))
    ray = light.outgoing / length[..., None]
    path = light.path * length
    front, edge_y, edge_z = board_plane.columns(p.screen_rotation)
    ty, tz = _components(tangent)
    # Components of the ray along the board's axes and its local normal.
    rf, ry, rz = dot(ray, front), dot(ray, edge_y), dot(ray, edge_z)
    slope_y, slope_z = board.slopes(light.board[..., 0], light.board[..., 1])
    py, pz = -tz - slant * ty, ty - slant * tz
    scale = (py * ry + pz * rz) / (rf - slope_y * ry - slope_z * rz)
    # pull = probe − (probe·r̂)/(r̂·b) b, which is perpendicular to the ray already.
    lateral = path * np.sqrt((py + scale * slope_y) ** 2 + (pz + scale * slope_z) ** 2 + scale * scale)
    a = p.axis
    lift = slope_z * ty - slope_y * tz
    across_a = lift * dot(front, a) + ty * dot(edge_z, a) - tz * dot(edge_y, a)
    across_r = lift * rf + ty * rz - tz * ry
    chirp = (across_a - across_r * dot(ray, a)) / path
    return lateral, chirp
