"""A curve on the board, as any of the models predicts it, and the distance of points from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

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
    """

    points: Array
    width: Array | None = None
    flux: Array | None = None
    phase: Array | None = None

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
    s_nodes = curve.arc_length()
    spline = CubicSpline(s_nodes, curve.points)
    first, second = spline.derivative(), spline.derivative(2)
    p = np.asarray(points, float)
    nearest = np.argmin(((p[:, None, :] - curve.points[None, :, :]) ** 2).sum(axis=-1), axis=1)
    s = s_nodes[nearest]
    for _ in range(8):
        d, t = p - spline(s), first(s)
        step = (d * t).sum(-1) / np.maximum((t * t).sum(-1) - (d * second(s)).sum(-1), 0.1)
        s = s + step
        if np.max(np.abs(step), initial=0.0) < 1e-12:
            break
    d, t = p - spline(s), first(s)
    return (t[:, 0] * d[:, 1] - t[:, 1] * d[:, 0]) / np.linalg.norm(t, axis=1), s
