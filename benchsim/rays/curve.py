"""The predicted trace of one exposure: centre line, width, flux, phase, and the irradiance across it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RegularGridInterpolator

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Laser, Mirror, Physics, Screen
from benchsim.bench.place import Placement
from benchsim.rays import interpolated_trace
from benchsim.rays.batch import stacked
from benchsim.rays.bench import Bench, nodes_needed
from benchsim.rays.interpolated_trace import FAINT, left_of
from benchsim.rays.phases import axis_points, check, many_phases, sample_phases, stands
from benchsim.rays.profile import Profiles
from benchsim.rays.sweep import cuts, mixed
from benchsim.rays.width import across as irradiance_across
from benchsim.rays.width import widths

Array = NDArray[np.float64]


def trace_curve(
    laser: Laser,
    mirror: Mirror,
    physics: Physics,
    screen: Screen,
    placement: Placement,
    *,
    facet: int | None = None,
    samples: int = 96,
) -> Curve:
    """Time-averaged trace on the board, of the nominal bench without effects.

    The centre is the mean of the irradiance across the curve. Diffraction at the height does not move it (its profile's
    tails are symmetric; see `diffraction`), nor does incoherent divergence, to first order. Where several branches
    cross the board, the one nearest to phase 0 is taken, which is aimed at the screen's centre.

    Parameters
    ----------
    laser, mirror, physics, screen, placement
        The bench of one exposure.
    facet : int, optional
        The exposure is gated to this facet: a sweep of one facet instead of all.
    samples : int
        Points, evenly spaced along the curve.

    Returns
    -------
    Curve
        ``points`` [mm] on the board from edge to edge, in the order of growing phase. ``width`` [mm] is the root of the
        adaptive Gaussian-weighted second moment about the mean (`profile.adaptive`), which exists with diffraction too;
        0 without beam. ``flux`` [1/mm]: light per mm of the curve, laser power 1, averaged over a revolution, all of
        the profile's tails included. Without beam the single ray has power 1. ``phase`` [rad] is the turn of the
        reflecting normal from ``placement.normal``; facet k reflects there at mirror phase ``phase − 2πk/facets``.

    Raises
    ------
    BenchsimError
        Laser below the horizon or behind the mirror; mirror that misses the beam; trace off the board.
    """
    return trace(Bench(laser, mirror, physics, screen, placement, facet), samples)


def trace(bench: Bench, samples: int = 96, *, width: bool = True) -> Curve:
    """Time-averaged trace of a bench with whatever effects its parts have; see `trace_curve`.

    Where facets lean differently and the exposure is not gated, ``points`` is the mean of the light of all facets,
    ``width`` that of all their profiles together, and ``parting`` how far they lie apart. ``width`` false leaves it out
    (None), which saves half the time.
    """
    check(bench)
    phase = sample_phases(bench, samples)
    if not bench.physics.beam:
        return _ray_curve(bench, phase, width=width)
    for rule in interpolated_trace.rules(bench):
        found = interpolated_trace.curves(bench, phase, rule, width=width)
        if found.resolved:
            return found.curve()
    points, _, nodes = beam_profiles(bench, phase)
    wide, aside = widths(bench, nodes).T if width else (None, None)
    return Curve(points, wide, nodes.flux, nodes.mean(nodes.phase), nodes.parting(bench.parts.timing.shake), aside)


def _ray_curve(bench: Bench, phase: Array, *, width: bool = True) -> Curve:
    points = axis_points(bench, phase)
    shake = bench.parts.timing.shake
    tangent = tangents(points)
    nodes = mixed(bench, cuts(bench, points, tangent, phase[:, None, None], 1, 1, kicks=False), points, tangent, 1)
    if nodes.shift is not None and nodes.share is not None:
        centre = (nodes.share * nodes.shift).sum(axis=1)
        points = points + centre[:, None] * left_of(tangent)
    parting = nodes.parting(shake)
    spread = np.zeros(len(phase)) if parting is None else np.sqrt(parting)
    return Curve(points, spread if width else None, nodes.flux, phase, parting)


def traces(benches: Sequence[Bench], samples: int = 96, *, width: bool = True) -> list[Curve | None]:
    """`trace` of benches that are `batch.alike`, worked out together; None where the light misses mirror or board."""
    out, left = together(benches, samples, width=width)
    for i in left:
        out[i] = _or_none(benches[i], samples, width=width)
    return out


def together(
    benches: Sequence[Bench], samples: int, *, width: bool = True, front: bool = False
) -> tuple[list[Curve | None], list[int]]:
    """Smooth traces of benches that are `batch.alike`, and the numbers of those that are not smooth enough for it.

    None, too, where the light misses mirror or board. ``front`` as in `interpolated_trace.curves`.
    """
    out: list[Curve | None] = [None] * len(benches)
    left = [i for i, bench in enumerate(benches) if stands(bench)]
    rules = interpolated_trace.rules(benches[0])
    if not left or not rules:
        return out, left
    members = [benches[i] for i in left]
    stack = stacked(members)
    phase = many_phases(stack, members, samples)
    lit = np.asarray(np.isfinite(phase).all(axis=1))
    left, phase = [i for i, on in zip(left, lit.tolist(), strict=True) if on], phase[lit]
    for rule in rules:
        if not left:
            break
        if len(left) < len(members):
            members = [benches[i] for i in left]
            stack = stacked(members)
        found = interpolated_trace.curves(stack, phase, rule, width=width, front=front)
        for k in np.flatnonzero(found.resolved).tolist():
            out[left[k]] = found.curve(k)
        left, phase = [i for i in left if out[i] is None], phase[~found.resolved]
    return out, left


def _or_none(bench: Bench, samples: int, *, width: bool) -> Curve | None:
    try:
        return trace(bench, samples, width=width)
    except BenchsimError:
        return None


def tangents(points: Array) -> Array:
    """Unit tangents (n, 2) of the smooth curve through points (n, 2), in their order."""
    steps = np.diff(points, axis=0)
    length = np.hypot(steps[:, 0], steps[:, 1])
    if len(points) >= 4 and length.max() < 1.3 * length.min():
        # Evenly spaced: the number of the point serves as the parameter, and the spline's derivative is a matrix.
        t = _derivative(len(points)) @ points
        return t / np.hypot(t[:, 0], t[:, 1])[:, None]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    t = CubicSpline(s, points)(s, 1)
    return np.asarray(t / np.linalg.norm(t, axis=1, keepdims=True))


@lru_cache(maxsize=64)
def _derivative(n: int) -> Array:
    """Matrix (n, n) of the derivative of the cubic spline through n evenly spaced values."""
    return np.asarray(CubicSpline(np.arange(n), np.eye(n))(np.arange(n), 1))


def beam_profiles(
    bench: Bench, phase: Array, across: int | None = None, along: int | None = None
) -> tuple[Array, Array, Profiles]:
    """Profiles perpendicular to the trace's centre line, from the laser axis' ray as a first guess.

    Parameters
    ----------
    bench : Bench
    phase : (m,) array
        Phases of the axis ray, growing [rad].
    across, along : int, optional
        Nodes on the facet; default `nodes_needed`.

    Returns
    -------
    points : (n, 2) ndarray [mm]
        Centres; n < m where some profiles get no light.
    tangent : (n, 2) ndarray
        Unit, of growing phase.
    nodes : Profiles
        ``q`` is measured from ``points``.

    Raises
    ------
    BenchsimError
        If the mirror misses the beam.
    """
    points = axis_points(bench, phase)
    need = nodes_needed(bench)
    start = phase[:, None, None]
    for t, h in ((across or need[0], 1), (across or need[0], along or need[1])):
        tangent = tangents(points)
        nodes = cuts(bench, points, tangent, start, t, h, kicks=h > 1)
        if h > 1:
            nodes = mixed(bench, nodes, points, tangent, t)
        flux = nodes.flux
        brightest = np.nanmax(flux, initial=0.0)
        bright = flux > FAINT * brightest
        reach = np.linalg.norm(points[-1] - points[0])
        if bright.sum() < 4 or brightest * reach < FAINT:
            raise BenchsimError(
                "the mirror misses the beam; mend the mirror's position, its height or the laser's angles"
            )
        if not bright.all():
            nodes, points, tangent = nodes.only(bright), points[bright], tangent[bright]
        centre = nodes.mean(nodes.q)
        if nodes.shift is not None and nodes.share is not None:
            centre = centre + (nodes.share * nodes.shift).sum(axis=1)
        points = points + centre[:, None] * left_of(tangent)
        start = nodes.phase
    return points, tangent, nodes._replace(q=nodes.q - centre[:, None, None])


def irradiance_profiles(
    laser: Laser,
    mirror: Mirror,
    physics: Physics,
    screen: Screen,
    placement: Placement,
    q: Array,
    *,
    facet: int | None = None,
    samples: int = 96,
) -> tuple[Curve, Array]:
    """Irradiance across the trace, at offsets from the centre line.

    Parameters
    ----------
    laser, mirror, physics, screen, placement, facet, samples
        As in `trace_curve`; ``physics.beam`` must be true.
    q : (n,) array [mm]
        Evenly spaced offsets from the centre line, along the tangent turned by +90 degrees.

    Returns
    -------
    curve : Curve
    irradiance : (samples, n) ndarray [1/mm²]
        Laser power 1, averaged over a revolution. Without diffraction it is the average over each cell of q.

    Raises
    ------
    BenchsimError
        As `trace_curve`; or without beam, where the trace is a line of no width.
    """
    bench = Bench(laser, mirror, physics, screen, placement, facet)
    if not physics.beam:
        raise BenchsimError("physics.beam: false, a single ray has no profile; set it to true")
    check(bench)
    points, _, nodes = beam_profiles(bench, sample_phases(bench, samples))
    width, aside = widths(bench, nodes).T
    curve = Curve(points, width, nodes.flux, nodes.mean(nodes.phase), None, aside)
    return curve, irradiance_across(bench, nodes, np.broadcast_to(q, (len(points), len(q))))


def irradiance(
    laser: Laser,
    mirror: Mirror,
    physics: Physics,
    screen: Screen,
    placement: Placement,
    points: Array,
    *,
    facet: int | None = None,
    step: float = 0.02,
    reach: float = 12.0,
    samples: int = 96,
) -> Array:
    """Irradiance at points of the board, interpolated in a table of profiles.

    Parameters
    ----------
    laser, mirror, physics, screen, placement, facet
        As in `irradiance_profiles`.
    points : (n, 2) array [mm]
    step, reach : float [mm]
        Of the table across the curve; 0 beyond ``reach``, which cuts a slit's tails, and beyond the curve's ends.
    samples : int
        Profiles along the curve.

    Returns
    -------
    (n,) ndarray [1/mm²]
        Laser power 1, averaged over a revolution. The edges of geometric optics are softened over ``step``; its kinks
        leave interpolation errors of some 1e-3 of the peak.

    Raises
    ------
    BenchsimError
        As `irradiance_profiles`.
    """
    count = int(reach / step)
    q: Array = step * np.linspace(-count, count, 2 * count + 1)
    curve, table = irradiance_profiles(laser, mirror, physics, screen, placement, q, facet=facet, samples=samples)
    distance, s = signed_distance(curve, points)
    out = np.zeros(len(distance))
    near = (np.abs(distance) <= q[-1]) & (s >= 0) & (s <= curve.arc_length()[-1])
    across = RegularGridInterpolator((curve.arc_length(), q), table, method="linear")
    out[near] = across(np.column_stack([s[near], distance[near]]))
    return out
