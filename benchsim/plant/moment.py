"""A plant at one moment: where its mirrors point, what of their light is lost and where, and the flux it makes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.fluxes import product
from benchsim.fluxes.heliostat import ideal_normal
from benchsim.fluxes.product import Beams, batches
from benchsim.instruments.mount.axes import pointing
from benchsim.instruments.mount.records import Mount, angles
from benchsim.plant.model import Field, Mesh, Plant
from benchsim.plant.shading import lost

Array = NDArray[np.float64]

NOTHING: Mapping[str, Array] = {}


@dataclass(frozen=True)
class Noise:
    """Standard errors of a Monte Carlo.

    Attributes
    ----------
    power : (n,)
        Of each heliostat's power, on whichever receiver [W].
    received : (receivers,)
        Of the power on each [W].
    flux : tuple of (along, up) arrays
        Of each receiver's cells [W/m²].
    rays : int
    accuracy : float
        Relative, of a receiver's power or its brightest cell, the larger.
    """

    power: Array
    received: Array
    flux: tuple[Array, ...]
    rays: int
    accuracy: float


@dataclass(frozen=True)
class Moment:
    """A plant at one moment, of n heliostats.

    Attributes
    ----------
    sun : (3,)
        Unit vector toward it.
    irradiance : float
        On a plane that faces the sun [W/m²].
    cosine, shaded, blocked, transmitted, caught : (n,)
        Of incidence; parts of the mirror's area; parts of the light that the air lets pass, and that then meets the
        receiver.
    power : (n,)
        On the receiver [W].
    reflected : (n,)
        By the mirror were it alone [W].
    image_rms : (n,)
        Of the light's distance from the central ray on the plane perpendicular to it [mm].
    landing : (n, 2)
        Where the central ray meets the surface of the receiver aimed at, along and up [mm]; nan: it does not. By Monte
        Carlo the centroid of the light on that receiver; nan: none is.
    flux : tuple of (along, up) arrays
        On each receiver [W/m²].
    meshes : tuple of Mesh
    grid : float
        By how much the shares caught change, at most, without the edge correction: what finer cells may change.
    received : (receivers,)
        Power on each receiver [W]; of the product, what its own heliostats bring to it.
    noise : Noise or None
        Of a Monte Carlo.
    """

    sun: Array
    irradiance: float
    cosine: Array
    shaded: Array
    blocked: Array
    transmitted: Array
    caught: Array
    power: Array
    reflected: Array
    image_rms: Array
    landing: Array
    flux: tuple[Array, ...]
    meshes: tuple[Mesh, ...]
    grid: float
    received: Array
    noise: Noise | None = None

    @property
    def spillage(self) -> Array:
        """Part of the light that reaches the receiver's distance and misses it, (n,)."""
        return np.asarray(1 - self.caught)


def normals(field: Field, sun: ArrayLike, errors: Mapping[str, Array] = NOTHING) -> Array:
    """Of mirrors that are driven to where they should point and have errors, (n, 3)."""
    ideal = ideal_normal(field.position, field.aim, sun)
    if not any(np.any(v) for v in errors.values()):
        return ideal
    if field.kinematics == "az-el":
        reading = np.stack(angles(ideal), axis=1)
    else:
        # Both angles of `axes` at which the mirror's normal, south at 0, is the ideal one.
        e, n, u = ideal.T
        reading = np.stack([np.arctan2(-u, -n), np.arcsin(np.clip(e, -1, 1))], axis=1)
    return pointing(Mount(field.kinematics, "spot"), reading, errors)[0]


def transmitted(distance: Array, kind: str) -> Array:
    """Part of the light that the air lets pass, of distances [mm].

    Clear: MIRVAL's for a visual range of some 23 km, Leary & Hankins 1979 (SAND77-8280): 0.99321 − 1.176e-4 d +
    1.97e-8 d² to 1 km, exp(−1.106e-4 d) beyond (d in m).
    """
    if kind == "none":
        return np.ones_like(distance)
    d = distance / 1e3
    return np.asarray(np.where(d <= 1e3, 0.99321 - 1.176e-4 * d + 1.97e-8 * d**2, np.exp(-1.106e-4 * d)))


def meshes(plant: Plant, cells: int | None = None) -> tuple[Mesh, ...]:
    """Grids of the receivers whose cells are half as wide as the narrowest core's sigma, or ``cells`` along and up."""
    # An even disc has half of its half angle for sigma; an aureole makes the whole wider, but the spot no smoother.
    core = np.hypot(plant.blur, min(plant.sun.sigma, plant.sun.half / 2))
    narrow = float((core * plant.field.distance).min())
    if cells is not None:
        return tuple(r.mesh(1.0, cells, cells) for r in plant.receivers)
    return tuple(r.mesh(narrow / 2) for r in plant.receivers)


def moment(
    plant: Plant,
    sun: ArrayLike,
    irradiance: float,
    errors: Mapping[str, Array] = NOTHING,
    grids: tuple[Mesh, ...] | None = None,
) -> Moment:
    """What a plant does at one moment.

    Parameters
    ----------
    plant : Plant
    sun : (3,) array
        Unit vector toward it.
    irradiance : float
        On a plane that faces the sun [W/m²].
    errors : mapping of str to (n,)
        Of the mounts, as `Field.errors`.
    grids : tuple of Mesh, optional
        Default `meshes`.
    """
    s, f = np.asarray(sun, float), plant.field
    grids = grids or meshes(plant)
    beams = _beams(plant, s, errors)
    cosine, ray = np.maximum(beams.cosine, 0.0), beams.ray
    shaded, blocked = lost(f.position, beams.normal, f.width, f.height, s, ray, f.distance)
    through = transmitted(f.distance, plant.site.attenuation)
    clean = irradiance * plant.optics.reflectance * (1 - plant.optics.soiling)
    reflected = clean * f.area / 1e6 * cosine
    arrives = clean * (1 - shaded - blocked) * through
    caught, rough, place = np.zeros(len(f)), np.zeros(len(f)), np.full((len(f), 2), np.nan)
    maps = []
    for k, (receiver, mesh) in enumerate(zip(plant.receivers, grids, strict=True)):
        own = np.flatnonzero(f.receiver == k)
        total = np.zeros(len(mesh.points))
        cell = receiver.extent[0] * receiver.extent[1] / len(mesh.points)
        for some, lit, values in batches(beams.chosen(own), mesh.points, mesh.normals):
            who = own[some]
            total[lit] += arrives[who] @ values
            caught[who] = values @ mesh.weights[lit]
            rough[who] = values.sum(axis=1) * cell
        place[own] = receiver.landing(f.position[own], ray[own])
        maps.append(total.reshape(mesh.shape))
    whole = f.area * np.maximum(cosine, 1e-12)
    caught, rough = np.clip(caught / whole, 0, 1), rough / whole
    power = reflected * (1 - shaded - blocked) * through * caught
    received = np.bincount(f.receiver, power, len(plant.receivers)).astype(float)
    return Moment(
        s, irradiance, cosine, shaded, blocked, through, caught, power, reflected, beams.image_rms, place, tuple(maps),
        grids, float(np.abs(caught - rough).max()), received,
    )  # fmt: skip


def _beams(plant: Plant, sun: Array, errors: Mapping[str, Array]) -> Beams:
    f = plant.field
    share, sun_parts = plant.sun.gaussians
    blur = plant.blur
    spread, parts = np.hypot(plant.sun.sigma, blur), np.hypot(sun_parts[:, None], blur)
    return Beams(
        f.position, normals(f, sun, errors), f.width, f.height, spread, f.distance, sun, share, parts
    )  # fmt: skip


def shifted(plant: Plant, shift: Array) -> Plant:
    """A plant whose heliostats aim elsewhere, by (n, 2) along their receivers and up [mm]."""
    f = plant.field
    aim = f.aim.copy()
    for k, receiver in enumerate(plant.receivers):
        own = f.receiver == k
        aim[own] = receiver.shifted(aim[own], shift[own])
    return replace(plant, field=replace(f, aim=aim))


def over_limit(plant: Plant, m: Moment) -> Array:
    """Power above the limits, of each receiver; 0 of those without one [W]."""
    return np.array(
        [
            0.0 if r.peak_limit is None else np.maximum(flux.ravel() - r.peak_limit, 0) @ mesh.weights / 1e6
            for r, flux, mesh in zip(plant.receivers, m.flux, m.meshes, strict=True)
        ]
    )


def over_limit_changes(
    plants: tuple[Plant, Plant], moments: tuple[Moment, Moment], errors: tuple[Mapping[str, Array], Mapping[str, Array]]
) -> Array:
    """By how much the power above the limits grows if of all heliostats one alone changes from first to second, (n,) W.

    Parameters
    ----------
    plants : (Plant, Plant)
        Of the same heliostats, which may aim elsewhere.
    moments : (Moment, Moment)
        By `moment`, at one sun and on the same meshes.
    errors : pair of mappings
        Of the mounts, with which these were made.
    """
    p, f = plants[0], plants[0].field
    out = np.zeros(len(f))
    clean = p.optics.reflectance * (1 - p.optics.soiling)
    beams = [_beams(x, m.sun, e) for x, m, e in zip(plants, moments, errors, strict=True)]
    arrives = [m.irradiance * clean * (1 - m.shaded - m.blocked) * m.transmitted for m in moments]
    for k, (receiver, mesh) in enumerate(zip(p.receivers, moments[0].meshes, strict=True)):
        limit = receiver.peak_limit
        if limit is None:
            continue
        flux = moments[0].flux[k].ravel()
        own = np.flatnonzero(f.receiver == k)
        for some, lit, before in batches(beams[0].chosen(own), mesh.points, mesh.normals):
            who = own[some]
            at = mesh.normals if len(mesh.normals) == 1 else mesh.normals[lit]
            after = arrives[1][who, None] * product.flux(beams[1].chosen(who), mesh.points[lit], at)
            change = after - arrives[0][who, None] * before
            # Most of a receiver is far below its limit.
            near = flux[lit] + np.maximum(change.max(axis=0), 0) > limit
            there, weights = flux[lit][near], mesh.weights[lit][near] / 1e6
            out[who] = (np.maximum(there + change[:, near] - limit, 0) - np.maximum(there - limit, 0)) @ weights
    return out
