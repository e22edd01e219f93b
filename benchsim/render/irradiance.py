"""Irradiance on the board, in the board's millimetres: the light of one exposure, traced and binned.

A sample is a phase of the mirror and a point of the facet, weighted with the beam's density there; facets being alike,
one facet over all phases that reach the board stands for all. Samples are points of a Kronecker lattice with a random
shift, several shifts give the noise. Hits are shared bilinearly between the four nearest bins, which keeps their
centroid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement, place
from benchsim.render import backend
from benchsim.render.beam_table import BeamTable
from benchsim.render.diffraction import Pattern, pattern
from benchsim.render.laser import blur_sigma, density, dot, perpendicular
from benchsim.render.mirror import Optics, from_facet, optics, single_ray

Array = NDArray[np.float64]

REPLICATES = 8
"""Independent shifts of the lattice; their scatter is the noise."""

LIT = 0.05
"""A bin counts as lit above this fraction of the brightest; the noise is that of lit bins."""

MARGIN = 10.0
"""Light that falls this far beyond the board's edge is traced too [mm]."""

_EXPANDED_BYTES = 512 << 20
"""Memory that one film per thread may take; above it hits are added atomically."""


@dataclass(frozen=True)
class ScreenMap:
    """Irradiance on the board.

    Attributes
    ----------
    values : (nz, ny) ndarray [1/mm²]
        Per unit of laser power, averaged over one revolution; bin (i, j) is centred at (y0 + j pitch, z0 + i pitch) and
        holds the irradiance averaged over it with a tent of half width ``pitch`` in y and z.
    y0, z0, pitch : mm
    relative_error : float
        rms of the relative noise (1 sigma) over the lit bins, those above 5 % of the brightest.
    rays : int
        Rays traced for it.
    """

    values: Array
    y0: float
    z0: float
    pitch: float
    relative_error: float
    rays: int = 0

    @property
    def y(self) -> Array:
        """Centres of the columns (ny,) [mm]."""
        return self.y0 + self.pitch * np.arange(self.values.shape[1], dtype=float)

    @property
    def z(self) -> Array:
        """Centres of the rows (nz,) [mm]."""
        return self.z0 + self.pitch * np.arange(self.values.shape[0], dtype=float)


@dataclass(frozen=True)
class Sweep:
    """What is sampled in one exposure: constants about the middle phase, the range of phase, and what the ray's weight
    is.

    ``measure`` is what one ray of weight 1 carries, times the number of rays. ``shear`` [rad/mm] is how the phase has
    to change with t for the hit to stay where it is along the trace: δ less shear · t is sampled, within ±
    ``half_range`` about 0, which is the phase ``middle`` of the reflecting facet's normal.
    """

    optics: Optics
    middle: float
    shear: float
    half_range: float
    measure: float
    facets: bool
    beam: bool
    blur: float
    pattern: Pattern | None
    wavelength: float


def _phase_grid() -> Array:
    return np.linspace(-np.pi, np.pi, 20001)


def sweep(recording: Recording, exposure: Exposure, placement: Placement, lenses: BeamTable | None = None) -> Sweep:
    """Prepare an exposure in float64: the phases whose light reaches the board, and the pattern of diffraction.

    Raises
    ------
    BenchsimError
        If the recording has effects, which this version does not draw, or no light reaches the board.
    """
    if recording.effects:
        raise BenchsimError(
            f"{recording.path}: [effects.{next(iter(recording.effects))}] is not drawn by this version of render; "
            "remove it from the file"
        )
    laser, mirror, physics = recording.laser, recording.mirror, recording.physics
    facets = physics.facets and mirror.shape == "polygon"
    grid = _phase_grid()
    step = grid[1] - grid[0]
    half = np.array(recording.screen.size) / 2 + MARGIN
    whole = optics(laser, mirror, placement, 0.0)
    t = np.array([-1.0, 0.0, 1.0])[:, None, None] * (whole.half_width if facets else 0.0)
    h = np.array([-1.0, 0.0, 1.0])[None, :, None] * whole.half_height
    with np.errstate(all="ignore"):
        hit = from_facet(whole, grid, t, h, np) if physics.beam else single_ray(whole, grid, np, facets=facets)
        lands = hit.arrives & (np.abs(hit.y) <= half[0]) & (np.abs(hit.z) <= half[1])
        if not physics.beam and facets:
            lands &= np.abs(hit.t) <= whole.half_width
        if physics.beam:
            lands &= dot(hit.rho, hit.rho) < (4 * laser.waist) ** 2
    if not lands.any():
        raise BenchsimError(
            f"{recording.path}: in exposure {exposure.name} no light of the laser reaches the board; check the laser's "
            "angles, mirror_position_mm and the screen's size and shift"
        )
    lit = np.flatnonzero(lands.reshape(-1, grid.size).any(axis=0))
    shear = 0.0
    if physics.beam and facets:
        shear = _shear(optics(laser, mirror, placement, (grid[lit[0]] + grid[lit[-1]]) / 2))
    sheared = np.broadcast_to(grid - shear * t if physics.beam else grid, lands.shape)[lands]
    first, last = sheared.min() - step, sheared.max() + step
    middle, half_range = (first + last) / 2, (last - first) / 2
    about = optics(laser, mirror, placement, middle, lenses)

    measure = 2 * half_range / (2 * np.pi)
    if facets:
        measure *= 1 if exposure.facet is not None else mirror.facets
        if physics.beam:
            measure *= mirror.facet_width * mirror.height
    elif physics.beam:
        measure *= 2 * np.pi * mirror.radius * mirror.height  # a cylinder stands in the beam at all times

    table = None
    if physics.beam and physics.diffraction:
        wide = (np.linspace(-1, 1, 21) * about.half_width)[:, None] if facets else np.zeros((1, 1))
        delta = np.linspace(-half_range, half_range, 201) + shear * wide
        centre = from_facet(about, delta, wide, 0.0, np)
        nu, beta = nu_and_beta(about, centre, laser.wavelength)
        seen = centre.arrives & (dot(centre.rho, centre.rho) < (2.5 * laser.waist) ** 2)
        alpha = (1 - about.beam.direction[2] ** 2) / laser.waist**2

        def span(x: Array) -> tuple[float, float]:
            low, high = float(x[seen].min()), float(x[seen].max())
            pad = 0.01 * (high - low) + 1e-4 * max(abs(low), abs(high))
            return low - pad, high + pad

        if not seen.any():
            raise BenchsimError(
                f"{recording.path}: in exposure {exposure.name} the laser's beam misses the mirror; check "
                "mirror_position_mm and the laser's angles"
            )
        table = pattern(mirror.height, alpha, span(nu), span(beta))
    return Sweep(
        optics=about,
        middle=middle,
        shear=shear,
        half_range=half_range,
        measure=measure,
        facets=facets,
        beam=physics.beam,
        blur=blur_sigma(laser) if physics.beam else 0.0,
        pattern=table,
        wavelength=laser.wavelength,
    )


def _shear(o: Optics) -> float:
    """dδ/dt at which the hit stands still along the trace, at the middle phase."""
    e, x = 1e-4, 1e-2
    ahead, behind = from_facet(o, e, 0.0, 0.0, np), from_facet(o, -e, 0.0, 0.0, np)
    right, left = from_facet(o, 0.0, x, 0.0, np), from_facet(o, 0.0, -x, 0.0, np)
    motion = np.array([ahead.y - behind.y, ahead.z - behind.z]) / (2 * e)
    shift = np.array([right.y - left.y, right.z - left.z]) / (2 * x)
    return float(-(motion @ shift) / (motion @ motion))


def nu_and_beta(o: Optics, centre: Any, wavelength: float) -> tuple[Any, Any]:
    """ν and β of `diffraction` for the ray that leaves the facet at h = 0."""
    sine2 = 1.0 - centre.lean * centre.lean
    nu = sine2 * (o.beam.curvature / centre.spread + 1.0 / centre.distance) / wavelength
    beta = -2.0 * centre.rho[2] / (o.beam.waist * o.beam.waist)
    return nu, beta


def _kronecker(dimensions: int) -> list[int]:
    """Steps of a Kronecker sequence by powers of the generalised golden ratio (x^(d+1) = x + 1), in units of 2^-32."""
    if dimensions == 0:
        return []
    ratio = float(np.max(np.roots([1.0, *[0.0] * (dimensions - 1), -1.0, -1.0]).real))
    return [round(2**32 * ratio ** -(k + 1)) | 1 for k in range(dimensions)]


class _Film:
    """Bins with one more on every side for what the tents lose there."""

    def __init__(self, size: tuple[float, float], pitch: float) -> None:
        self.pitch = pitch
        self.ny, self.nz = (max(1, int(np.ceil(s / pitch - 1e-9))) for s in size)
        self.y0, self.z0 = -(self.ny - 1) / 2 * pitch, -(self.nz - 1) / 2 * pitch
        self.shape = (self.nz + 2, self.ny + 2)
        backed = (
            str(mi.variant()).startswith("llvm")
            and dr.thread_count() * 4 * self.shape[0] * self.shape[1] < _EXPANDED_BYTES
        )
        self.mode = dr.ReduceMode.Expand if backed else dr.ReduceMode.Auto

    def add(self, bins: Any, y: Any, z: Any, weight: Any, active: Any) -> None:
        """Share ``weight`` at (y, z) [mm] between the four nearest bins."""
        row = self.shape[1]
        fy = (y - (self.y0 - self.pitch)) * (1 / self.pitch)
        fz = (z - (self.z0 - self.pitch)) * (1 / self.pitch)
        active = active & (fy >= 0) & (fz >= 0) & (fy < self.shape[1] - 1) & (fz < self.shape[0] - 1)
        iy, iz = mi.UInt32(fy), mi.UInt32(fz)
        fy, fz = fy - mi.Float(iy), fz - mi.Float(iz)
        index = iz * row + iy
        upper = weight * fz
        lower = weight - upper
        dr.scatter_add(bins, lower - lower * fy, index, active, self.mode)
        dr.scatter_add(bins, lower * fy, index + 1, active, self.mode)
        dr.scatter_add(bins, upper - upper * fy, index + row, active, self.mode)
        dr.scatter_add(bins, upper * fy, index + (row + 1), active, self.mode)


def _opaque(value: float) -> Any:
    # As a variable rather than a literal, so that the kernel is compiled once for all exposures.
    return dr.opaque(mi.Float, float(value))


def _opaque_uint(value: int) -> Any:
    return dr.opaque(mi.UInt32, value)


class _Tables:
    """The pattern of diffraction where the kernel can read it."""

    def __init__(self, p: Pattern) -> None:
        self.nodes, self.cells, self.terms = p.weights.shape
        self.edges = mi.Float(np.stack([p.edges[:-1], np.diff(p.edges)], axis=-1).astype(np.float32).ravel())
        self.weights = mi.Float(p.weights.astype(np.float32).ravel())
        self.nu0 = _opaque(p.nu[0])
        self.nu_scale = _opaque((self.nodes - 1) / (p.nu[-1] - p.nu[0]))
        low, high = p.beta
        self.beta0, self.beta_scale = _opaque((low + high) / 2), _opaque(2 / (high - low))

    def sample(self, v: Any, nu: Any, beta: Any) -> tuple[Any, Any]:
        """h' [mm] and its weight."""
        x = v * self.cells
        cell = mi.UInt32(x)
        edge = dr.gather(mi.Vector2f, self.edges, cell)
        h = dr.fma(x - mi.Float(cell), edge.y, edge.x)
        node = mi.UInt32(dr.clip(dr.fma(nu - self.nu0, self.nu_scale, 0.5), 0.0, self.nodes - 0.5))
        packets = self.terms // 4
        at = (node * self.cells + cell) * packets
        terms = [x for k in range(packets) for x in dr.gather(mi.Vector4f, self.weights, at + k)]
        b = dr.clip((beta - self.beta0) * self.beta_scale, -1.0, 1.0)
        weight = terms[self.terms - 1]
        for k in reversed(range(self.terms - 1)):
            weight = dr.fma(weight, b, terms[k])
        return h, weight


class Tracer:
    """The kernel of one exposure: uniform numbers in, hits on the board out, float32."""

    def __init__(self, s: Sweep) -> None:
        self.sweep = s
        self.optics = s.optics.map(_opaque)
        self.half_range, self.shear = _opaque(s.half_range), _opaque(s.shear)
        self.tables = None if s.pattern is None else _Tables(s.pattern)
        self.wavelength = _opaque(s.wavelength)
        u, v = perpendicular(np.array(s.optics.beam.direction))
        self.plane = tuple(tuple(_opaque(x) for x in axis) for axis in (u, v))
        self.blur = _opaque(s.blur)
        self.dimensions = 1 if not s.beam else (5 if s.blur > 0 else 3)

    def __call__(self, u: list[Any]) -> tuple[Any, Any, Any, Any, tuple[Any, Any, Any]]:
        """Trace rays.

        Parameters
        ----------
        u : list of ``dimensions`` arrays in [0, 1)

        Returns
        -------
        y, z : mm
        weight : 1/mm² of the facet with a beam, else 1
        arrives : mask
        sample : (δ, t, h) of the ray [rad, mm, mm]
        """
        o, s = self.optics, self.sweep
        delta = dr.fma(2.0 * u[0], self.half_range, -self.half_range)
        if not s.beam:
            hit = single_ray(o, delta, dr, facets=s.facets)
            on = hit.arrives
            if s.facets:
                # The facet's ends hand over to the next one; its height is ignored, or setting errors of 1 mm would lose
                # the ray.
                on &= dr.abs(hit.t) <= o.half_width
            return hit.y, hit.z, mi.Float(1.0) + 0.0 * hit.y, on, (delta, hit.t, hit.h)
        t = dr.fma(2.0 * u[1], o.half_width, -o.half_width) if s.facets else mi.Float(0.0)
        delta = dr.fma(self.shear, t, delta)
        jitter = None
        if s.blur > 0:
            # Box-Muller; 1 − u lies in (0, 1].
            r = self.blur * dr.sqrt(-2.0 * dr.log(1.0 - u[3]))
            sine, cosine = dr.sincos(2.0 * dr.pi * u[4])
            jitter = (*self.plane, r * cosine, r * sine)
        if self.tables is None:
            h = dr.fma(2.0 * u[2], o.half_height, -o.half_height)
            hit = from_facet(o, delta, t, h, dr, jitter)
            weight = density(o.beam, hit.rho, hit.spread, dr.exp) * -hit.falling
        else:
            centre = from_facet(o, delta, t, mi.Float(0.0), dr, jitter)
            h, share = self.tables.sample(u[2], *nu_and_beta(o, centre, self.wavelength))
            hit = from_facet(o, delta, t, h, dr, jitter)
            weight = density(o.beam, centre.rho, centre.spread, dr.exp) * -centre.falling * share
        return hit.y, hit.z, weight, hit.arrives, (delta, t, h)

    def points(self, n: int, rng: np.random.Generator) -> list[Any]:
        """n points of a randomly shifted lattice, as ``dimensions`` arrays in [0, 1].

        The first coordinate runs through n equal strata; the rest follows a Kronecker sequence. With the shear of
        `Sweep`, a bin of the board sees a short run of the sequence, spread as evenly as it can be.
        """
        i = dr.arange(mi.UInt32, n)
        stratum = (1 << 32) // n
        first = i * _opaque_uint(stratum) + _opaque_uint(int(rng.integers(stratum)))
        u = [mi.Float(first) * _opaque(1.0 / (n * stratum))]
        for step in _kronecker(self.dimensions - 1):
            x = i * mi.UInt32(int(step)) + _opaque_uint(int(rng.integers(1 << 32)))
            # 24 bits are exact in float32; all 32 could round to 1.
            u.append(mi.Float(x >> 8) * 2.0**-24)
        return u


def irradiance(
    recording: Recording,
    exposure: Exposure,
    *,
    placement: Placement | None = None,
    seed: int,
    rays: int | None = None,
    relative_error: float | None = None,
    pitch: float = 0.25,
    lenses: BeamTable | None = None,
) -> ScreenMap:
    """Irradiance that the turning mirror lays on the board in one exposure.

    Homocentric Gaussian beam with incoherent blur, flat facets (or the cylinder), finite width and height, Fresnel
    diffraction at the height, one facet if the exposure is gated; each as ``recording.physics`` has it. Float32, hits
    within 1 µm of float64.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure
    placement : Placement, optional
        Where everything stands; default the stated setting.
    seed : int
        Of the lattice's shifts.
    rays : int, optional
        Number of rays; rounded up to whole replicates.
    relative_error : float, optional
        In place of ``rays``: the noise to reach, as in `ScreenMap`; default the recording's ``[render]
        relative_error``. The noise of a camera's pixel that sees several bins is smaller.
    pitch : float
        Size of a bin [mm].
    lenses : BeamTable, optional
        Aberration and shape that lenses add to the beam of ``recording.laser``.

    Returns
    -------
    ScreenMap
        Over the whole board.

    Raises
    ------
    BenchsimError
        If the recording asks for effects, or no light reaches the board.

    Notes
    -----
    Tents widen the trace by pitch²/6 of variance across. Without a beam the trace is a line without width, drawn one
    bin wide.
    """
    if rays is not None and relative_error is not None:
        raise TypeError("give rays or relative_error, not both")
    backend.use()
    s = sweep(recording, exposure, placement or place(recording.mirror, exposure), lenses)
    film = _Film(recording.screen.size, pitch)
    tracer = Tracer(s)
    rng = np.random.default_rng(seed)
    if rays is not None:
        per_replicate = max(1, -(-rays // REPLICATES))
        mean, error = _replicates(tracer, film, per_replicate, rng)
    else:
        target = recording.render.relative_error if relative_error is None else relative_error
        per_replicate = _FIRST
        mean, error = _replicates(tracer, film, per_replicate, rng)
        while error > target and per_replicate < _MOST:
            # The noise falls at least like 1/n; the loop mends a step too short.
            per_replicate = min(int(per_replicate * max(1.5, (error / target) ** 0.75)), _MOST)
            mean, error = _replicates(tracer, film, per_replicate, rng)
    values = mean[1:-1, 1:-1] * (s.measure / pitch**2)
    return ScreenMap(values, film.y0, film.z0, pitch, error, per_replicate * REPLICATES)


_FIRST = 1 << 19
_MOST = 1 << 29


def _replicates(tracer: Tracer, film: _Film, n: int, rng: np.random.Generator) -> tuple[Array, float]:
    """Mean weight per ray in every bin, and the relative noise of lit bins."""
    total = dr.zeros(mi.Float, film.shape[0] * film.shape[1])
    squares = dr.zeros(mi.Float, film.shape[0] * film.shape[1])
    for _ in range(REPLICATES):
        bins = dr.zeros(mi.Float, film.shape[0] * film.shape[1])
        y, z, weight, arrives, _sample = tracer(tracer.points(n, rng))
        film.add(bins, y, z, weight, arrives)
        bins = bins * _opaque(1 / n)
        total += bins
        squares += bins * bins
        dr.eval(total, squares)
    mean = total.numpy().astype(float) / REPLICATES
    lit = mean > LIT * mean.max()
    spread = np.maximum(squares.numpy()[lit] / REPLICATES - mean[lit] ** 2, 0) / (REPLICATES - 1)
    return mean.reshape(film.shape), float(np.sqrt(np.mean(spread / mean[lit] ** 2)))
