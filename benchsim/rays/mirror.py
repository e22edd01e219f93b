"""The turning mirror: points and normals of a facet or of the cylinder, reflection, and the glass before a coating.

Of glass with its coating behind, the front face is the facet: it stands at r and has the facet's edges, through which
all light enters; what the coating sends back leaves the front face wherever it comes to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field, evaluate
from benchsim.bench.model import Mirror
from benchsim.bench.place import Placement
from benchsim.rays.laser import cos_sin, cross, dot, outer, over, some

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

MOST_FACETS = 360

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "facets": ("facets", "size_mm"),
    "pivot-offset": ("dr",),
    "canting": ("pyr",),
    "facet-tilts": ("tilt_rms", *(f"tilt_{k}" for k in range(MOST_FACETS))),
    "axis-wobble": ("wob_c", "wob_s"),
    "axis-tilt": ("ped_x", "ped_y"),
    "azimuth-offset": ("az_enc",),
    "second-surface": ("glass",),
    "facet-curvature": ("fcurv",),
}
"""Effects of the mirror, with their parameters; a mirror has as many ``tilt_k`` as facets."""

GLASS = 1.515
"""Refractive index of BK7 at 633 nm (Schott: 1.51509)."""


@dataclass(frozen=True, eq=False)
class MirrorEffects:
    """What the mirror does beyond the recording's [mirror]; nothing by default. See `effects` for the signs.

    Attributes
    ----------
    pivot : float
        Added to r [mm]; the facets keep their width.
    pedestal : (3,) rad
        Turn of axis and body about world x, y, z through C (a rotation vector).
    glass : float
        Thickness before the coating [mm].
    curvature : float
        Of the facets, > 0 convex [1/mm].
    phases : (p,) array [rad]
    leans : (facets, p) array [rad], or None
        Lean of each facet's normal toward +axis, by the turn of that normal from the aimed one; None without any.
    facets : float
        Amplitude of the facets where the physics has a cylinder.
    """

    pivot: float = 0.0
    pedestal: tuple[float, float, float] = (0.0, 0.0, 0.0)
    glass: float = 0.0
    curvature: float = 0.0
    phases: Array | None = None
    leans: Array | None = None
    facets: float = 0.0

    def lean(self, facet: int | None, phase: Array) -> Array | float:
        """Lean of one facet, or (None) the mean of all, at phases [rad]."""
        if self.leans is None or self.phases is None:
            return 0.0
        row = self.leans.mean(axis=-2) if facet is None else self.leans[..., facet, :]
        if row.shape[-1] == 1:
            return np.asarray(row[..., 0]) if row.ndim > 1 else float(row[0])
        return np.interp(phase, self.phases, row)

    @property
    def uneven(self) -> bool:
        """Whether leans change with the phase."""
        return self.leans is not None and self.leans.shape[-1] > 1

    def spread(self, phase: Array) -> Array | None:
        """Each facet's lean less the mean of all at phases (..., n): (..., n, facets) [rad]; None if all are equal."""
        if self.leans is None or self.phases is None:
            return None
        off = self.leans - self.leans.mean(axis=-2, keepdims=True)
        if np.abs(off).max() < 1e-15:
            return None
        if not self.uneven:
            # Of several benches they are (bench, 1, 1, 1, facets, 1).
            rows = off[..., 0, 0, 0, :, 0] if off.ndim > 2 else off[:, 0]
            return np.broadcast_to(rows[..., None, :], (*phase.shape, off.shape[-2]))
        return np.stack([np.interp(phase, self.phases, row) for row in off], axis=1)

    def steepness(self, phase: Array, step: float = 1e-3) -> Array:
        """Derivative of `spread` by the phase, over some 2 mrad as a beam's light takes to pass, (n, facets)."""
        after, before = self.spread(phase + step), self.spread(phase - step)
        if after is None or before is None:
            return np.zeros((len(phase), 1))
        return (after - before) / (2 * step)


def effects(tables: Effects, fields: Mapping[str, Field], mirror: Mirror, *, gated: bool = False) -> MirrorEffects:
    """The mirror's share of a recording's effects (file units: mrad, mm, 1/m) and fields.

    ``tilt_rms`` alone widens the trace as facets would whose tilts have that rms (the quantiles of a normal
    distribution); it moves no gated exposure, for it does not say which facet leans where.

    Raises
    ------
    BenchsimError
        ``tilt_k`` of a facet that the mirror has not, or together with ``tilt_rms``; glass of negative thickness.
    """

    def of(name: str, key: str, unit: float = 1e-3) -> float:
        return unit * tables.get(name, {}).get(key, 0.0)

    n = mirror.facets
    k = np.arange(n)
    lean = np.full(n, of("canting", "pyr"))
    turn = 2 * np.pi * k / n
    lean += of("axis-wobble", "wob_c") * np.cos(turn) + of("axis-wobble", "wob_s") * np.sin(turn)
    tilts = dict(tables.get("facet-tilts", {}))
    rms = 1e-3 * tilts.pop("tilt_rms", 0.0)
    for key, value in tilts.items():
        facet = int(key.removeprefix("tilt_"))
        if facet >= n:
            raise BenchsimError(f"effects.facet-tilts.{key}: the mirror has {n} facets, 0 to {n - 1}; mend the number")
        lean[facet] += 1e-3 * value
    if rms and any(tilts.values()):
        raise BenchsimError("effects.facet-tilts: give tilt_rms or the facets' own tilts, not both")
    if rms and not gated:
        pattern = ndtri((k + 0.5) / n)
        lean += rms * pattern / np.sqrt(np.mean(pattern**2))
    if of("second-surface", "glass", 1.0) < 0:
        raise BenchsimError(f"effects.second-surface.glass: {of('second-surface', 'glass', 1.0):g} mm; give 0 or more")
    phases, leans = np.zeros(1), lean[:, None]
    if "lean" in fields:
        phases = np.array(fields["lean"].knots[0])
        leans = leans + evaluate(fields["lean"], phases[None, :], k[:, None])[0]
    return MirrorEffects(
        of("pivot-offset", "dr", 1.0),
        (of("axis-tilt", "ped_x"), of("axis-tilt", "ped_y"), of("azimuth-offset", "az_enc")),
        of("second-surface", "glass", 1.0),
        of("facet-curvature", "fcurv"),
        phases,
        leans if leans.any() else None,
        of("facets", "facets", 1.0),
    )


def turned(placement: Placement, polygon: MirrorEffects) -> Placement:
    """The placement with the mirror's axis and body turned with its pedestal; laser and aim stay."""
    if not any(polygon.pedestal):
        return placement
    turn = Rotation.from_rotvec(polygon.pedestal).as_matrix()
    return replace(placement, axis=turn @ placement.axis, normal=turn @ placement.normal)


def _turn(placement: Placement, phase: Array) -> tuple[Array, Array]:
    """Outward normal, the placement's turned right-handedly about the axis by ``phase``; and axis × normal."""
    e = np.asarray(phase)
    a, n = placement.axis, placement.normal
    lift = over(dot(a, n)) * a
    flat = n - lift
    across = cross(a, n)
    c, s = cos_sin(e)
    return outer(c, flat) + outer(s, across) + lift, outer(c, across) - outer(s, flat)


def surface(
    placement: Placement,
    radius: Array | float,
    curvature: Array | float,
    phase: Array,
    lean: Array | float,
    t: Array,
    h: Array,
) -> tuple[Array, Array, Array | None]:
    """Points and normals of a facet that may lean about its centre and be curved.

    A plane upright facet's points are C + r n + t (axis × n) + h axis.

    Parameters
    ----------
    placement : Placement
    radius, curvature : float [mm, 1/mm]
        r, the reflecting distance, and the facet's own curvature.
    phase : (...) array
        Right-handed turn of this facet's normal from ``placement.normal`` [rad]: the mirror's phase plus 2πk/facets.
    lean : float or (...) array [rad]
    t, h : arrays, broadcast against ``phase``
        Position on the facet across the axis and along it, from its centre [mm].

    Returns
    -------
    x : (..., 3) ndarray [mm]
    normal : (..., 3) ndarray
        Unit.
    area : (...) ndarray or None
        Area of the surface per dt dh; None where it is 1.
    """
    normal, across = _turn(placement, phase)
    along: Array = placement.axis
    x = placement.centre + over(radius) * normal
    if not (np.ndim(lean) == 0 and lean == 0):
        c, s = over(np.cos(lean)), over(np.sin(lean))
        normal, along = c * normal + s * along, c * along - s * normal
    th, hh = np.asarray(t, float)[..., None], np.asarray(h, float)[..., None]
    x = x + th * across + hh * along
    if not some(curvature):
        return x, normal, None
    x = x - 0.5 * over(curvature) * (th * th + hh * hh) * normal
    normal = normal + over(curvature) * (th * across + hh * along)
    area = np.sqrt(dot(normal, normal))
    return x, normal / area[..., None], area


def reflect(direction: Array, normal: Array) -> Array:
    """Mirror directions in planes of unit normal; lengths are kept."""
    return direction - (2.0 * dot(direction, normal))[..., None] * normal


def refracted(direction: Array, normal: Array, index: float = GLASS) -> tuple[Array, Array, Array]:
    """Snell's law for light that enters a medium of the index from air.

    Parameters
    ----------
    direction : (..., 3) array
        Of travel, of any length.
    normal : (..., 3) array
        Unit, against the light.
    index : float

    Returns
    -------
    inside : (..., 3) ndarray
        Unit.
    cosine : (...) ndarray
        Of the angle to the normal, inside.
    reflectance : (...) ndarray
        Fresnel's, of unpolarised light.
    """
    unit = direction / np.sqrt(dot(direction, direction))[..., None]
    outside = -dot(unit, normal)
    cosine = np.sqrt(1.0 - (1.0 - outside**2) / index**2)
    inside = unit / index + (outside / index - cosine)[..., None] * normal
    s = (outside - index * cosine) / (outside + index * cosine)
    p = (index * outside - cosine) / (index * outside + cosine)
    return inside, cosine, 0.5 * (s * s + p * p)


def through_glass(thickness: Array | float, entry: Array, normal: Array, direction: Array) -> tuple[Array, Array]:
    """Light that enters a plane-parallel plate, is reflected at the coating behind it, and leaves again.

    It leaves 2 × thickness × tan θ′ further on along the front face, θ′ its angle to the normal inside, in the
    direction in which the front face would reflect it.

    Parameters
    ----------
    thickness : float [mm]
    entry, normal, direction : (..., 3) array
        Where it meets the front face [mm], the face's unit normal there, and how it comes, of any length.

    Returns
    -------
    leave : (..., 3) ndarray [mm]
        Where it leaves the front face.
    passed : (...) ndarray
        Share of the light that passes the front face both ways.
    """
    inside, cosine, reflectance = refracted(direction, normal)
    leave = entry + (thickness / cosine)[..., None] * (inside + reflect(inside, normal))
    return leave, (1.0 - reflectance) ** 2
