"""Points with covariances as the fits take them, checked, and the frame that they are fitted in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """Affine coordinates in which a conic is held: x_n = matrix @ (x − origin).

    Attributes
    ----------
    origin : (2,) ndarray [mm]
        Mean of the points.
    matrix : (2, 2) ndarray [1/mm]
        Scales the points' principal axes to unit variance.
    """

    origin: Array
    matrix: Array

    def apply(self, points: Array) -> Array:
        """Points (…, 2) [mm] in the frame."""
        return np.asarray((points - self.origin) @ self.matrix.T)

    def undo(self, points: Array) -> Array:
        """Points (…, 2) of the frame, on the board [mm]."""
        return np.asarray(self.origin + points @ np.linalg.inv(self.matrix).T)


def check_points(points: ArrayLike, least: int) -> Array:
    """Points as a finite (n, 2) array; a BenchsimError that says what is wrong otherwise."""
    x = np.asarray(points, float)
    if x.ndim != 2 or x.shape[1] != 2:
        raise BenchsimError(f"points for a conic are an array (n, 2) of y and z in mm, not of shape {x.shape}")
    if not np.all(np.isfinite(x)):
        raise BenchsimError(
            f"point {int(np.argmin(np.isfinite(x).all(axis=1)))} of the curve is nan or inf; drop it first"
        )
    if len(x) < least:
        raise BenchsimError(
            f"a conic with its uncertainty needs at least {least} points, not {len(x)}; record a longer trace"
        )
    return x


def check_covariance(covariance: ArrayLike | None, n: int) -> Array:
    """Covariances (n, 2, 2) from None (unit), a sigma, sigmas (n,), or covariances (n, 2, 2) or (2, 2)."""
    s = np.asarray(1.0 if covariance is None else covariance, float)
    if s.shape in ((), (n,)):
        if not np.all(np.isfinite(s)) or np.any(s <= 0):
            raise BenchsimError("the sigma of the curve's points must be positive and finite (mm); check sigma_mm")
        return np.broadcast_to(s**2, (n,))[:, None, None] * np.eye(2)
    if s.shape not in ((n, 2, 2), (2, 2)):
        raise BenchsimError(f"covariance of {n} points is a sigma, ({n},), or ({n}, 2, 2), not of shape {s.shape}")
    s = np.broadcast_to(s, (n, 2, 2))
    trace = s[:, 0, 0] + s[:, 1, 1]
    good = np.isfinite(s).all() and np.all(np.abs(s[:, 0, 1] - s[:, 1, 0]) <= 1e-6 * trace) and np.all(trace > 0)
    if not good or np.any(np.linalg.eigvalsh(s)[:, 0] < -1e-9 * trace):
        raise BenchsimError(
            "the covariances of the points must be finite, symmetric and not negative (mm²); check them"
        )
    return s


def check_common(common: ArrayLike | None, n: int) -> Array:
    """Common errors as (n, 2, k)."""
    k = np.zeros((n, 2, 0)) if common is None else np.asarray(common, float)
    if k.ndim != 3 or k.shape[:2] != (n, 2) or not np.all(np.isfinite(k)):
        raise BenchsimError(
            f"common errors of {n} points are a finite array ({n}, 2, k) in mm per sigma, not of shape {k.shape}"
        )
    return k


def whitening(points: Array) -> Frame:
    """Frame in which the points have zero mean and unit variance along and across their principal axis."""
    origin = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - origin, full_matrices=False)
    spread = spread / np.sqrt(len(points))
    if not spread[0] > 1e-12 * (1e-300 + np.max(np.abs(points))):
        raise BenchsimError("all points of the curve coincide; a conic needs points along an arc")
    # a line's depth is rounding: a floor keeps the frame regular
    spread = np.maximum(spread, 1e-9 * spread[0])
    return Frame(origin, axes / spread[:, None])
