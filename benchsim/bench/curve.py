"""A curve on the board, as any of the models predicts it, and the distance of points from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_banded

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """Points along a trace, in the order of travel, board coordinates.

    Attributes
    ----------
    points : (n, 2) mm
        y, z on the board.
    width : (n,) mm, or None
        rms across the curve.
    flux : (n,), or None
        Light per mm of the curve, in units that are the same along one curve.
    phase : (n,) rad, or None
        Phase of the mirror at which the light arrives.
    parting : (n,) mm², or None
        What lines of their own that facets draw, and shaking, add to the mean square of the light's offset across the
        curve; None: nothing.
    aside : (n,) mm, or None
        How far to the left of travel from ``points``, the mean of the light, its `centre.centre` lies, which is where a
        photograph's trace is; None: nowhere else.
    """

    points: Array
    width: Array | None = None
    flux: Array | None = None
    phase: Array | None = None
    parting: Array | None = None
    aside: Array | None = None

    def at_centre(self) -> Curve:
        """The curve on which a photograph's trace lies: ``points`` moved by ``aside``."""
        if self.aside is None:
            return self
        spline = CubicSpline(np.arange(len(self.points)), self.points)
        along = spline(np.arange(len(self.points)), 1)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        points = self.points + self.aside[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=1)
        return replace(self, points=points, aside=None)

    def arc_length(self) -> Array:
        """Arc length from the first point (mm), of the chord polygon."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])


def signed_distance(curve: Curve, points: Array) -> tuple[Array, Array]:
    """Perpendicular distance of points from a smooth curve.

    Positive to the left of the direction of travel when y points right and z up, that is along the tangent
    turned by +90 degrees. The curve is a cubic spline through its points; the foot point is found by Newton's method
    from the nearest sample, so points must lie nearer to the curve than its radius of curvature.

    Parameters
    ----------
    curve : Curve
    points : (m, 2) array [mm]

    Returns
    -------
    distance : (m,) ndarray [mm]
    s : (m,) ndarray
        Arc length of the foot points [mm]. Feet beyond the ends are extrapolated; compare with the curve's range.
    """
    distance, s, _ = signed_distances(curve.points[None], points)
    return distance[0], s[0]


def signed_distances(curves: Array, points: Array, values: Array | None = None) -> tuple[Array, Array, Array | None]:
    """`signed_distance` of points from many curves at once.

    Parameters
    ----------
    curves : (curve, n, 2) array [mm]
        Points along each.
    points : (m, 2) or (curve, m, 2) array [mm]
        The same for all curves, or each curve's own.
    values : (curve, n, k) array, optional
        Given along the curves, wanted at the feet, by cubic splines in the arc length.

    Returns
    -------
    distance, s : (curve, m) ndarray [mm]
    at_feet : (curve, m, k) ndarray or None
    """
    knots: Array = np.zeros(curves.shape[:2])
    steps = np.diff(curves, axis=1)
    np.cumsum(np.sqrt(steps[..., 0] ** 2 + steps[..., 1] ** 2), axis=1, out=knots[:, 1:])
    coefficients = _splines(knots, curves if values is None else np.concatenate([curves, values], axis=2))
    target = np.asarray(points, float)
    py, pz = target[..., 0], target[..., 1]
    count, n = knots.shape
    # The nearest sample: of the squared distances, what differs from sample to sample.
    far = (curves[..., 0] ** 2 + curves[..., 1] ** 2)[:, None, :] - (2.0 * target) @ curves.transpose(0, 2, 1)
    near = np.argmin(far, axis=2)
    rows = np.arange(count)[:, None]
    # From there along the chord.
    ahead = np.minimum(near, n - 2)
    chord = steps[rows, ahead]
    off_y, off_z = py - curves[rows, near, 0], pz - curves[rows, near, 1]
    length = np.maximum(np.hypot(chord[..., 0], chord[..., 1]), 1e-300)
    s = knots[rows, near] + (off_y * chord[..., 0] + off_z * chord[..., 1]) / length
    # One growing list of all knots: each curve's are moved beyond those of the one before.
    apart = (np.arange(count) * (2.0 * knots[:, -1].max() + 1.0))[:, None]
    growing = (knots + apart).ravel()
    first, last, most = knots[:, :1], knots[:, -1:], n - 2
    table = coefficients.reshape(*coefficients.shape[:2], -1)
    lengths = np.diff(knots, axis=1)

    def piece(s: Array) -> NDArray[np.intp]:
        i = np.searchsorted(growing, (np.clip(s, first, last) + apart).ravel(), side="right").reshape(s.shape)
        return np.asarray(np.clip(i - 1 - rows * n, 0, most))

    i = piece(s)
    for _ in range(9):
        u = s - knots[rows, i]
        if (((u < 0) & (i > 0)) | ((u > lengths[rows, i]) & (i < most))).any():
            i = piece(s)
            u = s - knots[rows, i]
        a, b, c, e = table[:, :2].take(i + rows * (n - 1), axis=2)
        y, z = ((a * u + b) * u + c) * u + e
        ty, tz = (3 * a * u + 2 * b) * u + c
        by, bz = 6 * a * u + 2 * b
        dy, dz = py - y, pz - z
        step = (dy * ty + dz * tz) / np.maximum(ty * ty + tz * tz - (dy * by + dz * bz), 0.1)
        s = s + step
        # What a step this small leaves is its square, and of it the distance feels no more than the square.
        if np.max(np.abs(step), initial=0.0) < 1e-6:
            break
    at_feet = None
    if values is not None:
        i = piece(s)
        u = s - knots[rows, i]
        a, b, c, e = table[:, 2:].take(i + rows * (n - 1), axis=2)
        at_feet = np.moveaxis(((a * u + b) * u + c) * u + e, 0, -1)
    return (ty * dz - tz * dy) / np.sqrt(ty * ty + tz * tz), s, at_feet


def _splines(knots: Array, values: Array) -> Array:
    """Coefficients (4, k, curve, n − 1), highest power first, of cubic splines through values (curve, n, k).

    Not-a-knot as `scipy.interpolate.CubicSpline`, whose equations these are, solved for all curves in one.
    """
    count, n, k = values.shape
    if n < 4:
        return np.stack([CubicSpline(x, y).c for x, y in zip(knots, values, strict=True)]).transpose(1, 3, 0, 2)
    dx = np.diff(knots, axis=1)
    rise = np.diff(values, axis=1) / dx[..., None]
    bands, right = np.zeros((3, count, n)), np.empty(values.shape)
    bands[1, :, 1:-1] = 2 * (dx[:, :-1] + dx[:, 1:])
    bands[0, :, 2:] = dx[:, :-1]
    bands[2, :, :-2] = dx[:, 1:]
    right[:, 1:-1] = 3 * (dx[:, 1:, None] * rise[:, :-1] + dx[:, :-1, None] * rise[:, 1:])
    for end, own, other, band in ((0, 0, 1, 0), (-1, -1, -2, 2)):
        both = dx[:, own] + dx[:, other]
        bands[1, :, end] = dx[:, other]
        bands[band, :, 1 if end == 0 else -2] = both
        p, q, d = dx[:, own, None], dx[:, other, None], both[:, None]
        right[:, end] = ((p + 2 * d) * q * rise[:, own] + p * p * rise[:, other]) / d
    slope = solve_banded((1, 1), bands.reshape(3, -1), right.reshape(-1, k)).reshape(values.shape)
    bend = (slope[:, :-1] + slope[:, 1:] - 2 * rise) / dx[..., None]
    pieces = np.stack(
        [bend / dx[..., None], (rise - slope[:, :-1]) / dx[..., None] - bend, slope[:, :-1], values[:, :-1]]
    )
    return pieces.transpose(0, 3, 1, 2)
