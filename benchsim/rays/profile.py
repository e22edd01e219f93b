"""Profiles across the trace: irradiance as a function of the perpendicular offset, and its robust moments."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Profiles(NamedTuple):
    """Nodes of profiles across a trace: axes are (profile, t, h), before them (bench,) where there are several.

    ``q`` [mm] where the light from a node cuts the profile's line, ``weight`` its light per mm of the curve, ``phase``
    [rad] when; ``lateral`` [mm/rad] how far a turn of the reflected ray across its motion moves q; ``chirp`` [1/mm]
    turns a distance in q into a turn of the ray along the facet's height. Where the facets lean differently the nodes
    are those of the mean lean, and each facet has the same profile moved by ``shift`` (profile, facet) [mm] with
    ``share`` of the light; both are None otherwise.
    """

    q: Array
    weight: Array
    phase: Array
    lateral: Array
    chirp: Array
    shift: Array | None = None
    share: Array | None = None

    @property
    def flux(self) -> Array:
        """Light per mm of the curve, (profile,)."""
        return np.asarray(self.weight.sum(axis=(-2, -1)))

    def mean(self, values: Array) -> Array:
        """Flux-weighted mean over the nodes of a profile, (profile,)."""
        return np.asarray((self.weight * values).sum(axis=(-2, -1)) / self.flux)

    def parting(self, shake: Array | float = 0.0) -> Array | None:
        """Mean square of the facets' shifts about their mean, and of shaking [mm]: (profile,) [mm²]; None if 0."""
        if self.shift is None or self.share is None:
            return np.broadcast_to(np.square(shake), self.q.shape[:-2]) if np.any(shake) else None
        mean = (self.share * self.shift).sum(axis=-1, keepdims=True)
        return np.asarray((self.share * (self.shift - mean) ** 2).sum(axis=-1) + np.square(shake))

    def only(self, which: NDArray[np.generic] | slice) -> Profiles:
        """The profiles of an index."""
        q, weight, phase, lateral, chirp = (a[which] for a in self[:5])
        shift = None if self.shift is None else self.shift[which]
        share = None if self.share is None else self.share[which]
        return Profiles(q, weight, phase, lateral, chirp, shift, share)


def adaptive(
    q: Array, light: Array, centre: Array | None = None, iterations: int = 30, blur: Array | float = 0.0
) -> tuple[Array, Array]:
    """Adaptive Gaussian-weighted moments: the Gaussian that matches the profile under its own weight.

    Centre μ and width σ solve Σ W L (q − μ) = 0 and 2 Σ W L (q − μ)² = σ² Σ W L with W = exp(−(q − μ)²/2σ²): for a
    Gaussian they are its mean and rms; for a slit's diffraction pattern, whose variance is infinite, they are finite;
    for a box of half width b, σ = 0.714 b where the rms is 0.577 b. Bernstein & Jarvis 2002, AJ 123, 583, in one
    dimension. Undefined for a profile of two far-apart peaks, where the result depends on the start.

    Parameters
    ----------
    q, light : (m, n) array
        Offsets [mm] and light at them (weights of nodes, or samples of an evenly spaced profile).
    centre : (m,) array, optional
        Hold μ here, for instance at the mean, and solve for σ alone.
    iterations : int
    blur : float, or array that broadcasts against q
        rms of a Gaussian into which the light of each point is spread [mm]; the sums over it are closed forms.

    Returns
    -------
    centre, width : (m,) ndarray [mm]
    """
    total = light.sum(axis=1)
    mu = (light * q).sum(axis=1) / total if centre is None else np.asarray(centre, float)
    near = np.abs(q - mu[:, None])
    spread = np.asarray(blur, float) ** 2
    # A start from the mean absolute deviation converges where the variance does not exist.
    var = (1.25 * (light * near).sum(axis=1) / total) ** 2 + (light * spread).sum(axis=1) / total
    floor = 1e-24
    d = q - mu[:, None]
    if centre is not None and np.shape(spread)[-1:] in ((), (1,)):
        alike = np.broadcast_to(spread, (len(mu), 1))[:, 0]
        return mu, np.sqrt(_held(d * d, light, var, alike, floor, iterations))
    for _ in range(iterations):
        v = np.maximum(var, floor)[:, None]
        # What the weight leaves of a point's Gaussian is a Gaussian: less light, drawn toward the centre, narrower.
        left = v / (v + spread)
        w = light * np.sqrt(left) * np.exp(-0.5 * d**2 / (v + spread))
        s = w.sum(axis=1)
        drawn = left * d
        shift = (w * drawn).sum(axis=1) / s if centre is None else np.zeros_like(mu)
        weighted = (w * (drawn**2 + left * spread)).sum(axis=1) / s - shift**2
        # Exact in one step for a Gaussian: 1/var_profile = 1/var_weighted − 1/var_weight.
        rest = 1.0 / np.maximum(weighted, floor) - 1.0 / np.maximum(var, floor)
        new = np.clip(1.0 / np.maximum(rest, floor), var / 4, 4 * var + floor)
        done = np.max(np.abs(new - var) / np.maximum(var, floor), initial=0.0) < 1e-12
        var = new
        if centre is None:
            mu = mu + 2.0 * shift
            d = q - mu[:, None]
        if done and np.max(np.abs(shift), initial=0.0) < 1e-12:
            break
    return mu, np.sqrt(var)


def _held(d2: Array, light: Array, var: Array, spread: Array, floor: float, iterations: int) -> Array:
    """The variances of `adaptive` about held centres, of points (m, n) whose squares from it are ``d2``.

    Its fixed point, by the secant rule in ln σ²; ``spread`` (m,) is the variance by blur, the same for all points.
    """
    x, before, rose = np.log(np.maximum(var, floor)), None, None
    for _ in range(iterations):
        v = np.exp(x)
        wide = v + spread
        left = v / wide
        w = np.exp((-0.5 / wide)[:, None] * d2)
        w *= light
        weighted = left * (left * np.einsum("mn,mn->m", w, d2) / w.sum(axis=1) + spread)
        # Exact in one step for a Gaussian: 1/var_profile = 1/var_weighted − 1/var_weight.
        rest = 1.0 / np.maximum(weighted, floor) - 1.0 / v
        rise = np.clip(-np.log(np.maximum(rest, floor)) - x, -np.log(4.0), np.log(4.0))
        if not np.max(np.abs(rise), initial=0.0) >= 1e-12:
            return np.asarray(np.exp(x + rise))
        slope: Array = np.full(len(x), -1.0)
        if before is not None and rose is not None:
            with np.errstate(invalid="ignore", divide="ignore"):
                slope = (rise - rose) / (x - before)
            slope = np.where((slope > -3.0) & (slope < -0.2), slope, -1.0)
        before, rose, x = x, rise, x - rise / slope
    return np.asarray(np.exp(x))


def refine_height(nodes: Profiles, rows: int) -> tuple[Array, Array]:
    """q and light of the profiles on a finer Gauss–Legendre rule over the height, for moments of sharper weights.

    Both are smooth polynomials over the height; only a narrow weight over q needs the denser rule.

    Returns
    -------
    q, light : (profile, t, rows) ndarray
    """
    w, z, carry = _finer(nodes.q.shape[2], rows)
    return nodes.q @ carry.T, np.maximum((nodes.weight / w) @ carry.T, 0.0) * z


@lru_cache(maxsize=32)
def _finer(along: int, rows: int) -> tuple[Array, Array, Array]:
    u, w = np.polynomial.legendre.leggauss(along)
    v, z = np.polynomial.legendre.leggauss(rows)
    return w, z, interpolation(u, v)


def interpolation(nodes: Array, new: Array) -> Array:
    """Matrix (new, nodes) of the polynomial through values at ``nodes`` in [-1, 1]."""
    legendre = np.polynomial.legendre
    degree = len(nodes) - 1
    return legendre.legvander(new, degree) @ np.linalg.inv(legendre.legvander(nodes, degree))


def geometric_profile(nodes: Profiles, q: Array, columns: int = 48, rows: int = 12) -> Array:
    """Irradiance across the trace in geometric optics, averaged over the cells of the grid q.

    Positions t along the facet are columns; over each the cumulative light as a function of q is a chain of straight
    lines through the rows' edges. Light is conserved.

    Parameters
    ----------
    nodes : Profiles
        At least two nodes in h.
    q : (profile, n) array [mm]
        Evenly spaced along the last axis.
    columns, rows : int

    Returns
    -------
    (profile, n) ndarray
        Light per mm² of the board.
    """
    legendre = np.polynomial.legendre
    across, along = nodes.q.shape[1:]
    v, zv = legendre.leggauss(across)
    u, zu = legendre.leggauss(along)
    centres = (2 * np.arange(columns) + 1) / columns - 1 if across > 1 else np.zeros(1)
    edges = np.linspace(-1, 1, rows + 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    over_t = interpolation(v, centres)
    density = nodes.weight / (zv[:, None] * zu)
    light = np.maximum(np.einsum("at,ptu,bu->pab", over_t, density, interpolation(u, middles)), 0.0)
    # The midpoint rule is 1e-4 off; the nodes' own sum is not.
    light *= (nodes.flux / light.sum(axis=(1, 2)))[:, None, None]
    cut = np.einsum("at,ptu,bu->pab", over_t, nodes.q, interpolation(u, edges))
    if np.median(cut[..., -1] - cut[..., 0]) < 0:
        cut, light = cut[..., ::-1], light[..., ::-1]
    total = np.concatenate([np.zeros((*light.shape[:2], 1)), np.cumsum(light, axis=2)], axis=2)
    step = q[:, 1] - q[:, 0]
    borders = np.concatenate([q - 0.5 * step[:, None], q[:, -1:] + 0.5 * step[:, None]], axis=1)
    out = np.zeros(q.shape)
    for p in range(len(q)):
        for c in range(cut.shape[1]):
            out[p] += np.diff(np.interp(borders[p], cut[p, c], total[p, c]))
    return out / step[:, None]
