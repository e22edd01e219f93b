"""Laser, mirror and screen joined: where light arrives at a phase, and the profiles of the time-averaged trace.

The mirror's phase ε is swept uniformly, so the exposure averages over ε. Light from the point (t, h) of a facet draws
a thin curve on the board; the profile of the trace along a straight line (X, m), perpendicular to the tangent τ, is the
sum over (t, h) of what arrives where that curve cuts the line:

    E(q) dq = N/(2π) Σ I |n·g|/(g·d)³ dt dh / |τ·∂hit/∂ε|        at τ·(hit(t, h, ε) − X) = 0,  q = m·(hit − X).

The phase is solved for each node of a Gauss–Legendre rule on the facet. There is no edge to clip but the facet's own,
so the moments are smooth in every parameter.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Laser, Mirror, Physics, Screen
from benchsim.bench.place import Placement
from benchsim.rays import laser as source
from benchsim.rays import mirror as optic
from benchsim.rays import screen as board_plane
from benchsim.rays.laser import dot

Array = NDArray[np.float64]

PHASE_STEP = 1e-5
"""Step of the central difference in phase (rad): truncation and rounding are both near 1e-10 of the derivative."""


@dataclass(frozen=True)
class Bench:
    """What one exposure's light meets. ``facet`` is the gated facet, or None."""

    laser: Laser
    mirror: Mirror
    physics: Physics
    screen: Screen
    placement: Placement
    facet: int | None = None

    @property
    def facets(self) -> bool:
        """Whether light is reflected by flat facets; otherwise by a cylinder of the same r."""
        return self.physics.facets and self.mirror.shape == "polygon"

    @property
    def exposure_per_phase(self) -> float:
        """Share of the revolution per radian of one reflecting normal's turn [1/rad], summed over what reflects.

        N facets, or the gated one, each pass any phase once a revolution. A cylinder stands in the beam all the time:
        its share is 1 per radian of its surface. The pencil without beam or facets has one ray at each phase.
        """
        if self.physics.beam and not self.facets:
            return 1.0
        return (self.mirror.facets if self.facets and self.facet is None else 1) / (2 * np.pi)


class Light(NamedTuple):
    """Light at the mirror and on the board: point, unit normal, directions in and out (not normalised), hit, path."""

    x: Array
    normal: Array
    incoming: Array
    outgoing: Array
    board: Array
    path: Array

    def reaches(self, placement: Placement) -> NDArray[np.bool_]:
        """Where light falls on the mirror's outside and then on the board's front."""
        return (
            (dot(self.incoming, self.normal) < 0)
            & (board_plane.facing(placement, self.outgoing) < 0)
            & (self.path > 0)
            & np.isfinite(self.board).all(axis=-1)
        )


def _onward(bench: Bench, x: Array, normal: Array, incoming: Array) -> Light:
    outgoing = optic.reflect(incoming, normal)
    board, path = board_plane.meet(bench.placement, x, outgoing)
    return Light(x, normal, incoming, outgoing, board, path)


def axis_ray(bench: Bench, phase: Array) -> Light:
    """The single ray of ``physics.beam = false``, at each phase.

    With facets it is fixed along the laser's axis and meets the facet's plane; the facet's edges are not applied here.
    Without, it is the ray of a parallel pencil that meets P(ε) = C + r n(ε) (Carretero 2019, Eqs (9)-(12)).

    Parameters
    ----------
    bench : Bench
    phase : (...) array
        Phase of the reflecting facet [rad].
    """
    p = bench.placement
    normal = optic.normal_at(p, phase)
    incoming = np.broadcast_to(p.laser_direction, normal.shape)
    if bench.facets:
        x = optic.meet_facet_plane(p, bench.mirror.radius, normal, p.laser_point, p.laser_direction)
    else:
        x = p.centre + bench.mirror.radius * normal
    return _onward(bench, x, normal, incoming)


def beam_ray(bench: Bench, phase: Array, t: Array, h: Array) -> Light:
    """The beam's ray that meets the point (t, h) of the facet at a phase; for a cylinder t is 0."""
    p = bench.placement
    normal = optic.normal_at(p, phase)
    x = optic.facet_point(p, bench.mirror.radius, normal, t, h)
    return _onward(bench, x, normal, source.direction(bench.laser.curvature, p.laser_point, p.laser_direction, x))


@lru_cache(maxsize=32)
def _gauss(n: int) -> tuple[Array, Array]:
    return np.polynomial.legendre.leggauss(n)


def facet_nodes(bench: Bench, across: int, along: int) -> tuple[Array, Array, Array]:
    """Gauss–Legendre nodes on a facet.

    Returns
    -------
    t : (across, 1) ndarray [mm]
    h : (1, along) ndarray [mm]
    weight : (across, along) ndarray [mm²]
        For a cylinder a single t = 0 with weight r, the width of surface that a radian of phase sweeps.
    """
    u, w = _gauss(along)
    half = bench.mirror.height / 2
    if not bench.facets:
        return np.zeros((1, 1)), half * u[None, :], bench.mirror.radius * half * w[None, :]
    v, z = _gauss(across)
    wide = bench.mirror.facet_width / 2
    return wide * v[:, None], half * u[None, :], wide * half * np.outer(z, w)


class Profiles(NamedTuple):
    """Nodes of profiles across a trace: axes are (profile, t, h).

    ``q`` [mm] where the light from a node cuts the profile's line, ``weight`` its light per mm of the curve, ``phase``
    [rad] when; ``lateral`` [mm/rad] how far a turn of the reflected ray across its motion moves q; ``chirp`` [1/mm]
    turns a distance in q into a turn of the ray along the facet's height.
    """

    q: Array
    weight: Array
    phase: Array
    lateral: Array
    chirp: Array

    @property
    def flux(self) -> Array:
        """Light per mm of the curve, (profile,)."""
        return self.weight.sum(axis=(1, 2))

    def mean(self, values: Array) -> Array:
        """Flux-weighted mean over a profile, (profile,)."""
        return (self.weight * values).sum(axis=(1, 2)) / self.flux


def profiles(bench: Bench, origin: Array, tangent: Array, phase: Array, across: int, along: int) -> Profiles:
    """Profiles of the trace along straight lines on the board.

    Parameters
    ----------
    bench : Bench
    origin, tangent : (m, 2) array
        Points [mm] near the trace, and unit tangents in the direction of growing phase; the line runs along the tangent
        turned by +90 degrees.
    phase : (m,) array
        A phase at which light arrives near each origin [rad]; Newton's method starts there.
    across, along : int
        Number of nodes over the facet's width and height.

    Returns
    -------
    Profiles
        ``weight`` is NaN where a node's light cannot be brought to the line at any phase.
    """
    p = bench.placement
    t, h, area = facet_nodes(bench, across, along)
    tau = tangent[:, None, None, :]
    start = origin[:, None, None, :]
    left = np.stack([-tau[..., 1], tau[..., 0]], axis=-1)
    e = np.broadcast_to(phase[:, None, None], (len(phase), t.shape[0], h.shape[1])).copy()
    pair = np.array([0.0, PHASE_STEP])[:, None, None, None]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(12):
            f, ahead = dot(beam_ray(bench, e + pair, t, h).board - start, tau)
            step = -f * PHASE_STEP / (ahead - f)
            e += np.clip(step, -0.05, 0.05)
            # The slope's error of 1e-5 makes the next step that much smaller than this one.
            if not np.nanmax(np.abs(step), initial=0.0) > 1e-9:
                break
        both = beam_ray(bench, e + np.array([-1.0, 1.0])[:, None, None, None] * PHASE_STEP, t, h).board
        motion = (both[1] - both[0]) / (2 * PHASE_STEP)
        light = beam_ray(bench, e, t, h)
        speed = dot(motion, tau)
        power = source.power_density(bench.laser, p.laser_point, p.laser_direction, light.x, light.normal)
        weight = bench.exposure_per_phase * area * power / np.abs(speed)
        q = dot(light.board - start, left)
        lateral, chirp = _kick(bench, light, left, motion, speed, tau)
        missed = ~(np.abs(dot(light.board - start, tau)) < 1e-6)
        weight = np.where(missed, np.nan, np.where(light.reaches(p), weight, 0.0))
    return Profiles(q, weight, e, lateral, chirp)


def _kick(bench: Bench, light: Light, left: Array, motion: Array, speed: Array, tau: Array) -> tuple[Array, Array]:
    """How a small turn of the reflected ray moves its cut through the profile's line; see `Profiles`.

    A turn δ ⟂ r̂ moves the hit by s (δ − r̂ (δ·b)/(r̂·b)), b the board's normal; what of it lies along the motion only
    changes the phase at which the line is cut.
    """
    p = bench.placement
    length = np.linalg.norm(light.outgoing, axis=-1)
    ray = light.outgoing / length[..., None]
    path = light.path * length
    front, edges = p.screen_rotation[:, 0], p.screen_rotation[:, 1:]
    probe = (left - (dot(motion, left) / speed)[..., None] * tau) @ edges.T
    pull = probe - (dot(probe, ray) / (ray @ front))[..., None] * front
    pull = pull - dot(pull, ray)[..., None] * ray
    lateral = path * np.linalg.norm(pull, axis=-1)
    across = left @ edges.T
    a = p.axis
    chirp = (across @ a - dot(across, ray) * (ray @ a)) / path
    return lateral, chirp
