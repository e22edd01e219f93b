"""A plant at one moment by Monte Carlo: as `benchsim.plant.moment.moment`, with nothing of its optics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.fluxes.heliostat import mirror_axes
from benchsim.fluxes.paths import Light, Mirrors, Surface
from benchsim.fluxes.traced import trace
from benchsim.plant.model import Mesh, Plant, Receiver
from benchsim.plant.moment import NOTHING, Moment, Noise, meshes, normals, transmitted

Array = NDArray[np.float64]


def moment_traced(
    plant: Plant,
    sun: ArrayLike,
    irradiance: float,
    errors: Mapping[str, Array] = NOTHING,
    grids: tuple[Mesh, ...] | None = None,
    *,
    accuracy: float = 0.01,
    seed: int = 0,
    variant: str | None = None,
    specularity: Array | None = None,
) -> Moment:
    """What a plant does at one moment, by rays.

    Parameters
    ----------
    plant, sun, irradiance, errors, grids
        As `benchsim.plant.moment.moment` takes them.
    accuracy : float
        Relative standard error of every receiver's power and brightest cell.
    seed : int
    variant : str, optional
        Of Mitsuba.
    specularity : (n,), optional
        Of each heliostat in the place of the plant's [rad].
    """
    s, f, o = np.asarray(sun, float), plant.field, plant.optics
    grids = grids or meshes(plant)
    n = normals(f, s, errors)
    across, up = mirror_axes(n)
    through = transmitted(f.distance, plant.site.attenuation)
    reflectance = o.reflectance * (1 - o.soiling)
    mirrors = Mirrors(
        f.position, np.stack([across, up, n], axis=1), f.width, f.height, f.facets,
        np.where(np.isnan(f.focal), f.distance, f.focal), np.where(np.isnan(f.canting), f.distance, f.canting),
        f.distance, reflectance * through, np.full(len(f), o.specularity) if specularity is None else specularity,
        f.receiver,
    )  # fmt: skip
    surfaces = tuple(_surface(r, m) for r, m in zip(plant.receivers, grids, strict=True))
    light = Light(s, plant.sun.quantiles(), o.slope)
    got = trace(mirrors, light, surfaces, accuracy=accuracy, seed=seed, variant=variant)
    # W from the irradiance on a square millimetre.
    watts = irradiance / 1e6
    whole = np.maximum(got.whole, 1e-300)
    left = np.maximum(got.whole - got.shaded - got.blocked, 1e-300) * mirrors.passed
    maps, noise = [], []
    for receiver, mesh, total, variance in zip(plant.receivers, grids, got.maps, got.variances, strict=True):
        cell = receiver.extent[0] * receiver.extent[1] / len(mesh.points)
        maps.append(irradiance * total / cell)
        noise.append(irradiance * np.sqrt(variance) / cell)
    return Moment(
        s, irradiance, got.whole / f.area, got.shaded / whole, got.blocked / whole, through, got.landed / left,
        watts * got.landed, watts * reflectance * got.whole, np.sqrt(got.turn), got.place, tuple(maps), grids, 0.0,
        np.array([watts * m.sum() for m in got.maps]),
        Noise(
            watts * np.sqrt(got.landed_variance), watts * np.sqrt(got.received_variance), tuple(noise), got.rays,
            got.accuracy,
        ),
    )  # fmt: skip


def _surface(r: Receiver, mesh: Mesh) -> Surface:
    if r.kind == "cylinder":
        return Surface(True, np.array(r.centre), np.eye(3), r.width, r.height, mesh.shape)
    target = r.target
    return Surface(False, np.array(r.centre), np.vstack([target.axes, target.normal]), r.width, r.height, mesh.shape)
