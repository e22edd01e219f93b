"""Flux of many heliostats by Monte Carlo in Mitsuba: any sun's shape, facets, neighbours that shade and block.

Nothing is shared with `benchsim.fluxes.product`. What a ray meets is `paths`'; here rays are added up until they are
enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from benchsim.fluxes import paths
from benchsim.fluxes.paths import NAMES, Light, Mirrors, Surface
from benchsim.renderer.backend import use

Array = NDArray[np.float64]

BATCH = 2**20
"""Rays of a kernel: arrays of 4 MB, and half a second."""

GROUP = 2**14
"""Rays that are summed in single precision, at most: to 1e-5."""

MOST = 2**29
"""Rays at which one gives up, some minutes."""

DARK = 1e-3
"""Of the most lit receiver's power: below, a receiver's own accuracy is not waited for."""


@dataclass(frozen=True)
class Traced:
    """What was traced, as a multiple of the irradiance on a plane that faces the sun; sums of squares are variances.

    Attributes
    ----------
    whole, shaded, blocked : (n,)
        Of the beam on each mirror [mm²].
    landed, landed_variance : (n,)
        On any receiver, of what `Mirrors.passed` leaves [mm²].
    received_variance : (receivers,)
        Of what lands on each, of all mirrors [mm⁴].
    turn : (n,)
        Mean square of the light's distance from the central ray, across it at the receiver's distance [mm²].
    place : (n, 2)
        Centroid on the receiver aimed at, along and up [mm]; nan where nothing lands there.
    maps, variances : tuple of (along, up) arrays
        Power in each receiver's cells, and its variance [mm², mm⁴].
    rays : int
    accuracy : float
        Largest relative standard error of a receiver's power and of its brightest cell.
    """

    whole: Array
    shaded: Array
    blocked: Array
    landed: Array
    landed_variance: Array
    received_variance: Array
    turn: Array
    place: Array
    maps: tuple[Array, ...]
    variances: tuple[Array, ...]
    rays: int
    accuracy: float


def trace(
    mirrors: Mirrors,
    light: Light,
    surfaces: tuple[Surface, ...],
    *,
    accuracy: float = 0.01,
    seed: int = 0,
    variant: str | None = None,
) -> Traced:
    """Trace rays until power and brightest cell of every receiver are as sure as wanted.

    Parameters
    ----------
    mirrors : Mirrors
    light : Light
    surfaces : tuple of Surface
    accuracy : float
        Relative standard error.
    seed : int
    variant : str, optional
        Of Mitsuba; see `benchsim.renderer.backend.use`.
    """
    use(variant)
    n = len(mirrors.position)
    groups = max(1, -(-BATCH // n // GROUP))
    each = max(1, BATCH // (n * groups))
    count = n * groups * each
    scene, shapes = paths.neighbours(mirrors), [paths.shape(s) for s in surfaces]
    columns = {name: mi.Float(value.astype(np.float32)) for name, value in paths.columns(mirrors).items()}
    angles = mi.Float(light.angles.astype(np.float32))
    per, shares = np.zeros((len(NAMES), n)), np.zeros((2, n, len(surfaces)))
    maps: list[Any] = [np.zeros((2, *s.cells)) for s in surfaces]
    rays, reached = 0, np.inf
    while rays < MOST and reached > accuracy:
        sums = [dr.zeros(mi.Float, n * groups) for _ in NAMES]
        parts = [dr.zeros(mi.Float, n * groups * len(surfaces)) for _ in range(2)]
        bins = [[dr.zeros(mi.Float, s.cells[0] * s.cells[1]) for _ in range(2)] for s in surfaces]
        ray = dr.arange(mi.UInt32, count)
        index = ray // dr.opaque(mi.UInt32, each)
        # A variable, not a literal: one kernel serves all batches. Streams of neighbouring numbers are not independent,
        # hence the hash.
        batch = dr.opaque(mi.UInt32, (seed * 1_000_003 + rays // count) % 2**32)
        state, stream = mi.sample_tea_32(ray, batch)  # type: ignore[call-overload]
        generator: Any = mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(stream))  # type: ignore[operator]
        found = paths.rays(index // groups, columns, light, angles, generator, scene, shapes)
        for total, name in zip(sums, NAMES, strict=True):
            dr.scatter_add(total, found[name], index)
        for k, (pair, (cell, active)) in enumerate(zip(bins, found["cells"], strict=True)):
            for power, (total, part) in enumerate(zip(pair, parts, strict=True), 1):
                dr.scatter_add(total, found["landed"] ** power, cell, active)
                dr.scatter_add(part, found["landed"] ** power, index * len(surfaces) + k, active)
        dr.eval(sums, parts, bins)
        per += [np.array(x, float).reshape(n, groups).sum(axis=1) for x in sums]
        shares += [np.array(x, float).reshape(n, groups, -1).sum(axis=1) for x in parts]
        for total, pair, s in zip(maps, bins, surfaces, strict=True):
            total += np.array([np.array(x, float).reshape(s.cells) for x in pair])
        rays += count
        reached = _reached(maps)
    scale = mirrors.width * mirrors.height / (rays / n)
    got = dict(zip(NAMES, per, strict=True))
    # Weights in the kernel are of the mirrors' mean area, so that single precision is of no concern.
    unit = float(scale.mean())
    aimed = np.where(got["aimed"] > 0, got["aimed"], np.nan)
    place = np.stack([got["along"] / aimed, got["up"] / aimed], axis=1)
    # As many rays leave each mirror: one's are sure but for their weights if all land, but not on which receiver.
    landed, squared = shares.sum(axis=2)
    spread, each_spread = (np.maximum(q - x**2 / (rays / n), 0.0) for x, q in ((landed, squared), shares))
    through = np.maximum(got["whole"] - got["shaded"] - got["blocked"], 1e-300)
    return Traced(
        got["whole"] * scale, got["shaded"] * scale, got["blocked"] * scale, landed * unit,
        spread * unit**2, each_spread.sum(axis=0) * unit**2, got["turn"] / through, place,
        tuple(m[0] * unit for m in maps), tuple(m[1] * unit**2 for m in maps), rays, reached,
    )  # fmt: skip


def _reached(maps: list[Array]) -> float:
    """Relative standard error, of power and brightest cell of every receiver that is lit."""
    power = [m[0].sum() for m in maps]
    if not max(power):
        return float("inf")
    out = 0.0
    for (total, squares), p in zip(maps, power, strict=True):
        if p > DARK * max(power):
            k = int(total.argmax())
            out = max(out, np.sqrt(squares.sum()) / p, np.sqrt(squares.flat[k]) / total.flat[k])
    return float(out)
