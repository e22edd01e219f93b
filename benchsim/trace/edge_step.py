"""The blurred step across an edge: a series about the normal law's, and what a picture's own step adds to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.special import ndtr

from benchsim.trace.band import interpolate
from benchsim.trace.edge_pixels import CELLS, OUTLIER_SIGMA, Band, Edges, Line, masked_median

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLACK, CONTRAST, SLOPE, BLUR, KURTOSIS = range(5)  # columns of a shape: light, light, light per px, log px, 1

_PARAMETERS = 6  # offset, tilt, and those of the shape but the kurtosis

KURTOSIS_RANGE = (-1.2, 2.0)
"""Excess kurtosis from a box to a Laplace distribution: sharper or flatter blurs are none of a lens."""

BLUR_SPREAD = 0.1
"""Relative spread of the blur over a picture that lets a short edge, which measures its own badly, keep to the mean."""

KURTOSIS_REACH = 3.0
"""Blurs of black that an edge must show for its kurtosis to be told from the light behind the border."""

BEND_KNOTS = 0.25
"""Knots of the common step's own shape [px]: a pixel's response has its corners half a pixel apart."""

BEND_REACH = 4.0
"""Blurs from the edge beyond which the series holds."""

BEND = 0.03
"""1 sigma of the prior on its coefficients, in units of the contrast: what few edges do not show is not made up."""


@dataclass(frozen=True)
class _Bend:
    """What the picture's own step adds to the series: odd in the distance, zero from ``reach`` [px] on."""

    reach: float
    table: Array

    def at(self, d: Array) -> tuple[Array, Array]:
        """Value, and slope per px, at distances d [px]."""
        both = interpolate(self.table, np.abs(d) / self.reach * (len(self.table) - 1))
        return np.sign(d) * both[..., 0], both[..., 1]


_STRAIGHT = _Bend(1.0, np.zeros((2, 2)))


def common_bend(band: Band, edges: Edges, fitted: Fitted) -> _Bend:
    """The odd part of what the series leaves, from the pixels of all edges; behind the border is other light."""
    line, shape = fitted.line, fitted.shape
    behind = light_behind(band, edges, line, shape)
    light, _, _ = light_of(band, line, shape, behind, _STRAIGHT)
    _, d = band.coordinates(line)
    reach = BEND_REACH * float(np.exp(np.median(shape[:, BLUR])))
    own = (fitted.weight > 0) & (np.abs(d) < reach) & (behind < 1e-3)
    residual = ((band.light - light) / np.maximum(shape[:, CONTRAST, None], 1e-6))[own]
    pieces = max(4, round(reach / BEND_KNOTS))
    knots = np.concatenate([[0.0] * 3, np.linspace(0.0, reach, pieces + 1), [reach] * 3])
    # Zero at the edge, level with the series at the reach.
    free = slice(1, -2)
    design = BSpline.design_matrix(np.abs(d[own]), knots, 3)[:, free]
    odd = np.sign(d[own]) * residual
    right = design.T @ odd
    normal = (design.T @ design).toarray()
    variance = float(np.mean(odd**2)) if len(odd) else 1.0
    coefficients = np.zeros(len(knots) - 4)
    coefficients[free] = np.linalg.solve(normal + variance / BEND**2 * np.eye(len(normal)), right)
    spline, grid = BSpline(knots, coefficients, 3), np.linspace(0.0, reach, 32 * pieces + 1)
    return _Bend(reach, np.stack([spline(grid), spline(grid, 1)], axis=1))


def light_of(
    band: Band, line: Line, shape: Array, behind: Array, bend: _Bend = _STRAIGHT
) -> tuple[Array, list[Array], Array]:
    """Model's light, its derivatives by the seven parameters, and the step 0 … 1 from black to white."""
    s, d = band.coordinates(line)
    black, contrast, slope, log_blur, kurtosis = (shape[:, i, None] for i in range(5))
    blur = np.exp(log_blur)
    step, bell, by_kurtosis = _blurred_step(d / blur, kurtosis)
    white = contrast + slope * s
    bent, by_place = bend.at(d)
    step = step + bent
    gradient = white * (bell / blur + by_place)
    by_blur = -white * bell / blur * d
    derivative = [-gradient, -gradient * s, np.ones_like(s), step, step * s, by_blur, white * by_kurtosis]
    light = black + white * (step + behind)
    return light, derivative, step


def _blurred_step(q: Array, kurtosis: Array) -> tuple[Array, Array, Array]:
    """Blurred step of unit width, its derivatives by place and by kurtosis: Edgeworth's series to the fourth order."""
    bell = np.exp(-0.5 * q * q) * 0.3989422804014327
    q2 = q * q
    by_kurtosis = q * (3 - q2) * bell / 24
    return ndtr(q) + kurtosis * by_kurtosis, bell * (1 + kurtosis / 24 * (3 + q2 * (q2 - 6))), by_kurtosis


def light_behind(band: Band, edges: Edges, line: Line, shape: Array) -> Array:
    """Light of the white cells behind the border, as a fraction of the contrast, where it is more than 1e-4."""
    s, d = band.coordinates(line)
    blur = np.exp(shape[:, BLUR, None])
    at, depth = line.coordinates(edges.borders())
    slope = (depth[:, 8:] - depth[:, :1]) / (at[:, 8:] - at[:, :1])
    q = -(d - depth[:, :1] - slope * (s - at[:, :1])) / blur
    out = np.zeros_like(s)
    e, p = np.nonzero(band.use & (q > -3.7))
    changes = np.diff(edges.inner.astype(float), axis=1, prepend=0.0)[e]
    steps = ndtr((s[e, p, None] - at[e, :CELLS]) / blur[e])
    border, _, _ = _blurred_step(q[e, p], shape[e, KURTOSIS])
    out[e, p] = border * (steps * changes).sum(axis=1)
    return out


@dataclass(frozen=True)
class Fitted:
    """What the last Gauss–Newton step left."""

    line: Line
    shape: Array
    covariance: Array
    variance: Array
    freedom: Array
    weight: Array


def refined(
    band: Band,
    edges: Edges,
    line: Line,
    shape: Array,
    steps: int,
    *,
    common_blur: float | None = None,
    fit_kurtosis: bool = False,
    bend: _Bend = _STRAIGHT,
) -> Fitted:
    """Gauss–Newton steps; ``covariance`` of all parameters for pixels of unit variance, ``variance`` the residuals'."""
    shape = shape.copy()
    count = _PARAMETERS + fit_kurtosis
    for i in range(steps):
        if i % 3 == 0:
            behind = light_behind(band, edges, line, shape)
        light, derivative, step = light_of(band, line, shape, behind, bend)
        residual = band.light - light
        weight = _weights(residual, band.use, band.use & (np.abs(step - 0.5) < 0.45))
        columns = np.stack([*derivative[:count], residual], axis=1)
        product = (columns[:, :count] * weight[:, None]) @ columns.transpose(0, 2, 1)
        normal, right = product[..., :count], product[..., count]
        freedom = np.maximum(weight.sum(axis=1) - count, 1)
        variance = (weight * residual**2).sum(axis=1) / freedom
        if common_blur is not None:
            normal[:, 5, 5] += variance / BLUR_SPREAD**2
            right[:, 5] += variance / BLUR_SPREAD**2 * (common_blur - shape[:, BLUR])
        size = np.sqrt(np.einsum("eii->ei", normal)) + 1e-30
        normal = normal / (size[:, :, None] * size[:, None, :])
        inverse = np.linalg.inv(normal + 1e-9 * np.eye(count))
        change = np.einsum("eij,ej->ei", inverse, right / size) / size
        covariance = inverse / (size[:, :, None] * size[:, None, :])
        line = line.moved(np.clip(change[:, 0], -1, 1), np.clip(change[:, 1], -2 / line.length, 2 / line.length))
        shape[:, :3] += change[:, 2:5]
        shape[:, BLUR] = np.clip(shape[:, BLUR] + np.clip(change[:, 5], -0.3, 0.3), np.log(0.25), np.log(8.0))
        if fit_kurtosis:
            shape[:, KURTOSIS] += np.clip(change[:, 6], -1, 1)
    return Fitted(line, shape, covariance, variance, freedom, weight)


def common_blur(band: Band, fitted: Fitted) -> float:
    """Mean log of the blur of all edges, each weighted by how well it is determined."""
    precision = 1 / np.maximum(fitted.covariance[:, 5, 5] * fitted.variance, 1e-30)
    precision = np.where(band.use.any(axis=1), np.minimum(precision, 4 * np.median(precision)), 0.0)
    return float(np.average(fitted.shape[:, BLUR], weights=precision)) if precision.any() else 0.0


def common_kurtosis(band: Band, fitted: Fitted) -> float:
    """Mean kurtosis of the edges that show enough black to tell it; 0 if there is none."""
    _, d = band.coordinates(fitted.line)
    reach = -np.where(band.use, d, 0.0).min(axis=1) / np.exp(fitted.shape[:, BLUR])
    precision = 1 / np.maximum(fitted.covariance[:, 6, 6] * fitted.variance, 1e-30)
    precision = np.where(reach > KURTOSIS_REACH, np.minimum(precision, 4 * np.median(precision)), 0.0)
    if not precision.any():
        return 0.0
    return float(np.clip(np.average(fitted.shape[:, KURTOSIS], weights=precision), *KURTOSIS_RANGE))


def _weights(residual: Array, use: Mask, near: Mask) -> Array:
    """1, or 0 where a pixel stands out; all pixels alike otherwise.

    Weights that follow the noise, or a biweight, would treat the black and the white side of the step differently, and
    every misfit of its shape, which is antisymmetric, would then move the edge (0.004 px on photographs of other code).
    """
    scatter = 1.4826 * masked_median(np.abs(residual), near)[:, None]
    return np.where(use & (np.abs(residual) <= np.maximum(OUTLIER_SIGMA * scatter, 1e-6)), 1.0, 0.0)
