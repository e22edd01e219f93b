"""The band of pixels along a curve: each pixel's place along and across it, grouped into profiles.

A profile is made of the raw pixels whose foot points lie within one step of the curve. No pixel is interpolated and
none is used twice, so the noise of the profiles is as independent as that of the pixels; and because each pixel has
its own place across the curve, an oblique cut and a slope of the brightness along the curve do not move the centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

KNOT_STEP = 40.0
"""Knots of smooth curves along the trace [px]: wiggles shorter than this count as scatter of the centres."""


def smooth_curve(t: Array, values: Array, weight: Array, span: tuple[float, float], step: float = KNOT_STEP) -> BSpline:
    """Weighted least-squares cubic spline with evenly spaced knots; bridges gaps where no data are.

    The third difference of neighbouring coefficients is held to zero with a weight 1e-4 of the mean data weight, which
    only shows where data are missing.

    Parameters
    ----------
    t : (n,) array
    values : (n,) or (n, d) array
    weight : (n,) array
        1/variance, any unit.
    span : (low, high)
        Range that the spline covers.
    step : float
        Distance of the knots.
    """
    pieces = max(1, round((span[1] - span[0]) / step))
    knots = np.concatenate([[span[0]] * 3, np.linspace(span[0], span[1], pieces + 1), [span[1]] * 3])
    basis = BSpline.design_matrix(np.clip(t, *span), knots, 3).toarray()
    normal = basis.T @ (weight[:, None] * basis)
    third = np.diff(np.eye(pieces + 3), 3, axis=0)
    normal += 1e-4 * np.trace(normal) / len(normal) * third.T @ third
    normal += 1e-12 * np.trace(normal) / len(normal) * np.eye(len(normal))
    return BSpline(knots, np.linalg.solve(normal, basis.T @ (weight.reshape(-1, *[1] * (values.ndim - 1)) * values)), 3)


def interpolate(table: Array, at: Array) -> Array:
    """Rows of a table (n, c) linearly interpolated at fractional row numbers (...), held at its ends: (..., c)."""
    at = np.clip(at, 0, len(table) - 1.001)
    low = at.astype(np.intp)
    part = (at - low)[..., None]
    return (1 - part) * table[low] + part * table[low + 1]


@dataclass(frozen=True)
class Band:
    """Pixels of a band, one row per profile, padded.

    Attributes
    ----------
    t : (k,) px
        Along the curve, at the middle of each profile.
    point, normal : (k, 2)
        Of the curve there [px], unit; the normal is the tangent turned from +u towards +v.
    v, u : (k, m) int
        Pixels (row, column).
    n : (k, m) px
        Distance of the pixel from the curve, along the normal.
    inside : (k, m) bool
        False where the row is padded.
    """

    t: Array
    point: Array
    normal: Array
    u: NDArray[np.intp]
    v: NDArray[np.intp]
    n: Array
    inside: Mask

    def take(self, image: NDArray) -> NDArray:
        """The image's values at the band's pixels, (k, m)."""
        return image[self.v, self.u]


def band_along(curve: BSpline, span: tuple[float, float], half_width: float, shape: tuple[int, int]) -> Band | None:
    """Pixels within ``half_width`` of a curve, grouped by the foot point into profiles one pixel apart.

    Parameters
    ----------
    curve : BSpline of (u, v)
        Parameter about equal to arc length [px]; must turn by less than 90 degrees from its chord and bend with
        radii well above ``half_width``.
    span : (low, high)
        Part of the curve that is wanted.
    half_width : float
        [px]
    shape : (h, w)
        Of the picture.

    Returns
    -------
    Band, or None if the curve lies outside the picture.
    """
    h, w = shape
    t = np.arange(np.floor(span[0]), np.ceil(span[1]) + 1.0)
    line = curve(t)
    low = np.maximum(np.floor(line.min(axis=0) - half_width - 2), 0).astype(int)
    high = np.minimum(np.ceil(line.max(axis=0) + half_width + 3), [w, h]).astype(int)
    if np.any(high <= low):
        return None
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    cv2.polylines(mask, [np.round(line - low).astype(np.int32)], False, 1, thickness=2 * int(np.ceil(half_width)) + 3)
    v, u = np.nonzero(mask)
    p = np.stack([u + low[0], v + low[1]], axis=1).astype(float)
    chord = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    foot = np.interp(p @ chord, line @ chord, t)
    # Tabulated: the curve bends by far less than a pixel in one, so that interpolation is exact to 1e-6 px.
    nodes = np.arange(t[0] - half_width, t[-1] + half_width + 1, 0.25)
    table = np.concatenate([curve(nodes), curve(nodes, 1), curve(nodes, 2)], axis=1)
    for _ in range(3):
        c0, c1, c2 = np.split(interpolate(table, (foot - nodes[0]) / 0.25), 3, axis=1)
        d = p - c0
        step = (d * c1).sum(1) / ((c1 * c1).sum(1) - (d * c2).sum(1))
        foot = foot + np.clip(step, -half_width, half_width)
    c0, c1, _ = np.split(interpolate(table, (foot - nodes[0]) / 0.25), 3, axis=1)
    d = p - c0
    n = (c1[:, 0] * d[:, 1] - c1[:, 1] * d[:, 0]) / np.linalg.norm(c1, axis=1)
    row = np.floor(foot - t[0]).astype(int)
    keep = (np.abs(n) <= half_width) & (row >= 0) & (row < len(t) - 1)
    if not keep.any():
        return None
    p, n, row = p[keep].astype(int), n[keep], row[keep]
    order = np.argsort(row, kind="stable")
    p, n, row = p[order], n[order], row[order]
    count = np.bincount(row, minlength=len(t) - 1)
    column = np.arange(len(row)) - (np.cumsum(count) - count)[row]
    table = np.zeros((len(t) - 1, count.max()))
    across, inside = table.copy(), table.astype(bool)
    uu, vv = table.astype(np.intp), table.astype(np.intp)
    across[row, column], inside[row, column] = n, True
    uu[row, column], vv[row, column] = p[:, 0], p[:, 1]
    middle = t[:-1] + 0.5
    tangent = curve(middle, 1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return Band(middle, curve(middle), np.stack([-tangent[:, 1], tangent[:, 0]], axis=1), uu, vv, across, inside)
