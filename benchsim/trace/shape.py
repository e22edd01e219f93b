"""The line's own mean shape, estimated from the data: a spline across the line, varying slowly along it.

No shape is assumed: neither Gaussian nor the pattern of a slit nor the pixel's own response, which is part of what is
measured. All profiles share the shape, so its noise is small, and a profile is then placed by its whole shape,
as precisely as a known shape would be. What ties the shape to a position is its `centre.centre`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline
from scipy.linalg import cho_factor, cho_solve

from benchsim.bench.centre import centre, influence
from benchsim.trace.band import interpolate

Array = NDArray[np.float64]

KNOT_STEP = (0.5, 1.5)
"""Knots across the line [px], in the core and in the flanks: a pixel's response holds nothing finer than the first."""

MAX_ORDER = 3
"""Highest Legendre order of the change along the line; the order used is the one of least AIC. BIC, which guards
against a term of too much, left changes out that moved the centres of one end against the other's by 13 µm."""

CHANGE = 0.3
"""1 sigma of the prior on each term of change along the line, in units of the peak: holds what saturation hides."""

_NODES = 33
_GRID_STEP = 0.05
_TABLE_STEP = 0.02  # linear interpolation in it errs by 1e-5 of the peak


def legendre(t: Array, span: tuple[float, float], order: int) -> Array:
    """Legendre polynomials 0 … order of t scaled from span to [-1, 1], (..., order + 1)."""
    scaled = 2 * (np.asarray(t) - span[0]) / max(span[1] - span[0], 1e-9) - 1
    return np.asarray(np.polynomial.legendre.legvander(np.clip(scaled, -1, 1), order), float)


@dataclass(frozen=True)
class Shape:
    """P(x, t): light at x across the line [px], at t along it [px]; zero outside ±``half_width``, unit integral.

    Attributes
    ----------
    table : (n, 2 (order + 1)) array
        At x from -``half_width`` on in fine steps: coefficients of the Legendre terms along the line, before
        normalisation, and their derivatives by x.
    order : int
        Legendre order of the change along the line.
    span : (low, high) px
        Range of t.
    core : float
        Half width [px] of the window, about the centre, of flux, width and skewness.
    half_width : float
        [px] The flanks from ``core`` to here define zero.
    integral, centre, width, skewness : CubicSpline
        Functions of t: integral over the core; centre [px]; adaptive rms width about the mean [px]; third standardised
        moment of the core.
    pull : (n,) array
        By how much light at the x of ``table``'s rows moves the centre, over the profile's flux [px].
    slope_response : float
        Shift of the centre [px] per slope left in the background, light/px over flux [1/px²].
    """

    table: Array
    order: int
    span: tuple[float, float]
    core: float
    half_width: float
    integral: CubicSpline
    centre: CubicSpline
    width: CubicSpline
    skewness: CubicSpline
    pull: Array
    slope_response: float

    def evaluate(self, x: Array, t: Array) -> tuple[Array, Array]:
        """P and dP/dx at x (k, m) of profiles at t (k,)."""
        terms = legendre(t, self.span, self.order) / self.integral(t)[:, None]
        both = interpolate(self.table, (x + self.half_width) / _TABLE_STEP)
        both[np.abs(x) > self.half_width] = 0.0
        n = self.order + 1
        return np.einsum("kmj,kj->km", both[..., :n], terms), np.einsum("kmj,kj->km", both[..., n:], terms)

    def moved(self, x: Array, light: Array) -> Array:
        """By how much light at x (k, m) that is not the shape's, over the flux, moves profiles' centres, (k,) [px]."""
        weight = interpolate(self.pull[:, None], (x + self.half_width) / _TABLE_STEP)[..., 0]
        return np.asarray((np.where(np.abs(x) <= self.half_width, weight, 0.0) * light).sum(axis=1))


def fit_shape(
    x: Array,
    t: Array,
    y: Array,
    weight: Array,
    span: tuple[float, float],
    core: float,
    half_width: float,
    highest: int = MAX_ORDER,
) -> Shape:
    """Weighted least squares of a tensor spline: cubic across the line, Legendre along it, its order chosen by AIC.

    Priors, weak against any line worth measuring: third differences across the line 1 peak, changes along it
    `CHANGE` peaks (1 sigma).

    Parameters
    ----------
    x, t : (n,) array
        Place of each pixel across and along the line [px].
    y : (n,) array
        Its light, background removed, over the flux of its profile [1/px].
    weight : (n,) array
        1/variance of y.
    span, core, half_width
        As in `Shape`.
    highest : int
        Of the Legendre orders to choose from; 0 for one shape all along.
    """
    knots = _knots(core, half_width)
    count = len(knots) - 4
    order = np.argsort(x)
    x, t, y, weight = x[order], t[order], y[order], weight[order]
    design = BSpline.design_matrix(np.clip(x, -half_width, half_width), knots, 3)
    value, first = design.data.reshape(-1, 4), design.indices.reshape(-1, 4)[:, 0]
    terms = legendre(t, span, highest)
    normal, right = _normal_equations(value, first, terms, y, weight, count)
    square = float(weight @ y**2)
    flat = np.linalg.solve(normal[0, 0] + 1e-9 * np.trace(normal[0, 0]) / count * np.eye(count), right[0])
    peak = max(float(flat.max()), 1e-12)
    third = np.diff(np.eye(count), 3, axis=0)
    smooth = third.T @ third / peak**2
    best: tuple[float, Array] | None = None
    for j in range(highest + 1):
        prior = np.kron(np.eye(j + 1), smooth)
        prior[count:, count:] += np.eye(j * count) / (CHANGE * peak) ** 2
        block = normal[: j + 1, : j + 1].transpose(0, 2, 1, 3).reshape((j + 1) * count, -1) + prior
        factor = cho_factor(block + 1e-12 * np.trace(block) / len(block) * np.eye(len(block)))
        r = right[: j + 1].ravel()
        c = cho_solve(factor, r)
        chi2 = square - float(c @ r)
        # Terms that the data hold, not those that only the prior holds.
        free = float(np.sum(1 - np.diag(cho_solve(factor, prior))))
        if j == 0:
            scale = chi2 / max(len(y) - free, 1.0)
        aic = chi2 / max(scale, 1e-30) + 2 * free
        if best is None or aic < best[0]:
            best = (aic, c.reshape(j + 1, count).T)
        else:
            break
    assert best is not None
    return _finish(knots, best[1], span, core, half_width)


def _knots(core: float, half_width: float) -> Array:
    inner = np.linspace(-core, core, 2 * max(2, round(core / KNOT_STEP[0])) + 1)
    outer = np.linspace(core, half_width, max(1, round((half_width - core) / KNOT_STEP[1])) + 1)[1:]
    middle = np.concatenate([-outer[::-1], inner, outer])
    return np.concatenate([[-half_width] * 3, middle, [half_width] * 3])


def _normal_equations(
    value: Array, first: NDArray[np.intp], terms: Array, y: Array, weight: Array, count: int
) -> tuple[Array, Array]:
    """Normal matrix (term, term, count, count) and right side (term, count); x sorted, so ``first`` is too."""
    k = terms.shape[1]
    starts = np.flatnonzero(np.diff(first, prepend=-1))
    at = first[starts]
    pairs = [(j, i) for j in range(k) for i in range(j, k)]
    first_term, second_term = np.array(pairs).T
    products = terms[:, first_term] * terms[:, second_term]
    normal = np.zeros((k, k, count, count))
    right = np.zeros((k, count))
    for a in range(4):
        wa = weight * value[:, a]
        right[:, at + a] += np.add.reduceat((wa * y)[:, None] * terms, starts, axis=0).T
        for b in range(a, 4):
            sums = np.add.reduceat((wa * value[:, b])[:, None] * products, starts, axis=0)
            for q, (j, i) in enumerate(pairs):
                normal[j, i, at + a, at + b] += sums[:, q]
    for j, i in pairs:
        upper = np.triu(normal[j, i])
        normal[j, i] = upper + np.triu(upper, 1).T
        normal[i, j] = normal[j, i]
    return normal, right


def _finish(knots: Array, c: Array, span: tuple[float, float], core: float, half_width: float) -> Shape:
    """Set the flanks to zero and work out integral, centre and moments along the line."""
    steps = round(2 * half_width / _GRID_STEP)
    grid = np.linspace(-half_width, half_width, 2 * (steps // 2) + 1)
    step = grid[1] - grid[0]
    basis = BSpline.design_matrix(grid, knots, 3).toarray()
    rough = basis @ c[:, 0]
    inner = np.abs(grid) <= core
    middle = float(np.sum((grid * rough)[inner]) / np.sum(rough[inner])) if np.sum(rough[inner]) else 0.0
    middle = float(np.clip(middle, -core / 2, core / 2))
    level = basis[np.abs(grid - middle) > core].mean(axis=0)
    c = c - (level @ c)[None, :]
    k = c.shape[1]
    nodes = np.linspace(*span, _NODES)
    light = (basis @ c) @ legendre(nodes, span, k - 1).T
    at = np.full(_NODES, middle)
    for _ in range(4):
        offset = grid[:, None] - at
        window = np.clip((core - np.abs(offset)) / step + 0.5, 0, 1)
        total = np.maximum((window * light).sum(axis=0), 1e-12)
        at = np.clip(at + (window * light * offset).sum(axis=0) / total, -core / 2, core / 2)
    offset = grid[:, None] - at
    width = _adaptive_width(offset, window * light)
    where = np.clip(centre(grid[None, :], light.T, width, at), -core / 2, core / 2)
    second = np.maximum((window * light * offset**2).sum(axis=0) / total, 1e-12)
    skew = (window * light * offset**3).sum(axis=0) / total / second**1.5
    slope = influence((grid - where.mean()) / width.mean())[1]
    gain = width.mean() / max(float((slope @ (light / total)).mean()), 1e-3)
    spline, fine = BSpline(knots, c, 3), np.arange(-half_width, half_width + _TABLE_STEP, _TABLE_STEP)
    pull = gain * influence((fine - where.mean()) / width.mean())[0]
    return Shape(
        np.concatenate([spline(fine), spline(fine, 1)], axis=1),
        k - 1,
        span,
        core,
        half_width,
        CubicSpline(nodes, total * step),
        CubicSpline(nodes, where),
        CubicSpline(nodes, width),
        CubicSpline(nodes, skew),
        pull,
        float(pull @ fine) * _TABLE_STEP,
    )


def _adaptive_width(offset: Array, light: Array) -> Array:
    """Width σ of the Gaussian that matches each column under its own weight: 2 Σ W L q² = σ² Σ W L, W = exp(-q²/2σ²).

    Bernstein & Jarvis 2002, AJ 123, 583, in one dimension. The rms for a Gaussian, finite where the variance is not.
    """
    var = np.maximum((light * offset**2).sum(axis=0) / np.maximum(light.sum(axis=0), 1e-12), 0.04)
    for _ in range(25):
        weighted = light * np.exp(-0.5 * offset**2 / var)
        inner = np.maximum((weighted * offset**2).sum(axis=0) / np.maximum(weighted.sum(axis=0), 1e-12), 1e-6)
        var = np.clip(1.0 / np.maximum(1.0 / inner - 1.0 / var, 1e-6), var / 4, 4 * var)
    return np.sqrt(var)
