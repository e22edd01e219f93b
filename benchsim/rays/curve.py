"""The predicted trace of one exposure: centre line, width, flux, phase, and the irradiance across it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RegularGridInterpolator

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Laser, Mirror, Physics, Screen
from benchsim.bench.place import Placement
from benchsim.rays import screen as board_plane
from benchsim.rays.profile import Profiles
from benchsim.rays.sweep import Bench, axis_ray, cuts, mixed
from benchsim.rays.width import across as irradiance_across
from benchsim.rays.width import widths

Array = NDArray[np.float64]

MOST = 128
"""Cap on the nodes in one direction; beams narrower than a twentieth of the facet reach it and are placed less well."""

FAINT = 1e-9
"""Share of a trace's brightest flux, and of the laser's power on the board, below which the mirror misses the beam."""

SEARCH = (501, 4001)
"""Phases of the half turn at which the board is looked for: the finer only where the coarser finds nothing."""


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

    Where facets lean differently and the exposure is not gated, ``points`` is the mean of the light of all facets and
    ``width`` that of all their profiles together. ``width`` false leaves it out (None), which saves half the time.
    """
    check(bench)
    phase = sample_phases(bench, samples)
    if not bench.physics.beam:
        return _ray_curve(bench, phase, width=width)
    points, _, nodes = beam_profiles(bench, phase)
    return Curve(points, widths(bench, nodes) if width else None, nodes.flux, nodes.mean(nodes.phase))


def check(bench: Bench) -> None:
    """Raise BenchsimError if the laser stands below the horizon or behind the mirror."""
    d = bench.placement.laser_direction
    if d[2] > 0:
        raise BenchsimError("the laser is below the horizon; give an elevation above 0")
    if d @ bench.placement.normal >= 0:
        raise BenchsimError("the laser stands behind the mirror; mend the laser's angles or the mirror's position")


def sample_phases(bench: Bench, samples: int) -> Array:
    """Phases at which the laser's axis ray travels evenly over the board, (samples,) [rad], growing.

    Raises
    ------
    BenchsimError
        If the ray misses the mirror at all phases, or never meets the board.
    """
    for count in SEARCH:
        grid = np.linspace(-np.pi / 2, np.pi / 2, count)
        beyond, board = _beyond(bench, grid)
        on = np.flatnonzero(beyond <= 0)
        if len(on):
            break
    else:
        if not np.isfinite(beyond).any():
            raise BenchsimError(
                "the mirror misses the beam or sends none of it toward the board; "
                "mend the mirror's position or the laser's angles"
            )
        nearest = board[np.argmin(beyond)]
        raise BenchsimError(
            f"the trace passes beside the board (nearest point y = {nearest[0]:.0f}, z = {nearest[1]:.0f} mm); "
            "mend the mirror's position, the laser's angles or the screen's size"
        )
    runs = np.split(on, np.flatnonzero(np.diff(on) > 1) + 1)
    run = min(runs, key=lambda r: np.min(np.abs(grid[r])))
    before, after = max(int(run[0]) - 1, 0), min(int(run[-1]) + 1, len(grid) - 1)
    if np.isfinite(beyond[[before, after]]).all():
        first, last = grid[before], grid[after]
    else:
        first, last = _edges(bench, grid, int(run[0]), int(run[-1]))
    dense = np.linspace(first, last, 160)
    light = axis_ray(bench, dense)
    steps = np.diff(light.board, axis=0)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    # Where it crosses the edge, by a straight line between two of these points: to some 1e-3 mm.
    off = board_plane.margin(bench.screen.size, light.board)
    on = np.flatnonzero(off <= 0)
    i, j = (int(on[0]), int(on[-1])) if len(on) else (0, len(dense) - 1)
    start = s[i] if i == 0 else s[i] + (s[i - 1] - s[i]) * off[i] / (off[i] - off[i - 1])
    end = s[j] if j == len(dense) - 1 else s[j] + (s[j + 1] - s[j]) * off[j] / (off[j] - off[j + 1])
    return np.interp(np.linspace(start, end, samples), s, dense)


def _beyond(bench: Bench, phase: Array) -> tuple[Array, Array]:
    """How far beyond the board's edge the axis ray lands [mm], infinite where it does not, and where."""
    p = bench.placement
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        light = axis_ray(bench, phase)
        lit = light.reaches(p)
        if bench.facets and not bench.physics.beam:
            rest = light.x - p.centre
            along = rest @ p.axis
            off = (rest * rest).sum(axis=-1) - along**2 - bench.radius**2
            lit &= np.sqrt(np.maximum(off, 0.0)) <= bench.mirror.facet_width / 2
        return np.where(lit, board_plane.margin(bench.screen.size, light.board), np.inf), light.board


def _edges(bench: Bench, grid: Array, first: int, last: int) -> tuple[float, float]:
    """Phases at which the axis ray comes onto the board and leaves it, to 1e-3 of the grid's step, from inside."""
    inside, ways = (first, last), (-1, 1)
    out = [float(grid[i]) for i in inside]
    beside = [
        float(grid[i + w]) if 0 <= i + w < len(grid) else float(grid[i]) for i, w in zip(inside, ways, strict=True)
    ]
    for _ in range(2):
        part = np.linspace(out, beside, 33)
        off = _beyond(bench, part.ravel())[0].reshape(part.shape) > 0
        for side in (0, 1):
            k = int(np.argmax(off[:, side])) if off[:, side].any() else len(part)
            out[side] = float(part[max(k - 1, 0), side])
            beside[side] = float(part[min(k, len(part) - 1), side])
    return out[0], out[1]


def _ray_curve(bench: Bench, phase: Array, *, width: bool = True) -> Curve:
    points = axis_ray(bench, phase).board
    spread = np.full(len(phase), bench.parts.timing.shake)
    tangent = tangents(points)
    nodes = mixed(bench, cuts(bench, points, tangent, phase[:, None, None], 1, 1, kicks=False), points, tangent, 1)
    if nodes.shift is not None and nodes.share is not None:
        centre = (nodes.share * nodes.shift).sum(axis=1)
        points = points + centre[:, None] * left_of(tangent)
        spread = np.hypot(spread, np.sqrt((nodes.share * (nodes.shift - centre[:, None]) ** 2).sum(axis=1)))
    return Curve(points, spread if width else None, nodes.flux, phase)


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
    return t / np.linalg.norm(t, axis=1, keepdims=True)


@lru_cache(maxsize=64)
def _derivative(n: int) -> Array:
    """Matrix (n, n) of the derivative of the cubic spline through n evenly spaced values."""
    return np.asarray(CubicSpline(np.arange(n), np.eye(n))(np.arange(n), 1))


def left_of(tangent: Array) -> Array:
    return np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)


def nodes_needed(bench: Bench) -> tuple[int, int]:
    """Gauss–Legendre nodes over a facet's width and height that place the centre line to 1e-7 mm.

    The facet's half sides in units of the beam's waist decide; measured against 80 × 40 nodes over beam diameters of
    1 to 40 mm, on twelve settings disturbed by 2 σ.
    """
    w = bench.laser.waist
    across = 4 + int(np.ceil(5 * bench.mirror.facet_width / 2 / w))
    along = 3 + int(np.ceil(6 * bench.mirror.height / 2 / w))
    return min(across, MOST), min(along, MOST)


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
    points = axis_ray(bench, phase).board
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
    curve = Curve(points, widths(bench, nodes), nodes.flux, nodes.mean(nodes.phase))
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
