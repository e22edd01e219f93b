"""A heliostat's flux by Monte Carlo in Mitsuba: spherical facets, Gaussian sun, Gaussian slopes, a plane target.

A reference for tests. Nothing is shared with `benchsim.fluxes.collado` but the heliostat and the target, nothing with
`benchsim.fluxes.traced`: rays start at random places before a facet from a random point of the sun, meet a sphere (a
shape of Mitsuba's), are reflected at its normal, disturbed by a random slope, and meet the target's rectangle. No
blocking, no shading.

Float32 keeps 6e-8 of a length: sphere and target are scenes of their own, each in its own frame, at the facet's vertex
and at the target's centre, so that 200 m cost 0.01 mm. Facets are spheres of radius 2 d, set in a plane and canted so
that each sends a central ray along the mirror's axis to the distance d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.fluxes.heliostat import Heliostat, Target, mirror_axes, unit
from benchsim.renderer.backend import use

Array = NDArray[np.float64]

START = 200.0
"""How far before the facet a ray starts [mm]: outside any sag of a facet."""
PEAK = 0.9
"""Radius of the disk about the peak that is fitted, in standard deviations of the map: a fourth-degree polynomial
follows a Gaussian there to 0.1 % at its top."""


@dataclass(frozen=True)
class FluxMap:
    """Flux on a target's cells, as a multiple of the irradiance on a plane that faces the sun.

    Attributes
    ----------
    values : (batches, cells, cells)
        [batch, along the width, up], independent of each other.
    target : Target
    """

    values: Array
    target: Target

    @property
    def mean(self) -> Array:
        """(cells, cells)"""
        return self.values.mean(axis=0)

    def average(self) -> tuple[float, float]:
        """Over the target, and its standard error."""
        return _mean(self.values.mean(axis=(1, 2)))

    def peak(self) -> tuple[float, float]:
        """Of a polynomial of fourth degree fitted about the brightest place, and its standard error.

        The brightest *cell* would be too bright by the noise. The place, the disk fitted and so the estimator are those
        of the mean of all batches; the error is from the scatter of the batches.
        """
        mean = self.mean
        grids = self.target.grid(mean.shape[0])
        shadows = [mean.sum(axis=1), mean.sum(axis=0)]
        at = [float(f @ g / f.sum()) for f, g in zip(shadows, grids, strict=True)]
        spread = [float(np.sqrt(f @ (g - c) ** 2 / f.sum())) for f, g, c in zip(shadows, grids, at, strict=True)]
        u, v = ((g - c) / w for g, c, w in zip(grids, at, spread, strict=True))
        inside = np.hypot(u[:, None], v[None, :]) < PEAK
        pairs = [(i, j) for i in range(5) for j in range(5 - i)]
        # A cell holds the mean of the flux over it, so it is fitted with the mean of each term.
        over = [[_over_cell(g, i) for i in range(5)] for g in (u, v)]
        design = np.stack([np.outer(over[0][i], over[1][j])[inside] for i, j in pairs], axis=1)
        fits = np.linalg.lstsq(design, self.values[:, inside].T, rcond=None)[0]
        fine = np.linspace(-PEAK, PEAK, 73)
        a, b = np.meshgrid(fine, fine, indexing="ij")
        top = np.stack([a**i * b**j for i, j in pairs], axis=-1)
        surface = np.where(np.hypot(a, b) < PEAK / 1.5, top @ fits.mean(axis=1), -np.inf)
        place = np.unravel_index(int(np.argmax(surface)), surface.shape)
        return _mean(top[place] @ fits)


def _over_cell(x: Array, power: int) -> Array:
    """Mean of x^power over cells about equally spaced centres."""
    half = (x[1] - x[0]) / 2
    return np.asarray(((x + half) ** (power + 1) - (x - half) ** (power + 1)) / (power + 1) / (2 * half))


def _mean(values: Array) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def flux(
    heliostat: Heliostat,
    target: Target,
    sun: ArrayLike,
    normal: ArrayLike,
    *,
    cells: int = 60,
    rays: int = 400_000,
    batches: int = 10,
    seed: int = 0,
    variant: str | None = None,
) -> FluxMap:
    """Trace rays from sun to target.

    Parameters
    ----------
    heliostat : Heliostat
    target : Target
    sun, normal : (3,) array
        Unit vectors toward the sun, and of the mirror's centre.
    cells : int
        Of the map, along width and height.
    rays, batches : int
        Rays of a batch, and batches.
    seed : int
    variant : str, optional
        Of Mitsuba; see `benchsim.renderer.backend.use`.

    Returns
    -------
    FluxMap
    """
    use(variant)
    s, n = np.asarray(sun, float), unit(normal)
    distance = float(np.linalg.norm(np.array(target.centre) - np.array(heliostat.position)))
    facets = _facets(heliostat, n, distance)
    sphere = mi.load_dict(
        {"type": "scene", "mirror": {"type": "sphere", "radius": 2 * distance, "center": [0, 0, 2 * distance]}}
    )
    half = [target.width / 2, target.height / 2]
    plane = mi.load_dict(
        {"type": "scene", "target": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([*half, 1.0])}}
    )
    frame = np.vstack([target.axes, target.normal])
    values = np.zeros((batches, cells, cells))
    for b in range(batches):
        bins = dr.zeros(mi.Float, cells * cells)
        for k, (vertex, axes) in enumerate(facets):
            count = rays // len(facets)
            to_target = frame @ axes.T
            offset = frame @ (np.array(heliostat.position) + vertex - np.array(target.centre))
            # A variable, not a literal: one kernel serves all batches and facets. Streams of neighbouring numbers are
            # not independent, hence the hash.
            number = dr.opaque(mi.UInt32, ((seed * 7919 + b) * 1009 + k) % 2**32)
            state, stream = mi.sample_tea_32(dr.arange(mi.UInt32, count), number)  # type: ignore[call-overload]
            generator: Any = mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(stream))  # type: ignore[operator]
            hit, weight = _trace(heliostat, len(facets), axes @ s, to_target, offset, generator, sphere, plane)
            uv = hit.uv * cells
            cell = mi.UInt32(dr.clip(uv.x, 0, cells - 1)) * cells + mi.UInt32(dr.clip(uv.y, 0, cells - 1))
            dr.scatter_add(bins, weight / count, cell, hit.is_valid())
        area = target.width * target.height / cells**2
        values[b] = np.array(bins, float).reshape(cells, cells) / area
    return FluxMap(values, target)


def _facets(h: Heliostat, normal: Array, distance: float) -> list[tuple[Array, Array]]:
    """Of each facet: its vertex from the mirror's centre, and its frame's axes as rows (across, up, normal)."""
    across, up = mirror_axes(normal)
    out = []
    for i in range(h.facets[0]):
        for j in range(h.facets[1]):
            x = ((i + 0.5) / h.facets[0] - 0.5) * h.width
            y = ((j + 0.5) / h.facets[1] - 0.5) * h.height
            vertex = x * across + y * up
            own = unit(normal - vertex / (2 * distance))
            edge = unit(across - (across @ own) * own)
            out.append((vertex, np.array([edge, np.cross(own, edge), own])))
    return out


def _trace(
    h: Heliostat, facets: int, sun: Array, to_target: Array, offset: Array, generator: Any, sphere: Any, plane: Any
) -> tuple[Any, Any]:
    """Rays of one facet; the hit on the target and each ray's power. ``sun`` in the facet's frame."""

    def uniform() -> Any:
        return generator.next_float32()

    def gauss() -> Any:
        return mi.warp.square_to_std_normal(mi.Point2f(uniform(), uniform()))

    def constant(v: Array) -> Any:
        return mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in v))

    width, height = h.width / h.facets[0], h.height / h.facets[1]
    a, b = np.linalg.svd(sun[None])[2][1:]
    g = gauss() * dr.opaque(mi.Float, h.sun)
    toward = dr.normalize(constant(sun) + constant(a) * g.x + constant(b) * g.y)
    at = mi.Point3f(
        (uniform() - 0.5) * dr.opaque(mi.Float, width), (uniform() - 0.5) * dr.opaque(mi.Float, height), 0.0
    )
    si = sphere.ray_intersect(mi.Ray3f(at + START * toward, -toward))
    normal = -si.n  # the mirror is the sphere's inside
    normal = dr.select(normal.z < 0, -normal, normal)
    slope = mi.Frame3f(normal)
    g = gauss() * dr.opaque(mi.Float, h.slope)
    bent = dr.normalize(normal + slope.s * g.x + slope.t * g.y)
    out = 2 * dr.dot(bent, toward) * bent - toward
    rows = [constant(row) for row in to_target]

    def turned(v: Any) -> Any:
        return mi.Vector3f(*(dr.dot(row, v) for row in rows))

    ray = mi.Ray3f(mi.Point3f(turned(si.p) + constant(offset)), turned(out))
    # The beam through the facet's rectangle, which stands at the angle between its normal and the sun.
    power = dr.opaque(mi.Float, h.reflectance * width * height) * toward.z
    return plane.ray_intersect(ray), dr.select(si.is_valid(), power, 0.0)
