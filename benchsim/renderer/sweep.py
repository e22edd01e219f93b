"""One exposure prepared in float64: the phases whose light reaches the board, and the diffraction along the trace."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement
from benchsim.renderer.beam_table import BeamTable
from benchsim.renderer.diffraction import Pattern, pattern
from benchsim.renderer.effects import check
from benchsim.renderer.laser import blur_sigma, dot
from benchsim.renderer.mirror import Hit, Optics, bench, from_facet, optics, single_ray

Array = NDArray[np.float64]

MARGIN = 10.0
"""Light that falls this far beyond the board's edge is traced too [mm]."""

FOCUSED = 1 / 16
"""Smallest ν of `diffraction` over its largest. Light that comes to a focus on the board has ν = 0 there and spreads
over all h'; what little of a bent beam is nearer to its focus is spread as at this ν."""


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
    numbers: tuple[int, ...] = (0,)

    @property
    def differs(self) -> bool:
        """Whether facets have to be told apart: their ``numbers`` are those that the exposure sees."""
        return self.optics.shape is not None and self.optics.shape.differs

    @property
    def ghost(self) -> bool:
        """Whether there is a second reflection, at a glass front face."""
        return self.optics.shape is not None and self.optics.shape.coated_behind


def _phase_grid(points: int) -> Array:
    return np.linspace(-np.pi, np.pi, points)


def sweep(recording: Recording, exposure: Exposure, placement: Placement, lenses: BeamTable | None = None) -> Sweep:
    """Prepare an exposure in float64: the phases whose light reaches the board, and the pattern of diffraction.

    Raises
    ------
    BenchsimError
        If the recording has an effect that `renderer` does not draw, or no light reaches the board.
    """
    check(recording)
    stands = bench(recording, exposure, placement, lenses)
    recording = stands.recording
    laser, mirror, physics = recording.laser, recording.mirror, recording.physics
    facets = physics.facets and mirror.shape == "polygon"
    numbers = (exposure.facet,) if exposure.facet is not None else tuple(range(mirror.facets))
    whole = optics(stands, 0.0)
    which = _which(whole, numbers)
    grid = _phase_grid(20001 if which.size == 1 else 5001)
    step = grid[1] - grid[0]
    half = np.array(recording.screen.size) / 2 + MARGIN
    t = np.array([-1.0, 0.0, 1.0])[:, None, None] * (whole.half_width if facets else 0.0)
    h = np.array([-1.0, 0.0, 1.0])[None, :, None] * whole.half_height
    k = which[:, None, None, None] if which.size > 1 else float(which[0])
    with np.errstate(all="ignore"):
        if physics.beam:
            hit = from_facet(whole, grid, t, h, np, facet=k)
        else:
            hit = single_ray(whole, grid, np, facets=facets, facet=k)
        hit = moved(whole, hit)
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
        shear = _shear(optics(stands, (grid[lit[0]] + grid[lit[-1]]) / 2), float(which[0]))
    sheared = np.broadcast_to(grid - shear * t if physics.beam else grid, lands.shape)[lands]
    first, last = sheared.min() - step, sheared.max() + step
    middle, half_range = (first + last) / 2, (last - first) / 2
    about = optics(stands, middle)

    measure = 2 * half_range / (2 * np.pi)
    if facets:
        measure *= 1 if exposure.facet is not None else mirror.facets
        if physics.beam:
            measure *= mirror.facet_width * mirror.height
    elif physics.beam:
        measure *= 2 * np.pi * stands.radius * mirror.height  # a cylinder stands in the beam at all times

    table = None
    if physics.beam and physics.diffraction:
        wide = (np.linspace(-1, 1, 21) * about.half_width)[:, None] if facets else np.zeros((1, 1))
        delta = np.linspace(-half_range, half_range, 201) + shear * wide
        if about.plain:
            centre = from_facet(about, delta, wide, 0.0, np)
            nu, beta = nu_and_beta(about, centre, laser.wavelength)
        else:
            with np.errstate(all="ignore"):
                # The ghost's light has a pattern of its own, whose places the table has to hold, too.
                front = np.array([0.0, 1.0] if about.shape is not None and about.shape.coated_behind else [0.0])
                centre, ends = over_height(
                    about, delta, wide, np, facet=which[:, None, None], ghost=front[:, None, None, None]
                )
                nu, beta, gamma = bent_pattern(about, centre, ends, laser.wavelength)
        seen = centre.arrives & (dot(centre.rho, centre.rho) < (2.5 * laser.waist) ** 2)
        if not about.plain:
            seen &= (np.abs(centre.y) < half[0] + 5 * MARGIN) & (np.abs(centre.z) < half[1] + 5 * MARGIN)
        alpha = (1 - about.beam.direction[2] ** 2) / laser.waist**2

        def span(x: Array) -> tuple[float, float]:
            # Where the light falls on the facet is alike for the ghost.
            x = np.broadcast_to(x, seen.shape)[seen]
            low, high = float(x.min()), float(x.max())
            pad = 0.01 * (high - low) + 1e-4 * max(abs(low), abs(high))
            return low - pad, high + pad

        def magnitude(x: Array) -> tuple[float, float]:
            low, high = span(x)
            return max(low, FOCUSED * high), high

        if not seen.any():
            raise BenchsimError(
                f"{recording.path}: in exposure {exposure.name} the laser's beam misses the mirror; check "
                "mirror_position_mm and the laser's angles"
            )
        bends = (0.0, 0.0) if about.plain else span(gamma)
        table = pattern(mirror.height, alpha, magnitude(nu), span(beta), gamma_range=bends)
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
        numbers=numbers,
    )


def _which(o: Optics, numbers: tuple[int, ...]) -> Array:
    """Numbers of the facets to look at where light may fall: all where they differ, else any."""
    return np.array(numbers if o.shape is not None and o.shape.differs else numbers[:1], float)


def _shear(o: Optics, facet: float) -> float:
    """dδ/dt at which the hit stands still along the trace, at the middle phase."""
    e, x = 1e-4, 1e-2
    ahead, behind, right, left = (
        from_facet(o, np.array(delta), np.array(t), np.array(0.0), np, facet=facet)
        for delta, t in ((e, 0.0), (-e, 0.0), (0.0, x), (0.0, -x))
    )
    motion = np.array([ahead.y - behind.y, ahead.z - behind.z]) / (2 * e)
    shift = np.array([right.y - left.y, right.z - left.z]) / (2 * x)
    return float(-(motion @ shift) / (motion @ motion))


def nu_and_beta(o: Optics, centre: Any, wavelength: float) -> tuple[Any, Any]:
    """ν and β of `diffraction` for the ray that leaves the facet at h = 0."""
    sine2 = 1.0 - centre.lean * centre.lean
    nu = sine2 * (o.beam.curvature / centre.spread + 1.0 / centre.distance) / wavelength
    beta = -2.0 * centre.rho[2] / (o.beam.waist * o.beam.waist)
    return nu, beta


def over_height(
    o: Optics, delta: Any, t: Any, m: Any, jitter: Any = None, facet: Any = 0.0, ghost: Any = 0.0
) -> tuple[Hit, tuple[Hit, Hit]]:
    """Hits from the middle and from the two ends of the facet's height, upper end first."""
    zero = 0.0 * (delta + t)
    middle, upper, lower = (
        from_facet(o, delta, t, zero + h, m, jitter, facet, ghost) for h in (0.0, o.half_height, -o.half_height)
    )
    return middle, (upper, lower)


def bent_pattern(o: Optics, centre: Hit, ends: tuple[Hit, Hit], wavelength: Any) -> tuple[Any, Any, Any]:
    """ν, β and γ of `diffraction` where effects bend the light, from where it lands.

    At the board's point X the path over h is stationary at h' and bends there by λν. Since the derivative of the path
    with respect to h is up·(direction to X less that of the geometric ray), and X = X(h') makes it vanish,
    λν = up·(1 − r r)·dX/dh' / D for a ray of unit direction r that travels D. Only its magnitude counts: the amplitude
    over the height being real, −ν with −γ gives the same light. γ likewise: half the path's third derivative.
    """
    upper, lower = ends
    length = dot(centre.out, centre.out) ** 0.5
    ray = tuple(c / length for c in centre.out)
    e = o.half_height

    def bend(x: Any, y: Any, z: Any) -> Any:
        motion = o.from_board((x, y, z))
        square = dot(centre.up, motion) - dot(centre.up, ray) * dot(ray, motion)
        return square / (centre.distance * length * wavelength)

    first = bend(*((getattr(upper, k) - getattr(lower, k)) / (2.0 * e) for k in "xyz"))
    # X(h) = X(0) + first h + second h² / 2, and the path's third derivative is to second what λν is to first.
    second = bend(*((getattr(upper, k) + getattr(lower, k) - 2.0 * getattr(centre, k)) / (e * e) for k in "xyz"))
    nu = abs(first)
    beta = -2.0 * dot(centre.rho, centre.up) / (o.beam.waist * o.beam.waist)
    return nu, beta, 0.5 * second * first / nu


def footprint(s: Sweep) -> tuple[Array, Array]:
    """Where light falls on the board in geometric optics: y and z [mm] of the facet's corners, edges and middle,
    (phases, points).

    NaN where no light arrives.
    """
    which = _which(s.optics, s.numbers)
    delta = np.linspace(-s.half_range, s.half_range, 4001 if which.size == 1 else 1001)[:, None]
    # All facets' points side by side, and those of a glass front face's reflection.
    k, ghost = (g.ravel() for g in np.meshgrid(which, [0.0, 1.0] if s.ghost else [0.0]))
    with np.errstate(all="ignore"):
        if s.beam:
            t, h = (g.ravel() for g in np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
            t = t * (s.optics.half_width if s.facets else 0.0)
            k, ghost = np.repeat(k, t.size), np.repeat(ghost, t.size)
            t, h = np.tile(t, len(which) * (1 + s.ghost)), np.tile(h, len(which) * (1 + s.ghost))
            hit = from_facet(s.optics, delta + s.shear * t, t, h * s.optics.half_height, np, facet=k, ghost=ghost)
        else:
            hit = single_ray(s.optics, delta, np, facets=s.facets, facet=k, ghost=ghost)
        hit = moved(s.optics, hit)
    return np.where(hit.arrives, hit.y, np.nan), np.where(hit.arrives, hit.z, np.nan)


def moved(o: Optics, hit: Hit, shake: Any = None) -> Hit:
    """The hit with the motion of the exposure; ``shake`` are two draws of a normal law for that of the ray."""
    if o.motion is None:
        return hit
    y, z = hit.y + o.motion.shift[0], hit.z + o.motion.shift[1]
    if shake is not None:
        y, z = y + o.motion.shake * shake[0], z + o.motion.shake * shake[1]
    return replace(hit, y=y, z=z)


def blur_reach(s: Sweep) -> float:
    """How far from its geometric place light still counts [mm]: diffraction, incoherent blur, aberration."""
    shake = 6.0 * s.optics.motion.shake if s.optics.motion is not None else 0.0
    if not s.beam:
        return 1.0 + shake
    distance = abs(s.optics.height / s.optics.slope)
    reach = 2.0 + shake + 8.0 * s.blur * distance / abs(s.optics.slope)
    # Beyond, diffraction by a mirror 2 mm high spreads 0.1 % of the light thinner than a millionth of the peak.
    return reach + (64.0 if s.pattern is not None else 20.0 if s.optics.beam.lenses else 0.0)
