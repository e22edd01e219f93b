"""Noise of a line's pixels with the correlation of neighbours that speckle brings, measured on the photograph alone.

The photograph along the line is smoothed by a surface that may change across it as fast as a pixel can tell and along
it only over tens of pixels; what is left is noise. Its variance against light gives read, shot and speckle noise
(`trace.noise`); products of neighbours, over what the speckle alone would give, give the grain's size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve, cholesky_banded, solve_triangular
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array

from benchsim.trace.noise import PixelNoise, fit_pixel_noise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ACROSS, ALONG = 0.7, 50.0
"""Knots of the smooth surface across and along the line [px]."""

FAR = 3
"""Neighbours farther apart than this in rows or columns count as independent [px]."""

_TURNS = 3


@dataclass(frozen=True)
class Grain:
    """Noise of n pixels.

    Attributes
    ----------
    smooth : (n,)
        The photograph's own smooth light.
    residual : (n,)
        Photograph less that.
    leverage : (n,)
        Share of its own noise that the surface follows.
    variance, speckle : (n,)
        Of a pixel, and the part of it that neighbours share [light²].
    size : px
        Distance at which the correlation of the speckle has fallen to 1/e: exp(−d²/size²); 0: none.
    noise : PixelNoise
    """

    smooth: Array
    residual: Array
    leverage: Array
    variance: Array
    speckle: Array
    size: float
    noise: PixelNoise


def surface_basis(t: Array, n: Array, along: float = ALONG, across: float = ACROSS) -> csr_array:
    """Products of cubic B-splines along (t) and across (n) the line at scattered pixels, (pixels, terms)."""

    def one(x: Array, step: float) -> csr_array:
        low, high = float(x.min()) - 1e-9, float(x.max()) + 1e-9
        pieces = max(1, round((high - low) / step))
        knots = np.concatenate([[low] * 3, np.linspace(low, high, pieces + 1), [high] * 3])
        return csr_array(BSpline.design_matrix(x, knots, 3))

    a, b = one(t, along), one(n, across)
    # Four of each are not zero in a row.
    value = (a.data.reshape(-1, 4, 1) * b.data.reshape(-1, 1, 4)).reshape(-1)
    column = (a.indices.reshape(-1, 4, 1) * b.shape[1] + b.indices.reshape(-1, 1, 4)).reshape(-1)
    return csr_array((value, column, np.arange(0, len(value) + 1, 16)), shape=(len(t), a.shape[1] * b.shape[1]))


def measure_grain(
    u: NDArray[np.intp], v: NDArray[np.intp], t: Array, n: Array, light: Array, pedestal: Array, background: Array
) -> Grain:
    """Noise of the pixels of a line.

    Parameters
    ----------
    u, v : (n,) int
        Column and row of each pixel.
    t, n : (n,) px
        Along and across the line.
    light : (n,)
        What was measured, a dark picture subtracted if there is one.
    pedestal : (n,)
        Light that adds to the noise besides ``light``: twice the dark picture's where it was subtracted, else 0.
    background : (n,)
        Part of ``light`` that is not the line's.

    Returns
    -------
    Grain
    """
    design = surface_basis(t, n)
    keep = np.asarray(abs(design).sum(axis=0)).ravel() > 1e-3
    design = csr_array(design[:, keep])
    weight = np.ones(len(light))
    for _ in range(_TURNS):
        weighted = design.multiply(weight[:, None])
        normal = (weighted.T @ design).toarray()
        # Where pixels of a row all lie at one place across, the surface between them is only held smooth.
        normal += 1e-6 * np.trace(normal) / len(normal) * np.eye(len(normal))
        factor = cho_factor(normal)
        smooth = design @ cho_solve(factor, weighted.T @ light)
        leverage = np.clip(weight * _quadratic(design, cho_solve(factor, np.eye(len(normal)))), 0.0, 0.9)
        line = smooth - background
        noise = fit_pixel_noise(light - smooth, pedestal + smooth, line, leverage)
        variance = noise.variance(pedestal + smooth, line)
        weight = 1 / variance
    residual, shared = light - smooth, noise.speckle * line**2
    return Grain(smooth, residual, leverage, variance, shared, _size(u, v, residual, shared, variance), noise)


def _quadratic(design: csr_array, c: Array) -> Array:
    """x C x of every row x; a row's few entries are multiplied with each other alone."""
    out = np.zeros(design.shape[0])
    value, column, start = design.data, design.indices, design.indptr[:-1]
    filled = np.diff(design.indptr)
    for i in range(filled.max()):
        for j in range(i + 1):
            rows = np.flatnonzero(filled > i)
            a, b = start[rows] + i, start[rows] + j
            out[rows] += (1 if i == j else 2) * value[a] * value[b] * c[column[a], column[b]]
    return out


def _pairs(
    u: NDArray[np.intp], v: NDArray[np.intp], far: int = FAR
) -> list[tuple[int, int, NDArray[np.intp], NDArray[np.intp]]]:
    """Neighbours: (du, dv, indices of the first, indices of the second), each pair once, nearest first."""
    low_u, low_v = int(u.min()), int(v.min())
    where = np.full((int(v.max()) - low_v + 1 + 2 * far, int(u.max()) - low_u + 1 + 2 * far), -1)
    where[v - low_v + far, u - low_u + far] = np.arange(len(u))
    out = []
    for dv in range(far + 1):
        for du in range(-far, far + 1):
            if (dv, du) > (0, 0):
                other = where[v - low_v + far + dv, u - low_u + far + du]
                first = np.flatnonzero(other >= 0)
                out.append((du, dv, first, other[first]))
    return sorted(out, key=lambda p: p[0] ** 2 + p[1] ** 2)


def _size(u: NDArray[np.intp], v: NDArray[np.intp], residual: Array, shared: Array, variance: Array) -> float:
    """Size of the grain by least squares on the products of neighbours up to two pixels apart."""
    amplitude, scale = np.sqrt(shared), 1 / variance
    distance2, found, weight = [], [], []
    for du, dv, i, j in _pairs(u, v, 2):
        expected = amplitude[i] * amplitude[j]
        w = scale[i] * scale[j]
        bottom = float((w * expected**2).sum())
        if bottom > 0:
            distance2.append(du**2 + dv**2)
            found.append(float((w * expected * residual[i] * residual[j]).sum()) / bottom)
            weight.append(bottom)
    if not found:
        return 0.0
    d2, rho, w = np.array(distance2), np.array(found), np.array(weight)
    best = minimize_scalar(
        lambda s: float((w * (rho - np.exp(-d2 / s**2)) ** 2).sum()), bounds=(0.05, FAR), method="bounded"
    )
    return float(best.x) if best.x > 0.3 else 0.0


def whitener(u: NDArray[np.intp], v: NDArray[np.intp], order: Array, grain: Grain, use: Mask) -> Whitener:
    """Inverse square root of the noise's covariance for some of the pixels.

    Parameters
    ----------
    u, v : (n,) int
    order : (n,)
        Place along the line [px]: neighbours in it are neighbours in the matrix.
    grain : Grain
        Of all n pixels.
    use : (n,) bool
    """
    index = np.flatnonzero(use)
    index = index[np.argsort(order[index], kind="stable")]
    pairs = _pairs(u[index], v[index]) if grain.size > 0 else []
    width = max((int(np.abs(i - j).max()) for _, _, i, j in pairs if len(i)), default=0)
    band = np.zeros((width + 1, len(index)))
    band[0] = grain.variance[index]
    amplitude = np.sqrt(grain.speckle[index])
    for du, dv, i, j in pairs:
        low, high = np.minimum(i, j), np.maximum(i, j)
        band[high - low, low] = amplitude[i] * amplitude[j] * np.exp(-(du**2 + dv**2) / grain.size**2)
    return Whitener(index, _factor(band))


def _factor(band: Array) -> Array:
    """Lower banded Cholesky factor; a cut-off correlation may need a little white noise to be positive."""
    for extra in (0.0, 1e-3, 1e-2, 0.1):
        try:
            return np.asarray(cholesky_banded(np.vstack([band[:1] * (1 + extra), band[1:]]), lower=True))
        except np.linalg.LinAlgError:
            continue
    return np.sqrt(band[:1])


@dataclass(frozen=True)
class Whitener:
    """``index`` (m,): pixels used, along the line. ``factor``: lower banded Cholesky factor of their covariance."""

    index: NDArray[np.intp]
    factor: Array

    def __call__(self, residual: Array) -> Array:
        """z (m,) or (m, c) of residuals (n,) or (n, c): independent and of unit variance if only noise is in them."""
        x = residual[self.index]
        width, m = self.factor.shape
        flat = x.reshape(m, -1).astype(float)
        out = np.empty_like(flat)
        # Blocks of the factor's own width: dense triangles beside each other.
        step = max(width, 64)
        for start in range(0, m, step):
            stop = min(start + step, m)
            right = flat[start:stop].copy()
            low = max(0, start - width + 1)
            if low < start:
                right -= self._block(start, stop, low, start) @ out[low:start]
            out[start:stop] = solve_triangular(self._block(start, stop, start, stop), right, lower=True)
        return out.reshape(x.shape)

    def _block(self, top: int, bottom: int, left: int, right: int) -> Array:
        rows, columns = np.arange(top, bottom)[:, None], np.arange(left, right)[None, :]
        d = rows - columns
        inside = (d >= 0) & (d < len(self.factor))
        return np.where(
            inside, self.factor[np.clip(d, 0, len(self.factor) - 1), np.broadcast_to(columns, d.shape)], 0.0
        )
