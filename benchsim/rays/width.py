"""Widths and irradiance across the trace, with diffraction, blur and facets as the bench has them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchsim.rays import laser as source
from benchsim.rays.diffraction import fresnel_profile, scales
from benchsim.rays.profile import Profiles, adaptive, geometric_profile, refine_height
from benchsim.rays.sweep import Bench

Array = NDArray[np.float64]

FEW, MORE = 6, 24
"""Profiles whose widths are worked out; between them the width is smooth (1e-4 mm). More where a field has the facets
lean differently from phase to phase, and the width follows its knots."""


def blurs(bench: Bench, lateral: Array) -> Array:
    """rms [mm] of what spreads light across the trace like a Gaussian: incoherent divergence and shaking."""
    return np.hypot(source.blur_sigma(bench.laser) * lateral, bench.parts.timing.shake)


def widths(bench: Bench, nodes: Profiles) -> Array:
    """Adaptive width about the mean of each profile, (profile,) [mm]; worked out on a few and interpolated."""
    n = len(nodes.q)
    wanted = MORE if nodes.shift is not None and bench.parts.polygon.uneven else FEW
    few = _few(n, wanted)
    some = nodes.only(few)
    mean = some.mean(some.q)
    if bench.physics.diffraction:
        geometric, slit = scales(some, bench.laser.wavelength, bench.mirror.height)
        blur = blurs(bench, some.lateral.max(axis=(1, 2)))[:, None]
        apart = np.zeros(len(few)) if some.shift is None else np.ptp(some.shift, axis=1)
        reach = 2 * geometric + 5 * slit + 6 * blur[:, 0] + apart
        count = 1 + 2 * int(np.ceil(np.max(2 * reach / slit)))
        # Two samples per slit scale: the pattern times the weight is band-limited, so the sums converge exponentially.
        q = mean[:, None] + reach[:, None] * np.linspace(-1, 1, count)
        light = fresnel_profile(some, bench.laser.wavelength, bench.mirror.height, q)
    else:
        rows, heights = refine_height(some, 4 + 2 * some.q.shape[2])
        q, light = rows.reshape(len(few), -1), heights.reshape(len(few), -1)
        lateral = np.repeat(some.lateral.mean(axis=2), rows.shape[2], axis=1)
        blur = blurs(bench, lateral)
    if some.shift is not None and some.share is not None:
        facets = some.shift.shape[1]
        q = (q[:, :, None] + some.shift[:, None, :]).reshape(len(few), -1)
        light = (light[:, :, None] * some.share[:, None, :]).reshape(len(few), -1)
        blur = blur if blur.shape[1] == 1 else np.repeat(blur, facets, axis=1)
    # Its own mean is 0: the profiles are measured from the curve.
    width = adaptive(q, light, np.zeros(len(few)), blur=blur if blur.any() else 0.0)[1]
    return _between(n, wanted) @ width


def _few(n: int, wanted: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, n - 1, min(n, wanted)).round().astype(int))


@lru_cache(maxsize=64)
def _between(n: int, wanted: int) -> Array:
    """Matrix (n, few) of the cubic spline through values at the few profiles."""
    few = _few(n, wanted)
    return np.asarray(CubicSpline(few, np.eye(len(few)))(np.arange(n)))


def across(bench: Bench, nodes: Profiles, q: Array) -> Array:
    """Light per mm² at offsets q (profile, n) from the curve."""
    if nodes.shift is None or nodes.share is None:
        return _one(bench, nodes, q)
    parts = [
        nodes.share[:, k, None] * _one(bench, nodes, q - nodes.shift[:, k, None]) for k in range(nodes.shift.shape[1])
    ]
    return np.asarray(np.sum(parts, axis=0))


def _one(bench: Bench, nodes: Profiles, q: Array) -> Array:
    def sharp(at: Array) -> Array:
        if bench.physics.diffraction:
            return fresnel_profile(nodes, bench.laser.wavelength, bench.mirror.height, at)
        return geometric_profile(nodes, at)

    reach = blurs(bench, nodes.mean(nodes.lateral))[:, None]
    if not reach.any():
        return sharp(q)
    geometric, slit = scales(nodes, bench.laser.wavelength, bench.mirror.height)
    if bench.physics.diffraction and np.max(reach[:, 0] / slit) < 0.3:
        # A blur finer than the pattern: a few shifted patterns, exact to the pattern's band limit.
        x, w = np.polynomial.hermite_e.hermegauss(7)
        return np.asarray(np.sum([wi * sharp(q - reach * xi) for xi, wi in zip(x, w / w.sum(), strict=True)], axis=0))
    # Otherwise the sharp profile on a grid of its own, each of its samples spread into a Gaussian.
    extent = 2 * geometric + (20 * slit if bench.physics.diffraction else 0.0)
    step = np.minimum(0.4 * slit if bench.physics.diffraction else 0.02 * geometric, 0.6 * reach[:, 0])
    count = int(np.ceil(np.max(extent / step)))
    grid = nodes.mean(nodes.q)[:, None] + extent[:, None] * np.linspace(-1, 1, 2 * count + 1)
    light = sharp(grid) * (extent / count)[:, None]
    spread = np.exp(-0.5 * ((q[:, :, None] - grid[:, None, :]) / reach[:, :, None]) ** 2)
    return np.asarray(np.einsum("pqg,pg->pq", spread, light) / (np.sqrt(2 * np.pi) * reach))
