"""The camera's lens: OpenCV's distortion (Brown's model), applied and undone in pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Camera

Array = NDArray[np.float64]


def undistort(camera: Camera, pixels: Array) -> Array:
    """Pixels as a camera of the same focal length without distortion would see them, (..., 2) px.

    Newton's method; nan where it does not converge to 1e-9 px, that is where the distortion folds the picture over
    (far outside it, or with coefficients that were extrapolated).
    """
    pixels = np.asarray(pixels, float)
    if not any(camera.distortion):
        return pixels.copy()
    ideal = pixels.copy()
    miss, inverse = np.inf, None
    for _ in range(12):
        residual = distort(camera, ideal) - pixels
        miss = np.abs(residual).max(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # Newton squares the miss: below 0.01 px the last derivative leaves less than 1e-7 of it.
            if inverse is None or np.any(miss > 1e-2):
                (a, b), (c, d) = np.moveaxis(distortion_jacobian(camera, ideal), (-2, -1), (0, 1))
                inverse = [x / (a * d - b * c) for x in (a, b, c, d)]
            a, b, c, d = inverse
            ru, rv = residual[..., 0], residual[..., 1]
            ideal = ideal - np.stack([d * ru - b * rv, a * rv - c * ru], axis=-1)
        if not np.any(miss > 1e-5):
            break
    return np.where(np.asarray(miss <= 1e-5)[..., None], ideal, np.nan)


def distort(camera: Camera, ideal: Array) -> Array:
    """Pixels at which a lens with Brown's distortion shows undistorted pixels, (..., 2) px."""
    k1, k2, p1, p2, k3 = camera.distortion
    c = np.asarray(camera.principal_point)
    x, y = np.moveaxis((np.asarray(ideal, float) - c) / camera.focal, -1, 0)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([xd, yd], axis=-1) * camera.focal + c


def distortion_jacobian(camera: Camera, ideal: Array) -> Array:
    """d(pixel)/d(undistorted pixel) at undistorted places, (..., 2, 2); invert it for the other direction."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = np.moveaxis((np.asarray(ideal, float) - np.asarray(camera.principal_point)) / camera.focal, -1, 0)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return np.stack(
        [
            np.stack([radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, mixed], axis=-1),
            np.stack([mixed, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x], axis=-1),
        ],
        axis=-2,
    )
