"""Widths, centres and irradiance across the trace, with diffraction, blur and facets as the bench has them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchsim.bench.centre import centre
from benchsim.bench.errors import BenchsimError
from benchsim.rays import laser as source
from benchsim.rays.bench import Bench
from benchsim.rays.diffraction import even_profile, fresnel_profile, rule_needed, scales
from benchsim.rays.profile import Profiles, adaptive, geometric_profile, refine_height

Array = NDArray[np.float64]

FEW, MORE = 6, 24
"""Profiles whose widths are worked out; between them the width is smooth (1e-4 mm). More where a field has the facets
lean differently from phase to phase, and the width follows its knots."""


MOST = 2000
"""Half the samples of a profile with diffraction beyond which there is no trace. What the catalogue can do at four
times its caps needs 812 at the most; light that a step of a fit sends towards the board's horizon is metres wide, and
one such trace would take minutes and gigabytes."""


def blurs(bench: Bench, lateral: Array) -> Array:
    """rms [mm] of what spreads light across the trace like a Gaussian: incoherent divergence and shaking."""
    return np.hypot(source.blur_sigma(bench.laser) * lateral, bench.parts.timing.shake)


def widths(bench: Bench, nodes: Profiles) -> Array:
    """`adaptive_widths` of all profiles, (profile, 2) [mm]; worked out on a few and interpolated."""
    n = len(nodes.q)
    wanted = MORE if nodes.shift is not None and bench.parts.polygon.uneven else FEW
    return np.asarray(between(n, wanted) @ adaptive_widths(bench, nodes.only(few_of(n, wanted))))


def adaptive_widths(bench: Bench, some: Profiles, which: NDArray[np.bool_] | None = None) -> Array:
    """Adaptive width of each profile about its mean, and how far its `centre.centre` lies from that, (..., profile, 2)
    [mm].

    Parameters
    ----------
    bench : Bench
        Or a stack of benches; the profiles then have a leading axis.
    some : Profiles
        ``q`` measured from the curve.
    which : (bench,) bool, optional
        Benches of the stack that are wanted; default all. Only theirs are returned.
    """
    if some.q.ndim == 3:
        blur, shake = (
            np.full(len(some.q), float(v)) for v in (source.blur_sigma(bench.laser), bench.parts.timing.shake)
        )
        return _held(*_samples(bench, some, blur, shake))
    assert which is not None
    count = some.q.shape[1]
    blur, shake = (
        np.broadcast_to(np.reshape(v, (-1, 1)), (len(some.q), count))[which]
        for v in (source.blur_sigma(bench.laser), bench.parts.timing.shake)
    )
    if not which.all():
        some = some.only(which)
    benches = len(some.q)
    flat, blur, shake = _joined(some), blur.ravel(), shake.ravel()
    if not bench.physics.diffraction:
        return _held(*_samples(bench, flat, blur, shake)).reshape(-1, count, 2)
    window = _window(bench, flat, blur, shake)
    sizes = _grids(bench, flat, *window, benches)
    # Those of the same grid go together, with the finest rule among them: a finer one changes nothing. A bench's grid
    # over q must not depend on its company.
    mine = [sizes[:, 0] == grid for grid in sorted(set(sizes[:, 0].tolist()))]
    if len(mine) == 1:
        return _held(*_samples(bench, flat, blur, shake, window, sizes.max(axis=0))).reshape(-1, count, 2)
    found = []
    for m in mine:
        rows = np.repeat(m, count)
        sigma, reach, slits = (a[rows] for a in window)
        size = sizes[m].max(axis=0)
        found.append(_samples(bench, flat.only(rows), blur[rows], shake[rows], (sigma, reach, slits), size))
    # Filled up with places without light, all are one table.
    longest, widest = (max(f[k].shape[1] for f in found) for k in (0, 2))
    q, light = np.zeros((benches, count, longest)), np.zeros((benches, count, longest))
    spread = np.zeros((benches, count, widest))
    for m, (at, much, blurred) in zip(mine, found, strict=True):
        for table, part in ((q, at), (light, much), (spread, blurred)):
            table[m, :, : part.shape[1]] = part.reshape(-1, count, part.shape[1])
    return _held(*(table.reshape(-1, table.shape[2]) for table in (q, light, spread))).reshape(-1, count, 2)


def _joined(several: Profiles) -> Profiles:
    """Profiles of several benches without the leading axis."""
    q, weight, phase, lateral, chirp = (a.reshape(-1, *a.shape[2:]) for a in several[:5])
    shift, share = (None if a is None else a.reshape(-1, a.shape[-1]) for a in several[5:])
    return Profiles(q, weight, phase, lateral, chirp, shift, share)


def _window(bench: Bench, some: Profiles, blur: Array, shake: Array) -> tuple[Array, Array, Array]:
    """Spread of the light by blur, half width of the grid, and that per slit scale, (profile,) each."""
    geometric, slit = scales(some, bench.laser.wavelength, bench.mirror.height)
    sigma = np.hypot(blur * some.lateral.max(axis=(1, 2)), shake)
    apart = np.zeros(len(some.q)) if some.shift is None else np.ptp(some.shift, axis=1)
    reach = 2 * geometric + 5 * slit + 6 * sigma + apart
    return sigma, reach, reach / slit


def _grids(
    bench: Bench, some: Profiles, sigma: Array, reach: Array, slits: Array, benches: int = 1
) -> NDArray[np.intp]:
    """Half the count of the grid over q, and the count of nodes over the height, (bench, 2)."""
    # Two samples per slit scale: the pattern times the weight is band-limited, so the sums converge exponentially.
    count = 4 * np.ceil(slits.reshape(benches, -1).max(axis=1) / 2)
    if not (count <= MOST).all():
        raise BenchsimError(
            "the light of a trace is spread so far that its diffraction cannot be drawn; give smaller effects or errors"
        )
    rule = rule_needed(some, bench.laser.wavelength, bench.mirror.height, reach, benches)
    return np.stack([count.astype(np.intp), rule], axis=1)


def _held(q: Array, light: Array, spread: Array) -> Array:
    """Adaptive width and centre of samples measured from their mean, (profile, 2)."""
    return np.stack(placed(q, light, spread if spread.any() else 0.0), axis=1)


def placed(q: Array, light: Array, blur: Array | float = 0.0) -> tuple[Array, Array]:
    """Adaptive widths of profiles about their mean, and their `centre.centre`, (profile,) each [mm].

    Parameters
    ----------
    q, light : (profile, n) array
        Offsets from the mean of the light [mm], and light.
    blur : as of `adaptive`
    """
    _, width = adaptive(q, light, np.zeros(len(q)), blur=blur)
    return width, centre(q, light, width, np.zeros(len(q)), blur)


def _samples(
    bench: Bench,
    some: Profiles,
    blur: Array,
    shake: Array,
    window: tuple[Array, Array, Array] | None = None,
    size: NDArray[np.intp] | None = None,
) -> tuple[Array, Array, Array]:
    """Places, light and blur (profile, n) of profiles with one `_window` and grid's ``size``, default what they need.

    The blur is (profile, 1) where it is the same for all places.
    """
    mean = some.mean(some.q)
    if bench.physics.diffraction:
        sigma, reach, slits = window or _window(bench, some, blur, shake)
        count, rule = (_grids(bench, some, sigma, reach, slits)[0] if size is None else size).tolist()
        spread = sigma[:, None]
        q = mean[:, None] + reach[:, None] * (np.arange(-count, count + 1) / count)
        light = even_profile(some, bench.laser.wavelength, bench.mirror.height, mean, reach, count, rule)
    else:
        rows, heights = refine_height(some, 4 + 2 * some.q.shape[2])
        q, light = rows.reshape(len(rows), -1), heights.reshape(len(rows), -1)
        lateral = np.repeat(some.lateral.mean(axis=2), rows.shape[2], axis=1)
        spread = np.hypot(blur[:, None] * lateral, shake[:, None])
    if some.shift is not None and some.share is not None:
        facets = some.shift.shape[1]
        q = (q[:, :, None] + some.shift[:, None, :]).reshape(len(q), -1)
        light = (light[:, :, None] * some.share[:, None, :]).reshape(len(q), -1)
        spread = spread if spread.shape[1] == 1 else np.repeat(spread, facets, axis=1)
    return q, light, spread


def few_of(n: int, wanted: int) -> NDArray[np.intp]:
    """Numbers of a few of n profiles, evenly over them."""
    return np.unique(np.linspace(0, n - 1, min(n, wanted)).round().astype(int))


@lru_cache(maxsize=64)
def between(n: int, wanted: int) -> Array:
    """Matrix (n, few) of the cubic spline through values at the few profiles."""
    few = few_of(n, wanted)
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
