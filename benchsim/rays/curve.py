"""The predicted trace of one exposure: centre line, width, flux, phase, and the irradiance across it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RegularGridInterpolator

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Laser, Mirror, Physics, Recording, Screen
from benchsim.bench.place import Placement, SettingErrors, place
from benchsim.rays import laser as source
from benchsim.rays import screen as board_plane
from benchsim.rays.diffraction import fresnel_profile, scales
from benchsim.rays.profile import adaptive, geometric_profile, refine_height, smear
from benchsim.rays.sweep import PHASE_STEP, Bench, Profiles, axis_ray, profiles

Array = NDArray[np.float64]

MOST = 128
"""Cap on the nodes in one direction; beams narrower than a twentieth of the facet reach it and are placed less well."""

FAINT = 1e-9
"""Share of a trace's brightest flux, and of the laser's power on the board, below which the mirror misses the beam."""


def predict(recording: Recording, exposure: Exposure, errors: SettingErrors | None = None, samples: int = 96) -> Curve:
    """Time-averaged trace of one exposure of a recording on the board.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure
    errors : SettingErrors, optional
        True minus stated setting; default none.
    samples : int
        Points along the curve.

    Returns
    -------
    Curve
        See `trace_curve`.

    Raises
    ------
    BenchsimError
        If the recording's simulation contains effects, which this version does not model, and as `trace_curve`.
    """
    refuse_effects(recording)
    try:
        return trace_curve(
            recording.laser,
            recording.mirror,
            recording.physics,
            recording.screen,
            place(recording.mirror, exposure, errors),
            facet=exposure.facet,
            samples=samples,
        )
    except BenchsimError as error:
        raise BenchsimError(f"{exposure.name}: {error}") from None


def refuse_effects(recording: Recording) -> None:
    """Raise BenchsimError if the recording's simulation contains effects; this version models none."""
    for name in recording.effects:
        raise BenchsimError(
            f"{recording.path.name}: effects.{name}: the ray model of this version does not model it; remove the table"
        )


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
    bench = Bench(laser, mirror, physics, screen, placement, facet)
    check(bench)
    phase = sample_phases(bench, samples)
    if not physics.beam:
        return _ray_curve(bench, phase)
    points, _, nodes = beam_profiles(bench, phase)
    return Curve(points, _width(bench, nodes), nodes.flux, nodes.mean(nodes.phase))


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
    p = bench.placement
    grid = np.linspace(-np.pi / 2, np.pi / 2, 4001)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        light = axis_ray(bench, grid)
        lit = light.reaches(p)
        if bench.facets and not bench.physics.beam:
            t = (light.x - p.centre) @ p.axis
            off = np.linalg.norm(light.x - p.centre - t[:, None] * p.axis, axis=1) ** 2 - bench.mirror.radius**2
            lit &= np.sqrt(np.maximum(off, 0.0)) <= bench.mirror.facet_width / 2
        beyond = np.where(lit, board_plane.margin(bench.screen.size, light.board), np.inf)
    if not lit.any():
        raise BenchsimError(
            "the mirror misses the beam or sends none of it toward the board; "
            "mend the mirror's position or the laser's angles"
        )
    on = np.flatnonzero(beyond <= 0)
    if len(on) == 0:
        nearest = light.board[np.argmin(beyond)]
        raise BenchsimError(
            f"the trace passes beside the board (nearest point y = {nearest[0]:.0f}, z = {nearest[1]:.0f} mm); "
            "mend the mirror's position, the laser's angles or the screen's size"
        )
    runs = np.split(on, np.flatnonzero(np.diff(on) > 1) + 1)
    run = min(runs, key=lambda r: np.min(np.abs(grid[r])))
    first, last = _edge(bench, grid, run[0], -1), _edge(bench, grid, run[-1], 1)
    dense = np.linspace(first, last, 400)
    steps = np.linalg.norm(np.diff(axis_ray(bench, dense).board, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    return np.interp(np.linspace(0.0, s[-1], samples), s, dense)


def _edge(bench: Bench, grid: Array, index: int, way: int) -> float:
    """Phase at which the axis ray leaves the board between two neighbours on the grid, to 1e-4 of their distance."""
    other = index + way
    inside = grid[index]
    if not 0 <= other < len(grid):
        return float(inside)
    part = np.linspace(inside, grid[other], 257)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        light = axis_ray(bench, part)
        out = ~(light.reaches(bench.placement) & (board_plane.margin(bench.screen.size, light.board) <= 0))
    return float(part[max(int(np.argmax(out)) - 1, 0)] if out.any() else inside)


def _ray_curve(bench: Bench, phase: Array) -> Curve:
    ahead, behind = axis_ray(bench, phase + PHASE_STEP).board, axis_ray(bench, phase - PHASE_STEP).board
    speed = np.linalg.norm(ahead - behind, axis=1) / (2 * PHASE_STEP)
    return Curve(axis_ray(bench, phase).board, np.zeros(len(phase)), bench.exposure_per_phase / speed, phase)


def _tangents(points: Array) -> Array:
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    t = CubicSpline(s, points)(s, 1)
    return t / np.linalg.norm(t, axis=1, keepdims=True)


def _left(tangent: Array) -> Array:
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
    for t, h in ((across or need[0], 1), (across or need[0], along or need[1])):
        tangent = _tangents(points)
        nodes = profiles(bench, points, tangent, phase, t, h)
        flux = nodes.flux
        brightest = np.nanmax(flux, initial=0.0)
        bright = np.isfinite(flux) & (flux > FAINT * brightest)
        reach = np.linalg.norm(points[-1] - points[0])
        if bright.sum() < 4 or brightest * reach < FAINT:
            raise BenchsimError(
                "the mirror misses the beam; mend the mirror's position, its height or the laser's angles"
            )
        nodes = Profiles(*(a[bright] for a in nodes))
        centre = nodes.mean(nodes.q)
        points, tangent = points[bright] + centre[:, None] * _left(tangent[bright]), tangent[bright]
        phase = nodes.mean(nodes.phase)
    return points, tangent, nodes._replace(q=nodes.q - centre[:, None, None])


def _width(bench: Bench, nodes: Profiles) -> Array:
    """Adaptive width about the mean; with diffraction on a few profiles, between which it is smooth."""
    n = len(nodes.q)
    if not bench.physics.diffraction:
        q, light = refine_height(nodes, 4 + 2 * nodes.q.shape[2])
        sigma = source.blur_sigma(bench.laser)
        if sigma > 0:
            q, light = smear(nodes, sigma, q, light)
        return adaptive(q.reshape(n, -1), light.reshape(n, -1), np.zeros(n))[1]
    few = np.unique(np.linspace(0, n - 1, min(n, 7)).round().astype(int))
    some = Profiles(*(a[few] for a in nodes))
    geometric, slit = scales(some, bench.laser.wavelength, bench.mirror.height)
    reach = 2 * geometric + 5 * slit + 6 * source.blur_sigma(bench.laser) * some.lateral.max(axis=(1, 2))
    count = 1 + 2 * int(np.ceil(np.max(2 * reach / slit)))
    # Two samples per slit scale: the pattern times the weight is band-limited, so the sums converge exponentially.
    grid = reach[:, None] * np.linspace(-1, 1, count)
    width = adaptive(grid, _irradiance(bench, some, grid), np.zeros(len(few)))[1]
    return CubicSpline(few, width)(np.arange(n))


def _irradiance(bench: Bench, nodes: Profiles, q: Array) -> Array:
    """Light per mm² at offsets q (profile, n), with diffraction and incoherent divergence as the bench has them."""

    def sharp(at: Array) -> Array:
        if bench.physics.diffraction:
            return fresnel_profile(nodes, bench.laser.wavelength, bench.mirror.height, at)
        return geometric_profile(nodes, at)

    sigma = source.blur_sigma(bench.laser)
    if sigma == 0:
        return sharp(q)
    reach = sigma * nodes.mean(nodes.lateral)[:, None]
    geometric, slit = scales(nodes, bench.laser.wavelength, bench.mirror.height)
    if bench.physics.diffraction and np.max(reach[:, 0] / slit) < 0.3:
        # A blur finer than the pattern: a few shifted patterns, exact to the pattern's band limit.
        x, w = np.polynomial.hermite_e.hermegauss(7)
        return np.sum([wi * sharp(q - reach * xi) for xi, wi in zip(x, w / w.sum(), strict=True)], axis=0)
    # Otherwise the sharp profile on a grid of its own, each of its samples spread into a Gaussian.
    extent = 2 * geometric + (20 * slit if bench.physics.diffraction else 0.0)
    step = np.minimum(0.4 * slit if bench.physics.diffraction else 0.02 * geometric, 0.6 * reach[:, 0])
    count = int(np.ceil(np.max(extent / step)))
    grid = extent[:, None] * np.linspace(-1, 1, 2 * count + 1)
    light = sharp(grid) * (extent / count)[:, None]
    spread = np.exp(-0.5 * ((q[:, :, None] - grid[:, None, :]) / reach[:, :, None]) ** 2)
    return np.einsum("pqg,pg->pq", spread, light) / (np.sqrt(2 * np.pi) * reach)


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
    curve = Curve(points, _width(bench, nodes), nodes.flux, nodes.mean(nodes.phase))
    return curve, _irradiance(bench, nodes, np.broadcast_to(q, (len(points), len(q))))


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
