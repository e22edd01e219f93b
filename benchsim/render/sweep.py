"""One exposure prepared in float64: the phases whose light reaches the board, and the diffraction along the trace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement
from benchsim.render.beam_table import BeamTable
from benchsim.render.diffraction import Pattern, pattern
from benchsim.render.laser import blur_sigma, dot
from benchsim.render.mirror import Optics, from_facet, optics, single_ray

Array = NDArray[np.float64]

MARGIN = 10.0
"""Light that falls this far beyond the board's edge is traced too [mm]."""


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


def footprint(s: Sweep) -> tuple[Array, Array]:
    """Where light falls on the board in geometric optics: y and z [mm] of the facet's corners, edges and middle,
    (phases, points).

    NaN where no light arrives.
    """
    delta = np.linspace(-s.half_range, s.half_range, 4001)[:, None]
    with np.errstate(all="ignore"):
        if s.beam:
            t, h = (g.ravel() for g in np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
            t = t * (s.optics.half_width if s.facets else 0.0)
            hit = from_facet(s.optics, delta + s.shear * t, t, h * s.optics.half_height, np)
        else:
            hit = single_ray(s.optics, delta, np, facets=s.facets)
    return np.where(hit.arrives, hit.y, np.nan), np.where(hit.arrives, hit.z, np.nan)


def blur_reach(s: Sweep) -> float:
    """How far from its geometric place light still counts [mm]: diffraction, incoherent blur, aberration."""
    if not s.beam:
        return 1.0
    distance = abs(s.optics.height / s.optics.slope)
    reach = 2.0 + 8.0 * s.blur * distance / abs(s.optics.slope)
    # Beyond, diffraction by a mirror 2 mm high spreads 0.1 % of the light thinner than a millionth of the peak.
    return reach + (64.0 if s.pattern is not None else 20.0 if s.optics.beam.lenses else 0.0)
