"""The kernel: uniform numbers in, hits on the board out, float32, in Dr.Jit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchsim.renderer.diffraction import Pattern
from benchsim.renderer.laser import density, perpendicular
from benchsim.renderer.mirror import Hit, from_facet, single_ray
from benchsim.renderer.sweep import Sweep, bent_pattern, moved, nu_and_beta, over_height

GHOST = 0.125
"""Share of the rays that follow the reflection at a glass front face, where there is one."""


def opaque(value: float) -> Any:
    # As a variable rather than a literal, so that the kernel is compiled once for all exposures.
    return dr.opaque(mi.Float, float(value))


def opaque_uint(value: int) -> Any:
    return dr.opaque(mi.UInt32, value)


def _kronecker(dimensions: int) -> list[int]:
    """Steps of a Kronecker sequence by powers of the generalised golden ratio (x^(d+1) = x + 1), in units of 2^-32."""
    if dimensions == 0:
        return []
    ratio = float(np.max(np.roots([1.0, *[0.0] * (dimensions - 1), -1.0, -1.0]).real))
    return [round(2**32 * ratio ** -(k + 1)) | 1 for k in range(dimensions)]


class _Tables:
    """The pattern of diffraction where the kernel can read it."""

    def __init__(self, p: Pattern) -> None:
        self.nodes, self.cells, self.terms = p.weights.shape
        self.edges = mi.Float(np.stack([p.edges[:-1], np.diff(p.edges)], axis=-1).astype(np.float32).ravel())
        self.weights = mi.Float(p.weights.astype(np.float32).ravel())
        self.nu0 = opaque(p.nu[0])
        self.nu_scale = opaque((self.nodes - 1) / (p.nu[-1] - p.nu[0]))
        self.bends = 0 if p.gamma is None else len(p.gamma)
        if p.gamma is not None:
            self.nodes = len(p.nu)
            self.nu_scale = opaque((self.nodes - 1) / (p.nu[-1] - p.nu[0]))
            self.gamma0 = opaque(p.gamma[0])
            self.gamma_scale = opaque((self.bends - 1) / (p.gamma[-1] - p.gamma[0]))
        low, high = p.beta
        self.beta0, self.beta_scale = opaque((low + high) / 2), opaque(2 / (high - low))

    def sample(self, v: Any, nu: Any, beta: Any, gamma: Any = None, w: Any = None) -> tuple[Any, Any]:
        """h' [mm] and its weight; ``w`` in [0, 1) chooses between two nodes of γ."""
        x = v * self.cells
        cell = mi.UInt32(x)
        edge = dr.gather(mi.Vector2f, self.edges, cell)
        h = dr.fma(x - mi.Float(cell), edge.y, edge.x)
        node = mi.UInt32(dr.clip(dr.fma(nu - self.nu0, self.nu_scale, 0.5), 0.0, self.nodes - 0.5))
        if self.bends:
            place = dr.clip((gamma - self.gamma0) * self.gamma_scale, 0.0, float(self.bends - 1))
            node = node * self.bends + dr.minimum(mi.UInt32(place + w), self.bends - 1)
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
        self.optics = s.optics.map(opaque)
        self.half_range, self.shear = opaque(s.half_range), opaque(s.shear)
        self.tables = None if s.pattern is None else _Tables(s.pattern)
        self.wavelength = opaque(s.wavelength)
        u, v = perpendicular(np.array(s.optics.beam.direction))
        self.plane = tuple(tuple(opaque(x) for x in axis) for axis in (u, v))
        self.blur = opaque(s.blur)
        motion = s.optics.motion
        self.shakes = motion is not None and motion.shakes
        self.bent = not s.optics.plain
        # Dimensions beyond phase, t and h: where each begins, or None.
        self.dimensions = 3 if s.beam else 1
        self._at_blur = self._take(2, s.blur > 0)
        self._at_bend = self._take(1, self.tables is not None and self.tables.bends > 0)
        self._at_facet = self._take(1, s.differs and len(s.numbers) > 1)
        self._at_ghost = self._take(1, s.ghost)
        self._at_shake = self._take(2, self.shakes)

    def _take(self, count: int, wanted: bool) -> int | None:
        first = self.dimensions
        self.dimensions += count if wanted else 0
        return first if wanted else None

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
        facet: Any = float(s.numbers[0])
        if self._at_facet is not None:
            facet = dr.minimum(dr.floor(u[self._at_facet] * float(len(s.numbers))), float(len(s.numbers) - 1))
        ghost: Any = 0.0
        if self._at_ghost is not None:
            ghost = dr.select(u[self._at_ghost] < GHOST, mi.Float(1.0), 0.0)
        if not s.beam:
            hit = single_ray(o, delta, dr, facets=s.facets, facet=facet, ghost=ghost)
            on = hit.arrives
            if s.facets:
                # The facet's ends hand over to the next one; its height is ignored, or setting errors of 1 mm would
                # lose the ray.
                on &= dr.abs(hit.t) <= o.half_width
            weight = mi.Float(1.0) + 0.0 * hit.y
        else:
            t = dr.fma(2.0 * u[1], o.half_width, -o.half_width) if s.facets else mi.Float(0.0)
            delta = dr.fma(self.shear, t, delta)
            hit, weight = self._beam(u, delta, t, facet, ghost)
            on = hit.arrives
        if hit.share is not None:
            weight = weight * hit.share
        if self._at_ghost is not None:
            weight = weight * dr.select(ghost > 0.5, 1.0 / GHOST, 1.0 / (1.0 - GHOST))
        shake = None if self._at_shake is None else self._normal(u, self._at_shake)
        hit = moved(o, hit, shake)
        return hit.y, hit.z, weight, on, (delta, hit.t, hit.h)

    def _beam(self, u: list[Any], delta: Any, t: Any, facet: Any, ghost: Any) -> tuple[Hit, Any]:
        """The beam's ray from the point t across the facet, at a height of its own, and its weight."""
        o = self.optics
        jitter = None
        if self._at_blur is not None:
            a, b = self._normal(u, self._at_blur)
            jitter = (*self.plane, self.blur * a, self.blur * b)
        if self.tables is None:
            h = dr.fma(2.0 * u[2], o.half_height, -o.half_height)
            hit = from_facet(o, delta, t, h, dr, jitter, facet, ghost)
            return hit, density(o.beam, hit.rho, hit.spread, dr.exp) * -hit.falling
        if self.bent:
            w = None if self._at_bend is None else u[self._at_bend]
            return self._bent_beam(u[2], w, delta, t, jitter, facet, ghost)
        centre = from_facet(o, delta, t, mi.Float(0.0), dr, jitter)
        h, share = self.tables.sample(u[2], *nu_and_beta(o, centre, self.wavelength))
        hit = from_facet(o, delta, t, h, dr, jitter)
        return hit, density(o.beam, centre.rho, centre.spread, dr.exp) * -centre.falling * share

    def _bent_beam(self, v: Any, w: Any, delta: Any, t: Any, jitter: Any, facet: Any, ghost: Any) -> tuple[Hit, Any]:
        """The same with diffraction where effects bend the light over the facet's height.

        To first order in h they change ν, to second γ; the geometric ray of h' is where the first order sends it. What
        they do beyond, over the few millimetres of a facet, is left out.
        """
        o = self.optics
        assert self.tables is not None
        centre, (upper, lower) = over_height(o, delta, t, dr, jitter, facet, ghost)
        nu, beta, gamma = bent_pattern(o, centre, (upper, lower), self.wavelength)
        h, share = self.tables.sample(v, nu, beta, gamma, w)
        part = 0.5 * h / o.half_height
        hit = replace(centre, y=centre.y + part * (upper.y - lower.y), z=centre.z + part * (upper.z - lower.z), h=h)
        return hit, density(o.beam, centre.rho, centre.spread, dr.exp) * -centre.falling * share

    def _normal(self, u: list[Any], at: int) -> tuple[Any, Any]:
        """Two draws of the normal law (Box-Muller); 1 − u lies in (0, 1]."""
        r = dr.sqrt(-2.0 * dr.log(1.0 - u[at]))
        sine, cosine = dr.sincos(2.0 * dr.pi * u[at + 1])
        return r * cosine, r * sine

    def points(self, n: int, rng: np.random.Generator) -> list[Any]:
        """n points of a randomly shifted lattice, as ``dimensions`` arrays in [0, 1].

        The first coordinate runs through n equal strata; the rest follows a Kronecker sequence. With the shear of
        `Sweep`, a bin of the board sees a short run of the sequence, spread as evenly as it can be.
        """
        i = dr.arange(mi.UInt32, n)
        stratum = (1 << 32) // n
        first = i * opaque_uint(stratum) + opaque_uint(int(rng.integers(stratum)))
        u = [mi.Float(first) * opaque(1.0 / (n * stratum))]
        for step in _kronecker(self.dimensions - 1):
            x = i * mi.UInt32(int(step)) + opaque_uint(int(rng.integers(1 << 32)))
            # 24 bits are exact in float32; all 32 could round to 1.
            u.append(mi.Float(x >> 8) * 2.0**-24)
        return u
