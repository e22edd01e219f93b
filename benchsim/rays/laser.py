"""The beam at the mirror: directions of its rays and the power they carry.

Homocentric Gaussian beam: through the point (u, v) of the plane perpendicular to the axis at the reference point L runs
a ray along d + κ (u û + v v̂), with density 2/(π w²) exp(-2 (u² + v²)/w²). All rays pass through the virtual source
L − d/κ, so the ray through any point X runs along g = d + κ (X − L): no source point is needed, and κ → 0 (parallel)
and κ < 0 (converging) are no special cases.

An aberrated beam has directions d + K ρ + c(ρ) with ρ = (u, v), K the curvature matrix and c its coma and free field.
The ray through X solves ρ + ζ (K ρ + c(ρ)) = X's offset across the axis, ζ its offset along it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.fields import Field, evaluate, prepared
from benchsim.bench.model import Exposure, Laser
from benchsim.bench.place import Placement, toward_source

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "beam-direction": ("saz", "sel"),
    "beam-offset": ("bu", "bv"),
    "wavefront-curvature": ("curv",),
    "astigmatism": ("astig0", "astig45"),
    "coma": ("coma_u", "coma_v"),
    "finite-beam": ("beam", "size_mm"),
}
"""Effects of the source, with their parameters; `benchsim.rays.effects` gathers them."""

FARTHEST = 6.0
"""Value of 2ρ²/w² beyond which the quartic of a profile's shape is held: it outgrows the Gaussian further out."""


@dataclass(frozen=True)
class SourceEffects:
    """What the source does beyond the recording's [laser]; nothing by default. See `effects` for the signs.

    Attributes
    ----------
    dials : (azimuth, elevation) rad
    offset : (u, v) mm
    curvature, astigmatism : 1/mm
    coma : (u, v) rad/mm²
    angle : function of (u, v) [mm] that gives two angles [rad], or None
    shape : (c4, e_plus, e_cross)
        Log-density of the profile over the Gaussian.
    beam : float
        Amplitude of the beam where the physics has a single ray.
    """

    dials: tuple[float, float] = (0.0, 0.0)
    offset: tuple[float, float] = (0.0, 0.0)
    curvature: float = 0.0
    astigmatism: tuple[float, float] = (0.0, 0.0)
    coma: tuple[float, float] = (0.0, 0.0)
    angle: Callable[..., Array] | None = None
    shape: tuple[float, float, float] = (0.0, 0.0, 0.0)
    beam: float = 0.0

    @property
    def homocentric(self) -> bool:
        """Whether all rays still pass through one point."""
        return self.angle is None and not some(*self.astigmatism, *self.coma)


def effects(
    tables: Effects, fields: Mapping[str, Field], exposure: Exposure, shape: tuple[float, float, float]
) -> SourceEffects:
    """The source's share of a recording's effects (file units: mrad, mm, 1/m, mrad/mm²) and fields."""

    def of(name: str, unit: float) -> tuple[float, float]:
        table = tables.get(name, {})
        first, second = EFFECTS[name]
        return unit * table.get(first, 0.0), unit * table.get(second, 0.0)

    azimuth, elevation = of("beam-direction", 1e-3)
    if "stage" in fields:
        more = evaluate(fields["stage"], exposure.laser_azimuth, exposure.laser_elevation)
        azimuth, elevation = azimuth + float(more[0]), elevation + float(more[1])
    return SourceEffects(
        (azimuth, elevation),
        of("beam-offset", 1.0),
        1e-3 * tables.get("wavefront-curvature", {}).get("curv", 0.0),
        of("astigmatism", 1e-3),
        of("coma", 1e-3),
        prepared(fields["angle"]) if "angle" in fields else None,
        shape,
        tables.get("finite-beam", {}).get("beam", 0.0),
    )


def section(placement: Placement) -> tuple[Array, Array]:
    """Unit vectors u, v across the beam: v is the mirror's axis less its part along d, u = v × d."""
    d = placement.laser_direction
    v = placement.axis - over(dot(placement.axis, d)) * d
    v = v / over(np.sqrt(dot(v, v)))
    return cross(v, d), v


def turned(placement: Placement, source: SourceEffects) -> Placement:
    """The placement with the dials off and the beam displaced; the dials turn the beam about its reference point."""
    if any(source.dials):
        toward = -placement.laser_direction
        azimuth, elevation = np.arctan2(-toward[1], toward[0]), np.arcsin(np.clip(toward[2], -1.0, 1.0))
        placement = replace(
            placement, laser_direction=-toward_source(azimuth + source.dials[0], elevation + source.dials[1])
        )
    if any(source.offset):
        u, v = section(placement)
        placement = replace(placement, laser_point=placement.laser_point + source.offset[0] * u + source.offset[1] * v)
    return placement


def dot(a: Array, b: Array) -> Array:
    """Scalar product over the last axis, of three or two components."""
    out = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
    return np.asarray(out if a.shape[-1] == 2 else out + a[..., 2] * b[..., 2])


def some(*values: Any) -> bool:
    """Whether any of some numbers, or of arrays that hold one number for each of several benches, is not 0."""
    return any(bool(v.any()) if isinstance(v, np.ndarray) else bool(v) for v in values)


def over(scalars: Any) -> Any:
    """Scalars (...) as they multiply vectors (..., 3)."""
    return scalars[..., None] if isinstance(scalars, np.ndarray) and scalars.ndim else scalars


def outer(scalars: Array, vector: Array) -> Array:
    """Vectors (..., 3) of scalars (...) times one vector, or vectors that broadcast against the scalars.

    Each component lies together in memory, which is faster.
    """
    if vector.ndim == 1:
        return components_last(np.multiply.outer(vector, scalars))
    shape = np.broadcast_shapes(np.shape(scalars), vector.shape[:-1])
    out = np.empty((vector.shape[-1], *shape))
    for k, part in enumerate(out):
        np.multiply(scalars, vector[..., k], out=part)
    return components_last(out)


def cos_sin(angle: Array) -> tuple[Array, Array]:
    """Cosine and sine of angles, by the tangent of half of them: exact to 2e-16, and on processors whose vector units
    work out the tangent ten times faster than NumPy's own, which work out one number after another."""
    t = np.tan(0.5 * angle)
    square = t * t
    share = 1.0 / (1.0 + square)
    return (1.0 - square) * share, 2.0 * t * share


def components_last(stack: Array) -> Array:
    """A view (..., k) of (k, ...)."""
    return stack.transpose((*range(1, stack.ndim), 0))


def cross(a: Array, b: Array) -> Array:
    """Vector product of single vectors or stacks, without the checks that make NumPy's slow for them."""
    if a.ndim == b.ndim == 1:
        (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
        return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    (ax, ay, az), (bx, by, bz) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (a, b))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


@dataclass(frozen=True, eq=False)
class Beam:
    """The beam of one exposure, where it stands.

    Attributes
    ----------
    point, axis : (3,) array
        L [mm] and d.
    waist, curvature : float [mm, 1/mm]
    section : two (3,) arrays
        u, v; needed only where ``more`` is not homocentric or has a shape.
    more : SourceEffects
    """

    point: Array
    axis: Array
    waist: float
    curvature: float
    section: tuple[Array, Array] | None = None
    more: SourceEffects = SourceEffects()

    def light(self, x: Array) -> tuple[Array, Callable[..., Array]]:
        """Directions of the rays through x, and their power density as a function of the surface's normal there.

        An element dA at x with unit normal n is cut by the rays of |n·g| / (g·d)³ dA of the reference plane, exactly.

        Parameters
        ----------
        x : (..., 3) array [mm]
            On this side of a converging beam's focus.

        Returns
        -------
        direction : (..., 3) ndarray
            Of travel, not normalised.
        density : function
            Of normals (..., 3) and, optionally, the index of the points they belong to: [1/mm²], laser power 1. Light
            that comes from behind counts as none.
        """
        offset = x - self.point
        if not self.more.homocentric:
            return self._aberrated(offset)
        g = self.axis + over(self.curvature) * offset

        def density(normal: Array, which: Any = ...) -> Array:
            here = offset[which]
            along = dot(here, self.axis)
            spread = 1.0 + self.curvature * along
            inverse = 1.0 / spread
            rho2 = (dot(here, here) - along * along) * inverse**2
            light = self.gaussian(rho2)
            if some(*self.more.shape):
                u, v = self._across(here)
                light = light * self.reshaped(u * inverse, v * inverse)
            return light * np.maximum(-dot(g[which], normal), 0.0) * inverse**3

        return g, density

    def _across(self, offset: Array) -> tuple[Array, Array]:
        assert self.section is not None
        return dot(offset, self.section[0]), dot(offset, self.section[1])

    def gaussian(self, rho2: Array) -> Array:
        """Power per area of the reference plane at squares of the distance from the axis [mm²]."""
        w2 = self.waist**2
        return np.asarray(2.0 / (np.pi * w2) * np.exp((-2.0 / w2) * rho2))

    def reshaped(self, u: Array, v: Array) -> Array:
        """Density of the profile's shape over the Gaussian at places of the reference plane [mm]."""
        c4, plus, cross = self.more.shape
        w2 = self.waist**2
        s = np.minimum(2.0 * (u * u + v * v) / w2, FARTHEST)
        return np.asarray(np.exp(c4 * (s * s - 2.0 * s) + (plus * (u * u - v * v) + cross * 2.0 * u * v) / w2))

    def _aberrated(self, offset: Array) -> tuple[Array, Callable[..., Array]]:
        assert self.section is not None
        zeta = dot(offset, self.axis)
        p, q = self._across(offset)
        kappa, (a0, a45), (cu, cv) = self.curvature, self.more.astigmatism, self.more.coma
        k11, k12, k22 = kappa + a0, a45, kappa - a0
        angle = self.more.angle

        def rest(u: Array, v: Array) -> tuple[Array, Array]:
            gu = cu * (3 * u * u + v * v) + 2 * cv * u * v
            gv = 2 * cu * u * v + cv * (u * u + 3 * v * v)
            if angle is not None:
                free = angle(u, v)
                gu, gv = gu + free[0], gv + free[1]
            return gu, gv

        m11, m12, m22 = 1 + zeta * k11, zeta * k12, 1 + zeta * k22
        det = m11 * m22 - m12 * m12
        plain = angle is None and not some(*self.more.coma)
        gu = gv = np.zeros_like(zeta)
        # Each round shrinks the error by ζ dc/dρ, which is below 0.02 for the largest plausible aberrations.
        for _ in range(1 if plain else 4):
            a, b = p - zeta * gu, q - zeta * gv
            u, v = (m22 * a - m12 * b) / det, (m11 * b - m12 * a) / det
            if plain:
                break
            gu, gv = rest(u, v)
        du, dv = k11 * u + k12 * v + gu, k12 * u + k22 * v + gv
        g = self.axis + outer(du, self.section[0]) + outer(dv, self.section[1])

        def density(normal: Array, which: Any = ...) -> Array:
            a, b, down = u[which], v[which], zeta[which]
            j11 = k11 + 6 * cu * a + 2 * cv * b
            j12 = k12 + 2 * cu * b + 2 * cv * a
            j22 = k22 + 2 * cu * a + 6 * cv * b
            j21 = j12
            if angle is not None:
                step = 0.05
                by_u = (angle(a + step, b) - angle(a - step, b)) / (2 * step)
                by_v = (angle(a, b + step) - angle(a, b - step)) / (2 * step)
                j11, j21, j12, j22 = j11 + by_u[0], j21 + by_u[1], j12 + by_v[0], j22 + by_v[1]
            stretch: Array = (1 + down * j11) * (1 + down * j22) - down * down * j12 * j21
            light = self.gaussian(a * a + b * b)
            if some(*self.more.shape):
                light = light * self.reshaped(a, b)
            return light * np.maximum(-dot(g[which], normal), 0.0) / stretch

        return g, density

    @property
    def centre(self) -> Array:
        """Direction of the single ray through ρ = 0, (3,)."""
        if self.more.angle is None:
            return self.axis
        assert self.section is not None
        free = self.more.angle(0.0, 0.0)
        turned: Array = self.axis + free[0] * self.section[0] + free[1] * self.section[1]
        return turned


def beam(laser: Laser, placement: Placement, source: SourceEffects) -> Beam:
    """The beam as it stands; ``placement`` already `turned`."""
    return Beam(
        placement.laser_point,
        placement.laser_direction,
        laser.waist,
        laser.curvature + source.curvature,
        None if source.homocentric and not some(*source.shape) else section(placement),
        source,
    )


def blur_sigma(laser: Laser) -> float:
    """rms of the incoherent blur in one direction [rad]: a quarter of its full 1/e² angle."""
    return laser.incoherent_divergence / 4.0
