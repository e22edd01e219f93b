"""The refractive beam expander: real lenses in Mitsuba, traced once, and the beam that they make at the mirror.

Light travels along +z. Surfaces stand in the order of the light; a radius is positive where the centre of curvature
lies behind the surface, and the last thickness is the distance from the last surface to the mirror. Each surface is
traced in a frame of its own, with its vertex at the origin: float32 is then good to 1 µrad.

The input is a He-Ne laser's TEM00 beam at its waist: 1/e² diameter `INPUT_DIAMETER`, flat wavefront. Its Rayleigh
length of 0.8 m is long against the expander, and its diffraction, 0.1 mrad after an expander of 10, is below what the
expander's defocus makes; diffraction at the mirror is the concern of `diffraction`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Expander, Laser, Surface
from benchsim.renderer import backend
from benchsim.renderer.beam_table import BeamTable, monomials, slopes_of_monomials
from benchsim.renderer.glass import index

Array = NDArray[np.float64]

INPUT_DIAMETER = 0.8
"""1/e² diameter of the laser's beam before the expander [mm]: that of common 633 nm He-Ne tubes of 0.5 to 5 mW, which
their data sheets give as 0.6 to 0.9 mm."""

GRID_REACH = 2.6
"""The input is sampled to this many 1/e² radii; beyond lies 1e-6 of the power."""

TOLERANCE = 0.05
"""A diameter or divergence further from ``[laser]`` than this fraction is an error."""

_LOST = 0.01


@dataclass(frozen=True)
class TracedBeam:
    """Rays that left the expander, in the plane of the mirror.

    Attributes
    ----------
    source : (n, 2) mm
        Where the ray entered, from the axis of the first lens.
    position : (n, 2) mm
        Where it meets the plane perpendicular to the first lens' axis at the mirror.
    slope : (n, 2)
        dx/dz, dy/dz there.
    power : (n,)
        Of the ray: the input's density times the area of its cell times the transmission of all surfaces.
    transmission : (n,)
    lost : float
        Fraction of the input's power that missed a lens or was totally reflected.
    """

    source: Array
    position: Array
    slope: Array
    power: Array
    transmission: Array
    lost: float


@dataclass(frozen=True)
class ExpandedBeam:
    """What the expander makes of the laser, measured as a beam profiler and a wavefront sensor would.

    Attributes
    ----------
    diameter : float
        1/e² diameter at the mirror [mm]: four times the rms of the power, the mean of both directions.
    divergence : float
        Full angle between the 1/e² edges [rad]: the wavefront's mean curvature, by least squares weighted with the
        power, times the diameter.
    aberration : float
        rms of the slopes about that curvature, weighted with the power [rad].
    transmission : float
        Fraction of the input's power that arrives; uncoated surfaces.
    table : BeamTable
        For the emitter: centred on the power, aimed along its mean direction.
    """

    diameter: float
    divergence: float
    aberration: float
    transmission: float
    table: BeamTable


def elements(surfaces: tuple[Surface, ...]) -> list[slice]:
    """The lenses: runs of surfaces from air to air."""
    runs, start, before = [], 0, "air"
    for i, s in enumerate(surfaces):
        if before == "air":
            start = i
        if s.glass == "air":
            runs.append(slice(start, i + 1))
        before = s.glass
    if before != "air":
        raise BenchsimError(
            f"expander.surfaces[{len(surfaces)}]: the last surface must have \"air\" behind it, not '{before}'"
        )
    return runs


def _bounded(surface: Surface, number: int) -> None:
    if np.isfinite(surface.radius) and surface.semi_diameter >= abs(surface.radius):
        raise BenchsimError(
            f"expander.surfaces[{number}]: the semi-diameter {surface.semi_diameter:g} mm is not below the radius "
            f"{abs(surface.radius):g} mm; no sphere reaches so far out"
        )


def _shape(surface: Surface, before: float, after: float) -> tuple[Any, float]:
    """Mitsuba's scene of one surface with its vertex at the origin, and the z from which rays must start [mm]."""
    a, r = surface.semi_diameter, surface.radius
    if np.isinf(r):
        # A disk's normal is +z, so that light along +z comes from its inside.
        glass = {"type": "dielectric", "int_ior": before, "ext_ior": after}
        shape = {"type": "disk", "to_world": mi.ScalarTransform4f().scale([a, a, 1.0]), "bsdf": glass}
        return mi.load_dict({"type": "scene", "surface": shape}), -1.0
    inside, outside = (after, before) if r > 0 else (before, after)
    # Of the sphere only the cap about the vertex is there: v runs from 0 at +z to 1 at −z, and is stretched so that the
    # cap's edge falls between the two texels of the opacity.
    share = np.arcsin(a / abs(r)) / np.pi
    near = np.array([1.0, 0.0], np.float32)[:, None, None]
    opacity = {"type": "bitmap", "data": mi.TensorXf(near), "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    stretch = mi.ScalarTransform4f().scale([1.0, 0.5 / share, 1.0])
    opacity["to_uv"] = mi.ScalarTransform3f(np.array(stretch.matrix)[[0, 1, 3]][:, [0, 1, 3]])
    glass = {"type": "dielectric", "int_ior": inside, "ext_ior": outside}
    # The sphere is turned so that the vertex is its +z pole.
    turn = mi.ScalarTransform4f().translate([0.0, 0.0, r])
    if r > 0:
        turn = turn @ mi.ScalarTransform4f().rotate([1.0, 0.0, 0.0], 180.0)
    shape = {
        "type": "sphere",
        "radius": abs(r),
        "to_world": turn,
        "bsdf": {"type": "mask", "opacity": opacity, "nested": glass},
    }
    sag = abs(r) - np.sqrt(r * r - a * a)
    return mi.load_dict({"type": "scene", "surface": shape}), (-1.0 if r > 0 else -sag - 1e-3 * a)


def refract(
    surface: Surface, before: float, after: float, position: Array, direction: Array
) -> tuple[Array, Array, Array]:
    """One surface in Mitsuba.

    Parameters
    ----------
    surface : Surface
    before, after : float
        Indices.
    position, direction : (n, 3) array
        Rays in the surface's frame [mm]; directions of any length, toward +z.

    Returns
    -------
    position, direction : (n, 3) ndarray
        On the surface [mm], and behind it.
    transmission : (n,) ndarray
        Fresnel's, 0 where the ray misses the surface or is totally reflected.
    """
    if before == after:
        # A stop in its plane: Mitsuba refuses an interface without a difference of index.
        at = position - direction * (position[:, 2:] / direction[:, 2:])
        return at, direction, (np.hypot(at[:, 0], at[:, 1]) <= surface.semi_diameter).astype(float)
    scene, start = _shape(surface, before, after)
    origin = position + direction * ((start - position[:, 2:]) / direction[:, 2:])
    ray = mi.Ray3f(mi.Point3f(origin.T), dr.normalize(mi.Vector3f(direction.T)))
    hit = scene.ray_intersect(ray)
    bsdf = hit.bsdf()
    # A sample this near to 1 always chooses the transmitted ray, whose probability is Fresnel's transmission.
    sample, _ = bsdf.sample(mi.BSDFContext(mi.TransportMode.Importance), hit, 1 - 2.0**-20, mi.Point2f(0.5), True)
    there = np.array(hit.is_valid() & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaTransmission))
    onward = np.array(hit.to_world(sample.wo), float).T
    return (
        np.where(there[:, None], np.array(hit.p, float).T, 0.0),
        np.where(there[:, None], onward, [0.0, 0.0, 1.0]),
        np.where(there, np.array(sample.pdf, float), 0.0),
    )


def trace(expander: Expander, wavelength: float, grid: int = 101) -> TracedBeam:
    """Trace the input beam through the lenses to the mirror.

    ``defocus`` is added to the air gap before the last lens; ``decentre`` [mm] shifts the last lens along y and
    ``tilt`` [rad] turns it about x through the vertex of its first surface.

    Parameters
    ----------
    expander : Expander
    wavelength : float
        [mm]
    grid : int
        Rays across the input; those within `GRID_REACH` radii are traced.

    Raises
    ------
    BenchsimError
        If the surfaces do not make sense.
    """
    backend.use()
    lenses = elements(expander.surfaces)
    last = lenses[-1]
    if expander.defocus and len(lenses) < 2:
        raise BenchsimError("expander.defocus_mm: a single lens has no air gap that it could change; remove the key")
    waist = INPUT_DIAMETER / 2
    axis = np.linspace(-GRID_REACH, GRID_REACH, grid) * waist
    x, y = (v.ravel() for v in np.meshgrid(axis, axis))
    inside = np.hypot(x, y) <= GRID_REACH * waist
    source = np.column_stack([x[inside], y[inside]])
    power = 2 / (np.pi * waist**2) * np.exp(-2 * (source**2).sum(axis=1) / waist**2) * (axis[1] - axis[0]) ** 2

    position = np.column_stack([source, np.zeros(len(source))])
    direction = np.tile([0.0, 0.0, 1.0], (len(source), 1))
    transmission = np.ones(len(source))
    turn = Rotation.from_rotvec([expander.tilt, 0.0, 0.0]).as_matrix()
    shift = np.array([0.0, expander.decentre, 0.0])
    before = 1.0
    for i, surface in enumerate(expander.surfaces):
        _bounded(surface, i + 1)
        if i == last.start:
            position, direction = (position - shift) @ turn, direction @ turn
        after = index(surface.glass, wavelength)
        position, direction, part = refract(surface, before, after, position, direction)
        transmission *= part
        gap = surface.thickness
        if i == last.stop - 1:
            # Out of the lens' frame, at its first vertex, back to that of the expander.
            position[:, 2] += sum(s.thickness for s in expander.surfaces[last][:-1])
            position, direction = position @ turn.T + shift, direction @ turn.T
            gap += sum(s.thickness for s in expander.surfaces[last][:-1])
        if i == last.start - 1:
            gap += expander.defocus
            if gap < 0:
                raise BenchsimError("expander.defocus_mm: closes the air gap altogether; make it less negative")
        position[:, 2] -= gap
        before = after
    arrived = transmission > 0
    slope = direction[arrived, :2] / direction[arrived, 2:]
    return TracedBeam(
        source=source[arrived],
        position=position[arrived, :2] - position[arrived, 2:] * slope,
        slope=slope,
        power=(power * transmission)[arrived],
        transmission=transmission[arrived],
        lost=float(power[~arrived].sum() / power.sum()),
    )


def expand(expander: Expander, wavelength: float) -> ExpandedBeam:
    """The beam that the expander makes at the mirror.

    Raises
    ------
    BenchsimError
        If the surfaces do not make sense, or more than 1 % of the beam misses a lens.
    """
    rays = trace(expander, wavelength)
    if rays.lost > _LOST:
        raise BenchsimError(
            f"expander.surfaces: {rays.lost:.0%} of the laser's {INPUT_DIAMETER} mm beam misses a lens or is totally "
            "reflected; widen the semi-diameters or mend the radii"
        )
    weight = rays.power / rays.power.sum()
    position = rays.position - weight @ rays.position
    slope = rays.slope - weight @ rays.slope
    diameter = 4 * float(np.sqrt((weight @ position**2).mean()))
    curvature = float((weight @ (position * slope).sum(axis=1)) / (weight @ (position**2).sum(axis=1)))
    residual = slope - curvature * position
    waist = diameter / 2

    # ln of the density over that of the ideal beam, from the map of the mirror's plane back onto the input.
    edge = float(np.hypot(*position.T).max())
    a, b = (position / edge).T
    terms = monomials(a, b)
    back = np.linalg.lstsq(terms, rays.source, rcond=None)[0]
    by_a, by_b = (d @ back / edge for d in slopes_of_monomials(a, b))
    jacobian = np.abs(by_a[:, 0] * by_b[:, 1] - by_a[:, 1] * by_b[:, 0])
    w_in = INPUT_DIAMETER / 2
    ratio = (
        2 * (position**2).sum(axis=1) / waist**2
        - 2 * (rays.source**2).sum(axis=1) / w_in**2
        + np.log(jacobian * rays.transmission * (waist / w_in) ** 2 / rays.power.sum())
    )
    fits = [tuple(map(float, np.linalg.lstsq(terms, v, rcond=None)[0])) for v in (*residual.T, ratio)]
    return ExpandedBeam(
        diameter=diameter,
        divergence=curvature * diameter,
        aberration=float(np.sqrt(weight @ (residual**2).sum(axis=1))),
        transmission=float(rays.power.sum()),
        table=BeamTable(edge / waist, *fits),
    )


def check_against_laser(beam: ExpandedBeam, laser: Laser) -> str | None:
    """Compare the expander's beam with what ``[laser]`` states.

    Returns
    -------
    str or None
        One sentence where diameter or divergence differs by more than 0.1 %.

    Raises
    ------
    BenchsimError
        If one of them is off by more than `TOLERANCE`. A divergence is compared relative to the stated one or to the
        diffraction limit 4λ/(πD), whichever is larger.
    """
    limit = 4 * laser.wavelength / (np.pi * laser.beam_diameter)
    diameter = beam.diameter / laser.beam_diameter - 1
    divergence = (beam.divergence - laser.divergence) / max(abs(laser.divergence), limit)
    worst = max(abs(diameter), abs(divergence))
    if worst <= 1e-3:
        return None
    sentence = (
        f"the expander makes a beam of {beam.diameter:.3f} mm and {beam.divergence * 1e3:.3f} mrad at the mirror, "
        f"where [laser] says {laser.beam_diameter:.3f} mm and {laser.divergence * 1e3:.3f} mrad "
        f"({diameter:+.1%} and {divergence:+.1%})"
    )
    if worst > TOLERANCE:
        raise BenchsimError(
            f"[expander]: {sentence}; mend the surfaces or defocus_mm, or write the expander's values into [laser]"
        )
    return sentence
